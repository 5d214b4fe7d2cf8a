"""Interpolate positive functions on the hemisphere, from a grid or from scattered directions."""

from dataclasses import dataclass

import numpy as np

MARGIN = 4  # nodes added on every side, so that the spline's ends are far from where it is used
RUN_OUT = 24  # rows that the straight line beyond the horizon is followed: the filter forgets by 0.27 a row
FLOOR = 1e-9  # of the largest value: smaller ones, zeros among them, have no usable logarithm


def coefficients(values: np.ndarray) -> np.ndarray:
    """Compute cubic B-spline coefficients (nt + 2 MARGIN, np + 2 MARGIN, channels) of log values (nt, np, channels).

    Rows are theta from the pole to the horizon, columns phi round the azimuth (an even number). Beyond the pole the
    function goes on at phi + pi; beyond the horizon the logarithm goes on as a straight line. ValueError otherwise.
    """
    from scipy.ndimage import spline_filter1d

    values = np.asarray(values, np.float64)
    nt, around, _ = values.shape
    if around % 2 or nt <= MARGIN or around < 2 * MARGIN:
        raise ValueError(f"grid of {nt} x {around}: more than {MARGIN} rows, an even number of columns from 8 expected")
    least = np.maximum(values.max(axis=(0, 1)), 1e-300) * FLOOR
    logs = np.log(np.maximum(values, least))
    logs[0] = logs[0].mean(axis=0)  # one value at the pole, whatever the azimuth
    step = np.arange(1, RUN_OUT + 1)[:, None, None]
    half = np.concatenate([logs, logs[-1] + step * (logs[-1] - logs[-2])])
    # from horizon to horizon through the pole: there the spline is as smooth as anywhere
    arc = np.concatenate([np.roll(half[1:], around // 2, axis=1)[::-1], half])
    first = len(half) - 1 - MARGIN
    inner = spline_filter1d(arc, 3, axis=0, mode="mirror")[first : first + nt + 2 * MARGIN]
    # on a circle the filter [1/6, 4/6, 1/6] is a division in the Fourier domain
    response = (2 + np.cos(2 * np.pi * np.fft.rfftfreq(around))) / 3
    turned = np.fft.irfft(np.fft.rfft(inner, axis=1) / response[None, :, None], n=around, axis=1)
    return np.ascontiguousarray(np.concatenate([turned[:, -MARGIN:], turned, turned[:, :MARGIN]], axis=1))


def evaluate(spline: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
    """Evaluate exp of the spline (..., channels) at unit vectors (..., 3); 0 below the horizon."""
    from scipy.ndimage import map_coordinates

    (rows, columns, _), (x, y, z) = spline.shape, outgoing.reshape(-1, 3).T
    down = np.arctan2(np.hypot(x, y), z) / (np.pi / 2) * (rows - 2 * MARGIN - 1)
    turn = np.mod(np.arctan2(y, x) / (2 * np.pi), 1) * (columns - 2 * MARGIN)
    places = np.where(z >= 0, (down + MARGIN, turn + MARGIN), MARGIN)
    logs = [map_coordinates(channel, places, order=3, prefilter=False) for channel in np.moveaxis(spline, -1, 0)]
    values = np.where(z >= 0, np.exp(logs + 0 * turn), 0.0)  # what is no direction has no value
    return values.T.reshape(*outgoing.shape[:-1], spline.shape[2])


SMOOTHING = np.logspace(-12, 0, 25)  # of the roughness against the misfit, over the kernel's largest eigenvalue
LEAST_SIGMA = 0.01  # of a logarithm: what repeated measurements leave at best


@dataclass(frozen=True)
class SmoothingSpline:
    """A fitted spline."""

    points: np.ndarray  # (n, 2) on the disc
    weights: np.ndarray  # (n, channels)
    trend: np.ndarray  # (terms, channels)
    folds: np.ndarray  # (k, 2): signs of the symmetric images
    smoothing: float  # the factor chosen, over the kernel's largest eigenvalue
    left_out: np.ndarray  # (n, channels): error of the logarithm at each point when it is predicted from the others

    def __call__(self, places: np.ndarray) -> np.ndarray:
        """Evaluate logarithms (m, channels) at places (m, 2)."""
        radial = symmetric_kernel(places, self.points, self.folds)
        return radial @ self.weights + trend_terms(places, self.folds) @ self.trend


def symmetric_kernel(a: np.ndarray, b: np.ndarray, folds: np.ndarray) -> np.ndarray:
    """Average r^3 over the distances from a (m, 2) to the images of b (n, 2): (m, n)."""
    total = np.zeros((len(a), len(b)))
    for fold in folds:
        image = b * fold
        squared = (a[:, :1] - image[:, 0]) ** 2 + (a[:, 1:] - image[:, 1]) ** 2
        total += squared * np.sqrt(squared)
    return total / len(folds)


def trend_terms(places: np.ndarray, folds: np.ndarray) -> np.ndarray:
    """Return 1, x and y (m, terms): those that the symmetry leaves."""
    kept = [axis for axis in (0, 1) if (folds[:, axis] == 1).all()]
    return np.column_stack([np.ones(len(places)), *(places[:, axis] for axis in kept)])


def fit_spline(points: np.ndarray, logs: np.ndarray, sigma: np.ndarray, folds: np.ndarray) -> SmoothingSpline:
    """Fit a polyharmonic spline with the smoothing that predicts each point best from the others.

    Ordinary cross-validation: Wahba, Spline Models for Observational Data, 1990, ch. 4.

    points (n, 2), all different; logs (n, channels); sigma (n,): standard deviation of the logarithms, 0 where unknown.
    One eigenvalue problem of size n serves every smoothing and every channel. ValueError below four points or where
    they do not fix the trend.
    """
    trend = trend_terms(points, folds)
    if len(points) < 4 or np.linalg.matrix_rank(trend) < trend.shape[1]:
        raise ValueError(f"{len(points)} directions do not determine a surface; at least 4, not in one line, expected")
    deviation = np.sqrt(sigma**2 + LEAST_SIGMA**2)
    scale = np.sqrt(np.mean(deviation**2)) / deviation  # noisy points count less
    matrix = scale[:, None] * symmetric_kernel(points, points, folds) * scale
    basis = np.linalg.qr(scale[:, None] * trend, mode="complete")[0][:, trend.shape[1] :]
    eigenvalues, vectors = np.linalg.eigh(basis.T @ matrix @ basis)
    eigenvalues, vectors = np.maximum(eigenvalues, 0.0), basis @ vectors
    scaled = vectors.T @ (scale[:, None] * logs)
    largest = max(float(eigenvalues[-1]), 1e-300)
    tried = []
    for factor in SMOOTHING:
        damped = 1 / (eigenvalues + factor * largest)
        weights = vectors @ (damped[:, None] * scaled)
        left_out = weights / (vectors**2 @ damped)[:, None]
        tried.append((float((left_out**2).sum()), factor, weights, left_out))
    _, factor, weights, left_out = min(tried, key=lambda entry: entry[0])
    misfit = scale[:, None] * logs - matrix @ weights - factor * largest * weights
    beta = np.linalg.lstsq(scale[:, None] * trend, misfit, rcond=None)[0]
    return SmoothingSpline(points, scale[:, None] * weights, beta, folds, float(factor), left_out / scale[:, None])
