"""Whether captured views see a point of the surface, from what a renderer has: the mesh and the cameras."""

from __future__ import annotations

import threading
from collections import OrderedDict

import numba
import numpy as np

from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh
from nishiki.patches.raster import rasterise

KEPT = 8  # depth maps held at a time: the views around the ones being made
STEEP = 0.25  # cosine of the angle to the normal below which a view counts less and less
_TOLERANCE_PX = 1.5


class DepthMaps:
    """Depth of the surface in the captured views, made when asked for; the most recent ones are kept."""

    def __init__(self, mesh: Mesh):
        self.mesh = mesh
        self._maps: OrderedDict[str, np.ndarray] = OrderedDict()
        self._lock = threading.Lock()

    def prepare(self, cameras: list[Camera]) -> None:
        """Make the maps of these cameras and keep at least them."""
        names = {camera.name for camera in cameras}
        for camera in cameras:
            if camera.name not in self._maps:
                self._maps[camera.name] = rasterise(self.mesh, camera).depth
            self._maps.move_to_end(camera.name)
        while len(self._maps) > max(KEPT, len(names)):
            self._maps.popitem(last=False)

    def visible(self, positions: np.ndarray, normals: np.ndarray, camera: Camera) -> np.ndarray:
        """(...) float32 in 0..1 for points (..., 3) with normals (..., 3): 0 hidden, turned away, or outside the
        picture; 1 seen well; less than 1 where the view is steeper than `STEEP`."""
        with self._lock:
            if camera.name not in self._maps:
                self.prepare([camera])
            depth = self._maps[camera.name]
        shape = positions.shape[:-1]
        points = np.ascontiguousarray(positions, np.float64).reshape(-1, 3)
        pixels, depths = camera.project(points)
        towards = camera.centre - points
        distance = np.linalg.norm(towards, axis=1)
        cosine = (np.ascontiguousarray(normals, np.float64).reshape(-1, 3) * towards).sum(axis=1)
        cosine /= np.where(distance > 0, distance, 1)
        footprint = 1 / np.sqrt(abs(camera.intrinsics[0, 0] * camera.intrinsics[1, 1]))
        return seen(pixels, depths, cosine, depth, footprint).reshape(shape)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def seen(pixels, depths, cosine, depth, footprint):
    """See `DepthMaps.visible`; footprint: size of a pixel at depth 1.

    A point passes where it lies no deeper than the deepest of the 3 x 3 depths around its pixel, plus what the slope of
    the surface makes of 1.5 pixels.
    """
    out = np.zeros(len(depths), np.float32)
    rows, columns = depth.shape
    for i in range(len(depths)):
        z, c = depths[i], cosine[i]
        if not (z > 0 and c > 0):
            continue
        x, y = pixels[i, 0], pixels[i, 1]
        if not (-0.5 <= x <= columns - 0.5 and -0.5 <= y <= rows - 0.5):
            continue
        column, row = min(int(x + 0.5), columns - 1), min(int(y + 0.5), rows - 1)
        deepest = 0.0
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            for k in range(max(column - 1, 0), min(column + 2, columns)):
                if np.isfinite(depth[r, k]):
                    deepest = max(deepest, np.float64(depth[r, k]))
        slope = np.sqrt(max(1 - c * c, 0.0)) / max(c, 0.05)
        if z <= deepest + _TOLERANCE_PX * footprint * z * (0.5 + slope):
            out[i] = min(c / STEEP, 1.0)
    return out
