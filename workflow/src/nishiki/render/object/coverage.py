"""The object's edge as it covers the pixels, and means over them."""

from __future__ import annotations

import numpy as np

from nishiki.geometry.camera import Camera
from nishiki.geometry.camera_path import scaled
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.raster import rasterise

BAND_PIXELS = 1 << 22


def coverage(mesh: Mesh, camera: Camera, *, samples: int = 3) -> np.ndarray:
    """(rows, columns) float32 in 0..1: part of each pixel that shows the surface, by samples x samples points."""
    fine = scaled(camera, samples)
    out = np.empty((camera.rows, camera.columns), np.float32)
    height = max(1, BAND_PIXELS // (fine.columns * samples))
    for first in range(0, camera.rows, height):
        stop = min(first + height, camera.rows)
        shown = rasterise(mesh, fine, rows=(first * samples, stop * samples)).triangle >= 0
        out[first:stop] = block_mean(shown[..., None].astype(np.float32), samples)[..., 0]
    return out


def block_mean(values: np.ndarray, size: int) -> np.ndarray:
    """(rows * size, columns * size, n) -> (rows, columns, n): mean of square blocks; what does not fill one is cut."""
    rows, columns = values.shape[0] // size, values.shape[1] // size
    blocks = values[: rows * size, : columns * size].reshape(rows, size, columns, size, -1)
    return blocks.mean(axis=(1, 3), dtype=np.float32)


def reduced(linear: np.ndarray, covered: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean of each block, where samples that are not covered count as black, and the covered part of it."""
    part = block_mean(covered[..., None].astype(np.float32), size)
    sums = block_mean(np.where(covered[..., None], linear, np.float32(0)), size)
    return sums, part[..., 0]
