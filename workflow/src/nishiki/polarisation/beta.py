"""What the polarisers let through, from photographs of a white board (O appendix 1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nishiki.errors import UserError

LIT = 0.1  # of the board's bright end: darker pixels say nothing
FILLED = 0.25  # of a block's pixels must be lit


@dataclass(frozen=True)
class Beta:
    """channel (channels,): beta of the whole board; field (rows, columns, channels) float32: by place, NaN where
    it is below the limit; covered: share of the blocks that the board fills, the others have the channel's value;
    low: pixels below the limit in a channel; spread: (5th, 95th percentile) of the blocks relative to the channel."""

    channel: tuple[float, ...]
    field: np.ndarray
    covered: float
    low: int
    spread: tuple[float, float]


def board_ratio(
    over: np.ndarray, under: np.ndarray, *, block: int, least: float, what: str = "beta", local: bool = True
) -> Beta:
    """Ratio of two board images (rows, columns, channels), sums over blocks of `block` pixels, bilinear in between.

    A ratio below `least` is never divided by: such pixels become NaN and are counted. local False: one value a channel.

    Raises UserError where a channel's ratio as a whole is below `least`, or the board is dark.
    """
    over, under = np.asarray(over, np.float64), np.asarray(under, np.float64)
    known = np.isfinite(over) & np.isfinite(under)  # a value that is missing in one must not count in the other
    over, under = np.where(known, over, 0.0), np.where(known, under, 0.0)
    bright = np.percentile(under, 99, axis=(0, 1))
    if (bright <= 0).any():
        raise UserError(
            f"{what}: the white board is dark in channel {int(np.argmin(bright))}. Remedy: photograph it again"
        )
    lit = known & (under > LIT * bright) & (over >= 0)
    top, bottom = (np.where(lit, each, 0.0) for each in (over, under))
    channel = top.sum(axis=(0, 1)) / bottom.sum(axis=(0, 1))
    if (channel < least).any():
        place = int(np.argmin(channel))
        raise UserError(
            f"{what}: the board through the polarisers has {channel[place]:.2g} of its light in channel {place}, "
            "the limit is "
            f"{least:g}; the result would be mostly noise. Remedy: leave the channel out, expose "
            "longer, or turn the polariser"
        )
    blocks = channel[None, None]
    covered, spread = 1.0, (1.0, 1.0)
    if local:
        cells = [_cells(each, block) for each in (top, bottom, lit)]
        filled = cells[2] >= FILLED * _cells(np.ones(lit.shape), block)
        blocks = np.where(filled, cells[0] / np.where(filled, cells[1], 1.0), channel)
        covered = float(filled.mean())
        shares = (blocks / channel)[filled]
        spread = tuple(np.percentile(shares, (5, 95)).tolist()) if shares.size else spread
    field = _between(blocks, over.shape[:2], block)
    low = field < least
    field = np.where(low, np.nan, field).astype(np.float32)
    return Beta(tuple(channel.tolist()), field, covered, int(low.any(axis=-1).sum()), spread)


def _cells(values: np.ndarray, block: int) -> np.ndarray:
    """Sums over blocks of block x block pixels, the last ones smaller."""
    rows, columns = (np.arange(0, size, block) for size in values.shape[:2])
    return np.add.reduceat(np.add.reduceat(values.astype(np.float64), rows, axis=0), columns, axis=1)


def _between(blocks: np.ndarray, shape: tuple[int, int], block: int) -> np.ndarray:
    """Bilinear between the centres of the blocks, constant outside them: (*shape, channels) float64."""
    for axis, size in enumerate(shape):
        count = blocks.shape[axis]
        centres = (np.minimum(np.arange(count) * block + block, size) + np.arange(count) * block - 1) / 2
        place = np.interp(np.arange(size), centres, np.arange(count)) if count > 1 else np.zeros(size)
        lower = np.minimum(place.astype(int), max(count - 2, 0))
        upper = np.minimum(lower + 1, count - 1)
        weight = (place - lower).reshape([-1 if k == axis else 1 for k in range(3)])
        blocks = np.take(blocks, lower, axis=axis) * (1 - weight) + np.take(blocks, upper, axis=axis) * weight
    return blocks
