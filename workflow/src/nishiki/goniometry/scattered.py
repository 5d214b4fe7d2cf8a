"""Interpolation of scattered logarithms on the disc of directions, with the symmetry of the weave built in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

SMOOTHING = np.logspace(-12, 0, 25)  # of the roughness against the misfit, over the kernel's largest eigenvalue
LEAST_SIGMA = 0.01  # of a logarithm: what repeated measurements leave at best
Kernel = Literal["thin_plate", "cubic"]
Predictor = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class SmoothingSpline:
    """points (n, 2) on the disc; weights (n, channels); trend (terms, channels); folds (k, 2): signs of the symmetric
    images; smoothing: the factor chosen, over the kernel's largest eigenvalue; left_out (n, channels): error of the
    logarithm at each point when it is predicted from the others."""

    points: np.ndarray
    weights: np.ndarray
    trend: np.ndarray
    folds: np.ndarray
    kernel: Kernel
    smoothing: float
    left_out: np.ndarray

    def __call__(self, places: np.ndarray) -> np.ndarray:
        """Logarithms (m, channels) at places (m, 2)."""
        radial = symmetric_kernel(places, self.points, self.folds, self.kernel)
        return radial @ self.weights + trend_terms(places, self.folds) @ self.trend


def symmetric_kernel(a: np.ndarray, b: np.ndarray, folds: np.ndarray, kernel: Kernel) -> np.ndarray:
    """Mean of r^2 log r or r^3 over the distances from a (m, 2) to the images of b (n, 2): (m, n)."""
    total = np.zeros((len(a), len(b)))
    for fold in folds:
        image = b * fold
        squared = (a[:, :1] - image[:, 0]) ** 2 + (a[:, 1:] - image[:, 1]) ** 2
        if kernel == "cubic":
            total += squared * np.sqrt(squared)
        else:
            total += 0.5 * squared * np.log(np.maximum(squared, 1e-300))
    return total / len(folds)


def trend_terms(places: np.ndarray, folds: np.ndarray) -> np.ndarray:
    """1, x and y (m, terms): those that the symmetry leaves."""
    kept = [axis for axis in (0, 1) if (folds[:, axis] == 1).all()]
    return np.column_stack([np.ones(len(places)), *(places[:, axis] for axis in kept)])


def fit_spline(
    points: np.ndarray, logs: np.ndarray, sigma: np.ndarray, folds: np.ndarray, *, kernel: Kernel = "cubic"
) -> SmoothingSpline:
    """Polyharmonic smoothing spline whose smoothing predicts each point best from the others (ordinary
    cross-validation; Wahba, Spline Models for Observational Data, 1990, ch. 4).

    points (n, 2), all different; logs (n, channels); sigma (n,): standard deviation of the logarithms, 0 where unknown.
    One eigenvalue problem of size n serves every smoothing and every channel. ValueError below four points or where
    they do not fix the trend.
    """
    trend = trend_terms(points, folds)
    if len(points) < 4 or np.linalg.matrix_rank(trend) < trend.shape[1]:
        raise ValueError(f"{len(points)} directions do not determine a surface; at least 4, not in one line, expected")
    deviation = np.sqrt(sigma**2 + LEAST_SIGMA**2)
    scale = np.sqrt(np.mean(deviation**2)) / deviation  # noisy points count less
    matrix = scale[:, None] * symmetric_kernel(points, points, folds, kernel) * scale
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
    return SmoothingSpline(
        points, scale[:, None] * weights, beta, folds, kernel, float(factor), left_out / scale[:, None]
    )


def fit_linear(points: np.ndarray, logs: np.ndarray, folds: np.ndarray) -> Predictor:
    """Linear on the triangles of the points and their images; the nearest point's value outside them.

    Triangles over symmetric points need not be symmetric, so places are folded first.
    """
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

    unfolded, repeated = unfold(points, logs, folds)
    inside, nearest = LinearNDInterpolator(unfolded, repeated), NearestNDInterpolator(unfolded, repeated)

    def predict(places: np.ndarray) -> np.ndarray:
        places = folded(places, folds)
        values = inside(places)
        return np.where(np.isfinite(values), values, nearest(places))

    return predict


def folded(places: np.ndarray, folds: np.ndarray) -> np.ndarray:
    """Places (m, 2) brought to one of their images: that with the greatest x, then the greatest y."""
    best = places
    for fold in folds:
        image = places * fold
        better = (image[:, 0] > best[:, 0]) | ((image[:, 0] == best[:, 0]) & (image[:, 1] > best[:, 1]))
        best = np.where(better[:, None], image, best)
    return best


def unfold(points: np.ndarray, logs: np.ndarray, folds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points with their symmetric images, each place once, and the values that belong to them."""
    places = np.concatenate([points * fold for fold in folds])
    _, first = np.unique(np.round(places, 9) + 0.0, axis=0, return_index=True)
    first.sort()
    return places[first], np.concatenate([logs] * len(folds))[first]
