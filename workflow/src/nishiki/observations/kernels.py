"""Compiled code for photographs: decoding of stored codes, robust levels of blocks, pixels that stand out of them."""

import numpy as np
from numba import njit, types
from numba.extending import overload

from nishiki.observations.linearise import Edges, cells, on_one_grid, positions
from nishiki.threads import over_rows

SUBSAMPLE = 64  # of a block's samples, for the median and the spread
CLIP_SIGMAS = 4.0  # standard deviations about the median of a block


def linear_value(table, code):
    """Return the linear value of a code: by table for integer codes, the code itself for float ones (compiled only)."""
    raise NotImplementedError


@overload(linear_value)
def _linear_value(table, code):
    if isinstance(code, types.Float):
        return lambda table, code: code
    return lambda table, code: table[code]


@njit(cache=True, error_model="numpy")
def middle(values, count):
    """Return the median of the first `count` values, sorted in place (by insertion: they are few)."""
    for i in range(1, count):
        value, j = values[i], i
        while j > 0 and values[j - 1] > value:
            values[j] = values[j - 1]
            j -= 1
        values[j] = value
    return 0.5 * (values[(count - 1) // 2] + values[count // 2])


@njit(cache=True, nogil=True, error_model="numpy")
def block_levels(codes, table, row_edges, column_edges, saturated, clip):
    """Compute the robust level of each block and the share of its samples that are not usable.

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


LARGEST_GAIN, LARGEST_DARK = np.float32(1e30), np.float32(1e6)  # of values that are at most 1 where codes are integers
ANY_CODE = np.float32(-np.inf)
"""Clip below all codes, so that each counts as a measurement."""


def decode_codes(
    codes: np.ndarray,
    coding: tuple[np.ndarray, np.number, np.number],
    fields: tuple[np.ndarray, np.ndarray, np.ndarray],
    edges: Edges,
    *,
    corner: tuple[int, int] = (0, 0),
    channels: tuple[int, int, bool] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Decode codes (lights, n, m, channels) uint8 | uint16 | float32 into values and validity, see `decode`.

    coding: table of linear values by code, and the codes at or above, at or below which a sample is unusable, in the
    codes' own type; fields: gain and dark (lights or 1, r, c, channels) float32, and usable (n, m) uint8: inside the
    mask, no defect; edges: of the blocks of gain and dark, counted from where the codes' `corner` is; channels: first,
    last, whether their mean is wanted (default: each of all).
    Returns float32 (lights, n, m, channels or 1) and bool (lights, n, m).
    """
    (lights, n, m, count), (top, left) = codes.shape, corner
    first, last, reduced = channels or (0, count, False)
    gain, dark = on_one_grid(*fields[:2])
    if gain.shape[1:3] == (1, 1):
        edges = np.array([0, 1]), np.array([0, 1])
    rows, row_weights = positions(edges[0], top, top + n)
    _, column_weights = positions(edges[1], left, left + m)
    grid = rows, row_weights, cells(edges[1], left, left + m), column_weights
    out = np.empty((lights, n, m, 1 if reduced else last - first), np.float32)
    valid = np.empty((lights, n, m), bool)
    arguments = np.ascontiguousarray(codes), coding, (gain, dark, fields[2]), grid, (first, last, reduced), (out, valid)
    over_rows(decode, lights * n, *arguments)
    return out, valid


@njit(cache=True, nogil=True, error_model="numpy")
def decode(start, stop, codes, coding, fields, grid, channels, outputs):
    """Fill rows start .. stop - 1 of all lights together: `I' = (linear(code) - dark) * gain`, and their validity.

    Arguments as of `decode_codes`; fields interpolated bilinearly; grid: rows, the lower node of each row (n,), with
    row_weights of the next; cells (c or more,): first column of each cell between two block centres, then m, with
    column_weights (m,) of its right node. valid: inside the mask, gain known, finite, saturated in none of *all*
    channels, above the clip in at least one of the channels decoded. A saturated sample keeps its value; samples that
    cannot be formed are 0 and not valid.
    """
    (table, saturated, clip), (gain, dark, usable) = coding, fields
    (rows, row_weights, cells, column_weights), (first, last, reduced), (out, valid) = grid, channels, outputs
    _, n, m, _ = codes.shape
    share = np.float32(1.0 / (last - first)) if reduced else np.float32(1.0)
    gains, darks = np.empty(m, np.float32), np.empty(m, np.float32)
    for job in range(start, stop):
        j, y = job // n, job % n
        _mark_valid(codes[j, y], usable[y], saturated, clip, first, last, valid[j, y])
        for k in range(first, last):
            _between_blocks(gain[j], k, rows[y], row_weights[y], cells, column_weights, gains)
            _between_blocks(dark[j], k, rows[y], row_weights[y], cells, column_weights, darks)
            target = out[j, y, :, 0 if reduced else k - first]
            _scale_row(codes[j, y, :, k], table, gains, darks, share, reduced and k > first, target, valid[j, y])


def always_finite(code):
    """Check whether codes of this type are finite (compiled code only)."""
    raise NotImplementedError


@overload(always_finite)
def _always_finite_of(code):
    answer = isinstance(code, types.Integer)
    return lambda code: answer


@njit(cache=True, error_model="numpy")
def _mark_valid(codes, usable, saturated, clip, first, last, valid):
    """Mark the validity of one row by its codes (m, channels)."""
    m, channels = codes.shape
    if channels == 3 and first == 0 and last == 3:  # as many neighbours as the compiler knows: three times as fast
        for x in range(m):
            brightest = max(codes[x, 0], codes[x, 1], codes[x, 2])
            valid[x] = (usable[x] != 0) & (brightest < saturated) & (brightest > clip)
        return
    for x in range(m):
        fine, lit = usable[x] != 0, False
        for k in range(channels):
            fine &= codes[x, k] < saturated
            lit |= (codes[x, k] > clip) & (k >= first) & (k < last)
        valid[x] = fine & lit


@njit(cache=True, error_model="numpy")
def _between_blocks(field, k, row, row_weight, cells, weights, out):
    """Interpolate channel k of a grid field (r, c, channels) along one pixel row; NaN where a node is."""
    following = min(row + 1, field.shape[0] - 1)
    for c in range(len(cells) - 1):
        right = min(c + 1, field.shape[1] - 1)
        start = field[row, c, k] + row_weight * (field[following, c, k] - field[row, c, k])
        rise = field[row, right, k] + row_weight * (field[following, right, k] - field[row, right, k]) - start
        w, part = weights[cells[c] : cells[c + 1]], out[cells[c] : cells[c + 1]]
        for x in range(len(part)):
            part[x] = start + w[x] * rise


@njit(cache=True, error_model="numpy")
def _scale_row(codes, table, gains, darks, share, add, target, valid):
    """Write or add values of one channel of one row; those without a valid gain, and not finite ones, are 0."""
    for x in range(len(codes)):
        known = (gains[x] > 0) & (gains[x] < LARGEST_GAIN) & (abs(darks[x]) < LARGEST_DARK)  # false for NaN
        valid[x] &= known
        gains[x] = gains[x] if known else np.float32(0.0)
        darks[x] = darks[x] if known else np.float32(0.0)
    for x in range(len(codes)):
        value = (linear_value(table, codes[x]) - darks[x]) * gains[x] * share
        target[x] = target[x] + value if add else value
    if not always_finite(codes[0]):
        for x in range(len(codes)):
            if not np.isfinite(target[x]):
                target[x] = np.float32(0.0)
                valid[x] = False
