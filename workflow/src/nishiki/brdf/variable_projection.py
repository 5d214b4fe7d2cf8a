"""Fit Lambert and one Torrance-Sparrow lobe to many points by variable projection: one width, linear strengths.

A point has observations y_oc = K_d,c q_o + K_s,c a_o D(phi_o; gamma).  For a given gamma both strengths of a channel
are a 2 x 2 linear problem with K >= 0, so only log gamma is searched:

* a global grid of half widths with the ratio 2.  One step down is the fourth power, because D(phi; gamma / 2) =
  D(phi; gamma)^4: the whole grid costs one exponential an observation;
* then Gauss-Newton on the projected residual (Kaufman's Jacobian; Golub & Pereyra, Inverse Problems 19, 2003, R1),
  held inside the bracket by the sign of the exact derivative and replaced by bisection where it would leave it.

Arrays have observations before points: each operation runs over the points of a chunk at once.
"""

from dataclasses import dataclass

import numpy as np

GRID_RATIO = 2.0  # of neighbouring widths of the coarse search
REFINEMENTS = 24  # steps at most
CHUNK = 2048  # points that are fitted together
_TWO_LN2 = float(2.0 * np.log(2.0))
_GRID_FLOOR = 1e-9  # D below it is 0 on the grid: its powers would end in slow subnormal numbers
_FARTHEST = 1e30  # phi^2 of points that no lamp lights
# What is reported of a point, in this order
GAMMA, CURVATURE, RSS, RSS_DIFFUSE, USED, NEAREST, LIT, SCALE = range(8)
REPORT = 8  # figures a point, by their names above


def project_points(
    phi, amplitude, attenuation, diffuse, weights, log_min: float, log_max: float
) -> tuple[np.ndarray, np.ndarray]:
    """Fit every point; all arrays of one float type, in which the fit is made.

    phi, attenuation, diffuse, weights: (points, observations); amplitude: (points, observations, channels).  An
    observation in which any value is not finite, or whose weight is 0, does not count.  Returns strengths (points,
    channels, 3), K_s, K_d, and K_d where there is no lobe, and reports (points, REPORT), where sums of squares are in
    units of the squared SCALE of the point.
    """
    count, _, channels = amplitude.shape
    strengths, reports = np.zeros((count, channels, 3), amplitude.dtype), np.zeros((count, REPORT), amplitude.dtype)
    with np.errstate(all="ignore"):  # infinities and NaN keep their meaning
        for first in range(0, count, CHUNK):
            chunk = slice(first, first + CHUNK)
            given = (phi, attenuation, diffuse, weights, amplitude)
            points = _Points.of(*(array[chunk].T.copy() for array in given))
            strengths[chunk] = _fit(points, log_min, log_max, reports[chunk])
    return strengths, reports


@dataclass(frozen=True)
class _Points:
    """Observations times the roots of their weights, columns scaled to a mean of 1, freed of the best diffuse part.

    The scaling makes the fit equivariant under any radiometric scale that the float type can hold.
    """

    # square, lobe, diffuse: (observations, points) ndarray: phi^2, a and q; 0 where an observation does not count
    square: np.ndarray
    lobe: np.ndarray
    diffuse: np.ndarray
    left: np.ndarray  # (channels, observations, points) ndarray: y' = y - k0 q
    # alone, along: (channels, points) ndarray: strength k0 >= 0 of the diffuse column alone, and q.y'
    alone: np.ndarray
    along: np.ndarray
    total: np.ndarray  # (points,) ndarray: q.q
    scales: np.ndarray  # (3, points) ndarray: of the lobe, of q, and of the observations
    used: np.ndarray  # (points,) ndarray: observations that count

    @classmethod
    def of(cls, phi, attenuation, diffuse, weights, values) -> "_Points":
        """Weight and scale columns (observations, points) and values (channels, observations, points)."""
        finite = np.isfinite(phi + attenuation + diffuse + weights + values.sum(axis=0))
        if not finite.all():
            given = (phi, attenuation, diffuse, weights, values)
            phi, attenuation, diffuse, weights, values = (np.where(finite, column, 0) for column in given)
        root = np.sqrt(weights)
        lobe, top_lobe = _scaled(attenuation * root)
        diffuse, top_diffuse = _scaled(diffuse * root)
        values = values * root
        flat, top = _scaled(values.reshape(-1, values.shape[-1]))
        values, total = flat.reshape(values.shape), _products(diffuse, diffuse)
        product = _products(diffuse, values)
        alone = np.where((product > 0) & (total > 0), product / total, 0)
        left = values - alone[:, None] * diffuse
        scales, used = np.stack([top_lobe, top_diffuse, top]), (root > 0).sum(axis=0)
        return cls(phi * phi, lobe, diffuse, left, alone, _products(diffuse, left), total, scales, used)

    def some(self, chosen: np.ndarray) -> "_Points":
        """Return the chosen points."""
        return _Points(*(np.ascontiguousarray(values[..., chosen]) for values in vars(self).values()))


def _scaled(column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Divide a column (n, points) by its mean absolute value, which is returned; 1 where it is 0."""
    mean = np.abs(column).mean(axis=0)
    mean = np.where(mean > 0, mean, 1)
    return column / mean, mean


def _products(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Sum the products (..., observations, points) over the observations."""
    return np.einsum("...op,...op->...p", one, other)


def _fit(points: _Points, log_min: float, log_max: float, report: np.ndarray) -> np.ndarray:
    """Fit points and report of them; returns (points, channels, 3) strengths in the units of the observations."""
    step = np.log(GRID_RATIO)
    t = log_max - step * _best_of_grid(points, log_max, int(np.ceil((log_max - log_min) / step)) + 1)
    t = np.maximum(t, log_min)
    t, strengths, curvature, rss = _refined(points, t, np.maximum(t - step, log_min), np.minimum(t + step, log_max))
    report[:, GAMMA], report[:, CURVATURE], report[:, RSS] = np.exp(t), curvature, rss
    report[:, RSS_DIFFUSE] = _products(points.left, points.left).sum(axis=0)
    report[:, USED], report[:, SCALE] = points.used, points.scales[2]
    square = np.where(points.lobe > 0, points.square, _FARTHEST)
    report[:, NEAREST] = np.sqrt(square.min(axis=0))
    report[:, LIT] = (square < 4 * report[:, GAMMA] ** 2).sum(axis=0)  # within two half widths: D above 1 / 16
    lobe, diffuse, values = points.scales
    return np.stack(
        [strengths[0] * (values / lobe), strengths[1] * (values / diffuse), points.alone * (values / diffuse)]
    ).T


def _inverse_determinant(a, b, d):
    """1 / (a d - b^2), or 0 where the two columns are collinear within the rounding of their type."""
    tolerance = 1e-5 if a.itemsize == 4 else 1e-12
    determinant = a * d - b * b
    return np.where(determinant > tolerance * a * d, 1 / determinant, 0)


def _strengths(a, b, inverse, u, points: _Points) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Non-negative least squares in two unknowns, relative to the fit by the diffuse column alone.

    a, b (points,): the products s.s, s.q of the lobe's and the diffuse column; inverse (points,): of the determinant,
    0 if collinear; u (channels, points): s.y'.  Returns K_s, K_d - k0, and what K_s takes off sum y'^2: a difference
    that no subtraction of large sums blurs; each (channels, points).  If an unconstrained strength is negative the
    optimum lies where one is 0, and is the better of those two.
    """
    d, v, k0 = points.total, points.along, points.alone
    s, t = (d * u - b * v) * inverse, (a * v - b * u) * inverse
    inside = (inverse > 0) & (s >= 0) & (k0 + t >= 0)
    whole = u + k0 * b
    lobe = np.maximum(whole, 0) / np.where(a > 0, a, 1)
    gain = np.maximum(lobe * whole - k0 * k0 * d, 0)
    better = gain > 0
    return np.where(inside, s, lobe * better), np.where(inside, t, -k0 * better), np.where(inside, s * u + t * v, gain)


def _best_of_grid(points: _Points, log_max: float, steps: int) -> np.ndarray:
    """Index (points,) of the best half width of the grid, gamma_max / 2^index; of equally good ones the widest."""
    real = points.square.dtype.type
    margin = real(1.00001) if real == np.float32 else real(1 + 1e-12)
    height = np.exp2(-points.square * real(np.exp(-2 * log_max)))
    best, index = np.full(len(points.total), real(-1)), np.zeros(len(points.total), int)
    for step in range(steps):
        s = points.lobe * height
        a, b = _products(s, s), _products(s, points.diffuse)
        gain = _strengths(a, b, _inverse_determinant(a, b, points.total), _products(s, points.left), points)[2]
        gain = gain.sum(axis=0)
        better = gain > best * margin
        best, index = np.where(better, gain, best), np.where(better, step, index)
        height = np.maximum((height * height) ** 2 - real(_GRID_FLOOR), 0)
    return index


def _evaluated(points: _Points, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Strengths (2, channels, points) at log gamma = t, and slope, curvature, rss (points,) of the projected problem.

    slope: minus half the derivative of the sum of squares by t (exact); curvature: Kaufman's approximation of half the
    second derivative, sum_c K_s,c^2 |P j|^2 with j the lobe's derivative and P the projection off the active columns.
    """
    ratio = points.square * np.exp(-2 * t).astype(t.dtype)
    s = points.lobe * np.exp2(-ratio)
    j = s * ratio * t.dtype.type(_TWO_LN2)
    q, d = points.diffuse, points.total
    a, b = _products(s, s), _products(s, q)
    jj, js, jq = (_products(j, column) for column in (j, s, q))
    inverse = _inverse_determinant(a, b, d)
    one_left = np.where(a > 0, np.maximum(jj - js * js / a, 0), 0)
    both_left = np.maximum(jj - (js * js * d - 2 * js * jq * b + jq * jq * a) * inverse, 0)
    ks, kd, _ = _strengths(a, b, inverse, _products(s, points.left), points)
    rest = points.left - kd[:, None] * q - ks[:, None] * s  # the residuals themselves: no cancellation
    kd = kd + points.alone
    slope = (ks * _products(rest, j)).sum(axis=0)
    curvature = (ks * ks * np.where((inverse > 0) & (kd > 0), both_left, one_left)).sum(axis=0)
    return np.stack([ks, kd]), slope, curvature, _products(rest, rest).sum(axis=0)


def _refined(points: _Points, t: np.ndarray, lo: np.ndarray, hi: np.ndarray):
    """Safeguarded Gauss-Newton in t = log gamma between lo and hi; (t, strengths, curvature, rss), all at that t."""
    real = points.square.dtype
    settled = 1e-3 if real == np.float32 else 1e-9  # of the step before: what is left is far smaller
    t, lo, hi = (values.astype(real) for values in (t, lo, hi))
    strengths = np.empty((2, *points.alone.shape), real)
    curvature, rss = np.empty_like(t), np.empty_like(t)
    numbers, moved = np.arange(len(t)), np.full(len(t), np.inf)  # of the points that are still in `points`
    for _ in range(REFINEMENTS + 1):
        here = t[numbers]
        strengths[..., numbers], slope, curvature[numbers], rss[numbers] = _evaluated(points, here)
        on = (moved >= settled) & (slope != 0) & (curvature[numbers] > 0)
        if not on.any():
            break
        if 2 * on.sum() < len(on):
            numbers, here, slope, points, on = numbers[on], here[on], slope[on], points.some(on), on[on]
        lo[numbers], hi[numbers] = np.where(slope > 0, here, lo[numbers]), np.where(slope > 0, hi[numbers], here)
        new = here + slope / curvature[numbers]
        inside = (lo[numbers] <= new) & (new <= hi[numbers])
        t[numbers] = np.where(on, np.where(inside, new, 0.5 * (lo[numbers] + hi[numbers])), here)
        moved = np.abs(t[numbers] - here)
    return t, strengths, curvature, rss
