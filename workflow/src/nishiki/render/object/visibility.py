"""Whether captured views see a point of the surface, from what a renderer has: the mesh and the cameras."""

import threading
from collections import OrderedDict

import numba
import numpy as np

from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.visibility import rasterise

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
        """Judge how well a camera sees points (..., 3): 0 hidden, 1 well, between where steeper than `STEEP`."""
        with self._lock:
            if camera.name not in self._maps:
                self.prepare([camera])
            depth = self._maps[camera.name]
        shape = positions.shape[:-1]
        points, facing = (np.ascontiguousarray(a, np.float32).reshape(-1, 3) for a in (positions, normals))
        pose = np.column_stack([camera.rotation, camera.translation])
        lens = np.array(camera.distortion, np.float64)
        return seen(points, facing, pose, camera.intrinsics, lens, camera.centre, depth).reshape(shape)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def project(x, y, z, pose, intrinsics, lens):
    """Column, row and depth of a point, as `Camera.project` has them."""
    u = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]
    v = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]
    depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
    if not depth > 0:
        return 0.0, 0.0, depth
    u, v = u / depth, v / depth
    k1, k2, p1, p2, k3 = lens[0], lens[1], lens[2], lens[3], lens[4]
    square = u * u + v * v
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    a = u * radial + 2 * p1 * u * v + p2 * (square + 2 * u * u)
    b = v * radial + p1 * (square + 2 * v * v) + 2 * p2 * u * v
    column = intrinsics[0, 0] * a + intrinsics[0, 1] * b + intrinsics[0, 2]
    return column, intrinsics[1, 1] * b + intrinsics[1, 2], depth


@numba.njit(cache=True, nogil=True, error_model="numpy")
def seen(points, normals, pose, intrinsics, lens, centre, depth):
    """See `DepthMaps.visible`; points, normals (n, 3) float32, pose (3, 4) world to camera, lens (5,), centre (3,).

    A point passes where it lies no deeper than the deepest of the 3 x 3 depths around its pixel, plus what the slope of
    the surface makes of 1.5 pixels.
    """
    out = np.zeros(len(points), np.float32)
    rows, columns = depth.shape
    footprint = 1 / np.sqrt(abs(intrinsics[0, 0] * intrinsics[1, 1]))
    for i in range(len(points)):
        cosine, square = 0.0, 0.0
        for k in range(3):
            towards = centre[k] - points[i, k]
            cosine += towards * normals[i, k]
            square += towards * towards
        if not (cosine > 0 and square > 0):
            continue
        c = cosine / np.sqrt(square)
        x, y, z = project(points[i, 0], points[i, 1], points[i, 2], pose, intrinsics, lens)
        if not (z > 0 and -0.5 <= x <= columns - 0.5 and -0.5 <= y <= rows - 0.5):
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
