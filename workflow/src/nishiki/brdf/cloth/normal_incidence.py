"""Predict oblique reflectance from normal incidence by the published shift of the pattern.

The paper's law (Takeda et al., eq. 5-9): light from theta_i moves every point of the pattern in the plane
of the view V and of R_xy, the mirror direction projected on the cloth: with beta the angle from R_xy to V,

    beta0 = (pi/2) / (pi/2 - theta_i) beta                             for beta <= pi/2 - theta_i,
    beta0 = ((pi/2) beta + pi theta_i) / (pi/2 + theta_i)              otherwise,
    f(i, o) = rho_d + rho0(V0) / cos^2 theta_i,

V0 at the angle beta0 on the great circle from R_xy through V (exact), or by Takeda et al., eq. 8-9, which turns both
spherical coordinates in the same ratio (the paper's linear approximation).  Neither is reciprocal nor keeps energy.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from nishiki.brdf.cloth.interface import only_above
from nishiki.formats.stored import ArrayFields
from nishiki.goniometry.interpolation import coefficients, evaluate

GRAZING_COSINE = float(np.cos(np.radians(89.0)))  # 1 / cos^2 goes on as a constant beyond 89 degrees
UPRIGHT = np.finfo(float).tiny  # sine of theta_i below which light is along the normal: its azimuth has lost digits
_HALF_PI = np.pi / 2


def stretched_angle(beta: np.ndarray, theta_i: np.ndarray) -> np.ndarray:
    """Compute beta0 of Takeda et al., eq. 6, radians: 0 at 0, pi/2 at pi/2 - theta_i, pi at pi; beta at theta_i = 0.

    At theta_i = pi/2 the first branch has no extent and beta0 = (beta + pi) / 2.
    """
    beta, theta_i = np.broadcast_arrays(np.asarray(beta, float), np.asarray(theta_i, float))
    rest = _HALF_PI - theta_i
    near = (beta <= rest) & (rest > 0)
    first = _HALF_PI * beta / np.where(near, rest, 1.0)
    return np.where(near, first, (_HALF_PI * beta + np.pi * theta_i) / (_HALF_PI + theta_i))


def _frame(incident: np.ndarray, outgoing: np.ndarray):
    """Compute R_xy (..., 3), theta_i, beta and the unit vector T off R_xy in the plane of V; broadcast.

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
    """Compute V0 (..., 3), the view of the reflectance at normal incidence, on the great circle R_xy to V."""
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
    """Compute 1 / cos^2 theta_i (Takeda et al., eq. 5), constant from 89 degrees on, where it would go to infinity."""
    return 1.0 / np.maximum(np.asarray(incident, float)[..., 2], GRAZING_COSINE) ** 2


@dataclass(frozen=True)
class _Bard(ArrayFields):
    """The model rho_d + factor * rho0(V0); grid of `goniometry.table.BasicReflectance`, without its last theta."""

    values: np.ndarray  # (nt, np, channels) rho0 - rho_d, 1 / sr; theta 0 .. pi/2, phi 0 .. 2 pi without its end
    diffuse: np.ndarray  # (channels,) rho_d, 1 / sr

    @classmethod
    def of(cls, values: np.ndarray, *, diffuse: np.ndarray | float = 0.0):
        """Make the model of the grid of normal incidence (nt, np, channels), 1 / sr; diffuse stays out of the law."""
        values = np.asarray(values, float)
        diffuse = np.broadcast_to(np.asarray(diffuse, float), values.shape[-1:]).copy()
        return cls(values=np.maximum(values - diffuse, 0.0), diffuse=diffuse)

    @property
    def channels(self) -> int:
        """Number of channels."""
        return self.values.shape[-1]

    @cached_property
    def _spline(self) -> np.ndarray:
        return coefficients(self.values)

    def basic(self, view: np.ndarray) -> np.ndarray:
        """Interpolate rho0 - rho_d (..., channels) at V0; views below the horizon by rounding count as on it."""
        return evaluate(self._spline, np.concatenate([view[..., :2], np.maximum(view[..., 2:], 0.0)], axis=-1))

    def _law(self, incident, outgoing, view, factor):
        incident, outgoing = np.broadcast_arrays(np.asarray(incident, float), np.asarray(outgoing, float))
        above = (incident[..., 2] > 0) & (outgoing[..., 2] > 0)
        return only_above(above, self.diffuse + factor[..., None] * self.basic(view))


@dataclass(frozen=True)
class LinearBard(_Bard):
    """The law of Takeda et al., eq. 5-9, as printed."""

    KIND: ClassVar[str] = "bard_linear"

    def evaluate(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """Evaluate the BRDF, 1 / sr: (..., channels)."""
        return self._law(incident, outgoing, linear_view(incident, outgoing), amplitude(incident))


@dataclass(frozen=True)
class GreatCircleBard(_Bard):
    """The law of Takeda et al. on the exact great circle."""

    KIND: ClassVar[str] = "bard_great_circle"

    def evaluate(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """Evaluate the BRDF, 1 / sr: (..., channels)."""
        return self._law(incident, outgoing, great_circle_view(incident, outgoing), amplitude(incident))
