"""Define the interface of a cloth's reflection models, measure their quality, and exchange their dye.

A BRDF is a frozen dataclass in the cloth's frame: x the weft, y the warp, z the normal; unit vectors away from the
surface.  `channels` is the number of channels, `KIND` its name; a class that is reciprocal by construction says so
by `RECIPROCAL`.  `evaluate(incident, outgoing)` gives 1 / sr, (..., channels), broadcasts, is finite everywhere and 0
where light or view is not above the horizon.
`as_arrays` and `from_arrays` are inverse to each other and hold numbers only, so that a model is stored without pickle
(`nishiki.brdf.cloth.store`).

`Dyed` puts any dye on a measured gloss by the dichromatic model (Shafer, Using color to separate reflection components,
1985).  Light that a fibre's surface reflects has the lamp's colour; light that comes from within has the dye's.  A
black cloth shows the first alone (Takeda et al., section 2).  For another dye the light from within is added: that of a
diffuser under the gloss, which gets only what the gloss lets through on the way in and out,

    f = f_gloss + albedo / pi (1 - a(i)) (1 - a(o)) / (1 - a_mean),

with a(w) the directional albedo of the gloss and a_mean its cosine-weighted mean: reciprocal, and its albedo is
a(i) + albedo (1 - a(i)), at most 1 if the gloss' is (Kelemen and Szirmay-Kalos, A microfacet based coupled
specular-matte BRDF model with importance sampling, 2001).
"""

from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import numpy as np

from nishiki.goniometry.directions import angles

LEAST_COSINE = 1e-9  # of directions above the horizon: nearer ones count as that near, so that quotients stay finite


def off_horizon(directions: np.ndarray) -> np.ndarray:
    """Lift directions (..., 3) with 0 < z < LEAST_COSINE to it (their length stays 1 to 1e-18); keep the rest."""
    directions = np.asarray(directions, float)
    low = (directions[..., 2] > 0) & (directions[..., 2] < LEAST_COSINE)
    if not low.any():
        return directions
    lifted = directions.copy()
    lifted[low, 2] = LEAST_COSINE
    return lifted


@dataclass(frozen=True)
class Halves:
    """Light, view and their half vector h in the cloth's frame; arrays of the directions' broadcast shape (...,)."""

    above: np.ndarray  # bool: light and view above the horizon
    cos_i: np.ndarray  # n . light, 1 where not above, so that quotients stay finite
    cos_r: np.ndarray  # n . view, likewise
    h: np.ndarray  # (..., 3) unit, (0, 0, 1) where not above
    cos_d: np.ndarray  # h . light = h . view, 0 .. 1: the incidence on the facet


def halves(incident: np.ndarray, outgoing: np.ndarray) -> Halves:
    """Compute the geometry of unit vectors (..., 3), broadcast against each other."""
    incident, outgoing = np.broadcast_arrays(off_horizon(incident), off_horizon(outgoing))
    above = (incident[..., 2] > 0) & (outgoing[..., 2] > 0)
    total = np.where(above[..., None], incident + outgoing, (0.0, 0.0, 1.0))
    # |i + o| is at least i_z + o_z > 0: a half vector exists wherever both are above
    length = np.sqrt(np.sum(total * total, axis=-1))
    return Halves(
        above=above,
        cos_i=np.where(above, incident[..., 2], 1.0),
        cos_r=np.where(above, outgoing[..., 2], 1.0),
        h=total / length[..., None],
        cos_d=np.where(above, np.minimum(length / 2, 1.0), 1.0),
    )


def only_above(above: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Set values (..., channels) to 0 where `above` (...,) is false."""
    return np.where(above[..., None], values, 0.0)


def hemisphere(thetas: int = 24, phis: int = 48) -> tuple[np.ndarray, np.ndarray]:
    """Return directions (n, 3) over the hemisphere and their projected solid angles (n,), which sum to pi.

    Gauss-Legendre in sin^2 theta, the measure of the projected solid angle, equal steps in azimuth.
    """
    nodes, weights = np.polynomial.legendre.leggauss(thetas)
    sin2 = (nodes + 1) / 2
    phi = (np.arange(phis) + 0.5) * (2 * np.pi / phis)
    sin, cos = np.sqrt(sin2)[:, None], np.sqrt(1 - sin2)[:, None]
    directions = np.stack([sin * np.cos(phi), sin * np.sin(phi), np.broadcast_to(cos, (thetas, phis))], axis=-1)
    projected = np.broadcast_to((weights / 2 * np.pi / phis)[:, None], (thetas, phis))
    return directions.reshape(-1, 3), projected.ravel()


def directional_albedo(brdf, incident: np.ndarray, *, thetas: int = 24, phis: int = 48) -> np.ndarray:
    """Compute the share of the light from each direction (..., 3) that is reflected at all: (..., channels)."""
    views, projected = hemisphere(thetas, phis)
    incident = np.asarray(incident, float)
    flat = incident.reshape(-1, 3)
    albedo = [projected @ brdf.evaluate(direction, views) for direction in flat]
    return np.array(albedo).reshape(*incident.shape[:-1], -1)


def reciprocity_error(brdf, *, pairs: int = 4096, seed: int = 0) -> float:
    """Compute the rms of f(i, o) - f(o, i) over that of f, both weighted by cos_i cos_o, on random pairs."""
    rng = np.random.default_rng(seed)

    def directions():
        phi, cos = rng.uniform(0, 2 * np.pi, pairs), np.sqrt(rng.uniform(1e-4, 1, pairs))
        sin = np.sqrt(1 - cos * cos)
        return np.stack([sin * np.cos(phi), sin * np.sin(phi), cos], axis=-1)

    a, b = directions(), directions()  # cosine-distributed: the weight is in the density
    forth, back = brdf.evaluate(a, b), brdf.evaluate(b, a)
    size = np.mean((forth + back) ** 2) / 4
    return float(np.sqrt(np.mean((forth - back) ** 2) / size)) if size > 0 else 0.0


@dataclass(frozen=True)
class PredictionError:
    """Errors of predicted against measured values at one incidence (or in one of its planes)."""

    rms_rel: float  # cosine-weighted relative root mean square
    peak_direction: float  # angle between the brightest predicted and the brightest measured view, radians
    peak_value: float  # brightest predicted over brightest measured value, less 1


def prediction_error(
    outgoing: np.ndarray, measured: np.ndarray, predicted: np.ndarray, weights=None
) -> PredictionError:
    """Compute errors over the views (n, 3) of one incidence; values (n,) or (n, channels), channels are averaged.

    weights (n,): solid angle of each view's cell; equal where not given.  The weight of a squared error is that times
    cos theta_r.  Peaks are sought among the measured views.
    """
    measured, predicted = (np.asarray(v, float).reshape(len(outgoing), -1).mean(axis=1) for v in (measured, predicted))
    weights = np.asarray(outgoing)[:, 2] * (1.0 if weights is None else weights)
    top, guess = outgoing[np.argmax(measured)], outgoing[np.argmax(predicted)]
    across = np.linalg.norm(np.cross(top, guess))
    return PredictionError(
        rms_rel=float(np.sqrt(np.sum(weights * (predicted - measured) ** 2) / np.sum(weights * measured**2))),
        peak_direction=float(np.arctan2(across, top @ guess)),
        peak_value=float(predicted.max() / measured.max() - 1),
    )


def incidences(incident: np.ndarray, *, within_deg: float = 0.5) -> list[tuple[float, float, np.ndarray]]:
    """List the distinct incident directions of measurements (n, 3): (theta, phi) in radians and the rows of each.

    Directions closer than `within_deg` are one; at the normal phi is 0.  Sorted by theta, then phi.
    """
    left, groups = np.ones(len(incident), bool), []
    for row in range(len(incident)):
        if left[row]:
            near = np.linalg.norm(incident - incident[row], axis=1) < np.radians(within_deg)
            rows = np.flatnonzero(near & left)
            left[rows] = False
            theta = float(angles(incident[row])[0])
            phi = float(np.mod(np.arctan2(incident[row, 1], incident[row, 0]), 2 * np.pi)) if theta > 1e-3 else 0.0
            groups.append((theta, phi, rows))
    return sorted(groups, key=lambda group: (round(group[0], 4), group[1]))


POINTS = 6000  # of the hemisphere whose nearest views are counted


def solid_angles(outgoing: np.ndarray, *, quarter: bool = False, points: int = POINTS) -> np.ndarray:
    """Compute the solid angles (n,) of the cells of views (n, 3): the directions that are nearest to each.

    By counting evenly spread points (a Fibonacci lattice), so good to 2 pi / points; a cell has at least half a point.
    quarter: views stand for their mirror images in the planes x = 0 and y = 0 too, as under normal incidence.
    Directions measured several times share their cell.
    """
    from scipy.spatial import cKDTree

    k = np.arange(points) + 0.5
    z, phi = 1 - k / points, k * (np.pi * (3 - np.sqrt(5)))
    r = np.sqrt(1 - z * z)
    lattice = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)
    views = np.array(outgoing, float)
    if quarter:
        views[:, :2], lattice[:, :2] = np.abs(views[:, :2]), np.abs(lattice[:, :2])
    distinct, which, times = np.unique(np.round(views, 9), axis=0, return_inverse=True, return_counts=True)
    nearest = cKDTree(distinct).query(lattice)[1]
    counts = np.maximum(np.bincount(nearest, minlength=len(distinct)), 0.5)
    which = which.reshape(-1)
    return 2 * np.pi / points * counts[which] / times[which]


def together(outgoing: np.ndarray, values: np.ndarray, solid: np.ndarray, *, miss: float, worth: float) -> np.ndarray:
    """Compute inverse standard deviations (n,) of views of one incidence, weighted by their cells.

    A model that misses the values (n,) by `miss` of their cosine-weighted root mean square gets the sum of squared
    residuals `worth`, or the number of views where that is less: neighbouring views miss alike, they are not
    independent.
    """
    weight = outgoing[:, 2] * solid
    return np.sqrt(weight / np.sum(weight * values**2) * min(worth, len(values))) / miss


def single(values: np.ndarray, level: np.ndarray, *, miss: float) -> np.ndarray:
    """Compute inverse standard deviations (n,) of single values: `miss` of the value and of its incidence's level."""
    return 1 / (miss * np.sqrt(values**2 + level**2))


THETAS, PHIS = 16, 24  # grid of the stored directional albedo


WITHIN = ("diffuse", "body", "lambert")  # fields that hold the light from within


def gloss_of(brdf):
    """Return the model without its light from within, a black cloth of the same yarns; itself where it has none."""
    names = [field.name for field in fields(brdf)] if is_dataclass(brdf) else []
    inner = {name: getattr(brdf, name) for name in names if name in WITHIN}
    return replace(brdf, **{name: np.zeros_like(value) for name, value in inner.items()}) if inner else brdf


@dataclass(frozen=True)
class Dyed:
    """A gloss over a dye; channels are the dye's."""

    gloss: Any  # a BRDF of one channel, or of the dye's channels
    albedo: np.ndarray  # (channels,) of the dye under a gloss that takes nothing, 0 .. 1
    gloss_albedo: np.ndarray  # (THETAS, PHIS) share of the light that the gloss reflects, mean over its channels
    mean_albedo: float  # cosine-weighted mean of gloss_albedo

    @property
    def channels(self) -> int:
        """Number of channels."""
        return max(self.albedo.size, self.gloss.channels)

    def gloss_albedo_at(self, directions: np.ndarray) -> np.ndarray:
        """Interpolate the gloss's directional albedo (...,) linearly in theta and phi, periodic in phi."""
        theta, phi = angles(directions)
        t, p = np.clip(theta / (np.pi / 2) * THETAS - 0.5, 0, THETAS - 1), phi / (2 * np.pi) * PHIS
        t0, p0 = np.minimum(t.astype(int), THETAS - 2), p.astype(int)
        u, v = t - t0, p - p0
        rows = [
            (1 - v) * self.gloss_albedo[t0 + k, p0 % PHIS] + v * self.gloss_albedo[t0 + k, (p0 + 1) % PHIS]
            for k in (0, 1)
        ]
        return (1 - u) * rows[0] + u * rows[1]

    def body(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """Evaluate the BRDF of the dye below the gloss, 1 / sr."""
        through = (1 - self.gloss_albedo_at(incident)) * (1 - self.gloss_albedo_at(outgoing))
        through = through / max(1 - self.mean_albedo, 1e-3)
        above = (incident[..., 2] > 0) & (outgoing[..., 2] > 0)
        return only_above(above, through[..., None] * (self.albedo / np.pi))

    def evaluate(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """Evaluate the BRDF, 1 / sr."""
        return self.gloss.evaluate(incident, outgoing) + self.body(incident, outgoing)
