"""Relightable images: every pixel's photographs as few numbers, from which a viewer computes any light.

    value_k = o_k(l) + sum_p c_p T_pk(l)

with c_p the pixel's coefficients (one plane each), l the direction of the light, k the channel. Polynomial texture maps
(ptm; Malzbender, Gelb and Wolters, 2001): six monomials of l_x and l_y a channel. Hemispherical harmonics (hsh; Gautron
and others, 2004): nine a channel. Radial basis functions over principal components (rbf; Ponchio, Corsini and
Scopigno, 2018): the components are shared by the channels; between the captured lights Gaussians interpolate. The same
at the nodes of a grid over the hemisphere (bilinear). Weights are computed as the viewers compute them, so that the fit
sees what will be shown.
"""

from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np

from nishiki.formats.hsh import hemispherical_harmonics
from nishiki.formats.relight_weights import bilinear_weights, gaussian_weights, ptm_weights

RIDGES = (0.0, 1e-4, 1e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0)
"""Weights of the squared coefficients beside the squared errors, of those that are tried."""
WIDTHS = (0.05, 0.075, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.7)
"""Widths of the Gaussians between lights, as distances of unit vectors, of those that are tried."""
LEAST_REDUNDANCY = 1e-3
"""Share of a light's value that does not come from itself, below which leaving it out says nothing of a fit."""
GRID_SIDE = 8  # nodes along a side of the grid of bilinear
NODES = 0.006  # n: weight of a node's squared error beside that of a captured light
SLIGHT = 1e-6  # added to the normal matrix of components, which are orthogonal but for the rounding of their codes


class LightModel(Protocol):
    """One kind of relightable image.

    kind, colour_space : words of info.json; planes : number of coefficients a pixel.
    """

    kind: str
    colour_space: str

    @property
    def planes(self) -> int: ...

    def transfer(self, light: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """o (3,) and T (planes, 3) for a unit vector towards the light."""
        ...

    def fit(self, values: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """(n, planes) coefficients of pixels with values (n, lights, 3) where valid (n, lights) bool."""
        ...


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
        """With the ridge that predicts left-out lights best, on sample pixels (n, lights, 3)."""
        design = WEIGHTS[kind](lights)
        return cls(kind, design, chosen_ridge(design, values, valid))

    @property
    def planes(self) -> int:
        return 3 * self.design.shape[1]

    def transfer(self, light: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        weights = WEIGHTS[self.kind](np.asarray(light)[None])[0]
        return np.zeros(3), np.kron(weights[:, None], np.eye(3))

    def fit(self, values: np.ndarray, valid: np.ndarray) -> np.ndarray:
        return solve(self.design, values, valid, penalty(self.design, self.ridge)).reshape(len(values), -1)


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
        """(directions,) for one light, sum 1."""
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
        """Components of sample pixels (n, lights, 3) at which all lights are valid, or of all pixels without any."""
        rows = whole_pixels(values, valid, planes)
        mean_code = coded_mean(rows)
        components = principal_components((rows - mean_code / 255).reshape(len(rows), -1), planes)
        codes, span = coded_components(components.reshape(-1, *mean_code.shape))
        return cls(mean_code, codes, span, lights, chosen_width(lights, values, valid))

    def weights(self, light: np.ndarray) -> np.ndarray:
        """(lights,) of every captured light, sum 1."""
        return gaussian_weights(self.lights, light, self.width)

    def fit(self, values: np.ndarray, valid: np.ndarray) -> np.ndarray:
        design = self.components.reshape(self.planes, -1).T
        rows = (values - self.mean).reshape(len(values), -1, 1)
        return solve(design, rows, np.repeat(valid, 3, axis=1), SLIGHT * np.eye(self.planes))[..., 0]


@dataclass(frozen=True)
class GridModel(TabulatedModel):
    """bilinear: the directions are nodes of a grid over the hemisphere, and so are the values that are fitted.

    metric : (nodes, nodes) lower triangle C; errors e of the nodes count as |C' e|^2.
    """

    metric: np.ndarray
    kind: str = "bilinear"

    @classmethod
    def of(cls, lights: np.ndarray, values: np.ndarray, valid: np.ndarray, planes: int) -> "GridModel":
        """Components of sample pixels (n, nodes, 3) that err least under captured lights (L, 3), and little at nodes.

        C C' = A'A + n I, with A the weights of the nodes under the lights.
        """
        between = grid_weights(lights)
        metric = np.linalg.cholesky(between.T @ between + NODES * np.eye(between.shape[1]))
        rows = whole_pixels(values, valid, planes)
        mean_code = coded_mean(rows)
        seen = np.einsum("ngk,gh->nhk", rows - mean_code / 255, metric, optimize=True)
        components = principal_components(seen.reshape(len(seen), -1), planes).reshape(-1, *mean_code.shape)
        codes, span = coded_components(np.einsum("phk,hg->pgk", components, np.linalg.inv(metric), optimize=True))
        return cls(mean_code, codes, span, metric)

    def weights(self, light: np.ndarray) -> np.ndarray:
        """(nodes,) of every node, sum 1."""
        return bilinear_weights(GRID_SIDE, light)

    def fit(self, values: np.ndarray, valid: np.ndarray) -> np.ndarray:
        design = np.einsum("gh,pgk->hkp", self.metric, self.components).reshape(-1, self.planes)
        rows = np.einsum("ngk,gh->nhk", values - self.mean, self.metric, optimize=True).reshape(len(values), -1, 1)
        return solve(design, rows, np.repeat(valid, 3, axis=1), SLIGHT * np.eye(self.planes))[..., 0]


def grid_weights(lights: np.ndarray) -> np.ndarray:
    """(lights, nodes) of the nodes of the grid."""
    return np.stack([bilinear_weights(GRID_SIDE, light) for light in lights])


def whole_pixels(values: np.ndarray, valid: np.ndarray, planes: int) -> np.ndarray:
    """Values (n, lights, 3) of the pixels at which all lights are valid; of all pixels where these are too few."""
    whole = valid.all(axis=1)
    return values[whole] if whole.sum() > planes else values


def coded_mean(rows: np.ndarray) -> np.ndarray:
    """(directions, 3) uint8 of values (n, directions, 3)."""
    return np.rint(255 * np.clip(rows.mean(axis=0), 0, 1)).astype(np.uint8)


def principal_components(rows: np.ndarray, planes: int) -> np.ndarray:
    """(planes, variables) right singular vectors of rows (n, variables), the largest first.

    From the smaller of the two matrices of products; fewer than `planes`, by threes, where rows or variables are few.
    """
    planes = min(planes, 3 * (min(rows.shape) // 3))
    if len(rows) < rows.shape[1]:
        return np.linalg.svd(rows, full_matrices=False)[2][:planes]
    return np.linalg.eigh(rows.T @ rows)[1][:, ::-1][:, :planes].T


def coded_components(components: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Codes (planes, directions, 3) uint8 of components, and units of a code (planes,)."""
    span = 127 / np.maximum(np.abs(components).max(axis=(1, 2)), 1e-6)
    return (np.rint(components * span[:, None, None]) + 127).astype(np.uint8), span


class OpenLimeModel(PrincipalModel):
    """rbf as OpenLIME 1.2 shows it: `width` is not looked at, the Gaussians are as wide as the lights are far apart."""

    @classmethod
    def like(cls, model: PrincipalModel) -> "OpenLimeModel":
        """The same planes, shown by OpenLIME."""
        return cls(**{field.name: getattr(model, field.name) for field in fields(model)})

    def weights(self, light: np.ndarray) -> np.ndarray:
        """exp(-8 d^2 / m) of distances d, with m their mean weighted by exp(-2 d); sum 1."""
        distances = np.linalg.norm(self.lights - light, axis=1)
        near = np.exp(-2 * distances)
        mean = distances @ near / near.sum()
        weights = np.exp(-8 * distances**2 / max(mean, 1e-9))
        return weights / weights.sum()


def chosen_ridge(design: np.ndarray, values: np.ndarray, valid: np.ndarray) -> float:
    """The ridge of RIDGES with the smallest squared error of lights left out one at a time (closed form)."""
    whole = valid.all(axis=1)
    samples = (values[whole] if whole.any() else values).transpose(1, 0, 2).reshape(len(design), -1)
    errors = []
    for ridge in RIDGES:
        hat = design @ np.linalg.pinv(design.T @ design + penalty(design, ridge)) @ design.T
        kept = 1 - np.diag(hat)
        left_out = (samples - hat @ samples) / np.maximum(kept, LEAST_REDUNDANCY)[:, None]
        errors.append(float(np.mean(left_out**2)) if kept.min() > LEAST_REDUNDANCY else np.inf)
    return RIDGES[int(np.argmin(errors))]


def chosen_width(lights: np.ndarray, values: np.ndarray, valid: np.ndarray) -> float:
    """The width of WIDTHS with which the others predict a light best."""
    samples = values.transpose(1, 0, 2).reshape(len(lights), -1)
    counted = np.repeat(valid.T, 3, axis=1)
    others = ~np.eye(len(lights), dtype=bool)
    errors = []
    for width in WIDTHS:
        weights = np.zeros((len(lights), len(lights)))
        for number, rest in enumerate(others):
            weights[number, rest] = gaussian_weights(lights[rest], lights[number], width)
        errors.append(float(np.sum(np.where(counted, weights @ samples - samples, 0) ** 2)))
    return WIDTHS[int(np.argmin(errors))]


def penalty(design: np.ndarray, ridge: float) -> np.ndarray:
    """(bases, bases) added to the normal matrix: the ridge a light and coefficient, none on the first, the constant."""
    return ridge * len(design) * np.diag(np.arange(design.shape[1]) > 0).astype(float)


def solve(design: np.ndarray, values: np.ndarray, valid: np.ndarray, below: np.ndarray) -> np.ndarray:
    """(n, bases, channels): least squares of values (n, rows, channels) over the rows (n, rows) that are valid.

    below : (bases, bases) added to the normal matrix.
    """
    shared = np.linalg.solve(design.T @ design + below, design.T)
    fitted = np.einsum("br,nrk->nbk", shared, values, optimize=True)
    fitted[~valid.any(axis=1)] = 0
    partial = np.flatnonzero(valid.any(axis=1) & ~valid.all(axis=1))
    if len(partial):
        weight = valid[partial].astype(np.float64)
        outer = (design[:, :, None] * design[:, None, :]).reshape(len(design), -1)
        normal = (weight @ outer).reshape(-1, *below.shape) + below + 1e-9 * np.eye(len(below))
        right = np.einsum("rb,nrk->nbk", design, values[partial] * weight[..., None], optimize=True)
        fitted[partial] = np.linalg.solve(normal, right)
    return fitted
