"""What a separation looks like in numbers: shares, negative values, noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nishiki.polarisation.polarisation import SeparatedView

LIT = 0.1
"""Share of the brightest hundredth of a picture from which a pixel shows the object and not the dark round it."""


@dataclass(frozen=True)
class SeparationStatistics:
    """Of one view, over the valid pixels of the object and all channels.

    valid: share of the object's pixels; diffuse, specular: means; negative: share of specular values below 0;
    negative_mean: their mean; noise: standard deviation of the specular values' noise; doubtful: share of values below
    -3 noise, which noise alone leaves at about 0.1 %. None where nothing is valid.
    """

    valid: float
    diffuse: float | None
    specular: float | None
    negative: float | None
    negative_mean: float | None
    noise: float | None
    doubtful: float | None


def statistics_of(view: SeparatedView, shown: np.ndarray | None = None) -> SeparationStatistics:
    """Statistics of one separated view over the pixels that show the object, (rows, columns) bool; None: over all."""
    shown = np.ones(view.valid.shape, bool) if shown is None else shown
    share = float(view.valid[shown].mean()) if shown.any() else 0.0
    inside = view.valid & shown
    values = view.specular[inside]
    if not values.size:
        return SeparationStatistics(share, None, None, None, None, None, None)
    noise = noise_of(view.specular, inside)
    below = values[values < 0]
    return SeparationStatistics(
        share,
        float(view.diffuse[inside].mean(dtype=np.float64)),
        float(values.mean(dtype=np.float64)),
        float((values < 0).mean()),
        float(below.mean(dtype=np.float64)) if below.size else 0.0,
        noise,
        float((values < -3 * noise).mean()) if noise is not None else None,
    )


def select_lit(total: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Select, (rows, columns) bool, the pixels of total (rows, columns, channels) that are a tenth of the brightest."""
    light = total.mean(axis=-1)
    bright = float(np.percentile(light[valid], 99)) if valid.any() else 0.0
    return light >= LIT * bright if bright > 0 else np.ones(light.shape, bool)


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
