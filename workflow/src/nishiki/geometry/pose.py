"""Estimate the pose of one view, or of all views of a turntable together, from points and their pixels.

The camera stands still and the object turns by angle theta_i about the axis with direction a through point c, so that

    R_i = R_0 Rot(a, theta_i),    t_i = t_0 + R_0 (1 - Rot(a, theta_i)) c :

9 + n unknowns for n views (3 + 3 of the rest pose, 2 of a, 2 of c, n - 1 angles) in place of 6 n.
"""

from dataclasses import dataclass, replace

import numpy as np

from nishiki.errors import UserError
from nishiki.geometry.camera import NO_DISTORTION, Camera, distort
from nishiki.geometry.turn import rotation_matrix, rotation_vector

LEAST_POINTS = 4  # of a pose
DRAWS = 400  # at most
CONFIDENCE = 0.9999  # that some draw was without outliers
STOP = (3, 100, 1e-15)  # of Levenberg-Marquardt: so many steps, or one that changes nothing
# Where the second pose of a flat set fits worse by less than this many noise variances, the picture cannot tell.
DISTINCT = 20.0
FLAT = 0.05  # third over first extent of points that count as a plane
LINE = 1e-3  # second over first extent of points that fix no pose
SAME_POSE_DEG = 2.0


@dataclass(frozen=True)
class Sight:
    """One view of known points: points (n, 3) world, pixels (n, 2) (column, row), float64."""

    name: str
    points: np.ndarray
    pixels: np.ndarray


@dataclass(frozen=True)
class Pose:
    """A pose. camera: the view. inliers (n,) bool: points that agree with it. rms_px: over the inliers."""

    camera: Camera
    inliers: np.ndarray
    rms_px: float


def estimate_pose(
    sight: Sight,
    intrinsics: np.ndarray,
    distortion: tuple[float, ...] = NO_DISTORTION,
    *,
    rows: int,
    columns: int,
    outlier_px: float,
) -> Pose:
    """Estimate a pose by RANSAC of SQPnP, then Levenberg-Marquardt on the points within outlier_px.

    G. Terzakis and M. Lourakis, ECCV 2020. Inliers are chosen until they stay the same. Draws are fixed: equal input
    gives equal output.

    Raises UserError, naming the view and what to do: fewer than 4 points; points on a line; fewer than 5, or less than
    half of them, agree with one pose; points behind the camera; flat points with two poses that fit equally well.
    """
    sight = Sight(sight.name, np.asarray(sight.points, np.float64), np.asarray(sight.pixels, np.float64))
    _expect_spread(sight, np.ones(len(sight.points), bool))
    # about the points' mean, of unit size, so that the solvers' tolerances fit
    middle = sight.points.mean(axis=0)
    size = float(np.sqrt(((sight.points - middle) ** 2).sum(axis=1).mean()))
    given, sight = sight, Sight(sight.name, (sight.points - middle) / size, sight.pixels)
    lens = _Lens.of(intrinsics, distortion, rows, columns)
    start = _first_pose(sight, lens, outlier_px)
    if start is None:
        raise UserError(f"view {sight.name!r}: no camera sees these {len(sight.points)} points there. {REMEDY}")
    vector, inliers = _settle(sight, lens, start, outlier_px)
    # Some camera sees any four points where they are: one more must confirm it, where there is one.
    if inliers.sum() < max(min(LEAST_POINTS + 1, len(inliers)), len(inliers) / 2):
        count = int(inliers.sum())
        raise UserError(
            f"view {sight.name!r}: only {count} of {len(inliers)} correspondences agree within {outlier_px:g} px. "
            f"{REMEDY}"
        )
    _expect_spread(sight, inliers)
    vector = _expect_one(sight, lens, vector, inliers)
    camera = lens.camera(sight.name, vector)
    camera = replace(camera, translation=size * camera.translation - camera.rotation @ middle)
    projected, depth = camera.project(given.points)
    if (depth[inliers] <= 0).any():
        count = int((depth[inliers] <= 0).sum())
        raise UserError(f"view {sight.name!r}: {count} points lie behind the camera that fits best. {REMEDY}")
    errors = np.linalg.norm(projected - sight.pixels, axis=1)[inliers]
    return Pose(camera, inliers, float(np.sqrt((errors**2).mean())))


REMEDY = (
    "Remedy: check that columns and rows are not swapped, that points carry the mesh's own coordinates and unit, that "
    "the world is right-handed, and that the intrinsics are those of these pictures"
)


def refine_pose(camera: Camera, points: np.ndarray, pixels: np.ndarray) -> Camera:
    """Move a camera to the least reprojection error over points (n, 3), pixels (n, 2); intrinsics stay."""
    lens = _Lens.of(camera.intrinsics, camera.distortion, camera.rows, camera.columns)
    vector = np.concatenate([rotation_vector(camera.rotation), camera.translation])
    return lens.camera(camera.name, _refine(lens, vector, points, pixels))


@dataclass(frozen=True)
class _Lens:
    intrinsics: np.ndarray
    upright: np.ndarray
    distortion: np.ndarray
    rows: int
    columns: int

    @classmethod
    def of(cls, intrinsics: np.ndarray, distortion: tuple[float, ...], rows: int, columns: int) -> "_Lens":
        intrinsics = np.array(intrinsics, np.float64)
        upright = intrinsics.copy()
        upright[0, 1] = 0.0
        return cls(intrinsics, upright, np.array(distortion, np.float64), rows, columns)

    def straighten(self, pixels: np.ndarray) -> np.ndarray:
        """Convert pixels to the same camera without skew, which OpenCV's model lacks: exact, the lens comes first."""
        k = self.intrinsics
        skew = k[0, 1] * (pixels[:, 1] - k[1, 2]) / k[1, 1]
        return np.ascontiguousarray(np.column_stack([pixels[:, 0] - skew, pixels[:, 1]]))

    def camera(self, name: str, vector: np.ndarray) -> Camera:
        rotation, coefficients = rotation_matrix(vector[:3]), tuple(self.distortion.tolist())
        return Camera(name, self.intrinsics, rotation, vector[3:].copy(), self.rows, self.columns, coefficients)


def _expect_spread(sight: Sight, chosen: np.ndarray) -> None:
    """Raise a UserError unless the chosen points are at least 4, finite, and not on a line."""
    points = sight.points[chosen]
    if len(points) < LEAST_POINTS:
        raise UserError(
            f"view {sight.name!r}: expected at least {LEAST_POINTS} correspondences, found {len(points)}. Remedy: pick "
            "more points in this view, far apart and at different depths (6 or more are better)"
        )
    if not (np.isfinite(points).all() and np.isfinite(sight.pixels[chosen]).all()):
        raise UserError(f"view {sight.name!r}: correspondences that are not finite. Remedy: correct these rows")
    for values, what in ((points, "points"), (sight.pixels[chosen], "pixels")):
        sizes = np.linalg.svd(values - values.mean(axis=0), compute_uv=False)
        if sizes[1] <= LINE * sizes[0]:
            raise UserError(
                f"view {sight.name!r}: all {what} of its correspondences lie on a line, which leaves a turn about it "
                "open. Remedy: pick points to both sides of that line"
            )


def _first_pose(sight: Sight, lens: _Lens, outlier_px: float) -> np.ndarray | None:
    """Find rotation vector and translation (6,) that agree with most of the points; None where there is none."""
    import cv2

    done, turn, shift, _ = cv2.solvePnPRansac(
        sight.points, lens.straighten(sight.pixels), lens.upright, lens.distortion,
        iterationsCount=DRAWS, reprojectionError=outlier_px, confidence=CONFIDENCE, flags=cv2.SOLVEPNP_SQPNP,
    )  # fmt: skip
    vector = np.concatenate([turn.ravel(), shift.ravel()]) if done else np.full(6, np.nan)
    return vector if np.isfinite(vector).all() else None


def _errors(lens: _Lens, vector: np.ndarray, points: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Compute squared distances (n,) in pixels; infinite behind the camera."""
    projected, depth = lens.camera("", vector).project(points)
    return np.where(depth > 0, ((projected - pixels) ** 2).sum(axis=1), np.inf)


def _settle(sight: Sight, lens: _Lens, vector: np.ndarray, outlier_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Alternate between the points within outlier_px and the best pose of these."""
    inliers = _errors(lens, vector, sight.points, sight.pixels) <= outlier_px**2
    for _ in range(10):
        if inliers.sum() < LEAST_POINTS:
            break
        vector = _refine(lens, vector, sight.points[inliers], sight.pixels[inliers])
        now = _errors(lens, vector, sight.points, sight.pixels) <= outlier_px**2
        if (now == inliers).all():
            break
        inliers = now
    return vector, inliers


def _refine(lens: _Lens, vector: np.ndarray, points: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Fit a pose by least squares from rotation vector and translation (6,), by Levenberg-Marquardt."""
    import cv2

    turn, shift = vector[:3, None].copy(), vector[3:, None].copy()  # columns: others are not changed
    cv2.solvePnPRefineLM(
        np.ascontiguousarray(points), lens.straighten(pixels), lens.upright, lens.distortion, turn, shift, STOP
    )
    return np.concatenate([turn.ravel(), shift.ravel()])


def _expect_one(sight: Sight, lens: _Lens, vector: np.ndarray, inliers: np.ndarray) -> np.ndarray:
    """Choose the better of the two poses of flat points; UserError where the picture does not distinguish them.

    T. Collins and A. Bartoli, Infinitesimal plane-based pose estimation, IJCV 109, 2014. Other points pass unchanged.
    """
    import cv2

    points, pixels = sight.points[inliers], sight.pixels[inliers]
    centred = points - points.mean(axis=0)
    _, sizes, directions = np.linalg.svd(centred, full_matrices=False)
    if sizes[2] > FLAT * sizes[0]:
        return vector
    flat = points - np.outer(centred @ directions[2], directions[2])
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(
            flat, lens.straighten(pixels), lens.upright, lens.distortion, flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:
        return vector
    starts = [np.concatenate([turn.ravel(), shift.ravel()]) for turn, shift in zip(turns, shifts, strict=True)]
    poses = [vector, *(_refine(lens, start, points, pixels) for start in starts if np.isfinite(start).all())]
    poses = [pose for pose in poses if np.isfinite(pose).all()]
    sums = [float(_errors(lens, pose, points, pixels).sum()) for pose in poses]
    order = np.argsort(sums, kind="stable")
    best = poses[order[0]]
    variance = max(sums[order[0]] / max(1, 2 * len(points) - 6), 0.02**2)
    for other in order[1:]:
        turn = lens.camera("", best).rotation @ lens.camera("", poses[other]).rotation.T
        apart = float(np.degrees(np.linalg.norm(rotation_vector(turn))))
        if apart > SAME_POSE_DEG and sums[other] - sums[order[0]] < DISTINCT * variance:
            raise UserError(
                f"view {sight.name!r}: its points lie in a plane, and two cameras {apart:.0f} degrees apart explain "
                "them equally well. Remedy: add points off that plane, or photograph closer and further from the side"
            )
    return best


FOLDS = 3  # of cross-validation
LEAST_FOR_FOLDS = 6  # points of a view


@dataclass(frozen=True)
class TurntablePoses:
    """Poses on one axis."""

    cameras: tuple[Camera, ...]  # in the order given
    axis: np.ndarray  # (3,) unit and point (3,) of the axis, world
    point: np.ndarray
    angles_deg: np.ndarray  # (n,) from the first view
    rms_px: float  # root mean square over all points


@dataclass(frozen=True)
class PoseComparison:
    """A comparison of single poses with poses on one axis."""

    cameras: tuple[Camera, ...]  # the poses that predict left-out points better
    on_axis: bool
    turn: TurntablePoses  # the poses on one axis
    # free_px, turn_px: root mean square error at left-out points (each third of the points in its turn), None where a
    # view has fewer than 6 points
    free_px: float | None
    turn_px: float | None


def choose_poses(
    sights: list[Sight], cameras: list[Camera], *, steps: str = "free", full_turn: bool = False
) -> PoseComparison:
    """Choose poses on one axis if they predict left-out points at least as well as poses of their own, else the latter.

    sights: points that agree with the cameras (no outliers), in the order of the turn. steps: see `fit_turntable`.
    Where points are too few to leave some out, the poses stay as they are.
    """
    turn = fit_turntable(sights, cameras, steps=steps, full_turn=full_turn)
    if min(len(sight.points) for sight in sights) < LEAST_FOR_FOLDS:
        return PoseComparison(tuple(cameras), False, turn, None, None)
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
    return PoseComparison(turn.cameras if on_axis else tuple(cameras), on_axis, turn, free_px, turn_px)


def _part(sight: Sight, fold: int, *, keep: bool) -> Sight:
    inside = (np.arange(len(sight.points)) % FOLDS != fold) == keep
    return Sight(sight.name, sight.points[inside], sight.pixels[inside])


def _squares(camera: Camera, sight: Sight) -> float:
    projected, _ = camera.project(sight.points)
    return float(((projected - sight.pixels) ** 2).sum())


def fit_turntable(
    sights: list[Sight], cameras: list[Camera], *, steps: str = "free", full_turn: bool = False
) -> TurntablePoses:
    """Fit by least squares over all points of all views (n >= 2), started from the views' own poses.

    All cameras have the intrinsics and distortion of the first. steps: free (one angle a view) | equal (one step; a
    full circle by the number of views where full_turn).
    """
    from scipy.optimize import least_squares

    model = _Model(sights, cameras, steps, full_turn)
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


class _Model:
    def __init__(self, sights: list[Sight], cameras: list[Camera], steps: str, full_turn: bool) -> None:
        self.points = np.concatenate([sight.points for sight in sights]).astype(np.float64)
        self.pixels = np.concatenate([sight.pixels for sight in sights]).astype(np.float64)
        self.view = np.repeat(np.arange(len(sights)), [len(sight.points) for sight in sights])
        self.views, self.camera, self.steps, self.full_turn = len(sights), cameras[0], steps, full_turn
        self.axis, angles = _axis_of(cameras)
        self.across = np.linalg.svd(self.axis[None])[2][1:]
        self.sense = 1.0 if np.median(np.remainder(np.diff(angles) + np.pi, 2 * np.pi) - np.pi) >= 0 else -1.0

    def start(self, cameras: list[Camera]) -> np.ndarray:
        """Estimate (10 + angles,): turn of the rest pose, its translation, tilt of the axis, its place, angles."""
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
        """Compute rotations (n, 3, 3), translations (n, 3), axis, point and angles (n,)."""
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
    """Find axis (3,) in the world, angles (n,) from the first view, by the mean axis of the turns between all pairs."""
    rotations = np.array([camera.rotation for camera in cameras])
    total = np.zeros((3, 3))
    for rotation in rotations:
        # Relative turns Rot(a, theta) have their axis times 2 sin(theta) in the skew part, whatever the sign of theta.
        vectors = _skew_part(np.swapaxes(rotations, 1, 2) @ rotation)
        total += vectors.T @ vectors
    axis = np.linalg.eigh(total)[1][:, -1]
    axis = axis * (1.0 if axis[np.argmax(np.abs(axis))] >= 0 else -1.0)
    relative = rotations[0].T @ rotations
    return axis, np.arctan2(_skew_part(relative) @ axis / 2, (np.trace(relative, axis1=1, axis2=2) - 1) / 2)


def _skew_part(matrices: np.ndarray) -> np.ndarray:
    """Compute (n, 3) of rotations (n, 3, 3): their axes times twice the sines of their angles."""
    skew = matrices - np.swapaxes(matrices, 1, 2)
    return np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
