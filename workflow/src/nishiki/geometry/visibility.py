"""Find the surface that a view or a ray meets: a z-buffer of triangles, and a tree of boxes for rays.

The vertices go through the whole camera, lens distortion included; between them edges are straight in the picture,
which for triangles of a few pixels is the same thing. Edge functions as in J. Pineda, A parallel algorithm for polygon
rasterization, SIGGRAPH 1988.

In the tree of boxes each node's triangles are halved at the median of their centres, so that the tree is a complete
binary one and needs no links: node k has the children 2 k + 1 and 2 k + 2.
"""

from dataclasses import dataclass

import numba
import numpy as np
from numba import njit

from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh
from nishiki.threads import over_rows


@dataclass(frozen=True)
class Raster:
    """Surface points behind the pixel centres of a view, or of a band of its rows."""

    triangle: np.ndarray  # (rows, columns) int32, -1 where there is none
    # (rows, columns, 2) float32: weights of corners 0 and 1 of the triangle, perspective-correct, 0 where there is
    # none
    barycentric: np.ndarray
    depth: np.ndarray  # (rows, columns) float32 along the optical axis in the world's unit, +inf where there is none
    first_row: int  # row of the picture that row 0 of the arrays is


def rasterise(
    mesh: Mesh, camera: Camera, *, rows: tuple[int, int] | None = None, behind: np.ndarray | None = None
) -> Raster:
    """Find the triangle nearest to the camera behind each pixel centre.

    A pixel centre on an edge belongs to exactly one of the two triangles that share it (top-left rule, evaluated so
    that both see the same number). Triangles without area, with corners that are not finite, or with a corner at or
    behind the camera's plane show nowhere. rows: (first, stop), only these rows of the picture. behind: depth
    (rows, columns) float32 beyond which the surface is sought (default: the camera's plane).
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
    behind = np.zeros(shape, np.float32) if behind is None else behind
    fill(np.ascontiguousarray(pixels), depths, corners, first, behind, triangle, barycentric, depth)
    return Raster(triangle, barycentric, depth, first)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def edge(pixels, a, b, x, y):
    """Compute twice the signed area of (a, b, (x, y)); exactly opposite for (b, a), as the lower vertex comes first."""
    if a < b:
        return (pixels[b, 0] - pixels[a, 0]) * (y - pixels[a, 1]) - (pixels[b, 1] - pixels[a, 1]) * (x - pixels[a, 0])
    return -((pixels[a, 0] - pixels[b, 0]) * (y - pixels[b, 1]) - (pixels[a, 1] - pixels[b, 1]) * (x - pixels[b, 0]))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def owns(pixels, a, b):
    """Check whether the triangle left of a -> b owns the points on this edge: true for just one of a -> b, b -> a."""
    rise = pixels[b, 1] - pixels[a, 1]
    return rise > 0 or (rise == 0 and pixels[b, 0] < pixels[a, 0])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def bounds(values, size):
    """Find the first and last integer within the range of three values, clipped to [0, size)."""
    low = min(values[0], min(values[1], values[2]))
    high = max(values[0], max(values[1], values[2]))
    # Clipped before the conversion: a corner near the camera's plane can lie beyond the range of integers.
    return int(np.ceil(min(max(low, 0.0), np.float64(size)))), int(np.floor(max(min(high, size - 1.0), -1.0)))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill(pixels, depths, corners, first_row, behind, triangle, barycentric, depth):
    """Draw all triangles into the three arrays by z-buffer, beyond the depths `behind`."""
    rows, columns = triangle.shape
    for index in range(len(corners)):
        a, b, c = corners[index, 0], corners[index, 1], corners[index, 2]
        za, zb, zc = depths[a], depths[b], depths[c]
        area = edge(pixels, a, b, pixels[c, 0], pixels[c, 1])
        if not (za > 0 and zb > 0 and zc > 0 and abs(area) > 0 and np.isfinite(area)):
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
                if behind[row, column] < near < depth[row, column]:
                    depth[row, column] = near
                    triangle[row, column] = index
                    barycentric[row, column, 0] = wa / total
                    barycentric[row, column, 1] = (wc if swapped else wb) / total


def interpolate(attributes: np.ndarray, corners: np.ndarray, triangle: np.ndarray, barycentric: np.ndarray):
    """Interpolate vertex attributes (v, k) at surface points: triangle (...), barycentric (..., 2) -> (..., k) float32.

    corners (f, 3): the triangles' vertices. 0 where triangle is -1.
    """
    flat, weights, values = np.ravel(triangle), np.reshape(barycentric, (-1, 2)), np.asarray(attributes, np.float64)
    out = np.zeros((len(flat), values.shape[1]), np.float32)
    _mix_corners(np.ascontiguousarray(values), np.ascontiguousarray(corners, np.int32), flat, weights, out)
    return out.reshape(*np.shape(triangle), values.shape[1])


@njit(cache=True, nogil=True, error_model="numpy")
def _mix_corners(values, corners, triangle, weights, out):
    for n in range(len(triangle)):
        if triangle[n] >= 0:
            a, b, c = corners[triangle[n], 0], corners[triangle[n], 1], corners[triangle[n], 2]
            for k in range(values.shape[1]):
                last = values[c, k]
                out[n, k] = last + weights[n, 0] * (values[a, k] - last) + weights[n, 1] * (values[b, k] - last)


GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
"""Radians between points of a spiral that covers a disc evenly, where each has the same share of its area."""


def disc_points(count: int) -> np.ndarray:
    """Return (count, 2) points spread evenly over the unit disc; its middle alone where count is 1."""
    if count == 1:
        return np.zeros((1, 2))
    reach, angle = np.sqrt((np.arange(count) + 0.5) / count), GOLDEN_ANGLE * np.arange(count)
    return np.stack([reach * np.cos(angle), reach * np.sin(angle)], axis=1)


def frames_about(normals: np.ndarray) -> np.ndarray:
    """Make two unit vectors (n, 2, 3) normal to unit normals (n, 3) and each other (Duff et al., JCGT 6(1), 2017)."""
    nx, ny, nz = normals.T
    sign = np.copysign(1.0, nz)
    a = -1.0 / (sign + nz)
    b = nx * ny * a
    return np.stack([1.0 + sign * nx * nx * a, sign * b, -sign * nx, b, sign + ny * ny * a, -ny], 1).reshape(-1, 2, 3)


LEAF = 4
"""Triangles in a leaf."""
SLACK = 1e-9  # of the corners' weights


@dataclass(frozen=True)
class RayTree:
    """A tree over a mesh for rays."""

    boxes: np.ndarray  # (2 L - 1, 6) float32: lower and upper corner, L leaves
    triangles: np.ndarray  # (4 L, 9) float64: a corner and two edges, in the order of the leaves, some twice
    order: np.ndarray  # (4 L,) int32: their numbers in the mesh


@dataclass(frozen=True)
class Hits:
    """Hits of rays."""

    triangle: np.ndarray  # (n,) int32: in the mesh, -1 where nothing is met
    distance: np.ndarray  # (n,) float64, in multiples of the ray's direction
    weights: np.ndarray  # (n, 2) float64 of the triangle's second and third corner


def make_tree(vertices: np.ndarray, triangles: np.ndarray) -> RayTree:
    """Build the tree over a mesh: vertices (v, 3), triangles (f, 3), f > 0, all finite."""
    corners = np.asarray(vertices, np.float64)[triangles]
    leaves = 1 << max(0, int(np.ceil(np.log2(max(1, len(corners)) / LEAF))))
    # Spread evenly over the leaves; some stand twice, which changes nothing.
    order = np.arange(LEAF * leaves) * len(corners) // (LEAF * leaves)
    centres, parts = corners.mean(axis=1), 1
    while parts < leaves:  # each node's triangles are halved at the median along the longest side of their centres
        mine = order.reshape(parts, -1)
        places = centres[mine]
        widest = np.ptp(places, axis=1).argmax(axis=1)
        keys = np.take_along_axis(places, widest[:, None, None], axis=2)[:, :, 0]
        order, parts = np.take_along_axis(mine, keys.argsort(axis=1, kind="stable"), axis=1).ravel(), 2 * parts
    corners = corners[order]
    low, high = corners.min(axis=1), corners.max(axis=1)
    level = np.concatenate(
        [low.reshape(leaves, LEAF, 3).min(axis=1), high.reshape(leaves, LEAF, 3).max(axis=1)], axis=1
    )
    levels = [level]
    while len(level) > 1:
        level = np.concatenate(
            [np.minimum(level[::2, :3], level[1::2, :3]), np.maximum(level[::2, 3:], level[1::2, 3:])], axis=1
        )
        levels.append(level)
    boxes = np.concatenate(levels[::-1])
    # Rounded outwards, so that single precision cuts nothing off.
    boxes = np.concatenate(
        [np.nextafter(boxes[:, :3].astype(np.float32), -np.inf), np.nextafter(boxes[:, 3:].astype(np.float32), np.inf)],
        axis=1,
    )
    packed = np.concatenate([corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=1)
    return RayTree(np.ascontiguousarray(boxes, np.float32), np.ascontiguousarray(packed), order.astype(np.int32))


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def meet(tree, origin, direction, far, any_hit):
    """Intersect a ray within (0, far): place among the leaves' triangles or -1, distance, weights of two corners.

    The distance is in multiples of the ray's direction; the weights are those of the second and third corner.

    tree: boxes, triangles and a stack (64,) int32, which is scratch. any_hit: return the first hit found, whichever it
    is. Triangles: T. Moeller, B. Trumbore, Fast, minimum storage ray/triangle intersection, Journal of Graphics Tools
    1997; a slack of 1e-9 keeps rays from slipping through between neighbours.
    """
    (boxes, triangles, stack), (ox, oy, oz), (dx, dy, dz) = tree, origin, direction
    hit, best_u, best_v = -1, 0.0, 0.0
    ix = 1.0 / dx if abs(dx) > 1e-30 else 1e30
    iy = 1.0 / dy if abs(dy) > 1e-30 else 1e30
    iz = 1.0 / dz if abs(dz) > 1e-30 else 1e30
    inner = (len(boxes) - 1) // 2
    stack[0], depth = 0, 1
    while depth > 0:
        depth -= 1
        node = stack[depth]
        if node < inner:
            first, second = 1e300, 1e300
            for child in (2 * node + 1, 2 * node + 2):
                a, b = (boxes[child, 0] - ox) * ix, (boxes[child, 3] - ox) * ix
                near, last = min(a, b), max(a, b)
                a, b = (boxes[child, 1] - oy) * iy, (boxes[child, 4] - oy) * iy
                near, last = max(near, min(a, b)), min(last, max(a, b))
                a, b = (boxes[child, 2] - oz) * iz, (boxes[child, 5] - oz) * iz
                near, last = max(near, min(a, b)), min(last, max(a, b))
                if near <= last and last >= 0.0 and near < far:
                    if child == 2 * node + 1:
                        first = near
                    else:
                        second = near
            # The nearer child is looked at first: it is on top of the stack.
            if first <= second:
                if second < 1e300:
                    stack[depth] = 2 * node + 2
                    depth += 1
                if first < 1e300:
                    stack[depth] = 2 * node + 1
                    depth += 1
            else:
                if first < 1e300:
                    stack[depth] = 2 * node + 1
                    depth += 1
                stack[depth] = 2 * node + 2
                depth += 1
            continue
        for k in range(LEAF * (node - inner), LEAF * (node - inner) + LEAF):
            ax, ay, az = triangles[k, 3], triangles[k, 4], triangles[k, 5]
            bx, by, bz = triangles[k, 6], triangles[k, 7], triangles[k, 8]
            px, py, pz = dy * bz - dz * by, dz * bx - dx * bz, dx * by - dy * bx
            volume = ax * px + ay * py + az * pz
            if volume == 0.0:
                continue
            share = 1.0 / volume
            sx, sy, sz = ox - triangles[k, 0], oy - triangles[k, 1], oz - triangles[k, 2]
            u = (sx * px + sy * py + sz * pz) * share
            if u < -SLACK or u > 1.0 + SLACK:
                continue
            qx, qy, qz = sy * az - sz * ay, sz * ax - sx * az, sx * ay - sy * ax
            v = (dx * qx + dy * qy + dz * qz) * share
            if v < -SLACK or u + v > 1.0 + SLACK:
                continue
            distance = (bx * qx + by * qy + bz * qz) * share
            if 0.0 < distance < far:
                far, hit, best_u, best_v = distance, k, u, v
                if any_hit:
                    return hit, far, best_u, best_v
    return hit, far, best_u, best_v


@njit(cache=True, nogil=True, error_model="numpy")
def _cast(start, stop, tree, order, rays, any_hit, hits):
    (boxes, triangles), (origins, directions, far), (triangle, distance, weights) = tree, rays, hits
    stack = np.empty(64, np.int32)
    for ray in range(start, stop):  # numbers in place of rows, whose references would be counted
        origin = origins[ray, 0], origins[ray, 1], origins[ray, 2]
        direction = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        place, t, u, v = meet((boxes, triangles, stack), origin, direction, far[ray], any_hit)
        triangle[ray] = order[place] if place >= 0 else -1
        distance[ray], weights[ray, 0], weights[ray, 1] = t, u, v


def cast(
    tree: RayTree, origins: np.ndarray, directions: np.ndarray, *, far: np.ndarray | float = 1e9, any_hit: bool = False
) -> Hits:
    """Find the first hits of rays (n, 3), (n, 3) nearer than `far`, in multiples of their directions.

    any_hit: stop at the first hit found, whichever it is (for shadows: only whether there is one means something).
    """
    count = len(directions)
    directions = np.ascontiguousarray(directions, np.float64)
    origins = np.array(np.broadcast_to(origins, directions.shape), np.float64, order="C")
    far = np.array(np.broadcast_to(far, count), np.float64)
    hits = Hits(np.empty(count, np.int32), np.empty(count), np.empty((count, 2)))
    if count:
        over_rows(
            _cast, count, (tree.boxes, tree.triangles), tree.order, (origins, directions, far), any_hit,
            (hits.triangle, hits.distance, hits.weights),
        )  # fmt: skip
    return hits
