"""Compiled decoding: stored codes to white-normalised observations of planes, and to linear values of views.

What may not be used is marked.
"""

import numpy as np
from numba import njit, types
from numba.extending import overload

from nishiki.observations.block_kernels import linear_value


@njit(cache=True, nogil=True, error_model="numpy")
def view_values(codes, coding, fields, grid, usable, out, valid):
    """Fill linear values `(linear(code) - dark) * gain` and their validity.

    codes (n, m, channels) uint8 | uint16 | float32; coding: table, scale (above 0: linear(code) = code * scale,
    otherwise by the table), saturated (code from which a sample is unusable, in the codes' own type); fields: gain,
    dark (r, c, channels) float32 on block centres, interpolated bilinearly; grid: rows, the lower node of each row (n,)
    with row_weights of the next; cells (c or more,): first column of each cell between two block centres, then m, with
    column_weights (m,) of its right node; usable (n, m) uint8: no defect. out (n, m, channels) float32; valid (n, m)
    bool: usable, gain known, finite, saturated in no channel. A saturated sample keeps its value; what cannot be formed
    is 0.
    """
    (table, scale, saturated), (gain, dark), (n, m, channels) = coding, fields, codes.shape
    rows, row_weights, cells, column_weights = grid
    gains, darks = np.empty(m, np.float32), np.empty(m, np.float32)
    even = gain.shape[0] == 1 and gain.shape[1] == 1
    for y in range(n):
        _mark_unsaturated(codes[y], usable[y], saturated, valid[y])
        for k in range(channels):
            if even:
                gains[:], darks[:] = gain[0, 0, k], dark[0, 0, k]
            else:
                between_blocks(gain, k, rows[y], row_weights[y], cells, column_weights, gains)
                between_blocks(dark, k, rows[y], row_weights[y], cells, column_weights, darks)
            if not all_known(gains, darks):
                drop_unknown(gains, darks, valid[y])
            scale_row(codes[y, :, k], table, scale, gains, darks, np.float32(1.0), False, out[y, :, k])
        if not always_finite(codes[y, 0, 0]):
            drop_not_finite(out[y], valid[y])


@njit(cache=True, error_model="numpy")
def _mark_unsaturated(codes, usable, saturated, valid):
    """Mark the validity of one row by its codes (m, channels)."""
    m, channels = codes.shape
    if channels == 3:
        for x in range(m):
            fine = (codes[x, 0] < saturated) & (codes[x, 1] < saturated) & (codes[x, 2] < saturated)
            valid[x] = fine & (usable[x] != 0)
        return
    for x in range(m):
        fine = usable[x] != 0
        for k in range(channels):
            fine &= codes[x, k] < saturated
        valid[x] = fine


RUN = 255  # values that are counted in a counter of eight bits
LARGEST_GAIN, LARGEST_DARK = np.float32(1e30), np.float32(1e6)  # of values that are at most 1 where codes are integers


@njit(cache=True, nogil=True, error_model="numpy")
def decode(start, stop, codes, coding, fields, grid, channels, outputs):
    """Fill rows start .. stop - 1 of all lights together: `I' = (linear(code) - dark) * gain`, and their validity.

    codes (lights, n, m, channels) uint8 | uint16 | float32; coding: table, scale (above 0: linear(code) = code * scale,
    otherwise by the table), saturated, clip; fields: gain, dark (lights, r, c, channels) float32 on block centres,
    interpolated bilinearly, and usable; grid: rows, the lower node of each row (n,) with row_weights of the next; cells
    (c or more,): first column of each cell between two block centres, then m, with column_weights (m,) of its right
    node; usable (n, m) uint8: inside the mask, no defect; saturated, clip: codes at or above, at or below which a
    sample is unusable, in the codes' own type. channels: first, last, reduced. out (lights, n, m, last - first), or, if
    reduced, (lights, n, m, 1) for the mean over the channels first..last; valid (lights, n, m) bool: inside the mask,
    gain known, finite, saturated in none of *all* channels, above the clip in at least one of the channels decoded.
    Samples that cannot be formed are 0 and not valid.
    """
    (table, scale, saturated, clip), (gain, dark, usable) = coding, fields
    (rows, row_weights, cells, column_weights), (first, last, reduced), (out, valid) = grid, channels, outputs
    _, n, m, _ = codes.shape
    share = np.float32(1.0 / (last - first)) if reduced else np.float32(1.0)
    for job in range(start, stop):
        j, y = job // n, job % n
        _mark_valid(codes[j, y], usable[y], saturated, clip, first, last, valid[j, y])
        if one_value(gain[j], dark[j], first, last):
            for k in range(first, last):
                target = out[j, y, :, 0 if reduced else k - first]
                level, factor = dark[j, 0, 0, k], gain[j, 0, 0, k]
                scale_row_evenly(codes[j, y, :, k], table, scale, factor, level, share, reduced and k > first, target)
            if not always_finite(codes[j, y, 0, 0]):
                drop_not_finite(out[j, y], valid[j, y])
            continue
        gains, darks = np.empty(m, np.float32), np.empty(m, np.float32)
        for k in range(first, last):
            between_blocks(gain[j], k, rows[y], row_weights[y], cells, column_weights, gains)
            between_blocks(dark[j], k, rows[y], row_weights[y], cells, column_weights, darks)
            if not all_known(gains, darks):
                drop_unknown(gains, darks, valid[j, y])
            target = out[j, y, :, 0 if reduced else k - first]
            scale_row(codes[j, y, :, k], table, scale, gains, darks, share, reduced and k > first, target)
        if not always_finite(codes[j, y, 0, 0]):
            drop_not_finite(out[j, y], valid[j, y])


def always_finite(code):
    """Whether codes of this type are finite (compiled code only)."""
    raise NotImplementedError


@overload(always_finite)
def _always_finite_of(code):
    answer = isinstance(code, types.Integer)
    return lambda code: answer


@njit(cache=True, error_model="numpy")
def _mark_valid(codes, usable, saturated, clip, first, last, valid):
    """Mark the validity of one row by its codes (m, channels)."""
    m, channels = codes.shape
    if channels == 1:
        for x in range(m):
            valid[x] = (usable[x] != 0) & (codes[x, 0] < saturated) & (codes[x, 0] > clip)
        return
    if channels == 3 and first == 0 and last == 3:
        for x in range(m):
            a, b, c = codes[x, 0], codes[x, 1], codes[x, 2]
            valid[x] = (usable[x] != 0) & (max(a, b, c) < saturated) & (max(a, b, c) > clip)
        return
    for x in range(m):
        fine, lit = usable[x] != 0, False
        for k in range(channels):
            fine &= codes[x, k] < saturated
            lit |= (codes[x, k] > clip) & (k >= first) & (k < last)
        valid[x] = fine & lit


@njit(cache=True, error_model="numpy")
def between_blocks(field, k, row, row_weight, cells, weights, out):
    """Channel k of a grid field (r, c, channels) along one pixel row; NaN where a node is."""
    following = min(row + 1, field.shape[0] - 1)
    for c in range(len(cells) - 1):
        right = min(c + 1, field.shape[1] - 1)
        start = field[row, c, k] + row_weight * (field[following, c, k] - field[row, c, k])
        rise = field[row, right, k] + row_weight * (field[following, right, k] - field[row, right, k]) - start
        w, part = weights[cells[c] : cells[c + 1]], out[cells[c] : cells[c + 1]]
        for x in range(len(part)):
            part[x] = start + w[x] * rise


@njit(cache=True, error_model="numpy")
def all_known(gains, darks):
    """Whether every gain is above 0 and every product with it stays inside float32; false for NaN."""
    known = True
    for x in range(len(gains)):
        known &= (gains[x] > np.float32(0.0)) & (gains[x] < LARGEST_GAIN) & (abs(darks[x]) < LARGEST_DARK)
    return known


@njit(cache=True, error_model="numpy")
def drop_unknown(gains, darks, valid):
    for x in range(len(gains)):
        if not (gains[x] > 0 and gains[x] < LARGEST_GAIN and abs(darks[x]) < LARGEST_DARK):
            gains[x] = np.float32(0.0)
            darks[x] = np.float32(0.0)
            valid[x] = False


@njit(cache=True, error_model="numpy")
def scale_row(codes, table, scale, gains, darks, share, add, target):
    """Values of one channel of one row, written or added."""
    for x in range(len(codes)):
        linear = np.float32(codes[x]) * scale if scale > 0 else linear_value(table, codes[x])
        value = (linear - darks[x]) * gains[x] * share
        target[x] = target[x] + value if add else value


@njit(cache=True, error_model="numpy")
def one_value(gain, dark, first, last):
    """Whether gain and dark (r, c, channels) are one number for the whole picture, and known, in these channels."""
    return gain.shape[0] == 1 and gain.shape[1] == 1 and all_known(gain[0, 0, first:last], dark[0, 0, first:last])


@njit(cache=True, error_model="numpy")
def scale_row_evenly(codes, table, scale, gain, dark, share, add, target):
    """As `scale_row`, with one gain and dark level for the row: no arrays of them are made and read."""
    for x in range(len(codes)):
        linear = np.float32(codes[x]) * scale if scale > 0 else linear_value(table, codes[x])
        value = (linear - dark) * gain * share
        target[x] = target[x] + value if add else value


@njit(cache=True, error_model="numpy")
def drop_not_finite(out, valid):
    for x in range(out.shape[0]):
        for k in range(out.shape[1]):
            if not np.isfinite(out[x, k]):
                out[x, k] = np.float32(0.0)
                valid[x] = False


@njit(cache=True, error_model="numpy")
def count_run(brightest, within, saturated, clip, counts):
    """Largest of at most RUN values; counts (3,) uint8: saturated, at the clip, and all, of those inside the mask.

    Counters of eight bits: as many values as fit a vector are counted at once.
    """
    hot, cold, inside, most = np.uint8(0), np.uint8(0), np.uint8(0), brightest[0]
    for x in range(len(brightest)):
        here = np.uint8(within[x] != 0)
        inside = np.uint8(inside + here)
        hot = np.uint8(hot + (here & np.uint8(brightest[x] >= saturated)))
        cold = np.uint8(cold + (here & np.uint8(brightest[x] <= clip)))
        most = max(most, brightest[x])
    counts[0], counts[1], counts[2] = hot, cold, inside
    return most


@njit(cache=True, nogil=True, error_model="numpy")
def count_unusable(codes, usable, saturated, clip):
    """Pixels of one frame inside the mask that are: saturated in any channel, at the clip in all, not finite; in all.

    codes (rows, columns, channels); usable (rows, columns) uint8; saturated, clip: in the codes' own type.
    Returns these four counts and the largest code (of the whole frame).
    """
    rows, columns, channels = codes.shape
    hot, cold, broken, inside, most = 0, 0, 0, 0, codes[0, 0, 0]
    within_run = np.empty(3, np.uint8)
    brightest = np.empty(columns, codes.dtype)
    for y in range(rows):
        row, within = codes[y], usable[y]
        if channels == 3:  # a distance between neighbours that the compiler knows: SIMD code
            for x in range(columns):
                brightest[x] = max(row[x, 0], row[x, 1], row[x, 2])
        else:
            for x in range(columns):
                brightest[x] = row[x, 0]
                for k in range(1, channels):
                    brightest[x] = max(brightest[x], row[x, k])
        for start in range(0, columns, RUN):
            run = slice(start, min(start + RUN, columns))
            most = max(most, count_run(brightest[run], within[run], saturated, clip, within_run))
            hot, cold, inside = hot + within_run[0], cold + within_run[1], inside + within_run[2]
        if not always_finite(most):
            for x in range(columns):
                bad = False
                for k in range(channels):
                    bad |= not np.isfinite(row[x, k])
                broken += bad & (within[x] != 0)
    return hot, cold, broken, inside, most


@njit(cache=True, nogil=True, error_model="numpy")
def to_luma(codes, saturated, full, weights, rounding):
    """Luma (rows, columns, 1) of codes (rows, columns, channels) in their own type; `full` where one is saturated.

    A mean would hide that one channel was clipped, so such pixels are given a code that counts as saturated.
    rounding: 0.5 for integer codes, 0.0 for float.
    """
    rows, columns, channels = codes.shape
    out = np.empty((rows, columns, 1), codes.dtype)
    for y in range(rows):
        for x in range(columns):
            total, over = rounding, False
            for k in range(channels):
                total += weights[k] * codes[y, x, k]
                over = over or codes[y, x, k] >= saturated
            out[y, x, 0] = full if over else total
    return out
