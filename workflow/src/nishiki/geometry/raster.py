"""Which triangle each pixel of a view shows: a z-buffer over projected triangles.

The vertices go through the whole camera, lens distortion included; between them edges are straight in the picture,
which for triangles of a few pixels is the same thing. Edge functions as in J. Pineda, A parallel algorithm for polygon
rasterization, SIGGRAPH 1988.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh


@dataclass(frozen=True)
class Raster:
    """The surface points behind the pixel centres of a view, or of a band of its rows.

    triangle (rows, columns) int32, -1 where there is none; barycentric (rows, columns, 2) float32: weights of corners 0
    and 1 of the triangle, perspective-correct, 0 where there is none; depth (rows, columns) float32 along the optical
    axis in the world's unit, +inf where there is none; first_row: row of the picture that row 0 of the arrays is;
    behind: triangles left out because a corner lies at or behind the camera's plane.
    """

    triangle: np.ndarray
    barycentric: np.ndarray
    depth: np.ndarray
    first_row: int
    behind: int


def rasterise(mesh: Mesh, camera: Camera, *, cull: bool = False, rows: tuple[int, int] | None = None) -> Raster:
    """The triangle nearest to the camera behind each pixel centre.

    A pixel centre on an edge belongs to exactly one of the two triangles that share it (top-left rule, evaluated so
    that both see the same number). Triangles without area, with corners that are not finite, or with a corner at or
    behind the camera's plane show nowhere. cull: leave out triangles that turn their back to the camera (they hide
    nothing then); rows: (first, stop), only these rows of the picture.
    """
    first, stop = (0, camera.rows) if rows is None else rows
    if not 0 <= first <= stop <= camera.rows:
        raise ValueError(f"rows {first} to {stop} are not within the picture's {camera.rows}")
    pixels, depths = camera.project(mesh.vertices)
    shape = (stop - first, camera.columns)
    triangle = np.full(shape, -1, np.int32)
    barycentric = np.zeros((*shape, 2), np.float32)
    depth = np.full(shape, np.inf, np.float32)
    corners = np.ascontiguousarray(mesh.triangles, np.int32)
    behind = fill(np.ascontiguousarray(pixels), depths, corners, first, cull, triangle, barycentric, depth)
    return Raster(triangle, barycentric, depth, first, int(behind))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def edge(pixels, a, b, x, y):
    """Twice the signed area of (a, b, (x, y)); exactly opposite for (b, a), as the lower vertex always comes first."""
    if a < b:
        return (pixels[b, 0] - pixels[a, 0]) * (y - pixels[a, 1]) - (pixels[b, 1] - pixels[a, 1]) * (x - pixels[a, 0])
    return -((pixels[a, 0] - pixels[b, 0]) * (y - pixels[b, 1]) - (pixels[a, 1] - pixels[b, 1]) * (x - pixels[b, 0]))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def owns(pixels, a, b):
    """Whether the triangle left of a -> b owns the points on this edge: true for exactly one of a -> b and b -> a."""
    rise = pixels[b, 1] - pixels[a, 1]
    return rise > 0 or (rise == 0 and pixels[b, 0] < pixels[a, 0])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def bounds(values, size):
    """First and last integer within the range of three values, clipped to [0, size)."""
    low = min(values[0], min(values[1], values[2]))
    high = max(values[0], max(values[1], values[2]))
    # Clipped before the conversion: a corner near the camera's plane can lie beyond the range of integers.
    return int(np.ceil(min(max(low, 0.0), np.float64(size)))), int(np.floor(max(min(high, size - 1.0), -1.0)))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill(pixels, depths, corners, first_row, cull, triangle, barycentric, depth):
    """Z-buffer over all triangles into the three arrays; returns how many were left out as behind the camera."""
    rows, columns = triangle.shape
    behind = 0
    for index in range(len(corners)):
        a, b, c = corners[index, 0], corners[index, 1], corners[index, 2]
        za, zb, zc = depths[a], depths[b], depths[c]
        if not (za > 0 and zb > 0 and zc > 0):
            behind += 1
            continue
        area = edge(pixels, a, b, pixels[c, 0], pixels[c, 1])
        # Counter-clockwise in space is clockwise with rows downwards: a negative area faces the camera.
        if not abs(area) > 0 or not np.isfinite(area) or (cull and area > 0):
            continue
        swapped = area < 0
        if swapped:
            b, c, zb, zc = c, b, zc, zb
        left, right = bounds((pixels[a, 0], pixels[b, 0], pixels[c, 0]), columns)
        top, bottom = bounds((pixels[a, 1] - first_row, pixels[b, 1] - first_row, pixels[c, 1] - first_row), rows)
        on_a, on_b, on_c = owns(pixels, b, c), owns(pixels, c, a), owns(pixels, a, b)
        for row in range(top, bottom + 1):
            y = np.float64(row + first_row)
            for column in range(left, right + 1):
                x = np.float64(column)
                wa = edge(pixels, b, c, x, y)
                if not (wa > 0 or (wa == 0 and on_a)):
                    continue
                wb = edge(pixels, c, a, x, y)
                if not (wb > 0 or (wb == 0 and on_b)):
                    continue
                wc = edge(pixels, a, b, x, y)
                if not (wc > 0 or (wc == 0 and on_c)):
                    continue
                weight_sum = wa + wb + wc
                wa, wb, wc = wa / za, wb / zb, wc / zc
                total = wa + wb + wc
                near = np.float32(weight_sum / total)
                if near < depth[row, column]:
                    depth[row, column] = near
                    triangle[row, column] = index
                    barycentric[row, column, 0] = wa / total
                    barycentric[row, column, 1] = (wc if swapped else wb) / total
    return behind


def interpolate(attributes: np.ndarray, corners: np.ndarray, triangle: np.ndarray, barycentric: np.ndarray):
    """Attributes (v, k) of the vertices at surface points: triangle (...), barycentric (..., 2) -> (..., k) float32.

    corners (f, 3): the triangles' vertices. 0 where triangle is -1.
    """
    flat = np.ascontiguousarray(triangle, np.int32).reshape(-1)
    weights = np.ascontiguousarray(barycentric, np.float32).reshape(-1, 2)
    values = np.ascontiguousarray(attributes, np.float64)
    values_at = blend(values, np.ascontiguousarray(corners, np.int32), flat, weights)
    return values_at.reshape(*np.shape(triangle), values.shape[1])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def blend(values, corners, triangle, weights):
    """See `interpolate`: points (n,), weights (n, 2) -> (n, k) float32."""
    out = np.zeros((len(triangle), values.shape[1]), np.float32)
    for i in range(len(triangle)):
        if triangle[i] >= 0:
            a, b, c = corners[triangle[i], 0], corners[triangle[i], 1], corners[triangle[i], 2]
            u, v = np.float64(weights[i, 0]), np.float64(weights[i, 1])
            for k in range(values.shape[1]):
                out[i, k] = values[c, k] + u * (values[a, k] - values[c, k]) + v * (values[b, k] - values[c, k])
    return out
