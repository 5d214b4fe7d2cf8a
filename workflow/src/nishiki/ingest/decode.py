"""Compiled decoding: stored codes to white-normalised observations, with what may not be used marked."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from nishiki.ingest.blocks import linear_value


@njit(cache=True, parallel=True, error_model="numpy")
def decode(
    codes,
    table,
    gain,
    dark,
    rows,
    row_weights,
    columns,
    column_weights,
    usable,
    saturated,
    clip,
    first,
    last,
    reduced,
    out,
    valid,
):
    """Fill observations `I' = (linear(code) - dark) * gain` and their validity.

    codes (lights, n, m, channels) uint8 | uint16 | float32; table: linear value by code (unused for float);
    gain, dark (lights, r, c, channels) float32 on block centres, interpolated bilinearly; rows, columns: lower node of
    each row (n,) and column (m,), with the weight of the next; usable (n, m) uint8: inside the mask, no defect;
    saturated, clip: codes at or above, at or below which a sample is unusable. out (lights, n, m, last - first), or, if
    reduced, (lights, n, m, 1) for the mean over the channels first..last; valid (lights, n, m) bool: inside the mask,
    gain known, finite, saturated in none of *all* channels, above the clip in at least one of the channels decoded.
    Samples that cannot be formed are 0 and not valid.
    """
    lights, n, m, channels = codes.shape
    flat = gain.shape[1] == 1 and gain.shape[2] == 1
    share = np.float32(1.0 / (last - first))
    below = np.float32(clip)
    top = np.float32(saturated)
    for job in prange(lights * n):
        j, y = job // n, job % n
        if flat and channels == 1:
            _decode_flat(
                codes[j, y, :, 0],
                table,
                gain[j, 0, 0, 0],
                dark[j, 0, 0, 0],
                usable[y],
                top,
                below,
                out[j, y, :, 0],
                valid[j, y],
            )
            continue
        i0 = rows[y]
        i1 = min(i0 + 1, gain.shape[1] - 1)
        wy = row_weights[y]
        for x in range(m):
            c0 = columns[x]
            c1 = min(c0 + 1, gain.shape[2] - 1)
            wx = column_weights[x]
            fine = usable[y, x] != 0
            above = False
            for k in range(channels):
                fine = fine and codes[j, y, x, k] < top
            total = np.float32(0.0)
            for k in range(first, last):
                code = codes[j, y, x, k]
                g = (np.float32(1) - wy) * (
                    (np.float32(1) - wx) * gain[j, i0, c0, k] + wx * gain[j, i0, c1, k]
                ) + wy * ((np.float32(1) - wx) * gain[j, i1, c0, k] + wx * gain[j, i1, c1, k])
                d = (np.float32(1) - wy) * (
                    (np.float32(1) - wx) * dark[j, i0, c0, k] + wx * dark[j, i0, c1, k]
                ) + wy * ((np.float32(1) - wx) * dark[j, i1, c0, k] + wx * dark[j, i1, c1, k])
                value = np.float32((linear_value(table, code) - d) * g)
                above = above or code > below
                if not (g > 0) or not np.isfinite(value):
                    fine = False
                    value = np.float32(0.0)
                if reduced:
                    total += value * share
                else:
                    out[j, y, x, k - first] = value
            if reduced:
                out[j, y, x, 0] = total
            valid[j, y, x] = fine and above


@njit(cache=True, error_model="numpy")
def _decode_flat(codes, table, gain, dark, usable, top, below, out, valid):
    """One row of one channel under one gain: the common case of a scene without a white board."""
    for x in range(len(codes)):
        code = codes[x]
        value = np.float32((linear_value(table, code) - dark) * gain)
        fine = (usable[x] != 0) & (code < top) & (code > below)
        if np.isfinite(value):
            out[x] = value
            valid[x] = fine
        else:
            out[x] = np.float32(0.0)
            valid[x] = False


@njit(cache=True, error_model="numpy")
def count_unusable(codes, usable, saturated, clip):
    """Pixels of one frame inside the mask that are: saturated in any channel, at the clip in all, not finite; in all.

    codes (rows, columns, channels); usable (rows, columns) uint8. Returns these four counts and the largest code
    (of the whole frame, as a float).
    """
    hot, cold, broken, inside, most = 0, 0, 0, 0, codes[0, 0, 0]
    for y in range(codes.shape[0]):
        for x in range(codes.shape[1]):
            over, under, bad = False, True, False
            for k in range(codes.shape[2]):
                code = codes[y, x, k]
                over |= code >= saturated
                under &= code <= clip
                bad |= not np.isfinite(np.float32(code))
                most = max(most, code)
            if usable[y, x] != 0:
                inside += 1
                hot += over
                cold += under
                broken += bad
    return hot, cold, broken, inside, float(most)


@njit(cache=True, error_model="numpy")
def to_luma(codes, saturated, full, weights, rounding):
    """Luma (rows, columns, 1) of codes (rows, columns, 3) in their own type; full scale where a channel is saturated.

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
