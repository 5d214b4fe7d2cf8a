"""Predict oblique reflectance from normal incidence: the published shift of the pattern, and a facet distribution.

The paper's law (Takeda et al., eq. 5-9), the baseline: light from theta_i moves every point of the pattern in the plane
of the view V and of R_xy, the mirror direction projected on the cloth: with beta the angle from R_xy to V,

    beta0 = (pi/2) / (pi/2 - theta_i) beta                             for beta <= pi/2 - theta_i,
    beta0 = ((pi/2) beta + pi theta_i) / (pi/2 + theta_i)              otherwise,
    f(i, o) = rho_d + rho0(V0) / cos^2 theta_i,

V0 at the angle beta0 on the great circle from R_xy through V (exact), or by Takeda et al., eq. 8-9, which turns both
spherical coordinates in the same ratio (the paper's linear approximation).  Neither is reciprocal nor keeps energy.

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

from nishiki.brdf.cloth.interface import halves, only_above
from nishiki.brdf.torrance_sparrow import fresnel
from nishiki.formats.fields import ArrayFields
from nishiki.goniometry.interpolation import coefficients, evaluate

GRAZING_COSINE = float(np.cos(np.radians(89.0)))  # 1 / cos^2 goes on as a constant beyond 89 degrees
UPRIGHT = 1e-290  # sine of theta_i below which light is along the normal: the digits of its azimuth are lost
_HALF_PI = np.pi / 2


def stretched_angle(beta: np.ndarray, theta_i: np.ndarray) -> np.ndarray:
    """beta0 of Takeda et al., eq. 6, radians: 0 at 0, pi/2 at pi/2 - theta_i, pi at pi; beta itself at theta_i = 0.

    At theta_i = pi/2 the first branch has no extent and beta0 = (beta + pi) / 2.
    """
    beta, theta_i = np.broadcast_arrays(np.asarray(beta, float), np.asarray(theta_i, float))
    rest = _HALF_PI - theta_i
    near = (beta <= rest) & (rest > 0)
    first = _HALF_PI * beta / np.where(near, rest, 1.0)
    return np.where(near, first, (_HALF_PI * beta + np.pi * theta_i) / (_HALF_PI + theta_i))


def _frame(incident: np.ndarray, outgoing: np.ndarray):
    """R_xy (..., 3), theta_i, beta and the unit vector T off R_xy in the plane of V; broadcast.

    beta by atan2 (exact near 0 and pi).  Along the normal any R_xy does, for then beta0 = beta; where V is along
    +-R_xy, which is on the horizon, T is the normal: the limit of views that sink to R_xy in the plane of incidence.
    """
    incident, outgoing = np.broadcast_arrays(np.asarray(incident, float), np.asarray(outgoing, float))
    across = np.hypot(incident[..., 0], incident[..., 1])
    tilted = across > UPRIGHT
    safe = np.where(tilted, across, 1.0)
    x, y = np.where(tilted, -incident[..., 0] / safe, 1.0), np.where(tilted, -incident[..., 1] / safe, 0.0)
    mirror = np.stack([x, y, np.zeros_like(x)], axis=-1)
    along = np.sum(mirror * outgoing, axis=-1)
    # off R_xy by components across it: exactly perpendicular, however little of V is left beside R_xy
    side = x * outgoing[..., 1] - y * outgoing[..., 0]
    off = np.stack([-side * y, side * x, outgoing[..., 2]], axis=-1)
    length = np.hypot(side, outgoing[..., 2])
    exists = length > 0
    off = np.where(exists[..., None], off / np.where(exists, length, 1.0)[..., None], (0.0, 0.0, 1.0))
    return mirror, np.arctan2(across, incident[..., 2]), np.arctan2(length, along), off


def great_circle_view(incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
    """V0 (..., 3): the view at normal incidence whose reflectance is taken, on the great circle from R_xy through V."""
    mirror, theta_i, beta, off = _frame(incident, outgoing)
    turned = stretched_angle(beta, theta_i)
    return np.cos(turned)[..., None] * mirror + np.sin(turned)[..., None] * off


def linear_view(incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
    """Compute V0 (..., 3) by Takeda et al., eq. 8-9.

    theta0 = pi/2 - (beta0 / beta)(pi/2 - theta_r), phi0 = (beta0 / beta) phi_r from R_xy.

    Exact in the plane of incidence on the mirror's side, where theta0 < 0 means beyond the normal; elsewhere it leaves
    the great circle.  beta -> 0 is R_xy itself.
    """
    mirror, theta_i, beta, _ = _frame(incident, outgoing)
    outgoing = np.broadcast_to(np.asarray(outgoing, float), mirror.shape)
    sideways = mirror[..., 0] * outgoing[..., 1] - mirror[..., 1] * outgoing[..., 0]
    forward = mirror[..., 0] * outgoing[..., 0] + mirror[..., 1] * outgoing[..., 1]
    # elevation and azimuth over beta first: both quotients are bounded, beta0 / beta is not
    safe, turned = np.where(beta > 0, beta, 1.0), stretched_angle(beta, theta_i)
    rise = turned * (np.arctan2(outgoing[..., 2], np.hypot(sideways, forward)) / safe)
    phi = turned * (np.arctan2(sideways, forward) / safe)
    c, s = np.cos(phi), np.sin(phi)
    x, y = mirror[..., 0] * c - mirror[..., 1] * s, mirror[..., 1] * c + mirror[..., 0] * s
    view = np.stack([np.cos(rise) * x, np.cos(rise) * y, np.sin(rise)], axis=-1)
    identity = (theta_i == 0)[..., None]  # exactly itself, whatever the rounding of the turns
    return np.where(identity, outgoing, view)


def amplitude(incident: np.ndarray) -> np.ndarray:
    """1 / cos^2 theta_i (Takeda et al., eq. 5), held from 89 degrees on, where it would go to infinity."""
    return 1.0 / np.maximum(np.asarray(incident, float)[..., 2], GRAZING_COSINE) ** 2


@dataclass(frozen=True)
class _Bard(ArrayFields):
    """rho_d + factor * rho0(V0); the grid is that of `goniometry.table.BasicReflectance`, without its last theta."""

    values: np.ndarray  # (nt, np, channels) rho0 - rho_d, 1 / sr; theta 0 .. pi/2, phi 0 .. 2 pi without its end
    diffuse: np.ndarray  # (channels,) rho_d, 1 / sr

    @classmethod
    def of(cls, values: np.ndarray, *, diffuse: np.ndarray | float = 0.0, **more):
        """From the grid of normal incidence (nt, np, channels), 1 / sr; diffuse is kept out of the law."""
        values = np.asarray(values, float)
        diffuse = np.broadcast_to(np.asarray(diffuse, float), values.shape[-1:]).copy()
        return cls(values=np.maximum(values - diffuse, 0.0), diffuse=diffuse, **more)

    @property
    def channels(self) -> int:
        """Number of channels."""
        return self.values.shape[-1]

    @cached_property
    def _spline(self) -> np.ndarray:
        return coefficients(self.values)

    def basic(self, view: np.ndarray) -> np.ndarray:
        """rho0 - rho_d (..., channels) at V0; what rounding puts below the horizon counts as on it."""
        return evaluate(self._spline, np.concatenate([view[..., :2], np.maximum(view[..., 2:], 0.0)], axis=-1))

    def _law(self, incident, outgoing, view, factor):
        incident, outgoing = np.broadcast_arrays(np.asarray(incident, float), np.asarray(outgoing, float))
        above = (incident[..., 2] > 0) & (outgoing[..., 2] > 0)
        return only_above(above, self.diffuse + factor[..., None] * self.basic(view))


@dataclass(frozen=True)
class LinearBard(_Bard):
    """Takeda et al., eq. 5-9 as printed."""

    KIND: ClassVar[str] = "bard_linear"

    def evaluate(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """BRDF, 1 / sr: (..., channels)."""
        return self._law(incident, outgoing, linear_view(incident, outgoing), amplitude(incident))


@dataclass(frozen=True)
class GreatCircleBard(_Bard):
    """The same on the exact great circle."""

    KIND: ClassVar[str] = "bard_great_circle"

    def evaluate(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """BRDF, 1 / sr: (..., channels)."""
        return self._law(incident, outgoing, great_circle_view(incident, outgoing), amplitude(incident))


@dataclass(frozen=True)
class ScaledBard(_Bard):
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
        return cls.of(values, directions=np.array([d for d, _ in groups]), factors=np.array(factors))


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
