"""Robust levels of blocks and the pixels that stand out of them, compiled."""

import numpy as np
from numba import njit, types
from numba.extending import overload

SUBSAMPLE = 64  # of a block's samples, for the median and the spread
CLIP_SIGMAS = 4.0  # standard deviations about the median of a block


def linear_value(table, code):
    """Linear value of a code: by table for integer codes, the code itself for float ones (compiled code only)."""
    raise NotImplementedError


@overload(linear_value)
def _linear_value(table, code):
    if isinstance(code, types.Float):
        return lambda table, code: code
    return lambda table, code: table[code]


@njit(cache=True, error_model="numpy")
def middle(values, count):
    """Median of the first `count` values, which are sorted in place (by insertion: they are few)."""
    for i in range(1, count):
        value, j = values[i], i
        while j > 0 and values[j - 1] > value:
            values[j] = values[j - 1]
            j -= 1
        values[j] = value
    return 0.5 * (values[(count - 1) // 2] + values[count // 2])


@njit(cache=True, nogil=True, error_model="numpy")
def block_levels(codes, table, row_edges, column_edges, saturated, clip):
    """Robust level of each block and the share of its samples that are not usable.

    codes (rows, columns, channels); table: linear value by code (two zeros for float codes); saturated, clip: codes at
    or above, at or below which a sample is not usable. Level: mean of the usable samples within 4 robust standard
    deviations of their median (median and median absolute deviation of at most 64 of them), so that dust, dead pixels
    and glints drop out.
    Returns levels (r, c, channels) float32 (NaN without usable samples), unusable (r, c, channels) float32 in 0..1.
    """
    r, c, channels = len(row_edges) - 1, len(column_edges) - 1, codes.shape[2]
    levels = np.empty((r, c, channels), np.float32)
    unusable = np.empty((r, c, channels), np.float32)
    picked = np.empty(SUBSAMPLE, np.float64)
    for i in range(r):
        for j in range(c):
            y0, y1, x0, x1 = row_edges[i], row_edges[i + 1], column_edges[j], column_edges[j + 1]
            width = x1 - x0
            samples = (y1 - y0) * width
            step = max(1, samples // SUBSAMPLE)
            for k in range(channels):
                count = 0
                for s in range(0, samples, step):
                    code = codes[y0 + s // width, x0 + s % width, k]
                    if code < saturated and code > clip and count < SUBSAMPLE:
                        picked[count] = linear_value(table, code)
                        count += 1
                if count == 0:
                    levels[i, j, k] = np.nan
                    unusable[i, j, k] = 1.0
                    continue
                median = middle(picked, np.int64(count))
                for s in range(count):
                    picked[s] = abs(picked[s] - median)
                sigma = 1.4826 * middle(picked, np.int64(count))
                # at least the rounding of the codes (table[1]), and 1 percent of the level
                bound = CLIP_SIGMAS * max(sigma, 0.01 * abs(median), table[1])
                total, used = 0.0, 0
                for y in range(y0, y1):
                    for x in range(x0, x1):
                        code = codes[y, x, k]
                        if code < saturated and code > clip:
                            value = linear_value(table, code)
                            if abs(value - median) <= bound:
                                total += value
                                used += 1
                levels[i, j, k] = total / used if used > 0 else median
                unusable[i, j, k] = 1.0 - used / samples
    return levels, unusable


@njit(cache=True, error_model="numpy")
def count_outliers(codes, table, levels, row_edges, column_edges, low, high, counts):
    """Add 1 to counts (rows, columns) uint8 where any channel's linear value is below low or above high of its block.

    low: factor of the block's level; high: amount above it (either may be infinite to switch that side off).
    """
    for i in range(len(row_edges) - 1):
        for j in range(len(column_edges) - 1):
            for y in range(row_edges[i], row_edges[i + 1]):
                for x in range(column_edges[j], column_edges[j + 1]):
                    for k in range(codes.shape[2]):
                        value = linear_value(table, codes[y, x, k])
                        level = levels[i, j, k]
                        if value < low * level or value > level + high:
                            counts[y, x] += 1
                            break
