"""The path of the camera around the object: its axis, where each view stands on it, and cameras between the views.

On a turntable the cameras, expressed in the object's frame, are turned copies of one another about one fixed axis.
Calibrated cameras keep to that only to within their errors, and a camera moved by hand does not at all; the path here
goes through every calibrated camera exactly, and follows the turn between them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from nishiki.geometry.camera import Camera
from nishiki.geometry.turn import circle_centre


@dataclass(frozen=True)
class CameraPath:
    """axis (3,) unit vector and point (3,) on it, world; position (views,) radians along the path, rising, starting at
    0; length: radians from the first view back to the first (a full turn) or to the last; closed: whether the last
    view neighbours the first; deviation_deg: largest angle between the axis of a step and the common one."""

    axis: np.ndarray
    point: np.ndarray
    position: np.ndarray
    length: float
    closed: bool
    deviation_deg: float

    def locate(self, index: int, fraction: float) -> float:
        """Position of the place `fraction` of the way from view `index` to the next one."""
        following = self.position[index + 1] if index + 1 < len(self.position) else self.length
        return float(self.position[index] + fraction * (following - self.position[index]))


def fit_turn(cameras: list[Camera], *, full_turn: bool) -> CameraPath:
    """Axis and path of the cameras, in their order.

    The direction of the axis is the mean of the steps' rotation vectors, the point the least-squares centre of the
    camera centres in the plane across it.  Positions grow by the angle of each step's rotation.
    """
    poses = [camera.rotation.T for camera in cameras]
    following = poses[1:] + poses[:1] if full_turn else poses[1:]
    steps = np.array([rotation_vector(b @ a.T) for a, b in zip(poses, following, strict=False)]).reshape(-1, 3)
    angles = np.linalg.norm(steps, axis=1)
    total = steps.sum(axis=0)
    turned = np.linalg.norm(total)
    axis = total / turned if turned > 1e-9 else np.array([0.0, 0.0, 1.0])
    moving = steps[angles > 1e-9] / angles[angles > 1e-9][:, None]
    off = np.degrees(np.arccos(np.clip(moving @ axis, -1, 1))).max() if len(moving) else 0.0
    sums = np.concatenate([[0.0], np.cumsum(angles)])
    length = float(sums[-1])
    return CameraPath(axis, axis_point(cameras, axis), sums[: len(cameras)], length, full_turn, float(off))


def axis_point(cameras: list[Camera], axis: np.ndarray) -> np.ndarray:
    """(3,) the point of the axis at the mean height of the camera centres: least-squares circle across the axis."""
    centres = np.array([camera.centre for camera in cameras])
    mean = centres.mean(axis=0)
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    x, y = (centres - mean) @ first, (centres - mean) @ second
    if len(cameras) < 3:
        return mean
    a, b = circle_centre(np.column_stack([x, y]))
    return mean + a * first + b * second


def camera_between(cameras: list[Camera], turn: CameraPath, index: int, fraction: float) -> Camera:
    """The camera `fraction` (0..1) of the way from view `index` to the next one.

    Both neighbours are turned about the axis to the place; on an ideal turn they coincide there, and what calibration
    errors leave between them is blended, rotations along the shortest arc.  At 0 and 1 the result is the neighbour.
    """
    a, b = cameras[index], cameras[(index + 1) % len(cameras)]
    step = twist(b.rotation.T @ a.rotation, turn.axis)
    ahead = turned(a, turn, fraction * step)
    behind = turned(b, turn, (fraction - 1) * step)
    between = rotation_vector(behind.rotation @ ahead.rotation.T)
    rotation = rotation_matrix(fraction * between) @ ahead.rotation
    centre = (1 - fraction) * ahead.centre + fraction * behind.centre
    return replace(
        a,
        name=f"{a.name}+{fraction:.3f}",
        intrinsics=(1 - fraction) * a.intrinsics + fraction * b.intrinsics,
        rotation=rotation,
        translation=-rotation @ centre,
        distortion=tuple((1 - fraction) * p + fraction * q for p, q in zip(a.distortion, b.distortion, strict=True)),
    )


def turned(camera: Camera, turn: CameraPath, angle: float) -> Camera:
    """The camera turned about the axis by `angle` radians."""
    spin = rotation_matrix(angle * turn.axis)
    rotation = camera.rotation @ spin.T
    centre = spin @ (camera.centre - turn.point) + turn.point
    return replace(camera, rotation=rotation, translation=-rotation @ centre)


def scaled(camera: Camera, factor: float) -> Camera:
    """The same camera with `factor` times as many pixels along each side; pixel centres stay at whole numbers."""
    rows, columns = max(1, round(camera.rows * factor)), max(1, round(camera.columns * factor))
    down, across = rows / camera.rows, columns / camera.columns
    # continuous image coordinates start half a pixel before the centre of the first pixel
    change = np.array([[across, 0, 0.5 * across - 0.5], [0, down, 0.5 * down - 0.5], [0, 0, 1]])
    return replace(camera, intrinsics=change @ camera.intrinsics, rows=rows, columns=columns)


def twist(rotation: np.ndarray, axis: np.ndarray) -> float:
    """Angle of the part of a rotation (3, 3) about the axis (swing-twist decomposition), radians, -pi..pi."""
    vector = rotation_vector(rotation)
    angle = np.linalg.norm(vector)
    if angle < 1e-12:
        return 0.0
    along = float(vector @ axis / angle)
    return float(2 * np.arctan2(np.sin(angle / 2) * along, np.cos(angle / 2)))


def rotation_vector(rotation: np.ndarray) -> np.ndarray:
    """(3,) axis times angle of a rotation matrix, radians; accurate at small angles and up to half a turn."""
    skew = 0.5 * np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    sine, cosine = np.linalg.norm(skew), 0.5 * (np.trace(rotation) - 1)
    angle = np.arctan2(sine, cosine)
    if sine > 1e-6:
        return skew * (angle / sine)
    if cosine > 0:
        return skew
    # half a turn: the rotation is 2 a a^T - 1
    outer = 0.5 * (rotation + np.eye(3))
    column = outer[:, np.argmax(np.diag(outer))]
    return angle * column / np.linalg.norm(column)


def rotation_matrix(vectors: np.ndarray) -> np.ndarray:
    """(..., 3, 3) rotations about vectors (..., 3) by their lengths in radians (Rodrigues)."""
    vectors = np.asarray(vectors, np.float64)
    angles = np.linalg.norm(vectors, axis=-1)
    # sin(x)/x and (1 - cos x)/x^2 without a division by zero
    ratio = np.sinc(angles / np.pi)
    half = np.sinc(angles / (2 * np.pi)) ** 2 / 2
    cross = np.zeros((*vectors.shape, 3))
    cross[..., 0, 1], cross[..., 0, 2], cross[..., 1, 2] = -vectors[..., 2], vectors[..., 1], -vectors[..., 0]
    cross -= np.swapaxes(cross, -1, -2)
    return np.eye(3) + ratio[..., None, None] * cross + half[..., None, None] * (cross @ cross)
