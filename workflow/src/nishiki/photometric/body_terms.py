"""Body shading of given normals: the terms (a, b, d) of `nishiki.photometric.lobe` by linear least squares.

With the normal known, I = c (a + b c + d x^8) is linear in its terms. Where the normals come from an intensity in which
gloss counts little (`nishiki.photometric.body_colour`), the terms that predict light are fitted here to the mean of the
channels, along those normals: light is predicted with all of the gloss and with the same normals.
"""

import numpy as np

from nishiki.photometric import flags as bits
from nishiki.photometric.light_selection import half_vectors, sum_lights
from nishiki.photometric.refine import LEAST_FACTOR, WIDTH
from nishiki.photometric.solve import AT_LEAST, PRIOR
from nishiki.threads import over_rows

PIXELS = 1024  # at a time


def shading_of_mean(
    intensity, mean, directions, field, *, usable, valid, least_change: float, noise: float = 0.003
) -> np.ndarray:
    """Fit the body shading along the field's normals to the mean of the channels.

    Parameters
    ----------
    intensity, mean : (lights, rows, columns) float32
        What the normals were fitted to, and the mean of the channels.
    directions : (lights, 3) float64
    field : NormalField
        Of a solver that fits a body shading.
    usable, valid : (lights, rows, columns) bool
        Samples to start from, and those to choose from again, by their residuals.
    least_change : float
        Sum of |intensity - mean| of a pixel, relative to that of |mean|, up to which its shading stays.
    noise : float
        Of the observations, relative to the albedo.

    Returns
    -------
    (rows, columns, 3) float32
        (a, b, d) of `nishiki.brdf.torrance_sparrow`; that of the field without an estimate or a lobe.
    """
    other, stack, start, known = (np.reshape(each, (len(directions), -1)) for each in (intensity, mean, usable, valid))
    normals, shading = field.normals.reshape(-1, 3), field.shading.reshape(-1, 3).copy()
    fitted = (field.flags.ravel() & (bits.NO_ESTIMATE | bits.FALLBACK)) == 0
    vectors = np.asarray(directions, np.float64), half_vectors(directions)

    def fit(first: int, last: int, stack: np.ndarray) -> None:
        for begin in range(first, last, PIXELS):
            here = np.arange(begin, min(begin + PIXELS, last))
            here = here[fitted[here]]
            there = known[:, here] & np.isfinite(stack[:, here])
            values = np.where(there, stack[:, here], 0).astype(np.float64)
            apart = np.abs(np.where(there, other[:, here] - values, 0)).sum(axis=0)
            changed = apart > least_change * np.abs(values).sum(axis=0)
            here, there, values = here[changed], there[:, changed], values[:, changed]
            terms, found = _fitted_terms(values, there & start[:, here], there, normals[here], vectors, noise)
            shading[here[found]] = terms[:, found].T

    over_rows(fit, len(shading), stack)
    return shading.reshape(field.shading.shape)


def _fitted_terms(values, chosen, known, normals, vectors, noise):
    """Return terms (3, pixels), scaled so that the body factor is 1 on average, weighted c^2, and where they hold."""
    columns = [normals[:, k].astype(np.float64) for k in range(3)]
    c, x = (sum(vector[:, k, None] * columns[k] for k in range(3)) for vector in vectors)
    power = np.maximum(x, 1e-3) ** 2
    power *= power
    features, lit = (c, c * c, c * power * power), c > 0
    terms, found = np.zeros((4, values.shape[1])), np.ones(values.shape[1], bool)
    limit: np.ndarray | float = np.inf
    for step in range(2):
        if step > 0:  # within three times the scatter
            rest = values - sum(term * feature for term, feature in zip(terms[:3], features, strict=True))
            chosen = known & (np.abs(rest) <= limit)
        weighted = [np.where(chosen & lit, each, 0) for each in features]
        pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
        sums = [sum_lights(weighted[k], features[m]) for k, m in pairs]
        right = [sum_lights(each, values) for each in weighted]
        solved, limit, good = _solve(sums, right, values, chosen & lit, noise)
        found &= good
        terms = np.where(found, solved, terms)
    with np.errstate(divide="ignore", invalid="ignore"):
        return terms[:3] / terms[3], terms[3] > 0


def _solve(sums, right, values, chosen, noise):
    """Return (a, b, d) and their mean factor, three times the scatter of the samples, and where the terms are a body's.

    The prior is as in `nishiki.photometric.refine.refine`, with the scatter about Lambert's law of the same normal.
    """
    (s00, s01, s02, s11, s12, s22), (r0, r1, r2) = sums, right
    kept, squares = chosen.sum(axis=0), sum_lights(values, values, chosen)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore", under="ignore"):
        albedo = r0 / s00
        left = np.maximum(squares - albedo * r0, 0)
        held = PRIOR * kept / 3 + left / (kept * albedo**2) / WIDTH**2
        ridge = 1e-9 * s00
        m00, m11, m22 = s00 + ridge, s11 + held + ridge, s22 + held + ridge
        l1, l2 = s01 / m00, s02 / m00
        d1, m21 = m11 - l1 * s01, s12 - l2 * s01
        k = m21 / d1
        d2, u1 = m22 - l2 * s02 - k * m21, r1 - l1 * r0
        d = (r2 - l2 * r0 - k * u1) / d2
        b = u1 / d1 - k * d
        a = r0 / m00 - l1 * b - l2 * d
        rest = squares - 2 * (a * r0 + b * r1 + d * r2)
        rest += a * (a * s00 + 2 * (b * s01 + d * s02)) + b * (b * s11 + 2 * d * s12) + d * d * s22
        scatter = np.sqrt(np.maximum(rest, 0) / np.where(kept > 4, kept - 3, 1))
        mean = a + (b * s01 + d * s02) / s00
        good = (kept >= AT_LEAST) & (albedo > 0) & (d1 > 0) & (d2 > 0) & (mean > LEAST_FACTOR * albedo)
    return np.stack([a, b, d, mean]), 3 * (scatter + noise * albedo), good
