"""Which texels a view shows, what it shows there, and where the view's own pixels lie in the atlas."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from nishiki.atlas.atlas import Atlas
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh, face_vectors
from nishiki.geometry.raster import Raster


@dataclass(frozen=True)
class PixelPlaces:
    """Where the pixels of one view lie in the atlas, sorted by tile, then row, then column.

    row, column (n,) int32; s, t (n,) float32; offsets (tiles + 1,) int64: tile k has the pixels offsets[k] up to
    offsets[k + 1].
    """

    row: np.ndarray
    column: np.ndarray
    s: np.ndarray
    t: np.ndarray
    offsets: np.ndarray


def object_pixels(mesh: Mesh, camera: Camera, raster: Raster, silhouette: np.ndarray | None) -> np.ndarray:
    """(rows, columns) bool: pixels that show the outer side of the surface, inside the silhouette where it is known."""
    towards = camera.centre - mesh.vertices[mesh.triangles[:, 0]]
    facing = (face_vectors(mesh.vertices, mesh.triangles) * towards).sum(axis=1) > 0
    # Triangle -1 reads the last entry.
    shown = np.append(facing, False)[raster.triangle]
    return shown if silhouette is None else shown & silhouette


def pixel_places(atlas: Atlas, raster: Raster, shown: np.ndarray) -> PixelPlaces:
    """Places of the pixels `shown` (rows, columns) in the atlas."""
    row, column = np.nonzero(shown)
    tile, s, t = atlas.locate(raster.triangle[row, column], raster.barycentric[row, column])
    order, offsets = by_tile(tile, atlas.tiles)
    places = (values[order] for values in (row.astype(np.int32), column.astype(np.int32), s, t))
    return PixelPlaces(*places, offsets)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def by_tile(tile, tiles):
    """Stable order (n,) of the points by tile, and where each tile starts; points of tile -1 are left out."""
    offsets = np.zeros(tiles + 1, np.int64)
    for k in tile:
        if k >= 0:
            offsets[k + 1] += 1
    for k in range(tiles):
        offsets[k + 1] += offsets[k]
    order, place = np.empty(offsets[tiles], np.int64), offsets.copy()
    for i in range(len(tile)):
        if tile[i] >= 0:
            order[place[tile[i]]] = i
            place[tile[i]] += 1
    return order, offsets


@dataclass(frozen=True)
class Sampled:
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
    usable: np.ndarray,
    pictures: list[np.ndarray],
    tolerance: float = 1.0,
    grazing_deg: float = 80.0,
) -> list[Sampled]:
    """Sample texels in one view, for each of its pictures (rows, columns, channels) float32.

    positions, normals (..., 3), inside (...): texels; depth (rows, columns): of the view's `Raster`; usable (rows,
    columns) bool: pixels that show the object and hold a valid value. A texel is visible where it is inside, faces the
    camera at less than `grazing_deg` from its normal, all four pixels around its image are usable, and the surface that
    each of them shows lies no further in front of or behind the texel than the texel's own tangent plane comes or goes
    within `tolerance` pixels, plus `tolerance` pixels of the surface's size (against ties of a surface with itself).
    """
    least = np.cos(np.radians(grazing_deg))
    towards = normals.reshape(-1, 3)
    index = turned_to(positions.reshape(-1, 3), towards, inside.reshape(-1), camera.centre, least)
    points, towards = positions.reshape(-1, 3)[index], towards[index]
    pixels, depths = camera.project(points)
    rotation, inverse = np.ascontiguousarray(camera.rotation), np.linalg.inv(camera.intrinsics)
    seen = np.empty(len(points), np.bool_)
    see(points, camera.centre, towards, pixels, depths, rotation, inverse, depth, usable, tolerance, seen)
    visible = np.zeros(inside.size, np.bool_)
    visible[index] = seen
    sampled = []
    for picture in pictures:
        values = np.zeros((inside.size, picture.shape[2]), np.float32)
        bilinear(pixels, seen, index, np.ascontiguousarray(picture, np.float32), values)
        sampled.append(Sampled(values.reshape(*inside.shape, -1), visible.reshape(inside.shape)))
    return sampled


@numba.njit(cache=True, nogil=True, error_model="numpy")
def turned_to(points, normals, inside, centre, least):
    """Numbers of the texels that are inside and face the camera's centre, the cosine above `least`."""
    texels = np.empty(len(points), np.int64)
    count = 0
    for i in range(len(points)):
        if not inside[i]:
            continue
        towards, length = 0.0, 0.0
        for k in range(3):
            ray = centre[k] - points[i, k]
            towards += normals[i, k] * ray
            length += ray * ray
        if towards > least * np.sqrt(length):
            texels[count] = i
            count += 1
    return texels[:count].copy()


@numba.njit(cache=True, nogil=True, error_model="numpy")
def see(points, centre, normals, pixels, depths, rotation, inverse, depth, usable, tolerance, seen):
    """See `sample_view`: fills seen (n,) for texels at points (n, 3)."""
    rows, columns = depth.shape
    footprint = np.sqrt(abs(inverse[0, 0] * inverse[1, 1]))
    for i in range(len(points)):
        seen[i] = False
        x, y, z = pixels[i, 0], pixels[i, 1], depths[i]
        if not z > 0 or not (0 <= x <= columns - 1 and 0 <= y <= rows - 1):
            continue
        towards = 0.0
        for k in range(3):
            towards += normals[i, k] * (centre[k] - points[i, k])
        n0, n1 = 0.0, 0.0
        for k in range(3):
            n0 += rotation[0, k] * normals[i, k]
            n1 += rotation[1, k] * normals[i, k]
        # Depth of the tangent plane at a pixel is -towards / (n . ray of the pixel): its relative change for one pixel.
        across = abs(n0 * inverse[0, 0]) + abs(n0 * inverse[0, 1] + n1 * inverse[1, 1])
        slack = tolerance * z * (footprint + across * z / towards)
        column, row = min(int(x), max(columns - 2, 0)), min(int(y), max(rows - 2, 0))
        good = True
        for down in range(2):
            for right in range(2):
                # A neighbour without weight is not asked: it may not exist.
                if (right == 1 and x == column) or (down == 1 and y == row):
                    continue
                r, c = row + down, column + right
                if not usable[r, c] or not abs(depth[r, c] - z) <= slack:
                    good = False
        seen[i] = good


@numba.njit(cache=True, nogil=True, error_model="numpy")
def bilinear(pixels, seen, index, picture, values):
    """Picture (rows, columns, channels) at the pixels (n, 2) (column, row) that are seen, into values[index[i]]."""
    rows, columns, channels = picture.shape
    for i in range(len(pixels)):
        if not seen[i]:
            continue
        column, row = min(int(pixels[i, 0]), columns - 1), min(int(pixels[i, 1]), rows - 1)
        u, v = pixels[i, 0] - column, pixels[i, 1] - row
        # A neighbour without weight is not read: it may be missing.
        right = column + 1 if u > 0 and column + 1 < columns else column
        below = row + 1 if v > 0 and row + 1 < rows else row
        for k in range(channels):
            top = (1 - u) * picture[row, column, k] + u * picture[row, right, k]
            bottom = (1 - u) * picture[below, column, k] + u * picture[below, right, k]
            values[index[i], k] = (1 - v) * top + v * bottom
