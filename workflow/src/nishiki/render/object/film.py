"""Frames of the object turning, and the object's edge as it covers the pixels."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from nishiki.geometry.camera import Camera
from nishiki.geometry.camera_path import scaled
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.raster import rasterise
from nishiki.render.display import developed
from nishiki.render.object.renderer import ObjectRenderer
from nishiki.render.object.shots import lit_by

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


def places(views: int, frames_per_step: int, *, closed: bool) -> list[tuple[int, float]]:
    """(view, fraction of the way to the next) of each frame: once round, or there and back where the turn is open."""
    steps = views if closed else views - 1
    forth = [(k // frames_per_step, k % frames_per_step / frames_per_step) for k in range(steps * frames_per_step)]
    if closed or views < 2:
        return forth or [(0, 0.0)]
    return [*forth, (views - 2, 1.0), *forth[:0:-1]]


def frames(
    renderer: ObjectRenderer,
    *,
    frames_per_step: int,
    columns: int,
    supersampling: int = 2,
    lights: tuple[tuple[int, float], ...] = ((0, 1.0),),
    background: float = 0.0,
) -> Iterator[np.ndarray]:
    """(rows, columns, 3) uint8 sRGB frames along the turn, each the mean of supersampling² samples a pixel."""
    width = min(columns, renderer.cameras[0].columns)
    factor = width * supersampling / renderer.cameras[0].columns

    def scale(camera):
        return scaled(camera, factor)

    along = places(len(renderer.cameras), frames_per_step, closed=renderer.turn.closed)
    shots = (lit_by(renderer.between(view, fraction, scale=scale), lights) for view, fraction in along)
    for picture in renderer.render(shots):
        linear, alpha = reduced(picture.linear, picture.covered, supersampling)
        yield developed(linear, alpha, background=background).pixels
