"""Where the highlights of unknown lighting come from: one direction in the lamp frame, if left-out views confirm it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nishiki.brdf.texels.model import GRAZING

SIGMAS = (0.1, 0.2, 0.4)  # radians, tried
DIRECTIONS = 120  # over the hemisphere around the camera
RIDGE = 0.1  # of the mean square of the lobe over texels
LEAST_GAIN = 0.05  # of the squared residual of the left-out observations
ELSEWHERE = 0.75  # quantile of the directions' gains that the best has to surpass by that much
NOWHERE = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Highlight:
    """direction (3,), 0 0 0 where none is supported; gain: share of the left-out squared residual that it
    explains beyond what most other directions do."""

    direction: tuple[float, float, float]
    gain: float


def fit_highlight(residuals: np.ndarray, normals: np.ndarray, to_camera: np.ndarray, weights: np.ndarray) -> Highlight:
    """The direction whose lobe, fitted to every other observation of each texel, best explains the rest.

    residuals (n, M): what the diffuse term leaves, mean of the channels; normals, to_camera (n, M, 3): unit, in the
    lamp frame of each view; weights (n, M) >= 0.  Every texel has its own K_s >= 0; the direction and one of SIGMAS are
    shared.  Accepted only if the observations that were left out gain LEAST_GAIN more than most
    directions give.
    """
    residuals, weights = residuals.astype(np.float32), weights.astype(np.float32)
    facing = np.maximum(np.sum(normals * to_camera, axis=-1), GRAZING)
    odd = (np.cumsum(weights > 0, axis=1) % 2).astype(np.float32)
    before = float(np.sum(weights * residuals**2))
    if before <= 0:
        return Highlight(NOWHERE, 0.0)
    gains = np.zeros(DIRECTIONS)
    tried = hemisphere(DIRECTIONS)
    for k, towards in enumerate(tried):
        half = to_camera + towards
        half = half / np.maximum(np.linalg.norm(half, axis=-1, keepdims=True), 1e-6)
        apart = np.sum((normals - half) ** 2, axis=-1)  # alpha^2 but for its fourth power
        lit = (np.sum(normals * towards, axis=-1) > 0) / facing
        for sigma in SIGMAS:
            lobe = np.exp(-apart / (2 * sigma**2)) * lit
            both = (weights * odd, weights * (1 - odd))
            gain = sum(_gain(lobe, residuals, fitted, left, before) for fitted, left in (both, both[::-1]))
            gains[k] = max(gains[k], gain)
    # residuals of neighbouring views are alike for other reasons too (wrong normals, shadows) that favour no direction
    best = int(np.argmax(gains))
    gain = float(gains[best] - np.quantile(gains, ELSEWHERE))
    direction = tuple(float(v) for v in tried[best]) if gain > LEAST_GAIN else NOWHERE
    return Highlight(direction, gain)


def _gain(lobe: np.ndarray, residuals: np.ndarray, fitted: np.ndarray, left: np.ndarray, before: float) -> float:
    """Share of the squared residual that K_s from the `fitted` observations takes off those `left` out."""
    below = np.sum(fitted * lobe**2, axis=1)
    ridge = RIDGE * float(np.mean(below)) + 1e-30  # texels that never came near the mirror direction say nothing
    ks = np.maximum(np.sum(fitted * lobe * residuals, axis=1), 0) / (below + ridge)
    off = 2 * ks[:, None] * lobe * residuals - (ks[:, None] * lobe) ** 2
    return float(np.sum(left * off)) / before


def hemisphere(count: int) -> np.ndarray:
    """(count, 3) float32 unit vectors with z > 0, evenly spread on a spiral."""
    k = np.arange(count) + 0.5
    z = 1 - k / count
    turn = np.pi * (1 + np.sqrt(5)) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1).astype(np.float32)
