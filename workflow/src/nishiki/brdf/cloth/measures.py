"""How good a BRDF is as physics (reciprocity, albedo) and as a prediction (errors at one incidence), and what a
measurement counts: the solid angle of its view's cell, and how far a model is expected to miss it."""

from dataclasses import dataclass

import numpy as np

from nishiki.brdf.cloth.interface import polar


def hemisphere(thetas: int = 24, phis: int = 48) -> tuple[np.ndarray, np.ndarray]:
    """Directions (n, 3) over the hemisphere and their projected solid angles (n,), which sum to pi.

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
    """Share of the light from each direction (..., 3) that is reflected at all: (..., channels)."""
    views, projected = hemisphere(thetas, phis)
    incident = np.asarray(incident, float)
    flat = incident.reshape(-1, 3)
    albedo = [projected @ brdf.evaluate(direction, views) for direction in flat]
    return np.array(albedo).reshape(*incident.shape[:-1], -1)


def reciprocity_error(brdf, *, pairs: int = 4096, seed: int = 0) -> float:
    """Root mean square of f(i, o) - f(o, i) over that of f, both weighted by cos_i cos_o, on random pairs."""
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
    """Errors over the views (n, 3) of one incidence; values (n,) or (n, channels), channels are averaged.

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
    """The distinct incident directions of measurements (n, 3): (theta, phi) in radians and the rows of each.

    Directions closer than `within_deg` are one; at the normal phi is 0.  Sorted by theta, then phi.
    """
    left, groups = np.ones(len(incident), bool), []
    for row in range(len(incident)):
        if left[row]:
            near = np.linalg.norm(incident - incident[row], axis=1) < np.radians(within_deg)
            rows = np.flatnonzero(near & left)
            left[rows] = False
            theta = float(polar(incident[row]))
            phi = float(np.mod(np.arctan2(incident[row, 1], incident[row, 0]), 2 * np.pi)) if theta > 1e-3 else 0.0
            groups.append((theta, phi, rows))
    return sorted(groups, key=lambda group: (round(group[0], 4), group[1]))


POINTS = 6000  # of the hemisphere whose nearest views are counted


def solid_angles(outgoing: np.ndarray, *, quarter: bool = False, points: int = POINTS) -> np.ndarray:
    """(n,) solid angle of the cell of each view (n, 3): the part of the hemisphere that is nearer to it than to others.

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
    """Inverse standard deviations (n,) of views of one incidence that count by their cells.

    A model that misses the values (n,) by `miss` of their cosine-weighted root mean square gets the sum of squared
    residuals `worth`, or the number of views where that is less: neighbouring views miss alike, they are not
    independent.
    """
    weight = outgoing[:, 2] * solid
    return np.sqrt(weight / np.sum(weight * values**2) * min(worth, len(values))) / miss


def single(values: np.ndarray, level: np.ndarray, *, miss: float) -> np.ndarray:
    """Inverse standard deviations (n,) of single measurements: `miss` of the value and of its incidence's level."""
    return 1 / (miss * np.sqrt(values**2 + level**2))
