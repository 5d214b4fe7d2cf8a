"""Evaluate and fit two models that a cloth's default model is compared with: no user needs them.

`ScaledBard` takes the published law of normal incidence with the best factor of every measured incidence.

The facet reading: light along the normal is mirrored into the view o by facets of normal h = (z + o) / |z + o|, at
theta_r / 2:

    rho(o) - rho_d = F(h.o) D(h) G1(o) / (4 cos theta_r),

so every view tells D at one tilt up to 45 degrees.  G1, the share of facets seen that face the view, follows from D
itself (Smith, Geometrical shadowing of a random rough surface, 1967): G1(o) = o_z int D (m.z) dm / int D (m.o)+ dm,
here by quadrature for the very D, anisotropic as it is; D and G1 are iterated.  Prediction, reciprocal by
construction:

    f(i, o) = rho_d + F(h.i) D(h) G1(i) G1(o) / (4 cos theta_i cos theta_r).

Facets steeper than 45 degrees are unseen: log D goes on there as a straight line in tan^2 of
the tilt (a bell of slopes) with the slope of the last degrees, never rising.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from nishiki.brdf.cloth.interface import halves, incidences, only_above, solid_angles
from nishiki.brdf.cloth.models import Fitted
from nishiki.brdf.cloth.normal_incidence import GreatCircleBard, great_circle_view
from nishiki.brdf.cloth.yarn_fit import Measured
from nishiki.brdf.torrance_sparrow import fresnel
from nishiki.formats.stored import ArrayFields
from nishiki.goniometry.interpolation import coefficients, evaluate

REFERENCES = ("facets", "bard_scaled")


@dataclass(frozen=True)
class ScaledBard(GreatCircleBard):
    """The great circle with the best single factor of every measured incidence: what no amplitude law can beat.

    It needs oblique measurements all over the hemisphere, so it is a reference, not a method; an incidence takes the
    factor of the nearest measured one.
    """

    KIND: ClassVar[str] = "bard_scaled"
    directions: np.ndarray  # (k, 3) measured incidences
    factors: np.ndarray  # (k,)

    def evaluate(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """BRDF, 1 / sr: (..., channels)."""
        incident = np.asarray(incident, float)
        factor = self.factors[np.argmax(incident @ self.directions.T, axis=-1)]
        return self._law(incident, outgoing, great_circle_view(incident, outgoing), factor)

    @classmethod
    def fit(cls, values: np.ndarray, groups, outgoing: np.ndarray, measured: np.ndarray, weights: np.ndarray):
        """Best factors in the weighted least-squares sense.

        groups: (direction (3,), rows) of every incidence; outgoing (n, 3); measured (n, channels); weights (n,).
        """
        law = GreatCircleBard.of(values)
        factors = []
        for direction, rows in groups:
            shape = law.basic(great_circle_view(direction, outgoing[rows]))
            weighted = shape * weights[rows, None]
            factors.append(np.sum(weighted * measured[rows]) / max(np.sum(weighted * shape), 1e-300))
        return cls(law.values, law.diffuse, directions=np.array([d for d, _ in groups]), factors=np.array(factors))


TILTS, TURNS = 61, 48  # grid of D: 1.5 by 7.5 degrees
ROUNDS = 8  # passes
SEEN = np.radians(43.6)  # steepest facet read: views beyond 87 degrees are extrapolated
FITTED = np.radians(12.0)  # of the seen ones, those that tell how D goes on
_LAST = 89.0  # degrees; tan^2 beyond is not needed


@dataclass(frozen=True)
class FacetBrdf(ArrayFields):
    """rho_d + F D G1 G1 / (4 cos cos): light and view are masked each for itself."""

    KIND: ClassVar[str] = "facets"
    RECIPROCAL: ClassVar[bool] = True
    density: np.ndarray  # (TILTS, TURNS) D, 1 / sr; tilt 0 .. pi/2, azimuth 0 .. 2 pi
    masking: np.ndarray  # (TILTS, TURNS) G1 by the direction
    diffuse: np.ndarray  # (channels,) rho_d, 1 / sr
    index: float  # refractive index

    @property
    def channels(self) -> int:
        """Number of channels."""
        return int(np.size(self.diffuse))

    @cached_property
    def _splines(self) -> tuple[np.ndarray, np.ndarray]:
        return coefficients(self.density[..., None]), coefficients(self.masking[..., None])

    def evaluate(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """BRDF, 1 / sr: (..., channels)."""
        incident, outgoing = np.broadcast_arrays(np.asarray(incident, float), np.asarray(outgoing, float))
        g = halves(incident, outgoing)
        density, masking = self._splines
        light, view = (np.clip(evaluate(masking, d)[..., 0], 1e-12, 1) for d in (incident, outgoing))
        mirror = fresnel(g.cos_d, self.index) * evaluate(density, g.h)[..., 0] * light * view / (4 * g.cos_i * g.cos_r)
        return only_above(g.above, mirror[..., None] + self.diffuse)


def read_facets(basic, *, index: float = 1.5, diffuse=None) -> FacetBrdf:
    """Read D off normal incidence; basic: function of views (..., 3) giving the reflectance (..., channels), 1 / sr.

    diffuse (channels,), 1 / sr: rho_d; default: the least reflectance over the hemisphere.  index: the result
    depends little on it, for D takes up its inverse.
    """
    tilt, turn = np.linspace(0, np.pi / 2, TILTS), np.arange(TURNS) * (2 * np.pi / TURNS)
    grid = np.stack(np.meshgrid(tilt, turn, indexing="ij"), axis=-1)
    directions = _unit(grid[..., 0], grid[..., 1])
    views = _unit(np.minimum(2 * grid[..., 0], np.pi / 2), grid[..., 1])
    measured = basic(views)
    unit = float(measured.max())
    unit = unit if unit > 0 else 1.0  # everything below is relative to the largest value: the result scales with it
    measured = measured / unit
    least = measured.reshape(-1, measured.shape[-1]).min(axis=0)
    diffuse = least if diffuse is None else np.broadcast_to(np.asarray(diffuse, float) / unit, least.shape)
    gloss = np.maximum((measured - diffuse).mean(axis=-1), 1e-3 * measured.mean())
    half = np.cos(np.minimum(grid[..., 0], SEEN))
    plain = gloss * 4 * np.maximum(views[..., 2], 0.02) / fresnel(half, index)
    seen, masking = tilt <= SEEN + 1e-9, np.ones(plain.shape)
    facing = np.maximum(directions.reshape(-1, 3) @ directions.reshape(-1, 3).T, 0.0)
    for _ in range(ROUNDS):
        at_view = evaluate(coefficients(masking[..., None]), views)[..., 0]
        density = _continued(np.maximum(plain / np.clip(at_view, 0.02, 1), 1e-12), tilt, seen)
        masking = smith_masking(density, directions, tilt, facing=facing)
    return FacetBrdf(density * unit, masking, unit * np.array(diffuse, float), float(index))


def _unit(theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
    z = np.maximum(np.cos(theta), 0.0)
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), z], axis=-1)


def _continued(density: np.ndarray, tilt: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """D with the facets steeper than SEEN supplied, azimuth by azimuth."""
    slope2 = np.tan(np.minimum(tilt, np.radians(_LAST))) ** 2
    used = seen & (tilt > SEEN - FITTED)
    logs, x = np.log(density[used]), slope2[used]
    x0 = x - x.mean()
    fall = np.minimum((x0 @ logs) / (x0 @ x0), -1e-3)
    # azimuths tell the fall badly one by one: each takes the mean over 25 degrees
    fall = np.mean([np.roll(fall, k) for k in range(-2, 3)], axis=0)
    out = density.copy()
    last = np.flatnonzero(seen)[-1]
    out[~seen] = density[last] * np.exp(np.maximum((slope2[~seen, None] - slope2[last]) * fall, -60.0))
    return out


def smith_masking(density: np.ndarray, directions: np.ndarray, tilt: np.ndarray, *, facing=None) -> np.ndarray:
    """G1 (TILTS, TURNS) of the directions on the grid, by quadrature over the facets on the same grid.

    facing: (m.o)+ of all facets and directions of the grid, where it is known already.
    """
    area = np.full(tilt.size, tilt[1] - tilt[0]) * np.sin(tilt) * (2 * np.pi / density.shape[1])
    area[-1] /= 2
    weights = (density * area[:, None]).ravel()
    normals = directions.reshape(-1, 3)
    facing = np.maximum(normals @ normals.T, 0.0) if facing is None else facing
    seen = normals[:, 2] * (weights @ normals[:, 2]) / np.maximum(facing @ weights, 1e-300)
    return np.clip(seen, 1e-9, 1.0).reshape(density.shape)


def fit_scaled(measured: Measured, valid: np.ndarray, grid: np.ndarray) -> ScaledBard:
    selected = measured.take(valid)
    weights = np.empty(valid.size)
    groups = []
    for _, _, rows in incidences(selected.incident):
        groups.append((selected.incident[rows[0]], rows))
        weights[rows] = selected.outgoing[rows, 2] * solid_angles(selected.outgoing[rows])
    return ScaledBard.fit(grid, groups, selected.outgoing, selected.values, weights)


def fit_reference(name: str, measured: Measured, basic) -> Fitted:
    """Fit one of REFERENCES; basic as of `nishiki.brdf.cloth.models.fit_models`."""
    valid = np.flatnonzero(np.isfinite(measured.values).all(axis=1))
    if name == "bard_scaled":
        return Fitted(fit_scaled(measured, valid, basic[1]), valid)
    return Fitted(read_facets(basic[0]), valid[measured.normal[valid]])
