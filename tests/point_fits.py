"""Fit Lambert and one Torrance-Sparrow lobe to the observations of each point.

The strengths (K_s, K_d, or beta) enter linearly and the half width gamma does not: the strengths are eliminated and
log gamma is searched globally (variable projection). There is no start value to choose, and beta = 164 beside
gamma = 0.07 is no harder than beta = 1 beside gamma = 1. Fits over a whole scene are in `nishiki.brdf.scene`.

A point has observations y_oc = K_d,c q_o + K_s,c a_o D(phi_o; gamma).  For a given gamma both strengths of a channel
are a 2 x 2 linear problem with K >= 0, so only log gamma is searched:

* a global grid of half widths with the ratio 2.  One step down is the fourth power, because D(phi; gamma / 2) =
  D(phi; gamma)^4: the whole grid costs one exponential an observation;
* then Gauss-Newton on the projected residual (Kaufman's Jacobian; Golub & Pereyra, Inverse Problems 19, 2003, R1),
  held inside the bracket by the sign of the exact derivative and replaced by bisection where it would leave it.

Arrays have observations before points: each operation runs over the points of a chunk at once.
"""

from dataclasses import dataclass
from enum import IntFlag

import numpy as np

from nishiki.brdf.scene import GAMMA_BOUNDS
from nishiki.errors import UserError


class FitFlag(IntFlag):
    """Bits of the `flags` of a fit."""

    NO_HIGHLIGHT = 1  # a lobe takes off no more than noise does: strength 0, width NaN
    AT_BOUND = 2  # the half width stands at the end of the range that was searched
    TOO_FEW = 4  # fewer observations than unknowns: strength 0, width NaN
    UNDETERMINED = 8  # fewer than two observations within two half widths, or a width known to a factor e^0.5 at best
    NOT_FINITE = 16  # some observations were not finite and were left out


REFINEMENTS = 24  # steps at most
CHUNK = 2048  # points that are fitted together
_TWO_LN2 = float(2.0 * np.log(2.0))
# What is reported of a point, in this order
GAMMA, CURVATURE, RSS, RSS_DIFFUSE, USED, NEAREST, LIT, SCALE = range(8)
REPORT = SCALE + 1  # figures a point
SIGNIFICANCE = 8.0  # F ratio that a lobe must reach; chance alone passes 6 for 1 in 1000 points of 36 x 3 observations
UNDETERMINED_LOG_GAMMA = 0.5  # standard deviation, a factor of 1.6 either way


@dataclass(frozen=True)
class PointFits:
    """Lambert + one lobe at each point: I' = diffuse * q + specular * a * D(phi; gamma).

    Arrays have the float type of the fit.  Points whose flags contain NO_HIGHLIGHT or TOO_FEW have specular 0 and
    gamma NaN: they take these from their neighbours (Miyazaki et al. 2007) or from the scene.
    """

    gamma: np.ndarray  # (points,) half width at half maximum, radians
    specular: np.ndarray  # (points, channels) K_s or beta, >= 0
    diffuse: np.ndarray  # (points, channels) K_d, >= 0
    residual: np.ndarray  # (points,) root mean square of the weighted residuals, units of the observations
    sigma_log_gamma: np.ndarray  # (points,) standard deviation of log gamma, NaN where gamma is
    nearest: np.ndarray  # (points,) smallest phi among the observations used, radians; infinite where none was
    used: np.ndarray  # (points,) int32, observations used
    lit: np.ndarray  # (points,) int32, observations within two half widths
    flags: np.ndarray  # (points,) uint8, bits of FitFlag


def fit_torrance_sparrow(
    phi, amplitude, *, weights=None, attenuation=None, diffuse=None, gamma_bounds=GAMMA_BOUNDS
) -> PointFits:
    """Fit K_d q + K_s a D(phi; gamma) to the observations of many points; K per channel, gamma per point.

    phi: (points, observations), angle(normal, half vector), radians, 0 .. pi.  amplitude: (points, observations,
    channels), observations relative to the white reference (or specular parts alone, with `diffuse` None).
    attenuation a: (points, observations), F G / cos theta_r (Tominaga and Tanaka 2004, eq. 10; K_s is then beta) or 1 /
    cos theta_r (Miyazaki et al. 2007, eq. 8); ones if None.  diffuse q: (points, observations), the Lambert term
    max(cos theta_i, 0); no diffuse term if None.
    weights: (points, observations), >= 0, inverse variances up to a factor; 0 leaves an observation out, as does any
    value that is not finite.  gamma_bounds: radians, the range searched.

    Fitted in float32 if amplitude is float32, else in float64.  Raises UserError for shapes that do not agree, negative
    weights, or bounds that are not 0 < low < high.
    """
    arrays = _prepare(phi, amplitude, attenuation, diffuse, weights)
    low, high = gamma_bounds
    if not 0 < low < high < np.inf:
        raise UserError(f"gamma_bounds: expected 0 < low < high in radians, found {gamma_bounds}; e.g. {GAMMA_BOUNDS}")
    strengths, reports = project_points(*arrays, float(np.log(low)), float(np.log(high)))
    return _judge(arrays, strengths, reports, low, high)


def _prepare(
    phi, amplitude, attenuation, diffuse, weights
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return contiguous arrays of one float type; fill in the defaults and check the shapes."""
    amplitude = np.asarray(amplitude)
    real = np.float32 if amplitude.dtype == np.float32 else np.float64
    if amplitude.ndim != 3:
        raise UserError(f"amplitude: expected (points, observations, channels), found shape {amplitude.shape}")
    shape = amplitude.shape[:2]
    weights = np.ones(shape, real) if weights is None else weights
    attenuation = np.ones(shape, real) if attenuation is None else attenuation
    diffuse = np.zeros(shape, real) if diffuse is None else diffuse
    columns = []
    for name, array in (("phi", phi), ("attenuation", attenuation), ("diffuse", diffuse), ("weights", weights)):
        array = np.asarray(array)
        if array.shape != shape:
            raise UserError(f"{name}: expected shape {shape} as amplitude's first axes, found {array.shape}")
        columns.append(np.ascontiguousarray(array, real))
    if np.any(columns[3] < 0):
        raise UserError(f"weights: expected values >= 0, found {np.nanmin(columns[3])}; 0 leaves an observation out")
    angles, attenuation, diffuse, weights = columns
    return angles, np.ascontiguousarray(amplitude, real), attenuation, diffuse, weights


def _judge(arrays, strengths, reports, low, high) -> PointFits:
    """Derive flags and standard deviations from the solver's reports; set unsupported lobes to 'no highlight'."""
    _, amplitude, _, diffuse, weights = arrays
    channels = amplitude.shape[2]
    has_diffuse = np.any(diffuse != 0, axis=1)
    used, gamma = reports[:, USED].astype(np.int32), reports[:, GAMMA].copy()
    unknowns = channels * (1 + has_diffuse) + 1
    freedom = used * channels - unknowns
    rss, gained = reports[:, RSS], reports[:, RSS_DIFFUSE] - reports[:, RSS]
    noise = rss / np.maximum(freedom, 1)
    rounding = (64 * np.finfo(amplitude.dtype).eps) ** 2 * used * channels
    few = (used < 2 + has_diffuse) | (freedom < 0)
    dark = ~few & ((gained <= rounding) | (gained < SIGNIFICANCE * (channels + 1) * noise))
    curvature = reports[:, CURVATURE]
    sigma = np.sqrt(noise / np.where(curvature > 0, curvature, 1))
    sigma = np.where(curvature > 0, sigma, np.inf)
    lit = reports[:, LIT].astype(np.int32)
    vague = (lit < 2) | (sigma > UNDETERMINED_LOG_GAMMA)
    edge = (gamma <= low * (1 + 1e-4)) | (gamma >= high * (1 - 1e-4))
    broken = ~(np.isfinite(rss) & np.isfinite(reports[:, RSS_DIFFUSE]) & np.isfinite(strengths).all(axis=(1, 2)))
    few |= broken  # sums or strengths beyond the float type: nothing can be said of the point
    lost = few | dark
    flags = FitFlag.TOO_FEW * few | FitFlag.NO_HIGHLIGHT * dark
    flags = flags | np.where(lost, 0, FitFlag.UNDETERMINED * vague | FitFlag.AT_BOUND * edge)
    flags = flags | FitFlag.NOT_FINITE * (broken | (used < np.sum(weights > 0, axis=1)))
    specular, kd = strengths[..., 0].copy(), np.where(lost[:, None], strengths[..., 2], strengths[..., 1])
    specular[lost], gamma[lost], sigma = 0, np.nan, np.where(lost, np.nan, sigma)
    kd[broken] = 0
    squares = np.where(lost, reports[:, RSS_DIFFUSE], rss)
    with np.errstate(over="ignore", invalid="ignore"):
        residual = reports[:, SCALE] * np.sqrt(squares / np.maximum(used * channels, 1))
    residual[~np.isfinite(residual)] = 0
    lit = np.where(lost, 0, lit)
    return PointFits(gamma, specular, kd, residual, sigma, reports[:, NEAREST], used, lit, flags.astype(np.uint8))


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
        lobe, top_lobe = _scale(attenuation * root)
        diffuse, top_diffuse = _scale(diffuse * root)
        values = values * root
        flat, top = _scale(values.reshape(-1, values.shape[-1]))
        values, total = flat.reshape(values.shape), _products(diffuse, diffuse)
        product = _products(diffuse, values)
        alone = np.where((product > 0) & (total > 0), product / total, 0)
        left = values - alone[:, None] * diffuse
        scales, used = np.stack([top_lobe, top_diffuse, top]), (root > 0).sum(axis=0)
        return cls(phi * phi, lobe, diffuse, left, alone, _products(diffuse, left), total, scales, used)

    def some(self, chosen: np.ndarray) -> "_Points":
        """Return the chosen points."""
        return _Points(*(np.ascontiguousarray(values[..., chosen]) for values in vars(self).values()))


def _scale(column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Divide a column (n, points) by its mean absolute value, which is returned; 1 where it is 0."""
    mean = np.abs(column).mean(axis=0)
    mean = np.where(mean > 0, mean, 1)
    return column / mean, mean


def _products(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Sum the products (..., observations, points) over the observations."""
    return np.einsum("...op,...op->...p", one, other)


def _fit(points: _Points, log_min: float, log_max: float, report: np.ndarray) -> np.ndarray:
    """Fit points and report on them; returns (points, channels, 3) strengths in the units of the observations."""
    step = np.log(2)  # of the grid: the next width is half, whose lobe is the fourth power
    t = log_max - step * _best_of_grid(points, log_max, int(np.ceil((log_max - log_min) / step)) + 1)
    t = np.maximum(t, log_min)
    t, strengths, curvature, rss = _refine(points, t, np.maximum(t - step, log_min), np.minimum(t + step, log_max))
    report[:, GAMMA], report[:, CURVATURE], report[:, RSS] = np.exp(t), curvature, rss
    report[:, RSS_DIFFUSE] = _products(points.left, points.left).sum(axis=0)
    report[:, USED], report[:, SCALE] = points.used, points.scales[2]
    square = np.where(points.lobe > 0, points.square, np.inf)
    report[:, NEAREST] = np.sqrt(square.min(axis=0))
    report[:, LIT] = (square < 4 * report[:, GAMMA] ** 2).sum(axis=0)  # within two half widths: D above 1 / 16
    lobe, diffuse, values = points.scales
    return np.stack(
        [strengths[0] * (values / lobe), strengths[1] * (values / diffuse), points.alone * (values / diffuse)]
    ).T


def _inverse_determinant(a, b, d):
    """Compute 1 / (a d - b^2), or 0 where the two columns are collinear within the rounding of their type."""
    tolerance = 1e-5 if a.itemsize == 4 else 1e-12
    determinant = a * d - b * b
    return np.where(determinant > tolerance * a * d, 1 / determinant, 0)


def _strengths(a, b, inverse, u, points: _Points) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solve non-negative least squares in two unknowns, relative to the fit by the diffuse column alone.

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
    """Find the index (points,) of the best half width of the grid, gamma_max / 2^index; the widest of equal ones."""
    real = points.square.dtype.type
    tiny, margin = np.finfo(real).tiny, real(1.00001) if real == np.float32 else real(1 + 1e-12)
    height = np.exp2(-points.square * real(np.exp(-2 * log_max)))
    best, index = np.full(len(points.total), real(-1)), np.zeros(len(points.total), int)
    for step in range(steps):
        s = points.lobe * height
        a, b = _products(s, s), _products(s, points.diffuse)
        gain = _strengths(a, b, _inverse_determinant(a, b, points.total), _products(s, points.left), points)[2]
        gain = gain.sum(axis=0)
        better = gain > best * margin
        best, index = np.where(better, gain, best), np.where(better, step, index)
        height = np.maximum((height * height) ** 2 - tiny, 0)  # powers of subnormal numbers are slow
    return index


def _evaluate(points: _Points, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Compute strengths (2, channels, points) at log gamma t; slope, curvature, rss (points,) of the projected problem.

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


def _refine(points: _Points, t: np.ndarray, lo: np.ndarray, hi: np.ndarray):
    """Refine t = log gamma in lo .. hi by safeguarded Gauss-Newton; return (t, strengths, curvature, rss) at that t."""
    real = points.square.dtype
    settled = 1e-3 if real == np.float32 else 1e-9  # of the step before: what is left is far smaller
    t, lo, hi = (values.astype(real) for values in (t, lo, hi))
    strengths = np.empty((2, *points.alone.shape), real)
    curvature, rss = np.empty_like(t), np.empty_like(t)
    numbers, moved = np.arange(len(t)), np.full(len(t), np.inf)  # of the points that are still in `points`
    for _ in range(REFINEMENTS + 1):
        here = t[numbers]
        strengths[..., numbers], slope, curvature[numbers], rss[numbers] = _evaluate(points, here)
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
