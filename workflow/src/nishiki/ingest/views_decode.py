"""Compiled: one photograph's codes to linear values, with what may not be used marked."""

from __future__ import annotations

import numpy as np
from numba import njit

from nishiki.ingest.blocks import linear_value
from nishiki.ingest.decode import between_blocks


@njit(cache=True, nogil=True, error_model="numpy")
def view_values(codes, table, saturated, gain, dark, rows, row_weights, cells, column_weights, usable, out, valid):
    """Fill linear values `(linear(code) - dark) * gain` and their validity.

    codes (n, m, channels) uint8 | uint16 | float32; table: linear value by code (two zeros for float codes); saturated:
    code from which a sample is unusable, in the codes' own type; gain, dark (r, c, channels) float32 on block centres,
    interpolated bilinearly; rows: lower node of each row (n,) with row_weights of the next; cells (c or more,): first
    column of each cell between two block centres, then m, with column_weights (m,) of its right node; usable (n, m)
    uint8: no defect. out (n, m, channels) float32; valid (n, m) bool: usable, gain known, finite, saturated in no
    channel. A saturated sample keeps its value; what cannot be formed is 0.
    """
    n, m, channels = codes.shape
    gains, darks = np.empty(m, np.float32), np.empty(m, np.float32)
    for y in range(n):
        for x in range(m):
            valid[y, x] = usable[y, x] != 0
        for k in range(channels):
            between_blocks(gain, k, rows[y], row_weights[y], cells, column_weights, gains)
            between_blocks(dark, k, rows[y], row_weights[y], cells, column_weights, darks)
            for x in range(m):
                code = codes[y, x, k]
                value = np.float32((linear_value(table, code) - darks[x]) * gains[x])
                known = (gains[x] > 0) & np.isfinite(value)
                valid[y, x] &= known & (code < saturated)
                out[y, x, k] = value if known else np.float32(0.0)
