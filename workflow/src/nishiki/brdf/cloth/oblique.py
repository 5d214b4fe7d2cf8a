"""Which oblique images tell most: a greedy D-optimal choice among those that could be taken.

The fit to normal incidence leaves an uncertainty of the parameters (its information matrix).  Each step takes the
measurement whose prediction is the most uncertain against what a measurement there is worth, leaves out its
neighbours, and updates the matrix (Fedorov, Theory of optimal experiments, 1972).  No measured value enters, so the
choice can be made before the images are taken.
"""

import numpy as np

from nishiki.brdf.cloth.interface import polar
from nishiki.brdf.cloth.measures import single
from nishiki.brdf.cloth.parametric import ShapeFit
from nishiki.brdf.cloth.yarn_facets import shape_of, shape_parts
from nishiki.brdf.cloth.yarn_fit import MISS_OBLIQUE, brdf_of, levels

STEEPEST = np.radians(80.0)  # views beyond are left out: a goniometer's cosines are least certain there
NEIGHBOUR = 2 * np.sin(np.radians(20.0) / 2)  # distance of unit vectors 20 degrees apart
STEP = 0.02


def choose_oblique(fit: ShapeFit, incident: np.ndarray, outgoing: np.ndarray, count: int) -> np.ndarray:
    """Indices (up to count,) into the candidates (n, 3), (n, 3), the most telling first."""
    allowed = np.flatnonzero((polar(outgoing) <= STEEPEST) & (polar(incident) <= STEEPEST))
    count = min(count, allowed.size)
    if count == 0:
        return np.empty(0, int)
    incident, outgoing = (np.ascontiguousarray(d[allowed]) for d in (incident, outgoing))
    slopes = _slopes(fit, incident, outgoing)
    apart = _apart(incident, outgoing)
    brdf = brdf_of(fit)
    values = brdf.evaluate(incident, outgoing).mean(axis=1)
    slopes *= single(values, levels(brdf, incident), miss=MISS_OBLIQUE)[:, None]
    size = fit.x.size
    # the body's albedo is eliminated from the fit; here it counts as known within a factor of 2.7
    covariance = np.zeros((size + 1, size + 1))
    covariance[:size, :size], covariance[size, size] = np.linalg.inv(fit.information), 1.0
    chosen, open_ = [], np.ones(len(incident), bool)
    for _ in range(count):
        spread = slopes @ covariance
        gain = np.sum(spread * slopes, axis=1)
        best = int(np.argmax(np.where(open_, gain, -1.0)))
        chosen.append(best)
        open_ &= apart(best)
        if not open_.any():
            break
        covariance -= np.outer(spread[best], spread[best]) / (1 + gain[best])
    return allowed[np.array(chosen)]


def _apart(incident: np.ndarray, outgoing: np.ndarray):
    """apart(k): which candidates are not neighbours of candidate k, with either order of light and view and mirrored.

    A model misses neighbouring measurements alike: the second tells little that the first has not told.
    """
    pairs = [np.abs(np.stack(pair)) for pair in ((incident, outgoing), (outgoing, incident))]

    def apart(k: int) -> np.ndarray:
        near = np.zeros(len(incident), bool)
        same_side = np.sign(incident[k, :2] * outgoing[k, :2])
        alike = np.all(np.sign(incident[:, :2] * outgoing[:, :2]) * same_side >= 0, axis=1)
        for pair in pairs:
            near |= (np.linalg.norm(pair - pairs[0][:, k, None], axis=-1) < NEIGHBOUR).all(axis=0)
        return ~(near & alike)

    return apart


def _slopes(fit: ShapeFit, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
    """(n, parameters + 1) derivatives of the predicted mean over channels; the last by the log of the body's albedo."""
    body = max(float(fit.coefficients[:, 0].mean()), 0.003)
    columns = []

    def value(x):
        parts = shape_parts(shape_of(x), incident, outgoing)
        return parts[:, 0] + parts[:, 2] + body * (parts[:, 1] + parts[:, 3]), parts

    for k in range(fit.x.size):
        step = np.zeros(fit.x.size)
        step[k] = STEP
        columns.append((value(fit.x + step)[0] - value(fit.x - step)[0]) / (2 * STEP))
    parts = value(fit.x)[1]
    return np.stack([*columns, body * (parts[:, 1] + parts[:, 3])], axis=1)
