"""Whether captured views see a point of the surface, from what a renderer has: the mesh and the cameras."""

import threading
from collections import OrderedDict

import numpy as np

from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.visibility import rasterise

KEPT = 8  # depth maps held at a time: the views around the ones being made
STEEP = 0.25  # cosine of the angle to the normal below which a view counts less and less
_TOLERANCE_PX = 1.5


class DepthMaps:
    """Depth of the surface in the captured views, the deepest of 3 x 3 pixels; the most recent maps are kept."""

    def __init__(self, mesh: Mesh):
        self.mesh = mesh
        self._maps: OrderedDict[str, np.ndarray] = OrderedDict()
        self._lock = threading.Lock()

    def prepare(self, cameras: list[Camera]) -> None:
        """Make the maps of these cameras and keep at least them."""
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
        """Judge how well a camera sees points (..., 3): 0 hidden, 1 well, between where steeper than `STEEP`.

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
