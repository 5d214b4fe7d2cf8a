"""Correct the Wiener estimator locally: a kernel regression of the residual of the linear map.

Real reflectances fill a curved sheet of spectrum space; a linear map can only return a plane through it. Among training
spectra whose camera responses resemble the pixel's, the residual of the linear map is much alike, and a smooth function
of the response predicts it. Kernel ridge regression with a compact kernel learns that function; away from the training
responses it returns exactly zero, which leaves the Wiener estimate.
"""

from dataclasses import dataclass

import numpy as np

TAPER_START, TAPER_END = 1.0, 3.0  # whitened standard deviations beyond the training box
RIDGES = (0.03, 0.1, 0.3, 1.0, 3.0)
RIDGE_TOLERANCE = 0.01  # the smoothest correction whose left-out error is within this part of the least
DARK = 0.05  # mean response at which the correction has half its weight: black stays black


@dataclass(frozen=True)
class ResponseSpace:
    """Whitened coordinates z = whiten @ (sqrt(response) - mean) and the box that the training set fills.

    The square root spreads dark colours as noise and eye do; whitening measures distance in standard deviations, so
    that the small chromatic differences count as much as the large one of lightness.
    """

    mean: np.ndarray  # (N,)
    whiten: np.ndarray  # (N, N)
    low: np.ndarray  # (N,) smallest z of the training set
    high: np.ndarray  # (N,) largest

    def coordinates(self, responses: np.ndarray) -> np.ndarray:
        """Compute z (P, N) of responses (P, N); negative responses count as zero."""
        return (np.sqrt(np.maximum(responses, 0.0)) - self.mean) @ self.whiten.T

    def taper(self, z: np.ndarray) -> np.ndarray:
        """Compute the taper (P,): 1 within 1 standard deviation of the training box, 0 beyond 3, smooth between."""
        outside = np.maximum(np.maximum(self.low - z, z - self.high), 0.0)
        t = np.clip((TAPER_END - outside) / (TAPER_END - TAPER_START), 0.0, 1.0)
        return np.prod(t * t * (3.0 - 2.0 * t), axis=-1)


@dataclass(frozen=True)
class LocalCorrection:
    """Correction = taper(z) * dark(response) * sum_m kernel(|z - centre_m| / radius) * weights_m."""

    centres: np.ndarray  # (M, N) in z
    weights: np.ndarray  # (M, B) per centre, B bands or coefficients
    radius: float
    variance: np.ndarray  # (M,) mean square error of the estimate near each centre, from leaving samples out
    far_variance: float  # mean square error of the linear map alone
    gamut_distance: float  # z distance to the nearest centre beyond which a response counts as unlike the training set
    left_out: np.ndarray  # (61,) mean square error over the training set, each sample left out in turn


def response_space(responses: np.ndarray, *, noise: float) -> ResponseSpace:
    """Whiten the space of training responses (M, N). Directions whose spread is below the noise are not blown up."""
    roots = np.sqrt(np.maximum(responses, 0.0))
    mean = roots.mean(axis=0)
    spread = roots - mean
    values, vectors = np.linalg.eigh(spread.T @ spread / max(len(spread), 1))
    # Noise of the root: d sqrt(r) = dr / (2 sqrt(r)); 1e-6 keeps channels that are copies of each other harmless.
    floor = max(noise / (2.0 * max(float(mean.mean()), 1e-3)), 1e-6)
    whiten = (vectors / np.sqrt(np.maximum(values, 0.0) + floor**2)).T
    z = spread @ whiten.T
    return ResponseSpace(mean=mean, whiten=whiten, low=z.min(axis=0), high=z.max(axis=0))


def compact_kernel(ratio: np.ndarray) -> np.ndarray:
    """Evaluate Wendland's C2 function (1 - r)^4 (4 r + 1) for r < 1, else 0: positive definite up to three dimensions.

    Source: Wendland, Adv. Comput. Math. 4 (1995) 389-396. In more dimensions the ridge keeps the system definite.
    """
    rest = np.maximum(1.0 - ratio, 0.0)
    return rest**4 * (4.0 * ratio + 1.0)


def dark_weight(responses: np.ndarray) -> np.ndarray:
    """Compute b / (b + 0.05) (P,) of the mean non-negative response b."""
    brightness = np.maximum(responses, 0.0).mean(axis=-1)
    return brightness / (brightness + DARK)


def fit_correction(
    residuals: np.ndarray,
    responses: np.ndarray,
    space: ResponseSpace,
    *,
    centres: int,
    radius: float,
    ridge: float | None,
) -> LocalCorrection:
    """Fit the correction to residuals (M, 61) of a linear estimator at training responses (M, N).

    centres : kernels, at most M; placed by k-means from farthest-point starts, so deterministic.
    radius : support of a kernel in whitened standard deviations. ridge : > 0, weight of smoothness against the
    data; None takes the largest of `RIDGES` whose error, when each training sample is left out in turn, is within 1 %
    of the least: real surfaces are never exactly those of the training set, and smooth functions extrapolate better.
    """
    z = space.coordinates(responses)
    chosen = place_centres(z, min(centres, len(z)))
    weight = dark_weight(responses)
    design = compact_kernel(distances(z, chosen) / radius) * weight[:, None]  # (M, centres)
    smooth = compact_kernel(distances(chosen, chosen) / radius)
    scale = float(np.mean(weight**2))
    ridges = np.array(RIDGES if ridge is None else [ridge]) * scale
    solution, squared = _ridge_regression(residuals, design, smooth, ridges)
    mean_square = squared.mean(axis=1)
    nearest = distances(z, chosen).min(axis=1)
    # the mean square error around each centre is that of the nearest training samples
    count = min(8, len(z))
    near = np.argpartition(distances(chosen, z), count - 1, axis=1)[:, :count]
    return LocalCorrection(
        centres=chosen,
        weights=solution,
        radius=radius,
        variance=mean_square[near].mean(axis=1),
        far_variance=float(np.mean(residuals**2)),
        gamut_distance=float(2.0 * np.percentile(nearest, 99.0) + 0.1),
        left_out=squared.mean(axis=0),
    )


def _ridge_regression(residuals, design, smooth, ridges):
    """Compute solution (centres, 61) and squared left-out errors (M, 61) of the largest ridge near the least of them.

    Minimises |residuals - design x|^2 + ridge x' smooth x. One pair of eigendecompositions makes both forms diagonal,
    so that every further ridge costs next to nothing. Leaving sample m out changes its residual by 1 / (1 - h_m), with
    h_m its leverage (Allen, Technometrics 16 (1974) 125-127); the floor of 0.05 keeps a sample that alone decides a
    centre from counting without bound.
    """
    values, vectors = np.linalg.eigh(smooth)
    kept = values > 1e-10 * values[-1]  # in many dimensions the kernel is not definite: leave those directions out
    root = vectors[:, kept] / np.sqrt(values[kept])
    values, vectors = np.linalg.eigh(root.T @ (design.T @ design) @ root)
    values, root = np.maximum(values, 0.0), root @ vectors
    modes = design @ root  # (M, J)
    target = modes.T @ residuals
    candidates = []
    for ridge in ridges:
        shrink = 1.0 / (values + ridge)
        leverage = modes**2 @ shrink
        error = (residuals - modes @ (shrink[:, None] * target)) / np.maximum(1.0 - leverage, 0.05)[:, None]
        candidates.append((root @ (shrink[:, None] * target), error**2))
    limit = (1.0 + RIDGE_TOLERANCE) ** 2 * min(squared.mean() for _, squared in candidates)
    return next(candidate for candidate in reversed(candidates) if candidate[1].mean() <= limit)


def evaluate_correction(
    correction: LocalCorrection, space: ResponseSpace, responses: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Evaluate the correction: values (P, B), variance (P,), distance to the nearest centre (P,); float64."""
    responses = np.asarray(responses, dtype=float)
    z = space.coordinates(responses)
    apart = distances(z, correction.centres)
    kernel = compact_kernel(apart / correction.radius)
    # The fourth power makes the smoother of the variance narrower than that of the values, at no further square root.
    share = kernel**4
    variance = (share @ correction.variance + 1e-2 * correction.far_variance) / (share.sum(axis=1) + 1e-2)
    values = (kernel @ correction.weights) * (space.taper(z) * dark_weight(responses))[:, None]
    return values, variance, apart.min(axis=1)


def distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Compute Euclidean distances (P, M) between rows of a (P, N) and b (M, N), by differences (no cancellation)."""
    total = np.zeros((len(a), len(b)))
    for axis in range(a.shape[1]):
        total += (a[:, axis, None] - b[None, :, axis]) ** 2
    return np.sqrt(total)


def place_centres(z: np.ndarray, count: int) -> np.ndarray:
    """Place k-means centres (count, N) of z (M, N), started from farthest points; deterministic."""
    if count == len(z):
        return z.copy()
    first = int(np.argmin(np.sum(z**2, axis=1)))
    picked, far = [first], np.sum((z - z[first]) ** 2, axis=1)
    for _ in range(count - 1):
        picked.append(int(np.argmax(far)))
        far = np.minimum(far, np.sum((z - z[picked[-1]]) ** 2, axis=1))
    centres = z[picked].copy()
    for _ in range(8):
        label = np.argmin(distances(z, centres), axis=1)
        members = np.bincount(label, minlength=count)
        for axis in range(z.shape[1]):
            total = np.bincount(label, weights=z[:, axis], minlength=count)
            centres[:, axis] = np.where(members > 0, total / np.maximum(members, 1), centres[:, axis])
    return centres
