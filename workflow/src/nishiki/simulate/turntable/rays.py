"""Rays against triangles: a tree of boxes, the nearest hit, and whether anything stands in the way."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

STACK = 64
_LEAF, _BINS = 4, 12


@dataclass(frozen=True)
class Tree:
    """boxes (n, 6) float64: lower then upper corner; links (n, 2) int32: first child or triangle, and number of
    triangles (0: two children, next to each other); triangles (f, 9) float64 in the tree's order: a corner and the two
    edges from it; order (f,) int32: their places in the mesh."""

    boxes: np.ndarray
    links: np.ndarray
    triangles: np.ndarray
    order: np.ndarray


def make_tree(vertices: np.ndarray, triangles: np.ndarray) -> Tree:
    """Tree of boxes over a mesh, split where the surface area heuristic is least over 12 bins (Wald 2007)."""
    corners = np.asarray(vertices, np.float64)[triangles]
    low, high = corners.min(axis=1), corners.max(axis=1)
    boxes, links = np.empty((2 * len(triangles), 6)), np.zeros((2 * len(triangles), 2), np.int32)
    order = np.arange(len(triangles), dtype=np.int32)
    used = _build(low, high, 0.5 * (low + high), order, boxes, links)
    packed = np.concatenate([corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=1)
    return Tree(boxes[:used].copy(), links[:used].copy(), np.ascontiguousarray(packed[order]), order)


@numba.njit(cache=True)
def _bound(order, first, count, low, high, box):
    for axis in range(3):
        box[axis], box[axis + 3] = 1e300, -1e300
    for k in range(first, first + count):
        for axis in range(3):
            box[axis] = min(box[axis], low[order[k], axis])
            box[axis + 3] = max(box[axis + 3], high[order[k], axis])


@numba.njit(cache=True)
def _half_area(box):
    x, y, z = box[3] - box[0], box[4] - box[1], box[5] - box[2]
    return x * y + y * z + z * x


@numba.njit(cache=True)
def _best_split(order, first, count, low, high, centre, bins, sums):
    """Axis and position of the cheapest of the bin borders; axis -1 where all centres coincide."""
    best_axis, best_place, best_cost = -1, 0.0, 1e300
    for axis in range(3):
        least, most = 1e300, -1e300
        for k in range(first, first + count):
            least, most = min(least, centre[order[k], axis]), max(most, centre[order[k], axis])
        if most - least < 1e-12:
            continue
        sums[:] = 0
        bins[:, :3], bins[:, 3:] = 1e300, -1e300
        scale = _BINS * (1.0 - 1e-9) / (most - least)
        for k in range(first, first + count):
            b = int((centre[order[k], axis] - least) * scale)
            sums[b] += 1
            for j in range(3):
                bins[b, j] = min(bins[b, j], low[order[k], j])
                bins[b, j + 3] = max(bins[b, j + 3], high[order[k], j])
        for border in range(1, _BINS):
            cost = 0.0
            for side in range(2):
                box, n = np.array([1e300, 1e300, 1e300, -1e300, -1e300, -1e300]), 0
                for b in range(0 if side == 0 else border, border if side == 0 else _BINS):
                    n += sums[b]
                    for j in range(3):
                        box[j], box[j + 3] = min(box[j], bins[b, j]), max(box[j + 3], bins[b, j + 3])
                cost = cost + n * _half_area(box) if n else 1e300
            if cost < best_cost:
                best_axis, best_place, best_cost = axis, least + border / scale, cost
    return best_axis, best_place


@numba.njit(cache=True)
def _build(low, high, centre, order, boxes, links):
    bins, sums = np.empty((_BINS, 6)), np.empty(_BINS, np.int64)
    stack = np.empty((256, 3), np.int64)
    stack[0] = np.array([0, 0, order.size])
    depth, used = 1, 1
    while depth:
        depth -= 1
        node, first, count = stack[depth]
        _bound(order, first, count, low, high, boxes[node])
        middle = first
        if count > _LEAF:
            axis, place = _best_split(order, first, count, low, high, centre, bins, sums)
            if axis >= 0:
                for k in range(first, first + count):
                    if centre[order[k], axis] < place:
                        order[k], order[middle] = order[middle], order[k]
                        middle += 1
            if middle == first or middle == first + count:
                middle = first + count // 2
        if middle == first:
            links[node, 0], links[node, 1] = first, count
            continue
        links[node, 0], links[node, 1] = used, 0
        stack[depth, 0], stack[depth, 1], stack[depth, 2] = used, first, middle - first
        stack[depth + 1, 0], stack[depth + 1, 1], stack[depth + 1, 2] = used + 1, middle, first + count - middle
        depth += 2
        used += 2
    return used


@numba.njit(cache=True)
def _enters(boxes, node, ox, oy, oz, ix, iy, iz, far):
    """Where a ray enters a box, or 1e300 where it misses it before `far`."""
    a, b = (boxes[node, 0] - ox) * ix, (boxes[node, 3] - ox) * ix
    near, last = min(a, b), max(a, b)
    a, b = (boxes[node, 1] - oy) * iy, (boxes[node, 4] - oy) * iy
    near, last = max(near, min(a, b)), min(last, max(a, b))
    a, b = (boxes[node, 2] - oz) * iz, (boxes[node, 5] - oz) * iz
    near, last = max(near, min(a, b)), min(last, max(a, b))
    return near if near <= last * (1.0 + 1e-12) and last >= 0.0 and near < far else 1e300


@numba.njit(cache=True)
def _cross(t, ox, oy, oz, dx, dy, dz):
    """Distance and the two barycentric weights of a ray with a triangle (Moeller & Trumbore 1997); -1 = no hit."""
    px, py, pz = dy * t[8] - dz * t[7], dz * t[6] - dx * t[8], dx * t[7] - dy * t[6]
    volume = t[3] * px + t[4] * py + t[5] * pz
    if volume == 0.0:
        return -1.0, 0.0, 0.0
    share = 1.0 / volume
    sx, sy, sz = ox - t[0], oy - t[1], oz - t[2]
    u = (sx * px + sy * py + sz * pz) * share
    if u < -1e-9 or u > 1.0 + 1e-9:
        return -1.0, 0.0, 0.0
    qx, qy, qz = sy * t[5] - sz * t[4], sz * t[3] - sx * t[5], sx * t[4] - sy * t[3]
    v = (dx * qx + dy * qy + dz * qz) * share
    if v < -1e-9 or u + v > 1.0 + 1e-9:
        return -1.0, 0.0, 0.0
    return (t[6] * qx + t[7] * qy + t[8] * qz) * share, u, v


@numba.njit(cache=True)
def _inverse(d):
    return 1.0 / d if abs(d) > 1e-300 else 1e300


@numba.njit(cache=True)
def nearest(boxes, links, triangles, stack, ox, oy, oz, dx, dy, dz, far, any_hit):
    """First hit of a ray nearer than `far`: distance, triangle in the tree's order (-1: none), weights of corners 1, 2.

    stack (STACK,) int32 is scratch. any_hit : return the first hit found, whichever it is (for shadows).
    """
    ix, iy, iz = _inverse(dx), _inverse(dy), _inverse(dz)
    best, found, best_u, best_v = far, -1, 0.0, 0.0
    depth, node = 0, 0
    if _enters(boxes, 0, ox, oy, oz, ix, iy, iz, best) >= 1e300:
        return best, found, best_u, best_v
    while True:
        first, count = links[node, 0], links[node, 1]
        following = -1
        if count:
            for k in range(first, first + count):
                t, u, v = _cross(triangles[k], ox, oy, oz, dx, dy, dz)
                if 0.0 < t < best:
                    best, found, best_u, best_v = t, k, u, v
                    if any_hit:
                        return best, found, best_u, best_v
        else:
            a = _enters(boxes, first, ox, oy, oz, ix, iy, iz, best)
            b = _enters(boxes, first + 1, ox, oy, oz, ix, iy, iz, best)
            if a < 1e300 and b < 1e300:
                following, other = (first, first + 1) if a <= b else (first + 1, first)
                stack[depth] = other
                depth += 1
            elif a < 1e300:
                following = first
            elif b < 1e300:
                following = first + 1
        if following < 0:
            if depth == 0:
                return best, found, best_u, best_v
            depth -= 1
            following = stack[depth]
        node = following
