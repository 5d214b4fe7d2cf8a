"""Which oblique images tell most: a greedy choice of those that leave the least error over all directions.

The fit to normal incidence leaves an uncertainty of the parameters (its information matrix), which makes errors of
predictions that go together; beside it a model has errors of its own, alike in directions close to each other
(DISCREPANCY, REACH). Each step takes the image after which the expected squared error, summed over all candidates with
the cosine of the view and relative to each incidence's level, is least (I-optimal design; Fedorov, Theory of optimal
experiments, 1972), and conditions both on it. No measured value enters, so the choice can be made before the images
are taken.
"""

import numpy as np

from nishiki.brdf.cloth.interface import polar
from nishiki.brdf.cloth.parametric import ShapeFit
from nishiki.brdf.cloth.yarn_facets import shape_of, shape_parts
from nishiki.brdf.cloth.yarn_fit import brdf_of, levels

STEEPEST = np.radians(80.0)  # views beyond are left out: a goniometer's cosines are least certain there
CANDIDATES = 700  # evenly thinned from all: their covariance is a full matrix
DISCREPANCY = 0.12  # standard deviation of the model's own error, of the value
REACH = 0.7  # distance of pairs of unit vectors (light, view) at which these errors have nothing in common
NOISE = 0.03, 0.01  # of a measurement, of the value and of its incidence's level
STEP = 0.02


def choose_oblique(fit: ShapeFit, incident: np.ndarray, outgoing: np.ndarray, count: int) -> np.ndarray:
    """Indices (up to count,) into the candidates (n, 3), (n, 3), the most telling first."""
    allowed = np.flatnonzero((polar(outgoing) <= STEEPEST) & (polar(incident) <= STEEPEST))
    if count == 0 or allowed.size == 0:
        return np.empty(0, int)
    pool = max(CANDIDATES, count)
    if allowed.size > pool:
        allowed = allowed[np.linspace(0, allowed.size - 1, pool).astype(int)]
    incident, outgoing = (np.ascontiguousarray(d[allowed]) for d in (incident, outgoing))
    brdf = brdf_of(fit)
    values, level = brdf.evaluate(incident, outgoing).mean(axis=1), levels(brdf, incident)
    slopes, size = _slopes(fit, incident, outgoing), fit.x.size
    # the body's albedo is eliminated from the fit; here it counts as known within a factor of 2.7
    parameters = np.zeros((size + 1, size + 1))
    parameters[:size, :size], parameters[size, size] = np.linalg.inv(fit.information), 1.0
    own = DISCREPANCY**2 * np.outer(values, values) * likeness(incident, outgoing)
    covariance = slopes @ parameters @ slopes.T + own
    noise = (NOISE[0] * values) ** 2 + (NOISE[1] * level) ** 2
    weight = outgoing[:, 2] / level**2
    chosen: list[int] = []
    open_ = np.ones(allowed.size, bool)
    for _ in range(min(count, allowed.size)):
        gain = weight @ covariance**2 / (np.diag(covariance) + noise)
        best = int(np.argmax(np.where(open_, gain, -1.0)))
        chosen.append(best)
        open_[best] = False
        column = covariance[:, best].copy()
        covariance -= np.outer(column, column) / (column[best] + noise[best])
    return allowed[np.array(chosen)]


def likeness(incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
    """(n, n) correlation of a model's errors at pairs of directions (n, 3): Wendland's function of their distance, the
    least over mirror images in the planes of weft and warp and over the exchange of light and view."""
    pairs = np.concatenate([incident, outgoing], axis=1)
    nearest = np.full((len(pairs), len(pairs)), np.inf)
    for x in (1.0, -1.0):
        for y in (1.0, -1.0):
            for same in (pairs, np.roll(pairs, 3, axis=1)):
                product = (pairs * np.tile([x, y, 1.0], 2)) @ same.T
                np.minimum(nearest, 4.0 - 2.0 * product, out=nearest)  # of unit vectors: squared distance of the pairs
    reach = np.minimum(np.sqrt(np.maximum(nearest, 0.0)) / REACH, 1.0)
    return (1.0 - reach) ** 4 * (4.0 * reach + 1.0)


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
