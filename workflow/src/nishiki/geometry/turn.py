"""Fit the circle of the camera centres of a turntable, and generate the path of a camera around the object.

On a turntable the cameras, expressed in the object's frame, are turned copies of one another about one fixed axis.
Calibrated cameras keep to that only to within their errors, and a camera moved by hand does not at all; the path here
goes through every calibrated camera exactly, and follows the turn between them.
"""

from dataclasses import dataclass, replace

import numpy as np

from nishiki.formats.stored import PlainFields
from nishiki.geometry.camera import Camera

FEWEST_VIEWS = 8  # from which a turn is estimated without boards or matrices
LARGEST_STEP = 1.6  # of a full turn, relative to the median step
ON_CIRCLE = 0.1  # relative distance from the circle up to which a camera belongs to one ring
EQUAL_STEPS_DEG = 0.05
"""Largest difference between steps that are called equal: a pixel on a radius of a thousand."""


@dataclass(frozen=True)
class CircleCheck(PlainFields):
    """The circle nearest to the camera centres."""

    axis: tuple[float, ...]  # (3,) unit, the way the cameras go round (counter-clockwise seen from its tip)
    centre: tuple[float, ...]  # (3,) of the circle
    radius: float  # mean
    radius_min: float  # radius_min, radius_max: over the views, relative to the mean
    radius_max: float
    off_plane: float  # largest distance from the plane of the circle, relative to the radius
    steps_deg: tuple[float, ...]  # from view to view, the last one back to the first view

    @property
    def full(self) -> bool:
        """Test if the views go once round: steps in one sense, together one turn, none above 1.6 times the median."""
        steps = np.array(self.steps_deg)
        once = abs(steps.sum() - 360) < 1e-4 and (steps > 0).all()
        return bool(once and steps.max() <= LARGEST_STEP * np.median(steps))


def order_round(centres: np.ndarray) -> list[int]:
    """Sort camera centres (n, 3) into the order of the turn; return indices, the first camera first.

    Those of cameras that go once round a circle in another order than they are given in: names like cam1/0000, or
    exports sorted by another key. All others keep their order.
    """
    given = list(range(len(centres)))
    turn = turn_of(centres)
    if turn is None or turn.full or turn.off_plane > ON_CIRCLE or turn.radius_min < 1 - ON_CIRCLE:
        return given
    angles = np.cumsum([0.0, *turn.steps_deg[:-1]]) % 360
    ahead = angles if angles[1] <= 180 else -angles % 360  # in the sense in which the second follows the first
    order = np.argsort(ahead, kind="stable").tolist()
    again = turn_of(centres[order])
    return order if again is not None and again.full else given


def circle_centre(points: np.ndarray) -> np.ndarray:
    """Compute the centre (2,) of the circle nearest to points (n, 2), n >= 3, in the sense of squared radii.

    |p|^2 = 2 p.c + (r^2 - |c|^2) is linear in the centre c and in the last term (Kåsa, 1976).
    """
    design = np.column_stack([2 * points, np.ones(len(points))])
    return np.linalg.lstsq(design, (points**2).sum(axis=1), rcond=None)[0][:2]


def turn_of(centres: np.ndarray) -> CircleCheck | None:
    """Fit the circle through camera centres (n, 3) in the order of the turn, by plane and algebraic circle fit.

    None where fewer than 3 distinct centres, or centres on a line, determine no circle.
    """
    centres = np.asarray(centres, np.float64)
    if len(centres) < 3:
        return None
    middle = centres.mean(axis=0)
    _, sizes, directions = np.linalg.svd(centres - middle)
    if sizes[1] <= 1e-9 * max(sizes[0], np.abs(centres).max()):
        return None
    plane = (centres - middle) @ directions[:2].T
    centre = circle_centre(plane)
    around = plane - centre
    radii = np.linalg.norm(around, axis=1)
    angles = np.arctan2(around[:, 1], around[:, 0])
    steps = np.remainder(np.diff(angles, append=angles[0]) + np.pi, 2 * np.pi) - np.pi
    sign = -1.0 if np.median(steps) < 0 else 1.0
    axis = sign * np.cross(directions[0], directions[1])
    return CircleCheck(
        axis=tuple(axis.tolist()),
        centre=tuple((middle + centre @ directions[:2]).tolist()),
        radius=float(radii.mean()),
        radius_min=float(radii.min() / radii.mean()),
        radius_max=float(radii.max() / radii.mean()),
        off_plane=float(np.abs((centres - middle) @ directions[2]).max() / radii.mean()),
        steps_deg=tuple(np.degrees(sign * steps).tolist()),
    )


def scale_turn(matrices: np.ndarray, centres: np.ndarray, factor: float) -> np.ndarray | None:
    """Return projections (n, 3, 4) of cameras at `factor` times their angles from the first about their circle's axis.

    matrices (n, 3, 4) and centres (n, 3), world's unit, in the order of the turn. -1 is an object that turns the other
    way: once round in equal steps, these are the given matrices in reverse order. None where the centres lie on no
    circle.
    """
    circle = turn_of(centres)
    if circle is None:
        return None
    if factor == -1 and circle.full and np.ptp(circle.steps_deg) < EQUAL_STEPS_DEG:
        return np.roll(matrices[::-1], 1, axis=0)
    angles = np.radians((1 - factor) * np.concatenate([[0.0], np.cumsum(circle.steps_deg[:-1])]))
    motions = np.tile(np.eye(4), (len(matrices), 1, 1))
    motions[:, :3, :3] = rotation_matrix(angles[:, None] * circle.axis)
    motions[:, :3, 3] = circle.centre - motions[:, :3, :3] @ np.array(circle.centre)
    return matrices @ motions


@dataclass(frozen=True)
class CameraPath:
    """The path of the cameras round an axis."""

    axis: np.ndarray  # (3,) unit vector and point (3,) on it, world
    point: np.ndarray
    position: np.ndarray  # (views,) radians along the path, rising, starting at 0
    length: float  # radians from the first view back to the first (a full turn) or to the last
    closed: bool  # whether the last view neighbours the first
    deviation_deg: float  # largest angle between the axis of a step and the common one

    def locate(self, index: int, fraction: float) -> float:
        """Compute the position `fraction` of the way from view `index` to the next one."""
        following = self.position[index + 1] if index + 1 < len(self.position) else self.length
        return float(self.position[index] + fraction * (following - self.position[index]))


def fit_turn(cameras: list[Camera], *, full_turn: bool) -> CameraPath:
    """Fit axis and path of the cameras, in their order.

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
    """Find the axis's point (3,) at the mean height of the camera centres: least-squares circle across the axis."""
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
    """Interpolate the camera `fraction` (0..1) of the way from view `index` to the next one.

    Both neighbours are turned about the axis to the place; on an ideal turn they coincide there, and what calibration
    errors leave between them is blended, rotations along the shortest arc.  At 0 and 1 the result is the neighbour.
    """
    a, b = cameras[index], cameras[(index + 1) % len(cameras)]
    step = twist(b.rotation.T @ a.rotation, turn.axis)
    ahead = turn_camera(a, turn, fraction * step)
    behind = turn_camera(b, turn, (fraction - 1) * step)
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


def turn_camera(camera: Camera, turn: CameraPath, angle: float) -> Camera:
    """Turn a camera about the axis by `angle` radians."""
    spin = rotation_matrix(angle * turn.axis)
    rotation = camera.rotation @ spin.T
    centre = spin @ (camera.centre - turn.point) + turn.point
    return replace(camera, rotation=rotation, translation=-rotation @ centre)


def scale_camera(camera: Camera, factor: float) -> Camera:
    """Scale a camera to `factor` times as many pixels along each side, at least one."""
    return camera.resize(max(1, round(camera.rows * factor)), max(1, round(camera.columns * factor)))


def twist(rotation: np.ndarray, axis: np.ndarray) -> float:
    """Compute the angle of a rotation (3, 3) about the axis (swing-twist decomposition), radians, -pi..pi."""
    vector = rotation_vector(rotation)
    angle = np.linalg.norm(vector)
    if angle < 1e-12:
        return 0.0
    along = float(vector @ axis / angle)
    return float(2 * np.arctan2(np.sin(angle / 2) * along, np.cos(angle / 2)))


def rotation_vector(rotation: np.ndarray) -> np.ndarray:
    """Compute axis times angle (3,) of a rotation matrix, radians; accurate at small angles and up to half a turn."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_rotvec()


def rotation_matrix(vectors: np.ndarray) -> np.ndarray:
    """Compute rotations (..., 3, 3) about vectors (..., 3) by their lengths in radians."""
    from scipy.spatial.transform import Rotation

    vectors = np.asarray(vectors, np.float64)
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)
