"""Find the cells of an atlas that triangles touch, and the place of surface points in them: compiled kernels."""

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, error_model="numpy")
def touches(corners, row, column, half_rows, half_columns):
    """Check whether a triangle (3, 2) and the open rectangle about (row, column) share a point (separating axes)."""
    for axis in range(2):
        middle, half = (row, half_rows) if axis == 0 else (column, half_columns)
        low = min(corners[0, axis], min(corners[1, axis], corners[2, axis]))
        high = max(corners[0, axis], max(corners[1, axis], corners[2, axis]))
        if low >= middle + half or high <= middle - half:
            return False
    for k in range(3):
        a, b, c = k, (k + 1) % 3, (k + 2) % 3
        down, right = np.float64(corners[b, 0]) - corners[a, 0], np.float64(corners[b, 1]) - corners[a, 1]
        side = down * (column - corners[a, 1]) - right * (row - corners[a, 0])
        third = down * (np.float64(corners[c, 1]) - corners[a, 1]) - right * (np.float64(corners[c, 0]) - corners[a, 0])
        if third < 0:
            side, third = -side, -third
        reach = abs(down) * half_columns + abs(right) * half_rows
        if third > 0 and side + reach <= 0:
            return False
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def mark_cells(chart, corners, grid, used, stride):
    """Mark cells one of whose texels a surface point looks up: within a texel of a triangle, rows and columns apart."""
    for i in range(len(chart)):
        if chart[i] < 0:
            continue
        first, rows, columns = grid[chart[i], 0], grid[chart[i], 1], grid[chart[i], 2]
        points = corners[i]
        top, bottom = cell_range(points[:, 0], stride, rows)
        left, right = cell_range(points[:, 1], stride, columns)
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                if not used[first + row * columns + column]:
                    half = stride / 2 + 1
                    used[first + row * columns + column] = touches(
                        points, (row + 0.5) * stride, (column + 0.5) * stride, half, half
                    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def cell_range(values, stride, count):
    """Find first and last cell that three coordinates, widened by a texel, reach."""
    low = min(values[0], min(values[1], values[2]))
    high = max(values[0], max(values[1], values[2]))
    first = min(max(int(np.floor((low - 1.0) / stride)), 0), count - 1)
    return first, min(max(int(np.floor((high + 1.0) / stride)), first), count - 1)
