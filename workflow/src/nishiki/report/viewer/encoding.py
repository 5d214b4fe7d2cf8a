"""Encode the maps of a painting in 8 bits for the viewer's textures, in steps of even visibility.

Reflectance. With Y the luminance of a pixel's reflectance under daylight and sigma its coefficients,

    u = Y^(1/3),    sigma = u^3 d + u^2 (m + sum_j q_j b_j),    Y(d) = 1, Y(m) = Y(b_j) = 0.

u is CIELAB's lightness but for a factor, and equal steps of q are about equal steps of its a* and b* at any lightness,
because dX^(1/3) = X^(-2/3) dX / 3. The b_j are the principal axes of sigma / u^2 in the metric in which the squared
distance is the mean squared difference in (a*, b*, L*) under several lamps; axes that no step of the code could show
are left out.

Normals. s = (n_x, n_y) / (1 + n_z), the stereographic projection, in a code that is finer for small tilts,
s = w t (k + (1 - k) t^2) with -1 <= t <= 1.

Body shading. Its terms (a, b, d[, e_x, e_y]) are given by their factors f at a few directions of light, rotated to
principal axes: a step is then a relative step of the light that leaves a pixel.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from nishiki.colour.colour import illuminant, white_xyz, xyz_matrix

TOP = int(np.iinfo(np.uint8).max)  # largest code
EVEN_TOP = TOP - 1  # of tilts, so that none has a code
LAMPS = ("D65", "A", "F2", "F11")
"""Lamps under which colours have to be right."""
BAND_SHARE = 0.02
"""Weight of a spectrum's own squared difference, relative to its visible difference: metameric parts are kept."""
LEAST_LUMINANCE = 1e-5  # of a white
SEEN = 0.25
"""Smallest spread of values in steps; principal axes with less are omitted."""
BRIGHT = 98
"""Percentile of the luminance displayed as 0.8 of white: steps are those of the picture at that exposure."""
FARTHEST = 99.95
"""Percentile of a plane's values covered by its code."""
DIRECTIONS = ((0.0, 0.0), (45.0, 0.0), (45.0, 90.0), (45.0, 180.0), (45.0, 270.0), (75.0, 45.0), (75.0, 225.0))
"""Polar angle and azimuth in degrees of the lights for comparing body shadings."""


@dataclass(frozen=True)
class Steps:
    """Steps of the codes.

    Of colour in CIELAB, of small tilts in s (the angle is twice as large), of the body shading as a share of the light.
    """

    colour: float
    tilt: float
    shading: float

    def scale(self, colour: float) -> "Steps":
        """Scale all steps in the proportion that gives this step of colour."""
        factor = colour / self.colour
        return Steps(colour, self.tilt * factor, self.shading * factor)


@dataclass(frozen=True)
class PlaneCode:
    """Values of one plane as codes 0 to 255, linearly from `low` to `high`."""

    low: float
    high: float

    @classmethod
    def over(cls, values: np.ndarray, step: float) -> "PlaneCode":
        """Return a code of this step, or of a wider one where the values (n,) require it, centred on them."""
        low, high = np.percentile(values, (100 - FARTHEST, FARTHEST)) if values.size else (0.0, 0.0)
        half = max(float(high - low), step * TOP) / 2
        return cls(float(low + high) / 2 - half, float(low + high) / 2 + half)

    def encode(self, values: np.ndarray) -> np.ndarray:
        """Return uint8 codes."""
        return np.clip(np.rint((values - self.low) * (TOP / (self.high - self.low))), 0, TOP).astype(np.uint8)


@dataclass(frozen=True)
class PrincipalCode:
    """Vectors (..., n) as codes along principal axes: values = mean + codes' values @ components."""

    mean: np.ndarray  # (n,)
    components: np.ndarray  # (planes, n)
    projections: np.ndarray  # (n, planes)
    planes: tuple[PlaneCode, ...]

    @classmethod
    def of(cls, vectors: np.ndarray, features: np.ndarray, step: float) -> "PrincipalCode":
        """Fit to vectors (samples, n); features (n, m): their visible effect. Axes below `SEEN` steps are dropped."""
        mean = vectors.mean(axis=0)
        root = np.linalg.cholesky(
            features @ features.T + 1e-12 * np.trace(features @ features.T) * np.eye(len(features))
        )
        centred = (vectors - mean) @ root
        values, axes = np.linalg.eigh(centred.T @ centred / max(len(centred), 1))
        order = [k for k in np.argsort(-values, kind="stable") if values[k] > (SEEN * step) ** 2]
        axes = axes[:, order]
        axes = axes * np.where(axes.sum(axis=0) < 0, -1, 1)
        projections = root @ axes
        components = np.linalg.solve(root.T, axes).T
        codes = centred @ axes
        return cls(mean, components, projections, tuple(PlaneCode.over(column, step) for column in codes.T))

    def encode(self, vectors: np.ndarray) -> list[np.ndarray]:
        """Return one array of codes a plane."""
        values = (vectors - self.mean.astype(np.float32)) @ self.projections.astype(np.float32)
        return [plane.encode(values[..., k]) for k, plane in enumerate(self.planes)]

    def backwards(self) -> "PrincipalCode":
        """Return the same with the axes of the smallest spread first."""
        return PrincipalCode(self.mean, self.components[::-1], self.projections[:, ::-1], self.planes[::-1])

    def describe(self) -> dict[str, Any]:
        """Return the parameters for the manifest."""
        return {
            "mean": self.mean.tolist(),
            "components": self.components.tolist(),
            "low": [plane.low for plane in self.planes],
            "high": [plane.high for plane in self.planes],
        }


@dataclass(frozen=True)
class ColourCode:
    """Coefficients of the reflectance; see the head of this module."""

    luminance: np.ndarray  # (K,) Y of each coefficient under daylight
    direction: np.ndarray  # (K,) d
    lightness: PlaneCode
    chroma: PrincipalCode

    @classmethod
    def of(
        cls, coefficients: np.ndarray, to_xyz: list[np.ndarray], basis: np.ndarray | None, step: float
    ) -> "ColourCode":
        """Fit to coefficients (samples, K); to_xyz: (3, K) of each lamp, the first being daylight; step: in CIELAB."""
        luminance = to_xyz[0][1]
        mean = coefficients.mean(axis=0)
        if not luminance @ mean > LEAST_LUMINANCE:
            mean = luminance / (luminance @ luminance)
        direction = mean / (luminance @ mean)
        code = cls(luminance, direction, PlaneCode(0, 1), PrincipalCode(mean, np.zeros((0, 0)), mean, ()))
        lightness, rest = code._split(coefficients)
        bright, top = np.percentile(lightness, (BRIGHT, FARTHEST)) if lightness.size else (1.0, 1.0)
        step = step / 116 * float(bright) / 0.8 ** (1 / 3)
        top = max(float(top), step / 2 * TOP)
        # differences of L*, a*, b* in units of 116, times Y^(2/3), under each lamp
        thirds = (matrix / 3 for matrix in to_xyz)
        seen = [np.stack([y, 500 / 116 * (x - y), 200 / 116 * (y - z)], axis=1) for x, y, z in thirds]
        bands = [] if basis is None else [basis * np.sqrt(BAND_SHARE / basis.shape[1])]
        features = np.concatenate([item / np.sqrt(len(seen)) for item in seen] + bands, axis=1)
        # the lightness of the first lamp is coded apart: along its own direction nothing is left to see
        return cls(luminance, direction, PlaneCode(0.0, top), PrincipalCode.of(rest, features, step))

    def _split(self, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        y = np.maximum(coefficients @ self.luminance.astype(np.float32), np.float32(LEAST_LUMINANCE))
        u = np.cbrt(y)
        return u, (coefficients - y[..., None] * self.direction.astype(np.float32)) / (u * u)[..., None]

    def encode(self, coefficients: np.ndarray) -> list[np.ndarray]:
        """Return one array of codes a plane, that of the lightness first."""
        u, rest = self._split(coefficients)
        return [self.lightness.encode(u), *self.chroma.encode(rest)]

    def describe(self) -> dict[str, Any]:
        """Return the parameters for the manifest."""
        return {"direction": self.direction.tolist(), "top": self.lightness.high, **self.chroma.describe()}


def colour_matrices(basis: np.ndarray | None, channels_to_xyz: np.ndarray) -> list[np.ndarray]:
    """Compute matrices (3, K) of `LAMPS`, relative to their whites; channels_to_xyz: (3, 3), used without a basis."""
    if basis is None:
        return [channels_to_xyz / white_xyz(illuminant("D65"))[:, None]]
    spectra = [illuminant(name) for name in LAMPS]
    return [xyz_matrix(lamp, basis) / white_xyz(lamp)[:, None] for lamp in spectra]


@dataclass(frozen=True)
class NormalCode:
    """Unit normals; see the head of this module."""

    width: float
    fineness: float

    @classmethod
    def of(cls, normals: np.ndarray, step: float) -> "NormalCode":
        """Fit to normals (samples, 3)."""
        tilts = np.abs(_stereographic(normals))
        farthest = min(np.percentile(tilts, FARTHEST), 1.0) if tilts.size else 1.0
        width = float(max(farthest, step * TOP / 2))
        return cls(width, float(np.clip(step * TOP / 2 / width, 0.1, 1.0)))

    def encode(self, normals: np.ndarray) -> list[np.ndarray]:
        """Return codes of the two planes."""
        nodes = np.linspace(-1, 1, 4096)
        curve = self.width * nodes * (self.fineness + (1 - self.fineness) * nodes**2)
        t = np.interp(_stereographic(normals), curve, nodes)
        codes = np.rint((t + 1) * (EVEN_TOP / 2)).astype(np.uint8)
        return [codes[..., 0], codes[..., 1]]

    def describe(self) -> dict[str, Any]:
        """Return the parameters for the manifest."""
        return {"width": self.width, "fineness": self.fineness}


def _stereographic(normals: np.ndarray) -> np.ndarray:
    return normals[..., :2] / np.maximum(1 + normals[..., 2:], 1e-3)


def shading_features(terms: int) -> np.ndarray:
    """Compute (terms, directions): each term of the body shading at `DIRECTIONS` for a facet that faces the eye."""
    polar, azimuth = np.radians(np.array(DIRECTIONS)).T
    cosine, half = np.cos(polar), np.cos(polar / 2)
    across = np.sin(polar) * np.array([np.cos(azimuth), np.sin(azimuth)])
    rows = [np.ones_like(cosine), cosine, half**8, *across]
    return np.array(rows[:terms]) / np.sqrt(len(polar))
