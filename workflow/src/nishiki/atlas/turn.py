"""The turntable as the cameras show it: which way is up, and how fine the pictures are."""

import numpy as np

from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh


def turning(cameras: list[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (3,): up along the turntable's axis, and front, across it, towards the first camera.

    Up is the mean of the pictures' own up: over a turn what lies across the axis cancels. In a world that is known up
    to an affine map only, both are still constant over the object.
    """
    up = normalised(-np.sum([camera.rotation[1] for camera in cameras], axis=0), np.array([0.0, 1.0, 0.0]))
    back = -cameras[0].rotation[2]
    front = back - (back @ up) * up
    if np.linalg.norm(front) < 1e-3:  # looking down: the picture's foot is in front
        front = cameras[0].rotation[1] - (cameras[0].rotation[1] @ up) * up
    if np.linalg.norm(front) < 1e-3:
        front = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    return up, front / np.linalg.norm(front)


def normalised(vector: np.ndarray, instead: np.ndarray) -> np.ndarray:
    """A unit vector; `instead` where the length is next to nothing."""
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-6 else instead


def probe_spacing(mesh: Mesh, cameras: list[Camera], *, texels_per_pixel: float) -> float:
    """Half a texel in the world's unit, for the median over views of the size of a pixel at the mesh's middle."""
    middle = np.median(mesh.vertices[mesh.triangles.reshape(-1)], axis=0)
    sizes = []
    for camera in cameras:
        depth = camera.project(middle[None])[1][0]
        if depth > 0:
            sizes.append(depth / np.sqrt(abs(camera.intrinsics[0, 0] * camera.intrinsics[1, 1])))
    extent = np.linalg.norm(np.nanmax(mesh.vertices, axis=0) - np.nanmin(mesh.vertices, axis=0))
    return float(np.median(sizes)) / (2 * texels_per_pixel) if sizes else float(extent) / 1000
