"""From linear camera values to what a screen shows, with the object's edge as it covers the pixels."""

from __future__ import annotations

import numpy as np

from nishiki.colour.encoding import decode, encode
from nishiki.geometry.camera import Camera
from nishiki.geometry.camera_path import scaled
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.raster import rasterise

BAND_PIXELS = 1 << 22


def three_channels(linear: np.ndarray) -> np.ndarray:
    """(..., 3): three channels stand for linear sRGB, which is a guess about the camera; any other number for grey."""
    if linear.shape[-1] == 3:
        return linear
    return np.repeat(linear.mean(axis=-1, keepdims=True), 3, axis=-1)


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
    """Mean of the covered samples of each block, and the covered part of it."""
    part = block_mean(covered[..., None].astype(np.float32), size)
    sums = block_mean(np.where(covered[..., None], linear, np.float32(0)), size)
    return sums / np.maximum(part, np.float32(1e-6)), part[..., 0]


def on_screen(linear: np.ndarray, alpha: np.ndarray, *, background: float = 0.0) -> tuple[np.ndarray, float]:
    """(rows, columns, 3) uint8 sRGB over an even background (sRGB-coded grey), and the part of the object's pixels
    with a channel beyond the screen's white.  alpha (rows, columns): part of the pixel that is object."""
    shown = three_channels(linear)
    grey = decode(np.float64(background), "srgb")
    weight = alpha[..., None].astype(np.float32)
    mixed = shown * weight + np.float32(grey) * (1 - weight)
    clipped = np.count_nonzero((shown > 1.001).any(axis=-1) & (alpha > 0)) / max(1, np.count_nonzero(alpha > 0))
    coded = encode(np.clip(mixed, 0, 1).astype(np.float32), "srgb")
    return np.floor(coded * 255 + 0.5).astype(np.uint8), float(clipped)
