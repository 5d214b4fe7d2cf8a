"""Fit relightable images: few numbers per pixel, from which a viewer computes the picture under any light.

    value_k = o_k(l) + sum_p c_p T_pk(l)

with c_p the pixel's coefficients (one plane each), l the direction of the light, k the channel. Polynomial texture maps
(ptm; Malzbender, Gelb and Wolters, 2001): six monomials of l_x and l_y a channel. Hemispherical harmonics (hsh; Gautron
and others, 2004): nine a channel. Radial basis functions over principal components (rbf; Ponchio, Corsini and
Scopigno, 2018): the components are shared by the channels; between the captured lights Gaussians interpolate. The same
at the nodes of a grid over the hemisphere (bilinear). Weights are computed as the viewers compute them, so that the fit
sees what will be shown.
"""

from dataclasses import dataclass

import numpy as np

from nishiki.formats.legacy_rti import hemispherical_harmonics
from nishiki.formats.relight import bilinear_weights, gaussian_weights, ptm_weights
from nishiki.formats.textured_surface import quantise
from nishiki.photometric.light_selection import distinct_sets

RIDGES = (0.0, 1e-4, 1e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0)
"""Candidate weights of the squared coefficients relative to the squared errors."""
WIDTHS = (0.05, 0.075, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.7)
"""Candidate widths of the Gaussians between lights, as distances of unit vectors."""
LEAST_REDUNDANCY = 1e-3
"""Share of a light's value predicted by others, below which leaving it out does not test a fit."""
GRID_SIDE = 8  # nodes along a side of the grid of bilinear
NODES = 0.006  # n: weight of a node's squared error beside that of a captured light
SLIGHT = 1e-6  # added to the normal matrix of components, which are orthogonal but for the rounding of their codes


HARMONICS = 3  # order: nine a channel
WEIGHTS = {"ptm": ptm_weights, "hsh": lambda lights: hemispherical_harmonics(lights, HARMONICS)}


@dataclass(frozen=True)
class HarmonicModel:
    """ptm or hsh: the same weights for every pixel and channel. design : (lights, bases) of the captured lights."""

    kind: str
    design: np.ndarray
    ridge: float
    colour_space: str = "rgb"

    @classmethod
    def of(cls, kind: str, lights: np.ndarray, values: np.ndarray, valid: np.ndarray) -> "HarmonicModel":
        """Choose the ridge that predicts left-out lights best, on sample pixels (lights, 3, n)."""
        design = WEIGHTS[kind](lights)
        whole = valid.all(axis=0)
        samples = (values[..., whole] if whole.any() else values).reshape(len(design), -1).astype(np.float64)
        errors = []
        for ridge in RIDGES:
            hat = design @ np.linalg.pinv(design.T @ design + penalty(design, ridge)) @ design.T
            kept = 1 - np.diag(hat)
            left_out = (samples - hat @ samples) / np.maximum(kept, LEAST_REDUNDANCY)[:, None]
            errors.append(float(np.mean(left_out**2)) if kept.min() > LEAST_REDUNDANCY else np.inf)
        return cls(kind, design, RIDGES[int(np.argmin(errors))])

    @property
    def planes(self) -> int:
        return 3 * self.design.shape[1]

    def transfer(self, light: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute o (3,) and T (planes, 3) for a unit vector towards the light."""
        weights = WEIGHTS[self.kind](np.asarray(light)[None])[0]
        return np.zeros(3), np.kron(weights[:, None], np.eye(3))

    def fit(self, values: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """Fit (planes, n) coefficients of pixels with values (lights, 3, n) where valid (lights, n) bool."""
        return solve(self.design, values, valid, penalty(self.design, self.ridge)).reshape(self.planes, -1)


@dataclass(frozen=True)
class TabulatedModel:
    """Principal components of all directions and channels together, in a table.

    mean_code : (directions, 3) uint8; codes : (planes, directions, 3) uint8 of the components; span : (planes,) units
    of a component's code.
    """

    mean_code: np.ndarray
    codes: np.ndarray
    span: np.ndarray

    @property
    def colour_space(self) -> str:
        return "mrgb"

    @property
    def planes(self) -> int:
        return len(self.codes)

    @property
    def mean(self) -> np.ndarray:
        """(directions, 3)."""
        return self.mean_code / 255

    @property
    def components(self) -> np.ndarray:
        """(planes, directions, 3) as viewers read them."""
        return (self.codes.astype(np.float64) - 127) / self.span[:, None, None]

    def weights(self, light: np.ndarray) -> np.ndarray:
        """Return (directions,) for one light, sum 1."""
        raise NotImplementedError

    def transfer(self, light: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        weights = self.weights(light)
        return weights @ self.mean, np.einsum("l,plk->pk", weights, self.components)


@dataclass(frozen=True)
class PrincipalModel(TabulatedModel):
    """rbf: the directions are those of the captured lights. lights : (L, 3); width : of the Gaussians between them."""

    lights: np.ndarray
    width: float
    kind: str = "rbf"

    @classmethod
    def of(cls, lights: np.ndarray, values: np.ndarray, valid: np.ndarray, planes: int) -> "PrincipalModel":
        """Compute components of sample pixels (lights, 3, n) at which all lights are valid, or of all without any."""
        rows = whole_pixels(values, valid, planes)
        mean_code = quantise(rows.mean(axis=0))
        components = principal_components((rows - mean_code / 255).reshape(len(rows), -1), planes)
        codes, span = coded_components(components.reshape(-1, *mean_code.shape))
        return cls(mean_code, codes, span, lights, chosen_width(lights, values, valid))

    def weights(self, light: np.ndarray) -> np.ndarray:
        """Return (lights,) of every captured light, sum 1."""
        return gaussian_weights(self.lights, light, self.width)

    def fit(self, values: np.ndarray, valid: np.ndarray) -> np.ndarray:
        design = self.components.reshape(self.planes, -1).T
        rows = (values - np.asarray(self.mean, np.float32)[..., None]).reshape(len(design), 1, -1)
        return solve(design, rows, valid, SLIGHT * np.eye(self.planes))[:, 0]


@dataclass(frozen=True)
class GridModel(TabulatedModel):
    """bilinear: the directions are nodes of a grid over the hemisphere, and so are the values that are fitted.

    metric : (nodes, nodes) lower triangle C; errors e of the nodes count as |C' e|^2.
    """

    metric: np.ndarray
    kind: str = "bilinear"

    @classmethod
    def of(cls, lights: np.ndarray, values: np.ndarray, valid: np.ndarray, planes: int) -> "GridModel":
        """Compute components of sample pixels (nodes, 3, n), accurate under captured lights (L, 3), less so at nodes.

        C C' = A'A + n I, with A the weights of the nodes under the lights.
        """
        between = grid_weights(lights)
        metric = np.linalg.cholesky(between.T @ between + NODES * np.eye(between.shape[1]))
        rows = whole_pixels(values, valid, planes)
        mean_code = quantise(rows.mean(axis=0))
        seen = np.einsum("ngk,gh->nhk", rows - mean_code / 255, metric, optimize=True)
        components = principal_components(seen.reshape(len(seen), -1), planes).reshape(-1, *mean_code.shape)
        codes, span = coded_components(np.einsum("phk,hg->pgk", components, np.linalg.inv(metric), optimize=True))
        return cls(mean_code, codes, span, metric)

    def weights(self, light: np.ndarray) -> np.ndarray:
        """Return (nodes,) of every node, sum 1."""
        return bilinear_weights(GRID_SIDE, light)

    def fit(self, values: np.ndarray, valid: np.ndarray) -> np.ndarray:
        weighted = np.einsum("gh,pgk->phk", self.metric, self.components).reshape(self.planes, -1)
        normal = weighted @ weighted.T + SLIGHT * np.eye(self.planes)
        design = np.einsum("phk,gh->pgk", weighted.reshape(self.components.shape), self.metric, optimize=True)
        shared = np.linalg.solve(normal, design.reshape(self.planes, -1)).astype(np.float32)
        rows = (values - np.asarray(self.mean, np.float32)[..., None]).reshape(shared.shape[1], -1)
        return np.where(valid.any(axis=0), shared @ rows, 0)


LightModel = HarmonicModel | PrincipalModel | GridModel


def grid_weights(lights: np.ndarray) -> np.ndarray:
    """Compute (lights, nodes) weights of the nodes of the grid."""
    return np.stack([bilinear_weights(GRID_SIDE, light) for light in lights])


def whole_pixels(values: np.ndarray, valid: np.ndarray, planes: int) -> np.ndarray:
    """Select values (n, directions, 3) of the pixels where all lights are valid; of all pixels if these are too few."""
    whole = valid.all(axis=0)
    return (values[..., whole] if whole.sum() > planes else values).transpose(2, 0, 1).astype(np.float64)


def principal_components(rows: np.ndarray, planes: int) -> np.ndarray:
    """Compute (planes, variables) right singular vectors of rows (n, variables), the largest first.

    From the smaller of the two matrices of products; fewer than `planes`, by threes, where rows or variables are few.
    """
    planes = min(planes, 3 * (min(rows.shape) // 3))
    if len(rows) < rows.shape[1]:
        return np.linalg.svd(rows, full_matrices=False)[2][:planes]
    return np.linalg.eigh(rows.T @ rows)[1][:, ::-1][:, :planes].T


def coded_components(components: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Quantise components (planes, directions, 3) to uint8; return the codes and their units (planes,)."""
    span = 127 / np.maximum(np.abs(components).max(axis=(1, 2)), 1e-6)
    return (np.rint(components * span[:, None, None]) + 127).astype(np.uint8), span


def chosen_width(lights: np.ndarray, values: np.ndarray, valid: np.ndarray) -> float:
    """Choose the width of WIDTHS that best predicts each light from the others."""
    samples = values.reshape(len(lights), -1).astype(np.float64)
    counted = np.tile(valid, (1, 3))
    others = ~np.eye(len(lights), dtype=bool)
    errors = []
    for width in WIDTHS:
        weights = np.zeros((len(lights), len(lights)))
        for number, rest in enumerate(others):
            weights[number, rest] = gaussian_weights(lights[rest], lights[number], width)
        errors.append(float(np.sum(np.where(counted, weights @ samples - samples, 0) ** 2)))
    return WIDTHS[int(np.argmin(errors))]


def penalty(design: np.ndarray, ridge: float) -> np.ndarray:
    """Return (bases, bases) to add to the normal matrix: the ridge a light and coefficient, none on the constant."""
    return ridge * len(design) * np.diag(np.arange(design.shape[1]) > 0).astype(float)


def solve(design: np.ndarray, values: np.ndarray, valid: np.ndarray, below: np.ndarray) -> np.ndarray:
    """Solve least squares of pixels over their valid lights: one matrix for each set of lights that are valid.

    Parameters
    ----------
    design : (lights, bases) or (lights * colours, bases) ndarray
    values : (rows of the design, channels, n) ndarray of float32
    valid : (lights, n) ndarray of bool
    below : (bases, bases) ndarray
        Added to the normal matrix.

    Returns
    -------
    (bases, channels, n) ndarray of float64; 0 for pixels without a valid light.
    """
    counts = valid.sum(axis=0)
    partial = np.flatnonzero((counts > 0) & (counts < len(valid)))
    colours = len(design) // len(valid)
    if len(partial) or not counts.all():
        values = (values.reshape(len(valid), -1, valid.shape[1]) * valid[:, None]).reshape(values.shape)
    right = np.float32(design).T @ values.reshape(len(values), -1)
    fitted = (np.linalg.inv(design.T @ design + below) @ right).reshape(-1, *values.shape[1:])
    if len(partial):
        first, member = distinct_sets(valid[:, partial])
        counted = np.repeat(valid[:, partial[first]].T, colours, axis=1).astype(np.float64)
        outer = (design[:, :, None] * design[:, None, :]).reshape(len(design), -1)
        normal = (counted @ outer).reshape(-1, *below.shape) + below + 1e-9 * np.eye(len(below))
        sums = right.reshape(fitted.shape)[..., partial].transpose(2, 0, 1)
        fitted[..., partial] = (np.linalg.inv(normal)[member] @ sums).transpose(1, 2, 0)
    return fitted
