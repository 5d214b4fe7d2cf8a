"""Place every surface point in one of many equal tiles of texels."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.formats.stored import ArrayFields, load_arrays
from nishiki.threads import strips

MARGIN = 0.5
"""Texels between a chart and the border of its grid, at least: look-ups then never need a texel beyond it."""


@dataclass(frozen=True)
class Atlas(ArrayFields):
    """Charts cut into tiles of size x size texels; neighbouring tiles share a row or column (stride size - 1)."""

    size: int
    chart: np.ndarray  # (f,) int32, -1 where a triangle has no place
    corners: np.ndarray  # (f, 3, 2) float32: (row, column) of the corners in the texels of their chart
    chart_grid: np.ndarray  # (charts, 3) int32: first cell, rows and columns of a chart's cells in `cells`
    cells: np.ndarray  # (n,) int32: tile of each cell, which small charts share; -1 where it holds no surface
    tile_chart: np.ndarray  # (tiles,) int32: the first of its charts
    tile_place: np.ndarray  # (tiles, 2) int32: the tile's cell (row, column) in its chart
    texels_per_unit: np.ndarray  # (charts, 2) float64

    @property
    def tiles(self) -> int:
        """Number of tiles."""
        return len(self.tile_chart)

    def locate(self, triangle: np.ndarray, barycentric: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find tile (...) int32 and row s, column t (...) float32 in [0, T - 1] of surface points.

        triangle (...), barycentric (..., 2) as of a `Raster`. Tile -1 where triangle is -1 or has no place. A point
        between two tiles belongs to the later one: s and t are below T - 1 but for rounding.
        """
        shape, stride, charts = np.shape(triangle), self.size - 1, np.append(self.chart, -1)
        triangle, weights = np.ravel(triangle), np.reshape(barycentric, (-1, 2))
        tile, places = np.full(len(triangle), -1, np.int32), np.zeros((2, len(triangle)), np.float32)
        for some in strips(len(triangle), 1 << 16):  # all float64 numbers of a view would take ten times its memory
            known = some.start + np.flatnonzero(charts[triangle[some]] >= 0)  # triangle -1 reads the last entry
            u, v = weights[known].astype(np.float64).T
            corners, (first, rows, columns) = self.corners[triangle[known]], self.chart_grid[charts[triangle[known]]].T
            row, column = (u * a + v * b + (1 - u - v) * c for a, b, c in corners.T)
            down = np.clip(np.floor(row / stride).astype(np.intp), 0, rows - 1)
            across = np.clip(np.floor(column / stride).astype(np.intp), 0, columns - 1)
            tile[known] = self.cells[first + down * columns + across]
            places[:, known] = np.clip((row - down * stride, column - across * stride), 0, stride)
        places[:, tile < 0] = 0
        return tile.reshape(shape), *places.reshape(2, *shape)

    def save(self, path: Path) -> None:
        """Write as .npz, deterministic."""
        arrays: dict[str, Any] = self.as_arrays()
        np.savez_compressed(path, **arrays)

    @classmethod
    def load(cls, path: Path) -> "Atlas":
        """Read a file that `save` wrote."""
        return cls.from_arrays(load_arrays(path))


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
    from nishiki.atlas.cells import mark_cells

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
