"""The renderer's own look-up, A, and its adjoint: what a pixel sees of a tile, bilinear between four texels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit


@dataclass(frozen=True)
class Footprints:
    """Where pixels look into a block of texels.

    corner (n,) int32: index of the upper left texel in a (observation, T, T) block, flattened; down, right (n,)
    float32 in [0, 1]: weights of the row below and the column to the right; order (n,) int64: places in the
    samples as they were given, the footprints being sorted by texel.
    """

    corner: np.ndarray
    down: np.ndarray
    right: np.ndarray
    order: np.ndarray
    observations: int
    size: int

    @classmethod
    def of(cls, observation: np.ndarray, s: np.ndarray, t: np.ndarray, *, observations: int, size: int) -> Footprints:
        """observation (n,) int in [0, observations); s, t (n,) row and column in [0, size - 1]."""
        row = np.clip(s.astype(np.int64), 0, size - 2)
        column = np.clip(t.astype(np.int64), 0, size - 2)
        corner = (observation.astype(np.int64) * size + row) * size + column
        order = np.argsort(corner, kind="stable")
        down = np.clip(s - row, 0, 1).astype(np.float32)[order]
        right = np.clip(t - column, 0, 1).astype(np.float32)[order]
        return cls(corner[order].astype(np.int32), down, right, order, observations, size)

    def look_up(self, texels: np.ndarray) -> np.ndarray:
        """(channels, n) values at the pixels, of texels (channels, observations, T, T)."""
        channels = texels.shape[0]
        out = np.empty((channels, len(self.corner)), texels.dtype)
        bilinear(np.ascontiguousarray(texels).reshape(channels, -1), self.corner, self.down, self.right, self.size, out)
        return out

    def spread(self, values: np.ndarray) -> np.ndarray:
        """Adjoint of `look_up`: (channels, observations, T, T) sums of values (channels, n) by their weights."""
        channels = values.shape[0]
        out = np.zeros((channels, self.observations * self.size * self.size), values.dtype)
        bilinear_adjoint(np.ascontiguousarray(values), self.corner, self.down, self.right, self.size, out)
        return out.reshape(channels, self.observations, self.size, self.size)

    def density(self) -> np.ndarray:
        """(observations, T, T) float32: weight that pixels give each texel; its maximum bounds the norm of A^T A."""
        return self.spread(np.ones((1, len(self.corner)), np.float32))[0]


@njit(cache=True, nogil=True, error_model="numpy")
def bilinear(texels, corner, down, right, size, out):
    """out[c, n] = the texels (channels, observations * T * T) seen by pixel n."""
    for c in range(texels.shape[0]):
        plane = texels[c]
        for n in range(corner.shape[0]):
            at, d, r = corner[n], down[n], right[n]
            top = plane[at] + r * (plane[at + 1] - plane[at])
            low = plane[at + size] + r * (plane[at + size + 1] - plane[at + size])
            out[c, n] = top + d * (low - top)


@njit(cache=True, nogil=True, error_model="numpy")
def bilinear_adjoint(values, corner, down, right, size, out):
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
            plane[at + size + 1] += r * low
            plane[at + size] += low - r * low
