"""The renderer's own look-up, A, and its adjoint: what a pixel sees of a tile, bilinear between four texels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit


@dataclass(frozen=True)
class Footprints:
    """Where pixels look into a block of texels.

    corner (n,) int32: index of the upper left texel in a flattened (observation, rows, columns) block; down, right (n,)
    float32 in [0, 1]: weights of the row below and the column to the right; order (n,) int64: places in the
    samples as they were given, the footprints being sorted by texel.
    """

    corner: np.ndarray
    down: np.ndarray
    right: np.ndarray
    order: np.ndarray
    shape: tuple[int, int, int]

    @classmethod
    def of(cls, observation: np.ndarray, s: np.ndarray, t: np.ndarray, shape: tuple[int, int, int]) -> Footprints:
        """shape: (observations, rows, columns) of the block; s, t (n,) row and column in [0, rows - 1], [0, columns -
        1]."""
        _, rows, columns = shape
        row = np.clip(s.astype(np.int64), 0, rows - 2)
        column = np.clip(t.astype(np.int64), 0, columns - 2)
        corner = (observation.astype(np.int64) * rows + row) * columns + column
        order = np.argsort(corner, kind="stable")
        down = np.clip(s - row, 0, 1).astype(np.float32)[order]
        right = np.clip(t - column, 0, 1).astype(np.float32)[order]
        return cls(corner[order].astype(np.int32), down, right, order, shape)

    def look_up(self, texels: np.ndarray) -> np.ndarray:
        """(channels, n) values at the pixels, of texels (channels, observations, rows, columns)."""
        channels = texels.shape[0]
        out = np.empty((channels, len(self.corner)), texels.dtype)
        flat = np.ascontiguousarray(texels).reshape(channels, -1)
        bilinear(flat, self.corner, self.down, self.right, self.shape[2], out)
        return out

    def spread(self, values: np.ndarray) -> np.ndarray:
        """Adjoint of `look_up`: (channels, observations, rows, columns) sums of values (channels, n) by their
        weights."""
        channels = values.shape[0]
        out = np.zeros((channels, int(np.prod(self.shape))), values.dtype)
        bilinear_adjoint(np.ascontiguousarray(values), self.corner, self.down, self.right, self.shape[2], out)
        return out.reshape(channels, *self.shape)

    def density(self) -> np.ndarray:
        """(observations, rows, columns) float32: weight that pixels give each texel; its maximum bounds the norm of A^T
        A."""
        return self.spread(np.ones((1, len(self.corner)), np.float32))[0]


@njit(cache=True, nogil=True, error_model="numpy")
def bilinear(texels, corner, down, right, columns, out):
    """out[c, n] = the texels (channels, observations * rows * columns) seen by pixel n."""
    for c in range(texels.shape[0]):
        plane = texels[c]
        for n in range(corner.shape[0]):
            at, d, r = corner[n], down[n], right[n]
            top = plane[at] + r * (plane[at + 1] - plane[at])
            low = plane[at + columns] + r * (plane[at + columns + 1] - plane[at + columns])
            out[c, n] = top + d * (low - top)


@njit(cache=True, nogil=True, error_model="numpy")
def bilinear_adjoint(values, corner, down, right, columns, out):
    """out[c, texel] += weight * values[c, n]: the transpose of `bilinear`."""
    for c in range(values.shape[0]):
        plane = out[c]
        for n in range(corner.shape[0]):
            at, d, r = corner[n], down[n], right[n]
            value = values[c, n]
            low = d * value
            top = value - low
            plane[at + 1] += r * top
            plane[at] += top - r * top
            plane[at + columns + 1] += r * low
            plane[at + columns] += low - r * low
