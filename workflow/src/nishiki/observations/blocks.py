"""Interpolate fields on coarse grids over the picture, and divide planes into bands of rows."""

import numpy as np

Edges = tuple[np.ndarray, np.ndarray]
CHECK_BLOCK = 16  # pixels, of the boards that a check looks at; `ingest.white_block` by default


def block_edges(length: int, block: int) -> np.ndarray:
    """Edges (blocks + 1,) int64 of blocks of nearly `block` pixels that cover `length` pixels without a remainder."""
    count = max(1, round(length / block))
    return np.arange(count + 1, dtype=np.int64) * length // count


def edges_between(length: int, block: int, start: int, stop: int) -> np.ndarray:
    """Edges of the blocks of `length` pixels that lie in start..stop, themselves edges, counted from start.

    A field on the blocks of a crop then has the values, and the interpolation, of the same blocks of the whole.
    """
    edges = block_edges(length, block)
    return edges[(edges >= start) & (edges <= stop)] - start


def blocks_around(inside: np.ndarray, block: int, margin: int) -> tuple[int, int]:
    """Start and stop, at edges of blocks, of the places (length,) bool that are set, at least one, with a rim.

    `margin` pixels or more and one further block on each side, so that a field that is interpolated between the centres
    of blocks has both its neighbours wherever `inside` is set.
    """
    set_at, edges = np.flatnonzero(inside), block_edges(len(inside), block)
    first = np.searchsorted(edges, max(set_at[0] - margin, 0), side="right") - 2
    last = np.searchsorted(edges, min(set_at[-1] + 1 + margin, len(inside)), side="left") + 1
    return int(edges[max(first, 0)]), int(edges[min(last, len(edges) - 1)])


def positions(edges: np.ndarray, start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
    """Where pixels start..stop lie between block centres: lower node (n,) int64, weight of the next (n,) float32.

    Beyond the outer centres the field is extrapolated (weights below 0 or above 1, by half a block at most).
    """
    centres = (edges[:-1] + edges[1:] - 1) / 2.0
    pixels = np.arange(start, stop)
    if len(centres) == 1:
        return np.zeros(len(pixels), np.int64), np.zeros(len(pixels), np.float32)
    lower = np.clip(np.searchsorted(centres, pixels, side="right") - 1, 0, len(centres) - 2)
    weight = (pixels - centres[lower]) / (centres[lower + 1] - centres[lower])
    return lower.astype(np.int64), weight.astype(np.float32)


def cells(edges: np.ndarray, start: int, stop: int) -> np.ndarray:
    """First pixel, counted from start, of each cell between neighbouring block centres, then the last cell's end.

    Cell c lies between the centres of blocks c and c + 1; the outer ones reach to the border. (cells + 1,) int64, with
    as many cells as blocks less one, but at least one; cells outside start..stop are empty.
    """
    centres = (edges[:-1] + edges[1:] - 1) / 2.0
    inner = np.ceil(centres[1:-1]).astype(np.int64)
    return np.clip(np.concatenate([[start], inner, [stop]]), start, stop) - start


def field_rows(field: np.ndarray, edges: Edges, start: int, stop: int) -> np.ndarray:
    """Values (rows, columns, channels) of a field on blocks (r, c, channels) in the rows start..stop of a picture."""
    if field.shape[:2] == (1, 1):
        return np.broadcast_to(field, (stop - start, int(edges[1][-1]), field.shape[2]))
    (above, down), (left, right) = positions(edges[0], start, stop), positions(edges[1], 0, int(edges[1][-1]))
    below, beyond = (np.minimum(n + 1, size - 1) for n, size in zip((above, left), field.shape, strict=False))
    field = field[above] + down[:, None, None] * (field[below] - field[above])
    return field[:, left] + right[:, None] * (field[:, beyond] - field[:, left])


def on_one_grid(gain: np.ndarray, dark: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gain and dark level (..., r, c, channels) as float32 on one grid of blocks, contiguous.

    A field that has the grid's shape is returned as it is: through `broadcast_to` it would become read-only, and
    kernels would be compiled once more for it.
    """
    shape = np.broadcast_shapes(gain.shape, dark.shape)
    gain, dark = (field if field.shape == shape else np.broadcast_to(field, shape) for field in (gain, dark))
    return np.ascontiguousarray(gain, np.float32), np.ascontiguousarray(dark, np.float32)


def picture_edges(shape: tuple[int, int], block: int) -> Edges:
    """Edges of the blocks of a picture."""
    return block_edges(shape[0], block), block_edges(shape[1], block)


def rows_of_band(lights: int, rows: int, columns: int, channels: int, tile_mib: int) -> int:
    """Rows of a band whose float32 observations fit into tile_mib MiB: a multiple of 8, at least 8."""
    fit = (tile_mib << 20) // max(1, lights * columns * channels * 4)
    return int(min(max(8, fit // 8 * 8), -(-rows // 8) * 8))


def bands_with_object(mask: np.ndarray, band_rows: int) -> tuple[int, ...]:
    """Numbers of the bands in which the mask (rows, columns) has a pixel; the others are neither kept nor read."""
    starts = range(0, len(mask), band_rows)
    return tuple(number for number, start in enumerate(starts) if mask[start : start + band_rows].any())
