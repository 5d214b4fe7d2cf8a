"""The height of a relief for the viewer's cast shadows: 16 bits, predicted from neighbours, in a zlib stream."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Any

import numpy as np

NOTHING = -32768
STEPS = 65000


def height_block(
    read: Callable[[slice], np.ndarray], shape: tuple[int, int], pitch: float, most_pixels: int, least_step: float
) -> tuple[bytes, dict[str, Any]]:
    """Block of a height map, and what a reader has to know of it.

    read : rows of the map in the unit of `pitch`, NaN where it is not known. Above `most_pixels` it is averaged.
    least_step : of a code, in pixels of the map; larger where 16 bits hold the range no finer. Codes are int16,
    difference from left + above - above left, low bytes of all before the high ones.
    """
    factor = max(1, int(np.ceil(np.sqrt(shape[0] * shape[1] / most_pixels))))
    bands = [_means(read(slice(k, min(k + 64 * factor, shape[0]))), factor) for k in range(0, shape[0], 64 * factor)]
    height = np.concatenate(bands)
    known = np.isfinite(height)
    low, high = (float(height[known].min()), float(height[known].max())) if known.any() else (0.0, 0.0)
    step = max(least_step * pitch, (high - low) / STEPS)
    codes = np.where(known, np.rint((np.nan_to_num(height) - low) / step) - STEPS // 2, NOTHING).astype(np.int16)
    change = np.diff(np.diff(codes, axis=0, prepend=np.int16(0)), axis=1, prepend=np.int16(0))
    data = zlib.compress(np.ascontiguousarray(change.view(np.uint8).reshape(-1, 2).T).tobytes(), 9)
    return data, {
        "rows": height.shape[0],
        "columns": height.shape[1],
        "factor": factor,
        "pitch": pitch * factor,
        "low": low + step * (STEPS // 2),
        "step": step,
        "nothing": NOTHING,
    }


def _means(values: np.ndarray, factor: int) -> np.ndarray:
    """Means over blocks, NaN where half of one is not known."""
    if factor == 1:
        return values
    pad = ((0, -values.shape[0] % factor), (0, -values.shape[1] % factor))
    blocks = np.pad(values.astype(np.float64), pad, mode="edge")
    blocks = blocks.reshape(blocks.shape[0] // factor, factor, blocks.shape[1] // factor, factor)
    known = np.isfinite(blocks)
    count = known.sum(axis=(1, 3))
    total = np.where(known, blocks, 0).sum(axis=(1, 3))
    return np.where(2 * count > factor * factor, total / np.maximum(count, 1), np.nan)
