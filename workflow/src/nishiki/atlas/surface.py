"""Compute the surface point behind every texel, and sample a view there."""

from dataclasses import dataclass

import numba
import numpy as np

from nishiki.atlas.atlas import Atlas
from nishiki.atlas.cells import cell_range, touches
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh, face_vectors
from nishiki.geometry.visibility import Raster

REACH = 1.5
"""Texels by which a surface is continued past its border, at most; the nearest point of the border counts beyond."""


def texel_triangles(atlas: Atlas) -> np.ndarray:
    """Find the nearest triangle of each texel, (tiles, T, T) int32, -1 where no surface point looks the texel up.

    A texel counts as inside where a surface point has it among the four that it is interpolated from, i.e. less than
    one row and one column away. Texels whose centre no triangle covers take the nearest one (the first of several).
    """
    shape = (atlas.tiles, atlas.size, atlas.size)
    triangle, distance = np.full(shape, -1, np.int32), np.full(shape, np.inf, np.float32)
    assign(atlas.chart, atlas.corners, atlas.chart_grid, atlas.cells, triangle, distance)
    return triangle


def texel_points(mesh: Mesh, atlas: Atlas, triangles: np.ndarray, tiles: slice) -> tuple[np.ndarray, ...]:
    """Compute positions (n, T, T, 3) float32, unit normals (n, T, T, 3) float32, inside (n, T, T) bool of some tiles.

    triangles are those of `texel_triangles`. Normals are interpolated from the vertices. Past a border the surface
    continues in the plane of its triangle, and the normal is that of the nearest point. 0 outside.
    """
    triangle = triangles[tiles]
    positions, normals = np.zeros((*triangle.shape, 3), np.float32), np.zeros((*triangle.shape, 3), np.float32)
    vertices, corners = np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.triangles, np.int32)
    places = atlas.tile_place[tiles]
    point_kernel(triangle, places, atlas.corners, corners, vertices, mesh.normals, positions, normals)
    return positions, normals, triangle >= 0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def nearest_weights(corners, row, column):
    """Compute weights of corners 0 and 1 of a triangle's (3, 2) point nearest to (row, column), and the distance²."""
    ar, ac = np.float64(corners[0, 0]), np.float64(corners[0, 1])
    br, bc = corners[1, 0] - ar, corners[1, 1] - ac
    cr, cc = corners[2, 0] - ar, corners[2, 1] - ac
    pr, pc = row - ar, column - ac
    det = br * cc - bc * cr
    if det != 0:
        v, w = (pr * cc - pc * cr) / det, (br * pc - bc * pr) / det
        if v >= 0 and w >= 0 and v + w <= 1:
            return 1 - v - w, v, 0.0
    best_u, best_v, best = 1.0, 0.0, np.inf
    for k in range(3):
        a, b = k, (k + 1) % 3
        er, ec = np.float64(corners[b, 0]) - corners[a, 0], np.float64(corners[b, 1]) - corners[a, 1]
        length = er * er + ec * ec
        along = 0.0
        if length > 0:
            along = min(max(((row - corners[a, 0]) * er + (column - corners[a, 1]) * ec) / length, 0.0), 1.0)
        dr, dc = row - corners[a, 0] - along * er, column - corners[a, 1] - along * ec
        square = dr * dr + dc * dc
        if square < best:
            best = square
            best_u = 1 - along if a == 0 else (along if b == 0 else 0.0)
            best_v = 1 - along if a == 1 else (along if b == 1 else 0.0)
    return best_u, best_v, best


@numba.njit(cache=True, nogil=True, error_model="numpy")
def assign(chart, corners, grid, cells, triangle, distance):
    """Fill the nearest triangle of every texel; see `texel_triangles`."""
    size = triangle.shape[1]
    stride = size - 1
    for i in range(len(chart)):
        if chart[i] < 0:
            continue
        first, rows, columns = grid[chart[i], 0], grid[chart[i], 1], grid[chart[i], 2]
        points = corners[i]
        top, bottom = cell_range(points[:, 0], stride, rows)
        left, right = cell_range(points[:, 1], stride, columns)
        low_row = int(np.floor(min(points[0, 0], min(points[1, 0], points[2, 0])))) - 1
        high_row = int(np.ceil(max(points[0, 0], max(points[1, 0], points[2, 0])))) + 1
        low_column = int(np.floor(min(points[0, 1], min(points[1, 1], points[2, 1])))) - 1
        high_column = int(np.ceil(max(points[0, 1], max(points[1, 1], points[2, 1])))) + 1
        for down in range(top, bottom + 1):
            for across in range(left, right + 1):
                tile = cells[first + down * columns + across]
                if tile < 0:
                    continue
                y, x = down * stride, across * stride
                for row in range(max(low_row, y), min(high_row, y + stride) + 1):
                    for column in range(max(low_column, x), min(high_column, x + stride) + 1):
                        if touches(points, np.float64(row), np.float64(column), 1.0, 1.0):
                            square = nearest_weights(points, np.float64(row), np.float64(column))[2]
                            if square < distance[tile, row - y, column - x]:
                                distance[tile, row - y, column - x] = square
                                triangle[tile, row - y, column - x] = i


@numba.njit(cache=True, nogil=True, error_model="numpy")
def point_kernel(triangle, places, flat, corners, vertices, vertex_normals, positions, normals):
    """Compute positions and normals of texels; see `texel_points`."""
    size = triangle.shape[1]
    for tile in range(len(triangle)):
        for i in range(size):
            for j in range(size):
                f = triangle[tile, i, j]
                if f < 0:
                    continue
                row, column = np.float64(places[tile, 0] * (size - 1) + i), np.float64(places[tile, 1] * (size - 1) + j)
                u, v, square = nearest_weights(flat[f], row, column)
                w = 1 - u - v
                a, b, c = corners[f, 0], corners[f, 1], corners[f, 2]
                length = 0.0
                for k in range(3):
                    positions[tile, i, j, k] = u * vertices[a, k] + v * vertices[b, k] + w * vertices[c, k]
                    value = u * vertex_normals[a, k] + v * vertex_normals[b, k] + w * vertex_normals[c, k]
                    normals[tile, i, j, k] = value
                    length += value * value
                if not length > 0:
                    for k in range(3):
                        normals[tile, i, j, k] = vertex_normals[a, k]
                        length += vertex_normals[a, k] ** 2
                for k in range(3):
                    normals[tile, i, j, k] /= np.sqrt(length)
                if square > 0:
                    continue_past_border(
                        flat[f], (vertices[a], vertices[b], vertices[c]), row, column, u, v, positions[tile, i, j]
                    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def continue_past_border(flat, corners, row, column, u, v, position):
    """Add the offset from the nearest point of a triangle to the texel, in the plane of the triangle.

    No further in space than REACH times the distance in the chart times the triangle's larger stretch: slivers would
    otherwise throw the point far away.
    """
    (a, b, c), w = corners, 1 - u - v
    dr = row - (u * flat[0, 0] + v * flat[1, 0] + w * flat[2, 0])
    dc = column - (u * flat[0, 1] + v * flat[1, 1] + w * flat[2, 1])
    br, bc = np.float64(flat[1, 0]) - flat[0, 0], np.float64(flat[1, 1]) - flat[0, 1]
    cr, cc = np.float64(flat[2, 0]) - flat[0, 0], np.float64(flat[2, 1]) - flat[0, 1]
    det = br * cc - bc * cr
    flat_area, area = abs(det), 0.0
    x, y, z = b - a, c - a, np.zeros(3)
    for k in range(3):
        z[k] = x[(k + 1) % 3] * y[(k + 2) % 3] - x[(k + 2) % 3] * y[(k + 1) % 3]
        area += z[k] * z[k]
    if not flat_area > 0:
        return
    limit = REACH * np.sqrt(np.sqrt(area) / flat_area) * np.sqrt(dr * dr + dc * dc)
    p, q = (dr * cc - dc * cr) / det, (br * dc - bc * dr) / det
    length = 0.0
    for k in range(3):
        length += (p * x[k] + q * y[k]) ** 2
    length = np.sqrt(length)
    part = 1.0 if length <= limit else limit / length
    for k in range(3):
        position[k] += part * (p * x[k] + q * y[k])


@dataclass(frozen=True)
class PixelPlaces:
    """Places of the pixels of one view in the atlas, sorted by tile, then row, then column."""

    row: np.ndarray  # (n,) int32
    column: np.ndarray  # (n,) int32
    s: np.ndarray  # (n,) float32
    t: np.ndarray  # (n,) float32
    offsets: np.ndarray  # (tiles + 1,) int64: tile k has the pixels offsets[k] up to offsets[k + 1]


def object_pixels(mesh: Mesh, camera: Camera, raster: Raster, silhouette: np.ndarray | None) -> np.ndarray:
    """Find pixels (rows, columns) bool that show the surface's outer side, inside the silhouette where it is known."""
    towards = camera.centre - mesh.vertices[mesh.triangles[:, 0]]
    facing = (face_vectors(mesh.vertices, mesh.triangles) * towards).sum(axis=1) > 0
    # Triangle -1 reads the last entry.
    shown = np.append(facing, False)[raster.triangle]
    return shown if silhouette is None else shown & silhouette


def pixel_places(atlas: Atlas, raster: Raster, shown: np.ndarray) -> PixelPlaces:
    """Find the places of the pixels `shown` (rows, columns) in the atlas."""
    row, column = np.nonzero(shown)
    tile, s, t = atlas.locate(raster.triangle[row, column], raster.barycentric[row, column])
    order = np.argsort(tile, kind="stable")
    offsets = np.searchsorted(tile[order], np.arange(atlas.tiles + 1))
    order, row, column = order[offsets[0] :], row.astype(np.int32), column.astype(np.int32)
    return PixelPlaces(row[order], column[order], s[order], t[order], offsets - offsets[0])


@dataclass(frozen=True)
class TexelValues:
    """values (..., channels) float32, 0 where not visible; visible (...) bool."""

    values: np.ndarray
    visible: np.ndarray


def sample_view(
    positions: np.ndarray,
    normals: np.ndarray,
    inside: np.ndarray,
    *,
    camera: Camera,
    depth: np.ndarray,
    pictures: list[np.ndarray],
    tolerance: float = 1.0,
    grazing_deg: float = 80.0,
) -> list[TexelValues]:
    """Sample texels in one view, for each of its pictures (rows, columns, channels) float32.

    positions, normals (..., 3), inside (...): texels; depth (rows, columns): of the view's `Raster`, infinite in pixels
    that do not show the object or hold no usable value. A texel is visible where it is inside, faces the camera at less
    than `grazing_deg` from its normal, and the surface that each of the four pixels around its image shows lies no
    further in front of or behind the texel than the texel's own tangent plane comes or goes within `tolerance` pixels,
    plus `tolerance` pixels of the surface's size (against ties of a surface with itself).
    """
    points, towards = positions.reshape(-1, 3), normals.reshape(-1, 3)
    ray = camera.centre - points
    facing = np.einsum("ij,ij->i", towards, ray)
    lengths = np.sqrt(np.einsum("ij,ij->i", ray, ray))
    index = np.flatnonzero(inside.reshape(-1) & (facing > np.cos(np.radians(grazing_deg)) * lengths))
    pixels, depths = camera.project(points[index])
    inverse, n = np.linalg.inv(camera.intrinsics), towards[index] @ camera.rotation[:2].T
    # Depth of the tangent plane at a pixel is -towards / (n . ray of the pixel): its relative change for one pixel.
    across = np.abs(n[:, 0] * inverse[0, 0]) + np.abs(n[:, 0] * inverse[0, 1] + n[:, 1] * inverse[1, 1])
    footprint = np.sqrt(abs(inverse[0, 0] * inverse[1, 1]))
    slack = tolerance * depths * (footprint + across * depths / facing[index])
    shown = (depths > 0) & ((pixels >= 0) & (pixels <= np.array(depth.shape[::-1]) - 1)).all(axis=1)
    index, pixels, depths, slack = (a[shown] for a in (index, pixels, depths, slack))
    near = _around(pixels)
    agree = [np.abs(depth[place] - depths) <= slack for place, _ in near]
    seen = np.all(agree, axis=0)
    index = index[seen]
    visible = np.zeros(inside.size, np.bool_)
    visible[index] = True
    sampled = []
    for picture in pictures:
        values = np.zeros((inside.size, picture.shape[2]), np.float32)
        values[index] = sum(weight[seen, None] * picture[row[seen], column[seen]] for (row, column), weight in near)
        sampled.append(TexelValues(values.reshape(*inside.shape, -1), visible.reshape(inside.shape)))
    return sampled


def _around(pixels: np.ndarray) -> list[tuple[tuple[np.ndarray, np.ndarray], np.ndarray]]:
    """Find rows and columns of the four pixels about places (n, 2) (column, row) in a picture, and their weights.

    A pixel without weight may not exist: the place's own stands for it.
    """
    first = np.floor(pixels).astype(np.intp)
    share = pixels - first
    (left, top), (u, v) = first.T, share.T
    right, below = np.where(u > 0, left + 1, left), np.where(v > 0, top + 1, top)
    return [
        ((top, left), (1 - u) * (1 - v)),
        ((top, right), u * (1 - v)),
        ((below, left), (1 - u) * v),
        ((below, right), u * v),
    ]
