"""The tiles of an object's atlas in one texture, and the place of every triangle's corners in it."""

from dataclasses import dataclass

import numpy as np

from nishiki.atlas.atlas import Atlas

GAP = 2  # texels between two charts


@dataclass(frozen=True)
class TextureAtlas:
    """One texture for all charts.

    Attributes
    ----------
    shape : (int, int)
        Rows and columns of the texture.
    origin : (tiles, 2) int64 ndarray
        Row and column of the first texel of each tile.
    corners : (f, 3, 2) float64 ndarray
        Row and column of the corners of each triangle, in texels from the texture's first; NaN where it has no place.
    """

    shape: tuple[int, int]
    origin: np.ndarray
    corners: np.ndarray

    @property
    def placed(self) -> np.ndarray:
        """(f,) bool: triangles that have a place."""
        return np.isfinite(self.corners).all(axis=(1, 2))

    def uv(self) -> np.ndarray:
        """(f, 3, 2) places as glTF counts them: from the left and from the top, texel centres at halves."""
        return (self.corners[..., ::-1] + 0.5) / np.array(self.shape[::-1])


def texture_atlas(atlas: Atlas) -> TextureAtlas:
    """Each chart whole, so that look-ups inside a triangle never cross a seam; charts on shelves, highest first."""
    stride = atlas.size - 1
    first, shared = np.unique(atlas.chart_grid[:, 0], return_inverse=True)
    blocks = np.zeros((len(first), 2), np.int64)
    np.maximum.at(blocks, shared, atlas.chart_grid[:, 1:].astype(np.int64) * stride + 1)
    width = int(max(blocks[:, 1].max(), np.ceil(np.sqrt(1.15 * np.prod(blocks + GAP, axis=1).sum()))))
    place = np.zeros_like(blocks)
    top = left = height = 0
    for block in np.lexsort((-blocks[:, 1], -blocks[:, 0])):
        rows, columns = blocks[block]
        if left + columns > width:
            top, left, height = top + height + GAP, 0, 0
        place[block] = top, left
        left, height = left + columns + GAP, max(height, rows)
    of_chart = place[shared]
    corners = np.full(atlas.corners.shape, np.nan)
    inside = atlas.chart >= 0
    corners[inside] = atlas.corners[inside] + of_chart[atlas.chart[inside]][:, None, :]
    origin = of_chart[atlas.tile_chart] + atlas.tile_place.astype(np.int64) * stride
    return TextureAtlas((int(top + height), width), origin, corners)


def fill_gaps(texture: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The texture (rows, columns, channels) with the nearest known texel where none is known."""
    if known.all() or not known.any():
        return texture
    from scipy import ndimage

    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return texture[tuple(nearest)]


def sample(texture: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(n, channels) bilinear look-ups at places (n, 2), row and column in texels."""
    rows, columns = texture.shape[:2]
    y, x = (np.clip(places[:, k], 0, size - 1) for k, size in enumerate((rows, columns)))
    i, j = (np.minimum(v.astype(np.int64), max(size - 2, 0)) for v, size in ((y, rows), (x, columns)))
    below, right = np.minimum(i + 1, rows - 1), np.minimum(j + 1, columns - 1)
    fy, fx = (y - i)[:, None], (x - j)[:, None]
    upper = texture[i, j] * (1 - fx) + texture[i, right] * fx
    lower = texture[below, j] * (1 - fx) + texture[below, right] * fx
    return upper * (1 - fy) + lower * fy
