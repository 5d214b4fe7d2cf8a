"""The atlas: every surface point's place in one of many equal tiles of texels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numba
import numpy as np

from nishiki.outside.stored import load_arrays

MARGIN = 0.5
"""Texels between a chart and the border of its grid, at least: look-ups then never need a texel beyond it."""


@dataclass(frozen=True)
class Atlas:
    """Charts cut into tiles of size x size texels; neighbouring tiles share a row or column (stride size - 1).

    size: T; chart (f,) int32, -1 where a triangle has no place; corners (f, 3, 2) float32: (row, column) of the corners
    in the texels of their chart; chart_grid (charts, 3) int32: first cell, rows and columns of each chart's cells in
    `cells`, which small charts share; cells (n,) int32: tile of each cell, -1 where it holds no surface; tile_chart
    (tiles,) int32: the first of its charts; tile_place (tiles, 2) int32: the tile's cell (row, column) in its chart;
    texels_per_unit (charts, 2) float64.
    """

    size: int
    chart: np.ndarray
    corners: np.ndarray
    chart_grid: np.ndarray
    cells: np.ndarray
    tile_chart: np.ndarray
    tile_place: np.ndarray
    texels_per_unit: np.ndarray

    @property
    def tiles(self) -> int:
        """Number of tiles."""
        return len(self.tile_chart)

    def locate(self, triangle: np.ndarray, barycentric: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Tile (...) int32 and row s, column t (...) float32 in [0, T - 1] of surface points.

        triangle (...), barycentric (..., 2) as of a `Raster`. Tile -1 where triangle is -1 or has no place. A point
        between two tiles belongs to the later one: s and t are below T - 1 but for rounding.
        """
        flat = np.ascontiguousarray(triangle, np.int32).reshape(-1)
        weights = np.ascontiguousarray(barycentric, np.float32).reshape(-1, 2)
        found = place(flat, weights, self.chart, self.corners, self.chart_grid, self.cells, self.size)
        return tuple(values.reshape(np.shape(triangle)) for values in found)

    def save(self, path: Path) -> None:
        """Write as .npz, deterministic."""
        np.savez_compressed(path, **{name: np.asarray(getattr(self, name)) for name in self.__dataclass_fields__})

    @classmethod
    def load(cls, path: Path) -> Atlas:
        """Read what `save` wrote."""
        arrays = load_arrays(path)
        return cls(int(arrays.pop("size")), **arrays)


def build_atlas(plane: np.ndarray, chart: np.ndarray, texels_per_unit: np.ndarray, *, size: int) -> Atlas:
    """Lay charts out in tiles of size x size texels.

    plane (f, 3, 2), chart (f,): as of `make_charts`; texels_per_unit (charts, 2). Each chart lies in the middle of its
    own grid of cells; charts smaller than a tile share tiles, no texel of which serves two of them; cells that no
    surface point looks up are dropped. Raises ValueError for size < 2.
    """
    if size < 2:
        raise ValueError(f"a tile needs at least 2 x 2 texels to interpolate between, not {size}")
    count, stride = len(texels_per_unit), size - 1
    inside = chart >= 0
    corners = np.zeros(plane.shape)
    corners[inside] = plane[inside] * texels_per_unit[chart[inside]][:, None, :]
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, chart[inside], corners[inside].min(axis=1))
    np.maximum.at(high, chart[inside], corners[inside].max(axis=1))
    shape = np.maximum(1, np.ceil((high - low + 2 * MARGIN) / stride)).astype(np.int64)
    shift = (shape * stride - (high - low)) / 2 - low
    group, origin = pack(np.ceil(high - low + 2 * MARGIN).astype(np.int64) + 1, size)
    shift = np.where(origin >= 0, origin + MARGIN - low, shift)
    corners[inside] += shift[chart[inside]][:, None, :]
    corners = corners.astype(np.float32)
    # The first chart of a group has the cells of all.
    owner = np.flatnonzero(group == np.arange(count))
    lengths = shape[owner].prod(axis=1)
    starts = np.zeros(count, np.int64)
    starts[owner] = np.cumsum(lengths) - lengths
    grid = np.column_stack([starts[group], shape]).astype(np.int32)
    used = np.zeros(lengths.sum(), np.bool_)
    mark_cells(chart, corners, grid, used, stride)
    cells = np.where(used, np.cumsum(used) - 1, -1).astype(np.int32)
    cell_owner = np.repeat(owner, lengths)
    within = np.arange(len(used)) - starts[cell_owner]
    places = np.stack(np.divmod(within, shape[cell_owner, 1]), axis=1)
    return Atlas(
        size,
        chart.astype(np.int32),
        corners,
        grid,
        cells,
        cell_owner[used].astype(np.int32),
        places[used].astype(np.int32),
        texels_per_unit,
    )


def pack(boxes: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Put boxes (n, 2) of texels, those that fit, into shared tiles, on shelves from the highest box to the lowest.

    Returns the group (n,) int64 of each box, named by its first member, and its origin (n, 2), -1 for boxes that do not
    fit and so stay alone.
    """
    group, origin = np.arange(len(boxes)), np.full((len(boxes), 2), -1)
    leader, top, height, left = -1, 0, 0, 0
    for box in np.lexsort((-boxes[:, 1], -boxes[:, 0])):
        rows, columns = boxes[box]
        if rows > size or columns > size:
            continue
        if left + columns > size:  # the next shelf
            top, left, height = top + height, 0, 0
        if leader < 0 or top + rows > size:  # the next tile
            leader, top, left, height = box, 0, 0, 0
        group[box], origin[box] = leader, (top, left)
        left, height = left + columns, max(height, rows)
    return group, origin


@numba.njit(cache=True, nogil=True, error_model="numpy")
def touches(corners, row, column, half_rows, half_columns):
    """Whether a triangle (3, 2) and the open rectangle about (row, column) have a common point (separating axes)."""
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
    """Cells one of whose texels a surface point looks up: within one texel of a triangle, rows and columns apart."""
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
    """First and last cell that three coordinates, widened by a texel, reach."""
    low = min(values[0], min(values[1], values[2]))
    high = max(values[0], max(values[1], values[2]))
    first = min(max(int(np.floor((low - 1.0) / stride)), 0), count - 1)
    return first, min(max(int(np.floor((high + 1.0) / stride)), first), count - 1)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def place(triangle, weights, chart, corners, grid, cells, size):
    """See `Atlas.locate`: points (n,) -> tile, s, t."""
    count, stride = len(triangle), size - 1
    tile = np.full(count, -1, np.int32)
    s, t = np.zeros(count, np.float32), np.zeros(count, np.float32)
    for i in range(count):
        f = triangle[i]
        if f < 0 or chart[f] < 0:
            continue
        u, v = np.float64(weights[i, 0]), np.float64(weights[i, 1])
        w = 1 - u - v
        row = u * corners[f, 0, 0] + v * corners[f, 1, 0] + w * corners[f, 2, 0]
        column = u * corners[f, 0, 1] + v * corners[f, 1, 1] + w * corners[f, 2, 1]
        first, rows, columns = grid[chart[f], 0], grid[chart[f], 1], grid[chart[f], 2]
        down = min(max(int(np.floor(row / stride)), 0), rows - 1)
        across = min(max(int(np.floor(column / stride)), 0), columns - 1)
        tile[i] = cells[first + down * columns + across]
        if tile[i] >= 0:
            s[i] = min(max(row - down * stride, 0.0), np.float64(stride))
            t[i] = min(max(column - across * stride, 0.0), np.float64(stride))
    return tile, s, t
