"""Views of the painting: which point of the maps each sample of the screen sees, and the maps at those points.

Ray casting to a rectangle in space is a homography, for a pinhole camera as for the frontal view: one 3 x 3 matrix
takes (column, row, 1) of the screen to the plane, another takes the plane to the maps.  The relief moves no pixel
sideways (no parallax) and hides nothing from an oblique eye; it acts through the normals and through cast shadows.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from nishiki.errors import require
from nishiki.render.plane.scene import PlaneScene, View


def screen_to_plane(view: View, scene: PlaneScene) -> np.ndarray:
    """(3, 3): (column, row, 1) of the screen to (x, y, 1) w on the plane z = 0; w > 0 where the ray meets it in front.

    Without an eye the painting is fitted into the screen, square pixels, centred.
    """
    rows, columns = screen_shape(view, scene)
    if view.eye_mm is None:
        step = scene.pitch * max(scene.shape[0] / rows, scene.shape[1] / columns)
        return np.array([[step, 0, -step * (columns - 1) / 2], [0, -step, step * (rows - 1) / 2], [0, 0, 1.0]])
    eye, camera = np.asarray(view.eye_mm, np.float64), view.camera()
    ray = camera.rotation.T @ np.linalg.inv(camera.intrinsics)  # directions of rays, linear in (column, row, 1)
    # eye + t ray meets z = 0 at t = -eye_z / ray_z: multiply by -ray_z, which is positive where t is
    return np.stack([eye[2] * ray[0] - eye[0] * ray[2], eye[2] * ray[1] - eye[1] * ray[2], -ray[2]])


def screen_shape(view: View, scene: PlaneScene) -> tuple[int, int]:
    """(rows, columns) of the picture."""
    return scene.shape if view.rows is None else (view.rows, require(view.columns))


def footprint(to_map: np.ndarray, first: int, last: int, columns: int, shape: tuple[int, int]) -> tuple[float, float]:
    """Largest steps on the maps, in their pixels, from one screen row and one screen column to the next.

    Over the screen rows first .. last - 1, where the painting is in sight; (0, 0) where it is not.  No step is longer
    than the painting: towards the horizon the steps grow without bound.
    """
    column, row = np.meshgrid(np.arange(columns, dtype=np.float64), np.arange(first, last, dtype=np.float64))
    x, y, w = (to_map[i, 0] * column + to_map[i, 1] * row + to_map[i, 2] for i in range(3))
    ahead = w > 0
    w = np.where(ahead, w, 1.0)
    x, y = x / w, y / w
    by_column = np.hypot((to_map[0, 0] - x * to_map[2, 0]) / w, (to_map[1, 0] - y * to_map[2, 0]) / w)
    by_row = np.hypot((to_map[0, 1] - x * to_map[2, 1]) / w, (to_map[1, 1] - y * to_map[2, 1]) / w)
    longest = np.hypot(*shape)
    by_column, by_row = np.minimum(by_column, longest), np.minimum(by_row, longest)
    margin = by_column + by_row  # the pixel may touch the painting though its centre does not
    outside = np.maximum(np.maximum(-x, x - shape[1] + 1), np.maximum(-y, y - shape[0] + 1))
    seen = ahead & (outside <= margin + 0.5)
    if not seen.any():
        return 0.0, 0.0
    return float(by_row[seen].max()), float(by_column[seen].max())


@dataclass(frozen=True)
class MapSamples:
    """Maps at the samples of a band of the screen."""

    normals: np.ndarray  # (h, w, 3) float32, unit length or 0
    coefficients: np.ndarray  # (h, w, K) float32
    shading: np.ndarray | None  # (h, w, 3 or 5) float32
    labels: np.ndarray | None  # (h, w) uint8, of the nearest pixel
    visibility: np.ndarray | None  # (lights, h, w) float32
    inside: np.ndarray  # (h, w) bool


def sample_maps(
    scene: PlaneScene, visibility: np.ndarray | None, to_map: np.ndarray, shape: tuple, extent: tuple
) -> MapSamples:
    """Bilinear samples at to_map . (column, row, 1), normals renormalised: the shading comes after.

    extent: (rows, columns) of the painting in pixels of the maps, where averaging in blocks rounded their number up.
    A missing normal among the four neighbours is left out; where half of the weight is missing, so is the sample.
    """
    height, width = shape
    lights = 0 if visibility is None else len(visibility)
    normals = np.empty((height, width, 3), np.float32)
    coefficients = np.empty((height, width, scene.coefficients.shape[2]), np.float32)
    terms = (0, 0, 0) if scene.shading is None else (height, width, scene.shading.shape[2])
    shading = np.empty(terms, np.float32)
    labels = np.empty((height, width) if scene.labels is not None else (0, 0), np.uint8)
    visible = np.empty((lights, height, width), np.float32)
    inside = np.empty((height, width), np.bool_)
    maps = (
        np.ascontiguousarray(scene.normals, np.float32),
        np.ascontiguousarray(scene.coefficients, np.float32),
        np.zeros((0, 0, 0), np.float32) if scene.shading is None else np.ascontiguousarray(scene.shading, np.float32),
        np.zeros((0, 0), np.uint8) if scene.labels is None else np.ascontiguousarray(scene.labels),
        np.zeros((0, 0, 0), np.float32) if visibility is None else np.ascontiguousarray(visibility, np.float32),
    )
    out = normals, coefficients, shading, labels, visible, inside
    _sample(maps, to_map, (float(extent[0]), float(extent[1])), out)
    return MapSamples(
        normals,
        coefficients,
        None if scene.shading is None else shading,
        None if scene.labels is None else labels,
        None if visibility is None else visible,
        inside,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _sample(maps, to_map, extent, out):
    (maps_n, maps_c, maps_s, maps_l, maps_v), (high, wide) = maps, extent
    normals, coefficients, shading, labels, visible, inside = out
    rows, columns = maps_n.shape[:2]
    for i in range(inside.shape[0]):
        for j in range(inside.shape[1]):
            w = to_map[2, 0] * j + to_map[2, 1] * i + to_map[2, 2]
            x = (to_map[0, 0] * j + to_map[0, 1] * i + to_map[0, 2]) / w
            y = (to_map[1, 0] * j + to_map[1, 1] * i + to_map[1, 2]) / w
            on = w > 0.0 and -0.5 <= x < wide - 0.5 and -0.5 <= y < high - 0.5
            inside[i, j] = on
            if not on:
                normals[i, j, :] = 0.0
                coefficients[i, j, :] = 0.0
                if shading.shape[0] > 0:
                    shading[i, j, :] = 0.0
                visible[:, i, j] = 0.0
                if labels.shape[0] > 0:
                    labels[i, j] = 0
                continue
            x, y = min(max(x, 0.0), columns - 1.0), min(max(y, 0.0), rows - 1.0)
            c0, r0 = min(int(x), max(columns - 2, 0)), min(int(y), max(rows - 2, 0))
            c1, r1 = min(c0 + 1, columns - 1), min(r0 + 1, rows - 1)
            fx, fy = x - c0, y - r0
            nx, ny, nz, known = 0.0, 0.0, 0.0, 0.0
            coefficients[i, j, :] = 0.0
            if shading.shape[0] > 0:
                shading[i, j, :] = 0.0
            for k in range(4):
                r, c = r1 if k >= 2 else r0, c1 if k % 2 == 1 else c0
                weight = (fy if k >= 2 else 1.0 - fy) * (fx if k % 2 == 1 else 1.0 - fx)
                if weight == 0.0:
                    continue
                px, py, pz = maps_n[r, c, 0], maps_n[r, c, 1], maps_n[r, c, 2]
                if abs(px * px + py * py + pz * pz - 1.0) < 0.02:
                    nx, ny, nz, known = nx + weight * px, ny + weight * py, nz + weight * pz, known + weight
                for m in range(coefficients.shape[2]):
                    coefficients[i, j, m] += np.float32(weight) * maps_c[r, c, m]
                if shading.shape[0] > 0:
                    for m in range(shading.shape[2]):
                        shading[i, j, m] += np.float32(weight) * maps_s[r, c, m]
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            scale = 1.0 / length if known > 0.5 and length > 0.0 else 0.0
            normals[i, j, 0], normals[i, j, 1], normals[i, j, 2] = nx * scale, ny * scale, nz * scale
            if labels.shape[0] > 0:
                labels[i, j] = maps_l[r1 if fy >= 0.5 else r0, c1 if fx >= 0.5 else c0]
            for m in range(visible.shape[0]):
                upper = maps_v[m, r0, c0] + (maps_v[m, r0, c1] - maps_v[m, r0, c0]) * fx
                lower = maps_v[m, r1, c0] + (maps_v[m, r1, c1] - maps_v[m, r1, c0]) * fx
                visible[m, i, j] = upper + (lower - upper) * fy
