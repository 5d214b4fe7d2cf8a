"""Pinhole cameras: world points to pixels and back.

World: the object's own frame, fixed to the object; on a turntable the camera goes round the object. Camera frame: x
right, y down, z into the scene. Pixels: (column, row), the centre of the top left pixel is (0, 0).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from nishiki.errors import UserError

NO_DISTORTION = (0.0, 0.0, 0.0, 0.0, 0.0)
ROUNDING = 1e-12


@dataclass(frozen=True)
class Camera:
    """One calibrated view.

    intrinsics (3, 3) float64, upper triangular, last element 1; rotation (3, 3) world to camera, translation (3,) in
    the world's unit; distortion: k1, k2, p1, p2, k3 (Brown's model, as OpenCV orders them); rows, columns: of its
    picture.
    """

    name: str
    intrinsics: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    rows: int
    columns: int
    distortion: tuple[float, ...] = field(default=NO_DISTORTION)

    @classmethod
    def from_matrix(cls, name: str, matrix: np.ndarray, *, rows: int, columns: int) -> Camera:
        """Camera of a 3x4 projection matrix (any scale and sign), by RQ decomposition.

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
        """Pixels (n, 2) (column, row) and depths (n,) of world points (n, 3), float64.

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

    def resize(self, rows: int, columns: int) -> Camera:
        """Describe the same camera for its picture resampled to another size."""
        along = np.array([columns / self.columns, rows / self.rows])
        intrinsics = np.diag([*along, 1.0]) @ self.intrinsics
        intrinsics[:2, 2] += 0.5 * along - 0.5
        return replace(self, intrinsics=intrinsics, rows=rows, columns=columns)

    def as_dict(self) -> dict:
        """Plain data, for JSON."""
        return {
            "name": self.name,
            "intrinsics": self.intrinsics.tolist(),
            "rotation": self.rotation.tolist(),
            "translation": self.translation.tolist(),
            "rows": self.rows,
            "columns": self.columns,
            "distortion": list(self.distortion),
        }

    @classmethod
    def from_dict(cls, values: dict) -> Camera:
        """Inverse of `as_dict`; keys beyond those of a camera are ignored."""
        arrays = (np.array(values[key], np.float64) for key in ("intrinsics", "rotation", "translation"))
        return cls(values["name"], *arrays, values["rows"], values["columns"], tuple(values["distortion"]))


def distort(plane: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """Brown's lens distortion of points (n, 2) on the plane at depth 1 (D. C. Brown, Close-range camera calibration,
    Photogrammetric Engineering 37, 1971)."""
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
    """A pinhole camera at `eye` towards `target`; field_of_view: vertical, radians; up: as the picture shows it."""
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
