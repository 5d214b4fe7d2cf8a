"""Given 3x4 matrices as cameras: which side of the camera the object is on, and whether the world is mirrored."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from nishiki.errors import UserError
from nishiki.geometry.camera import Camera


@dataclass(frozen=True)
class GivenCameras:
    """cameras: in the order given. mirror: factors on the world's axes, None where the world stands as given. target:
    (3,) the point nearest to the rays through the picture centres, in the cameras' world; None if not determined."""

    cameras: tuple[Camera, ...]
    mirror: tuple[int, int, int] | None
    target: np.ndarray | None


def cameras_of_matrices(matrices: Mapping[str, np.ndarray], *, rows: int, columns: int) -> GivenCameras:
    """Cameras of projection matrices (3, 4) by view, of any scale and sign.

    A matrix fixes its camera up to the sign of the depth; a proper rotation settles the sign. If then the point that
    all views look at lies behind all of them, the matrices describe a mirrored world (self-calibrations of a turntable
    leave that open): the world's axis nearest to the axis of the turn is negated. Pictures do not change by that.

    Raises UserError for matrices that are no camera's (`Camera.from_matrix`), or where the point lies before some
    views and behind others.
    """
    cameras = [Camera.from_matrix(name, matrix, rows=rows, columns=columns) for name, matrix in matrices.items()]
    target = point_in_sight(cameras)
    if target is None:
        return GivenCameras(tuple(cameras), None, None)
    behind = [camera.name for camera in cameras if camera.project(target[None])[1][0] <= 0]
    if not behind:
        return GivenCameras(tuple(cameras), None, target)
    if len(behind) < len(cameras):
        odd = behind if 2 * len(behind) <= len(cameras) else [c.name for c in cameras if c.name not in behind]
        raise UserError(
            f"projection matrices of {', '.join(odd[:8])}: these views and the others look away from each other; "
            "expected "
            "all cameras to see the same place from the same side of a right-handed world. Remedy: check the "
            "rows of these views (sign of a row, order of the views)"
        )
    mirror = mirror_of(np.array([camera.centre for camera in cameras]))
    flip = np.diag([*mirror, 1])
    cameras = [
        Camera.from_matrix(name, np.asarray(matrix, np.float64) @ flip, rows=rows, columns=columns)
        for name, matrix in matrices.items()
    ]
    return GivenCameras(tuple(cameras), mirror, target * mirror)


def point_in_sight(cameras: list[Camera]) -> np.ndarray | None:
    """(3,) the point nearest (least squares) to the rays through the picture centres; None where they are parallel or
    come from one place (largest angle between two rays below half a degree)."""
    rays = np.array([ray_through_middle(camera) for camera in cameras])
    if len(cameras) < 2 or np.linalg.norm(np.cross(rays[:, None], rays[None]), axis=-1).max() < np.sin(np.radians(0.5)):
        return None
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    centres = np.array([camera.centre for camera in cameras])
    spread = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
    if spread <= 1e-9 * np.abs(centres).max():
        return None
    return np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, centres))


def ray_through_middle(camera: Camera) -> np.ndarray:
    """(3,) unit direction in the world, away from the camera, through the middle of its picture (no distortion)."""
    middle = np.array([(camera.columns - 1) / 2, (camera.rows - 1) / 2, 1.0])
    direction = camera.rotation.T @ np.linalg.solve(camera.intrinsics, middle)
    return direction / np.linalg.norm(direction)


def mirror_of(centres: np.ndarray) -> tuple[int, int, int]:
    """Factors on the world's axes: -1 on the one nearest to the normal of the plane of the centres (n, 3)."""
    _, _, directions = np.linalg.svd(centres - centres.mean(axis=0))
    axis = int(np.argmax(np.abs(directions[2])))
    return tuple(-1 if k == axis else 1 for k in range(3))
