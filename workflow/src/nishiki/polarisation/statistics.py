"""What a separation looks like in numbers: shares, negative values, noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nishiki.polarisation.polarisation import SeparatedView


@dataclass(frozen=True)
class SeparationStatistics:
    """Of one view, over its valid pixels and all channels.

    valid: share of pixels; diffuse, specular: means; negative: share of specular values below 0; negative_mean: their
    mean; noise: standard deviation of the specular values' noise; doubtful: share of values below -3 noise, which noise
    alone leaves at about 0.1 %. None where nothing is valid.
    """

    valid: float
    diffuse: float | None
    specular: float | None
    negative: float | None
    negative_mean: float | None
    noise: float | None
    doubtful: float | None


def statistics_of(view: SeparatedView) -> SeparationStatistics:
    """Statistics of one separated view."""
    share = float(view.valid.mean())
    values = view.specular[view.valid]
    if not values.size:
        return SeparationStatistics(share, None, None, None, None, None, None)
    noise = noise_of(view.specular, view.valid)
    below = values[values < 0]
    return SeparationStatistics(
        share,
        float(view.diffuse[view.valid].mean(dtype=np.float64)),
        float(values.mean(dtype=np.float64)),
        float((values < 0).mean()),
        float(below.mean(dtype=np.float64)) if below.size else 0.0,
        noise,
        float((values < -3 * noise).mean()) if noise is not None else None,
    )


def noise_of(values: np.ndarray, valid: np.ndarray) -> float | None:
    """Standard deviation of the noise of (rows, columns, channels), from second differences in both directions, which
    plane and edge leave alone (J. Immerkaer, Fast noise variance estimation, CVIU 64, 1996; here the median of their
    absolute values, so that texture counts little). None without a 3 x 3 valid place."""
    if min(valid.shape) < 3:
        return None
    along = values[:, :-2] - 2 * values[:, 1:-1] + values[:, 2:]
    both = along[:-2] - 2 * along[1:-1] + along[2:]
    complete = np.ones(both.shape[:2], bool)
    for row in range(3):
        for column in range(3):
            complete &= valid[row : row + complete.shape[0], column : column + complete.shape[1]]
    if not complete.any():
        return None
    # Weights (1, -2, 1) x (1, -2, 1) have a sum of squares of 36; 0.6745 is the median of |N(0, 1)|.
    return float(np.median(np.abs(both[complete])) / 0.6745 / 6)
