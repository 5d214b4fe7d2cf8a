"""Rays against triangles: a tree of boxes, the nearest hit, and whether anything stands in the way."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from nishiki.threads import over_rows

_STACK, _LEAF = 256, 4


@dataclass(frozen=True)
class Tree:
    """boxes (n, 6) float64: lower then upper corner; links (n, 2) int32: first child or triangle, and number of
    triangles (0: two children, next to each other); triangles (f, 9) float64 in the tree's order: a corner and the two
    edges from it; order (f,) int32: their places in the mesh."""

    boxes: np.ndarray
    links: np.ndarray
    triangles: np.ndarray
    order: np.ndarray


@dataclass(frozen=True)
class Hits:
    """triangle (n,) int32: in the mesh, -1 where nothing is met; distance (n,) float64; weights (n, 2) float64 of the
    triangle's second and third corner."""

    triangle: np.ndarray
    distance: np.ndarray
    weights: np.ndarray


def make_tree(vertices: np.ndarray, triangles: np.ndarray) -> Tree:
    """Tree of boxes over a mesh; each is split where the surface area heuristic is least (MacDonald & Booth 1990)."""
    corners = np.asarray(vertices, np.float64)[triangles]
    bounds = np.concatenate([corners.min(axis=1), -corners.max(axis=1)], axis=1)  # both are minima so
    centres = corners.mean(axis=1)
    boxes, links, leaves = [None], [None], []
    waiting, placed = [(0, np.arange(len(triangles)))], 0
    while waiting:
        node, members = waiting.pop()
        boxes[node] = bounds[members].min(axis=0)
        parts = _split(bounds, centres, members) if len(members) > _LEAF else None
        if parts is None:
            links[node] = (placed, len(members))
            placed += len(members)
            leaves.append(members)
            continue
        links[node] = (len(boxes), 0)
        waiting += [(len(boxes) + 1, parts[1]), (len(boxes), parts[0])]
        boxes += [None, None]
        links += [None, None]
    order = np.concatenate(leaves).astype(np.int32)
    packed = np.concatenate([corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=1)
    boxes = np.array(boxes) * np.array([1, 1, 1, -1, -1, -1])
    return Tree(boxes, np.array(links, np.int32), np.ascontiguousarray(packed[order]), order)


def _split(bounds: np.ndarray, centres: np.ndarray, members: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The two shares of the triangles whose boxes have the least area times number, along the longest axis."""
    axis = np.ptp(centres[members], axis=0).argmax()
    members = members[np.argsort(centres[members, axis], kind="stable")]
    sorted_bounds = bounds[members]
    before = _half_areas(np.minimum.accumulate(sorted_bounds[:-1], axis=0))
    after = _half_areas(np.minimum.accumulate(sorted_bounds[:0:-1], axis=0)[::-1])
    count = np.arange(1, len(members))
    place = int(np.argmin(before * count + after * count[::-1])) + 1
    # A slice of one triangle after another would make the tree too deep for the stack of a ray.
    place = min(max(place, len(members) // 16 + 1), len(members) - len(members) // 16 - 1)
    return members[:place], members[place:]


def _half_areas(bounds: np.ndarray) -> np.ndarray:
    x, y, z = (-bounds[:, 3:] - bounds[:, :3]).T
    return x * y + y * z + z * x


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
def _nearest(boxes, links, triangles, stack, ox, oy, oz, dx, dy, dz, far, any_hit):
    """First hit of a ray nearer than `far`: distance, triangle in the tree's order (-1: none), weights of corners 1, 2.

    stack (_STACK,) int32 is scratch. any_hit : return the first hit found, whichever it is (for shadows).
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _cast(start, stop, boxes, links, triangles, order, origins, directions, far, any_hit, triangle, distance, weights):
    stack = np.empty(_STACK, np.int32)
    for ray in range(start, stop):
        o, d = origins[ray], directions[ray]
        t, found, u, v = _nearest(boxes, links, triangles, stack, o[0], o[1], o[2], d[0], d[1], d[2], far[ray], any_hit)
        triangle[ray] = order[found] if found >= 0 else -1
        distance[ray], weights[ray, 0], weights[ray, 1] = t, u, v


def cast(
    tree: Tree, origins: np.ndarray, directions: np.ndarray, *, far: np.ndarray | float = 1e9, any_hit: bool = False
) -> Hits:
    """First hits of rays (n, 3), (n, 3) nearer than `far`, in multiples of their directions.

    any_hit : stop at the first hit found, whichever it is (for shadows: only whether there is one means something).
    """
    count = len(directions)
    directions = np.ascontiguousarray(directions, np.float64)
    origins = np.array(np.broadcast_to(origins, directions.shape), np.float64, order="C")
    far = np.array(np.broadcast_to(far, count), np.float64)
    hits = Hits(np.empty(count, np.int32), np.empty(count), np.empty((count, 2)))
    if count:
        over_rows(
            _cast, count, tree.boxes, tree.links, tree.triangles, tree.order, origins, directions, far, any_hit,
            hits.triangle, hits.distance, hits.weights,
        )  # fmt: skip
    return hits
