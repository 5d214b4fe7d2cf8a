"""Compiled: one photograph's codes to linear values, with what may not be used marked."""

import numpy as np
from numba import njit

from nishiki.observations.plane_decode import (
    all_known,
    always_finite,
    between_blocks,
    drop_not_finite,
    drop_unknown,
    scale_row,
)


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
