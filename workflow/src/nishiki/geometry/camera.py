"""Project world points to pixels and back with pinhole cameras, check given matrices, and store calibrated views.

World: the object's own frame, fixed to the object; on a turntable the camera goes round the object. Camera frame: x
right, y down, z into the scene. Pixels: (column, row), the centre of the top left pixel is (0, 0).
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from nishiki.errors import UserError
from nishiki.formats.stored import PlainFields

NO_DISTORTION = (0.0, 0.0, 0.0, 0.0, 0.0)
ROUNDING = 1e-12  # of a depth, relative to its terms


@dataclass(frozen=True)
class Camera(PlainFields):
    """One calibrated view."""

    name: str
    intrinsics: np.ndarray  # (3, 3) float64, upper triangular, last element 1
    rotation: np.ndarray  # (3, 3) world to camera
    translation: np.ndarray  # (3,) in the world's unit
    rows: int  # rows, columns: of its picture
    columns: int
    # k1, k2, p1, p2, k3 (Brown's model, as OpenCV orders them)
    distortion: tuple[float, ...] = field(default=NO_DISTORTION)

    @classmethod
    def from_matrix(cls, name: str, matrix: np.ndarray, *, rows: int, columns: int) -> "Camera":
        """Make the camera of a 3x4 projection matrix (any scale and sign), by RQ decomposition.

        Raises UserError where the matrix is not 3x4, not finite, or its left 3x3 part is singular.
        """
        matrix = np.asarray(matrix, np.float64)
        if matrix.shape != (3, 4) or not np.isfinite(matrix).all():
            raise UserError(f"view {name!r}: expected a finite 3x4 projection matrix, found shape {matrix.shape}")
        left = matrix[:, :3]
        largest = np.abs(left[2]).max()  # first, so that squares and determinants stay in range at any scale
        matrix = matrix / largest if largest > 0 else matrix
        matrix = matrix / (np.linalg.norm(matrix[2, :3]) or 1.0)
        left = matrix[:, :3]
        if largest == 0 or np.linalg.cond(left) > 1e12:
            raise UserError(f"view {name!r}: the projection matrix is singular; expected a camera at a finite place")
        matrix = matrix * np.sign(np.linalg.det(left))
        flip = np.eye(3)[::-1]
        orthogonal, triangular = np.linalg.qr((flip @ matrix[:, :3]).T)
        upper, rotation = flip @ triangular.T @ flip, flip @ orthogonal.T
        signs = np.diag(np.sign(np.diag(upper)))
        upper, rotation = upper @ signs, signs @ rotation
        translation = np.linalg.solve(upper, matrix[:, 3])
        return cls(name, upper / upper[2, 2], rotation, translation, rows, columns)

    @property
    def matrix(self) -> np.ndarray:
        """(3, 4) float64: projection without distortion, so scaled that the third component is the depth."""
        return self.intrinsics @ np.column_stack([self.rotation, self.translation])

    @property
    def centre(self) -> np.ndarray:
        """(3,) float64: the camera's place in the world."""
        return -self.rotation.T @ self.translation

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute pixels (n, 2) (column, row) and depths (n,) of world points (n, 3), float64.

        Points at or behind the camera have depth <= 0 and pixels that mean nothing. A depth that is rounding of the sum
        it comes from (below 1e-12 of its terms) is 0.
        """
        points = np.asarray(points, np.float64)
        seen = points @ self.rotation.T + self.translation
        terms = np.abs(points) @ np.abs(self.rotation[2]) + abs(self.translation[2])
        depth = np.where(np.abs(seen[:, 2]) > ROUNDING * terms, seen[:, 2], 0.0)
        plane = seen[:, :2] / np.where(depth > 0, depth, 1.0)[:, None]
        if any(self.distortion):
            plane = distort(plane, self.distortion)
        k = self.intrinsics
        columns = k[0, 0] * plane[:, 0] + k[0, 1] * plane[:, 1] + k[0, 2]
        return np.column_stack([columns, k[1, 1] * plane[:, 1] + k[1, 2]]), depth

    def resize(self, rows: int, columns: int) -> "Camera":
        """Describe the same camera for its picture resampled to another size."""
        along = np.array([columns / self.columns, rows / self.rows])
        intrinsics = np.diag([*along, 1.0]) @ self.intrinsics
        intrinsics[:2, 2] += 0.5 * along - 0.5
        return replace(self, intrinsics=intrinsics, rows=rows, columns=columns)


def distort(plane: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """Apply Brown's lens distortion to points (n, 2) on the plane at depth 1.

    D. C. Brown, Close-range camera calibration, Photogrammetric Engineering 37, 1971.
    """
    k1, k2, p1, p2, k3 = coefficients
    x, y = plane[:, 0], plane[:, 1]
    square = x * x + y * y
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    return np.column_stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
        ]
    )


def look_at(
    eye, target, *, rows: int, columns: int, field_of_view: float, up=(0.0, 1.0, 0.0), name: str = "view"
) -> Camera:
    """Place a pinhole camera at `eye` towards `target`.

    field_of_view: vertical, radians; up: upward direction of the picture.
    """
    eye, target, up = (np.asarray(v, np.float64) for v in (eye, target, up))
    ahead = target - eye
    length = np.linalg.norm(ahead)
    right = np.cross(ahead, up)
    if not length > 0 or np.linalg.norm(right) < 1e-9 * length * max(np.linalg.norm(up), 1e-300):
        raise UserError(
            f"camera: expected an eye apart from its target and up across the line of sight; found {eye}, {target}"
        )
    if not (0 < field_of_view < np.pi) or rows < 1 or columns < 1:
        raise UserError(f"camera: expected a field of view of 0 to 180 degrees, found {np.degrees(field_of_view):g}")
    ahead, right = ahead / length, right / np.linalg.norm(right)
    rotation = np.stack([right, -np.cross(right, ahead), ahead])
    focal = rows / (2 * np.tan(field_of_view / 2))
    intrinsics = np.array([[focal, 0, (columns - 1) / 2], [0, focal, (rows - 1) / 2], [0, 0, 1]])
    return Camera(name, intrinsics, rotation, -rotation @ eye, rows, columns)


@dataclass(frozen=True)
class GivenCameras:
    """Given cameras."""

    cameras: tuple[Camera, ...]  # in the order given
    mirror: tuple[int, int, int] | None  # factors on the world's axes, None where the world stands as given
    # (3,) the point nearest to the rays through the picture centres, in the cameras' world; None if not determined
    target: np.ndarray | None


def cameras_of_matrices(matrices: Mapping[str, np.ndarray], *, rows: int, columns: int) -> GivenCameras:
    """Make the cameras of projection matrices (3, 4) by view, of any scale and sign.

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
            f"projection matrices of {', '.join(odd[:8])}: these views and the others face away from each other; "
            "expected the same side of a right-handed world. Remedy: check the signs of the rows and the order of "
            "these views"
        )
    centres = np.array([camera.centre for camera in cameras])
    normal = np.linalg.svd(centres - centres.mean(axis=0))[2][2]  # of the plane of the centres
    x, y, z = (1 - 2 * (np.arange(3) == np.argmax(np.abs(normal)))).tolist()
    mirror, flip = (x, y, z), np.diag([x, y, z, 1])
    cameras = [
        Camera.from_matrix(name, np.asarray(matrix, np.float64) @ flip, rows=rows, columns=columns)
        for name, matrix in matrices.items()
    ]
    return GivenCameras(tuple(cameras), mirror, target * mirror)


def point_in_sight(cameras: list[Camera]) -> np.ndarray | None:
    """Find the point (3,) nearest (least squares) to the rays through the picture centres.

    None where they are parallel or come from one place (largest angle between two rays below half a degree).
    """
    middles = [np.array([(camera.columns - 1) / 2, (camera.rows - 1) / 2, 1.0]) for camera in cameras]
    through = zip(cameras, middles, strict=True)
    rays = np.array([camera.rotation.T @ np.linalg.solve(camera.intrinsics, middle) for camera, middle in through])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    if len(cameras) < 2 or np.linalg.norm(np.cross(rays[:, None], rays[None]), axis=-1).max() < np.sin(np.radians(0.5)):
        return None
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    centres = np.array([camera.centre for camera in cameras])
    spread = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
    if spread <= 1e-9 * np.abs(centres).max():
        return None
    return np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, centres))


def save_cameras(
    path: Path,
    cameras: list[Camera],
    *,
    unit: str,
    full_turn: bool,
    source: str,
    reprojection_px: list[float | None],
    mirror: tuple[int, int, int] | None = None,
) -> None:
    """Write the views in the order of the turn; reprojection_px: root mean square of each view, None if unmeasured.

    source: matrices | boards | correspondences. mirror: factors that were put on the world's axes (see
    `nishiki.geometry.camera`); coordinates of the capture's own world have to be multiplied by them.
    """
    views = [
        {**camera.as_dict(), "reprojection_px": error} for camera, error in zip(cameras, reprojection_px, strict=True)
    ]
    document = {"unit": unit, "full_turn": full_turn, "source": source, "mirror": mirror, "views": views}
    Path(path).write_text(json.dumps(document, indent=1, sort_keys=True, allow_nan=False) + "\n")


def read_cameras(path: Path) -> dict:
    """Read the whole document: unit, full_turn, source, mirror, views. UserError where it is missing or damaged."""
    try:
        document = json.loads(Path(path).read_text())
        document["views"][0]["intrinsics"]
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise UserError(f"{path}: not a file of cameras ({error}). Remedy: run the stage cameras again") from None
    return document


def load_cameras(path: Path) -> list[Camera]:
    """Load the cameras alone, in the order of the turn. UserError as `read_cameras`."""
    return [Camera.from_dict(values) for values in read_cameras(path)["views"]]
