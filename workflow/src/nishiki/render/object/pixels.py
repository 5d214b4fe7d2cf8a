"""Transfer texels to pixels: look-up, rim of the silhouette, visibility in captured views, means of samples."""

import threading
from collections import OrderedDict
from itertools import product

import numpy as np

from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.turn import scale_camera
from nishiki.geometry.visibility import rasterise


def bilinear(s: np.ndarray, t: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """List the texels of a tile of size x size that pixels at rows s, columns t (n,) float32 are interpolated from.

    Returns their flat numbers chosen (m,), and for the four of each pixel place (4, n) in `chosen` and weights (4, n)
    float32. Coordinates beyond the tile are taken at its border.
    """
    (i, y), (j, x) = (_cell(np.clip(along, 0, size - 1), size) for along in (s, t))
    below, right = np.minimum(i + 1, size - 1), np.minimum(j + 1, size - 1)
    corners = np.stack([i * size + j, i * size + right, below * size + j, below * size + right])
    used = np.zeros(size * size, bool)
    used[corners] = True
    weights = np.stack([(1 - y) * (1 - x), (1 - y) * x, y * (1 - x), y * x])
    return np.flatnonzero(used), (np.cumsum(used) - 1)[corners], weights


def _cell(along: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Split coordinates into the number of the first of two texels and the distance from it, float32."""
    first = np.minimum(along.astype(np.int64), max(size - 2, 0))
    return first, (along - first).astype(np.float32)


def mix(residual: np.ndarray, visible: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return a weighted mean (m, channels) float32 of the residuals of several observations, texel by texel.

    residual (n, m, channels) float32; visible (n, m) float32 in 0..1: how well each observation sees the texel; weights
    (n,), none negative.  Texels that no observation sees get the mean by the weights alone.
    """
    share = weights[:, None] * visible
    total = share.sum(axis=0)
    share = np.where(total > 0, share / np.where(total > 0, total, 1), (weights / weights.sum())[:, None])
    return np.einsum("nm,nmc->mc", share.astype(np.float32), residual)


BESIDE = 2  # texels


def find_borders(shown: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Find a tile's texels (T * T,) bool within BESIDE of both shown and hidden ones, of those inside (T, T) charts."""
    import cv2

    shown, around = shown.reshape(inside.shape), np.ones((2 * BESIDE + 1, 2 * BESIDE + 1), np.uint8)
    near = [cv2.dilate((part & inside).astype(np.uint8), around) for part in (shown, ~shown)]
    return (near[0] & near[1]).ravel() > 0


def extend(values: np.ndarray, covered: np.ndarray, *, rings: int, within: np.ndarray | None = None) -> np.ndarray:
    """Extrapolate values (rows, columns, channels) float32 beyond the covered pixels by `rings` pixels.

    In place; reached (rows, columns) bool: covered or filled. within: the pixels that may be filled, all if None.

    A pixel at the silhouette's edge whose centre just misses the surface shows some of it all the same; left empty, it
    would be a dark rim. A pixel is the mean of its known neighbours, diagonal ones at half weight, each continued away
    from the rim by half the slope to the known pixel behind it: the noise of a full slope would grow with every ring.
    """
    import cv2

    reached = covered.copy()
    for _ in range(rings):
        border = cv2.dilate(reached.astype(np.uint8), np.ones((3, 3), np.uint8)) > reached
        border &= True if within is None else within
        i, j = np.divmod(np.flatnonzero(border), border.shape[1])  # five times as fast as np.nonzero
        if not len(i):
            break
        known = np.pad(reached, 2)
        sums, weight = np.zeros((len(i), values.shape[2])), np.zeros((len(i), 1))
        for y, x in product((-1, 0, 1), repeat=2):
            here, line = (known[i + 2 + k * y, j + 2 + k * x][:, None] for k in (1, 2))
            near, behind = (
                values[np.clip(i + k * y, 0, len(values) - 1), np.clip(j + k * x, 0, values.shape[1] - 1)]
                for k in (1, 2)
            )
            value = near.astype(np.float64)
            share = (1.0 if 0 in (y, x) else 0.5) * here
            sums += share * np.where(here, value + 0.5 * np.where(line, value - behind, 0), 0)
            weight += share
        values[i, j] = sums / weight
        reached |= border
    return reached


KEPT = 8  # depth maps held at a time: the views around the ones being made
STEEP = 0.25  # cosine of the angle to the normal below which a view counts less and less
_TOLERANCE_PX = 1.5


class DepthMaps:
    """Depth of the surface in the captured views, the deepest of 3 x 3 pixels; only the most recent maps are stored."""

    def __init__(self, mesh: Mesh):
        self.mesh = mesh
        self._maps: OrderedDict[str, np.ndarray] = OrderedDict()
        self._lock = threading.Lock()

    def prepare(self, cameras: list[Camera]) -> None:
        """Make the maps of these cameras and store at least them."""
        names = {camera.name for camera in cameras}
        import cv2

        for camera in cameras:
            if camera.name not in self._maps:
                depth = rasterise(self.mesh, camera).depth
                shown = np.where(np.isfinite(depth), depth, np.float32(0))
                self._maps[camera.name] = cv2.dilate(shown, np.ones((3, 3), np.uint8))
            self._maps.move_to_end(camera.name)
        while len(self._maps) > max(KEPT, len(names)):
            self._maps.popitem(last=False)

    def visible(self, positions: np.ndarray, normals: np.ndarray, camera: Camera) -> np.ndarray:
        """Compute how well a camera sees points (..., 3): 0 hidden, 1 well, between where steeper than `STEEP`.

        A point passes where it lies no deeper than the deepest of the 3 x 3 depths around its pixel, plus what the
        slope of the surface makes of 1.5 pixels.
        """
        with self._lock:
            if camera.name not in self._maps:
                self.prepare([camera])
            depth = self._maps[camera.name]
        points = np.asarray(positions, np.float64).reshape(-1, 3)
        towards = camera.centre - points
        cosine = np.einsum("nk,nk->n", towards, np.reshape(normals, (-1, 3)))
        cosine /= np.maximum(np.linalg.norm(towards, axis=1), 1e-300)
        pixels, away = camera.project(points)
        size = np.array(depth.shape[::-1])
        inside = (cosine > 0) & (away > 0) & (np.abs(pixels - 0.5 * (size - 1)) <= 0.5 * size).all(axis=1)
        column, row = np.clip(np.where(inside[:, None], pixels + 0.5, 0).astype(int), 0, size - 1).T
        slope = np.sqrt(np.maximum(1 - cosine**2, 0)) / np.maximum(cosine, 0.05)
        footprint = away / np.sqrt(abs(camera.intrinsics[0, 0] * camera.intrinsics[1, 1]))
        inside &= away <= depth[row, column] + _TOLERANCE_PX * footprint * (0.5 + slope)
        return np.where(inside, np.minimum(cosine / STEEP, 1), 0).astype(np.float32).reshape(positions.shape[:-1])


BAND_PIXELS = 1 << 22


def coverage(mesh: Mesh, camera: Camera, *, samples: int = 3) -> np.ndarray:
    """Compute each pixel's part covered by the surface, (rows, columns) float32, by samples x samples points."""
    fine = scale_camera(camera, samples)
    out = np.empty((camera.rows, camera.columns), np.float32)
    height = max(1, BAND_PIXELS // (fine.columns * samples))
    for first in range(0, camera.rows, height):
        stop = min(first + height, camera.rows)
        shown = rasterise(mesh, fine, rows=(first * samples, stop * samples)).triangle >= 0
        out[first:stop] = block_mean(shown[..., None].astype(np.float32), samples)[..., 0]
    return out


def block_mean(values: np.ndarray, size: int) -> np.ndarray:
    """Average square blocks, (rows * size, columns * size, n) -> (rows, columns, n); incomplete blocks are cut."""
    rows, columns = values.shape[0] // size, values.shape[1] // size
    blocks = values[: rows * size, : columns * size].reshape(rows, size, columns, size, -1)
    total = np.zeros((rows, columns, blocks.shape[-1]), np.float32)
    for i, j in product(range(size), repeat=2):
        total += blocks[:, i, :, j]
    return total / np.float32(size * size)


def reduce_blocks(linear: np.ndarray, covered: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Average each block, where samples that are not covered count as black; return its covered part too."""
    part = block_mean(covered[..., None].astype(np.float32), size)
    sums = block_mean(np.where(covered[..., None], linear, np.float32(0)), size)
    return sums, part[..., 0]
