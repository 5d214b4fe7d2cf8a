"""Poses of all views of a turntable together: one camera at rest, one axis, one angle a view.

The camera stands still and the object turns by angle theta_i about the axis with direction a through point c, so that

    R_i = R_0 Rot(a, theta_i),    t_i = t_0 + R_0 (1 - Rot(a, theta_i)) c :

9 + n unknowns for n views (3 + 3 of the rest pose, 2 of a, 2 of c, n - 1 angles) in place of 6 n.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from nishiki.geometry.camera import Camera, distort
from nishiki.geometry.camera_path import rotation_matrix
from nishiki.geometry.pose import Sight, refine_pose

FOLDS = 3
LEAST_FOR_FOLDS = 6


@dataclass(frozen=True)
class TurntablePoses:
    """cameras: in the order given; axis (3,) unit and point (3,) of the axis, world; angles_deg (n,) from the first
    view; rms_px: root mean square over all points."""

    cameras: tuple[Camera, ...]
    axis: np.ndarray
    point: np.ndarray
    angles_deg: np.ndarray
    rms_px: float


@dataclass(frozen=True)
class Choice:
    """cameras: the poses that predict left-out points better. turn: the poses on one axis. free_px, turn_px:
    root mean square error at points that took no part in the fit (each third of the points in its turn), None where
    a view has fewer than 6 points."""

    cameras: tuple[Camera, ...]
    on_axis: bool
    turn: TurntablePoses
    free_px: float | None
    turn_px: float | None


def choose_poses(sights: list[Sight], cameras: list[Camera], *, steps: str = "free", full_turn: bool = False) -> Choice:
    """Poses on one axis if these predict left-out points at least as well as poses of their own, else the latter.

    sights: points that agree with the cameras (no outliers), in the order of the turn. steps: see `fit_turntable`.
    Where points are too few to leave some out, the poses stay as they are.
    """
    turn = fit_turntable(sights, cameras, steps=steps, full_turn=full_turn)
    if min(len(sight.points) for sight in sights) < LEAST_FOR_FOLDS:
        return Choice(tuple(cameras), False, turn, None, None)
    free_sum, turn_sum, count = 0.0, 0.0, 0
    for fold in range(FOLDS):
        kept = [_part(sight, fold, keep=True) for sight in sights]
        tests = [_part(sight, fold, keep=False) for sight in sights]
        free = [refine_pose(c, s.points, s.pixels) for c, s in zip(cameras, kept, strict=True)]
        tied = fit_turntable(kept, cameras, steps=steps, full_turn=full_turn).cameras
        free_sum += sum(_squares(c, s) for c, s in zip(free, tests, strict=True))
        turn_sum += sum(_squares(c, s) for c, s in zip(tied, tests, strict=True))
        count += sum(len(sight.points) for sight in tests)
    free_px, turn_px = (float(np.sqrt(total / count)) for total in (free_sum, turn_sum))
    on_axis = turn_px <= free_px
    return Choice(turn.cameras if on_axis else tuple(cameras), on_axis, turn, free_px, turn_px)


def _part(sight: Sight, fold: int, *, keep: bool) -> Sight:
    inside = (np.arange(len(sight.points)) % FOLDS != fold) == keep
    return Sight(sight.name, sight.points[inside], sight.pixels[inside])


def _squares(camera: Camera, sight: Sight) -> float:
    projected, _ = camera.project(sight.points)
    return float(((projected - sight.pixels) ** 2).sum())


def fit_turntable(
    sights: list[Sight], cameras: list[Camera], *, steps: str = "free", full_turn: bool = False
) -> TurntablePoses:
    """Least squares over all points of all views (n >= 2), started from the views' own poses.

    All cameras have the intrinsics and distortion of the first. steps: free (one angle a view) | equal (one step; a
    full circle by the number of views where full_turn).
    """
    from scipy.optimize import least_squares

    model = _Model.of(sights, cameras, steps, full_turn)
    fit = least_squares(model.residuals, model.start(cameras), x_scale="jac", ftol=1e-12, xtol=1e-12, gtol=1e-12)
    rotations, translations, axis, point, angles = model.poses(fit.x)
    # The point of the axis nearest to the centre of the points seen: the choice along the axis is free.
    middle = np.concatenate([sight.points for sight in sights]).mean(axis=0)
    point = point + axis * (axis @ (middle - point))
    fitted = tuple(
        replace(camera, rotation=rotation, translation=translation)
        for camera, rotation, translation in zip(cameras, rotations, translations, strict=True)
    )
    rms = float(np.sqrt((fit.fun**2).sum() / len(model.points)))
    return TurntablePoses(fitted, axis, point, np.degrees(angles - angles[0]), rms)


@dataclass(frozen=True)
class _Model:
    points: np.ndarray
    pixels: np.ndarray
    view: np.ndarray
    views: int
    camera: Camera
    axis: np.ndarray
    across: np.ndarray
    steps: str
    full_turn: bool
    sense: float

    @classmethod
    def of(cls, sights: list[Sight], cameras: list[Camera], steps: str, full_turn: bool) -> _Model:
        axis, angles = _axis_of(cameras)
        across = np.linalg.svd(axis[None])[2][1:]
        sense = 1.0 if np.median(np.remainder(np.diff(angles) + np.pi, 2 * np.pi) - np.pi) >= 0 else -1.0
        return cls(
            np.concatenate([sight.points for sight in sights]).astype(np.float64),
            np.concatenate([sight.pixels for sight in sights]).astype(np.float64),
            np.repeat(np.arange(len(sights)), [len(sight.points) for sight in sights]),
            len(sights),
            cameras[0],
            axis,
            across,
            steps,
            full_turn,
            sense,
        )

    def start(self, cameras: list[Camera]) -> np.ndarray:
        """(10 + angles,): turn of the rest pose, its translation, tilt of the axis, its place, angles."""
        _, angles = _axis_of(cameras)
        rest = cameras[0]
        turns = [rest.rotation.T @ camera.rotation for camera in cameras[1:]]
        moves = [camera.translation - rest.translation for camera in cameras[1:]]
        design = np.concatenate([rest.rotation @ (np.eye(3) - turn) for turn in turns])
        point = np.linalg.lstsq(design, np.concatenate(moves), rcond=1e-9)[0]
        free = angles[1:]
        if self.steps == "equal":
            unwrapped = np.unwrap(angles)
            free = [] if self.full_turn else [(unwrapped[-1] - unwrapped[0]) / (self.views - 1)]
        return np.concatenate([np.zeros(3), rest.translation, np.zeros(2), self.across @ point, free])

    def angles(self, free: np.ndarray) -> np.ndarray:
        if self.steps != "equal":
            return np.concatenate([[0.0], free])
        step = self.sense * 2 * np.pi / self.views if self.full_turn else free[0]
        return step * np.arange(self.views)

    def poses(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Rotations (n, 3, 3), translations (n, 3), axis, point and angles (n,)."""
        axis = self.axis + x[6:8] @ self.across
        axis = axis / np.linalg.norm(axis)
        point = x[8:10] @ self.across
        angles = self.angles(x[10:])
        rest = rotation_matrix(x[:3]) @ self.camera.rotation
        turns = rotation_matrix(angles[:, None] * axis)
        return rest @ turns, x[3:6] + (point - turns @ point) @ rest.T, axis, point, angles

    def residuals(self, x: np.ndarray) -> np.ndarray:
        rotations, translations, *_ = self.poses(x)
        seen = np.einsum("nij,nj->ni", rotations[self.view], self.points) + translations[self.view]
        plane = distort(seen[:, :2] / seen[:, 2:], self.camera.distortion)
        k = self.camera.intrinsics
        columns = k[0, 0] * plane[:, 0] + k[0, 1] * plane[:, 1] + k[0, 2]
        return (np.column_stack([columns, k[1, 1] * plane[:, 1] + k[1, 2]]) - self.pixels).ravel()


def _axis_of(cameras: list[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Axis (3,) in the world and angles (n,) from the first view, by the mean axis of the turns between all pairs."""
    rotations = np.array([camera.rotation for camera in cameras])
    total = np.zeros((3, 3))
    for rotation in rotations:
        # Relative turns Rot(a, theta) have their axis times 2 sin(theta) in the skew part, whatever the sign of theta.
        relative = np.swapaxes(rotations, 1, 2) @ rotation
        vectors = np.stack([relative[:, 2, 1], relative[:, 0, 2], relative[:, 1, 0]], axis=1)
        vectors -= np.stack([relative[:, 1, 2], relative[:, 2, 0], relative[:, 0, 1]], axis=1)
        total += vectors.T @ vectors
    axis = np.linalg.eigh(total)[1][:, -1]
    axis = axis * (1.0 if axis[np.argmax(np.abs(axis))] >= 0 else -1.0)
    relative = rotations[0].T @ rotations
    skew = np.stack(
        [
            relative[:, 2, 1] - relative[:, 1, 2],
            relative[:, 0, 2] - relative[:, 2, 0],
            relative[:, 1, 0] - relative[:, 0, 1],
        ],
        axis=1,
    )
    return axis, np.arctan2(skew @ axis / 2, (np.trace(relative, axis1=1, axis2=2) - 1) / 2)
