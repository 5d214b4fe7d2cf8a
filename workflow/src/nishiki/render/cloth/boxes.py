"""A tree of boxes over triangles, and whether anything stands between a point and a lamp.

Each node's triangles are halved at the median of their centres, so that the tree is a complete binary one and needs
no links: node k has the children 2 k + 1 and 2 k + 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from nishiki.threads import over_rows

LEAF = 4
"""Triangles in a leaf."""


@dataclass(frozen=True)
class Boxes:
    """boxes (2 L - 1, 6) float32: lower and upper corner, L leaves; triangles (4 L, 9) float64: a corner and two edges,
    in the order of the leaves, some of them twice; order (4 L,) int32: their numbers in the mesh."""

    boxes: np.ndarray
    triangles: np.ndarray
    order: np.ndarray


def boxes_of(vertices: np.ndarray, triangles: np.ndarray) -> Boxes:
    """The tree over a mesh: vertices (v, 3), triangles (f, 3), f > 0, all finite."""
    corners = np.asarray(vertices, np.float64)[triangles]
    leaves = 1 << max(0, int(np.ceil(np.log2(max(1, len(corners)) / LEAF))))
    # Spread evenly over the leaves; some stand twice, which changes nothing.
    order = np.arange(LEAF * leaves) * len(corners) // (LEAF * leaves)
    _halve(corners.mean(axis=1), order, leaves)
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
    return Boxes(np.ascontiguousarray(boxes, np.float32), np.ascontiguousarray(packed), order.astype(np.int32))


@njit(cache=True, nogil=True, error_model="numpy")
def _halve(centres, order, leaves):
    """Sort `order` in place: each node's triangles are halved at the median along the longest side of their centres."""
    parts = 1
    total = len(order)
    while parts < leaves:
        size = total // parts
        for part in range(parts):
            mine = order[part * size : (part + 1) * size]
            widest, axis = -1.0, 0
            for k in range(3):
                low, high = np.inf, -np.inf
                for m in mine:
                    low, high = min(low, centres[m, k]), max(high, centres[m, k])
                if high - low > widest:
                    widest, axis = high - low, k
            keys = np.empty(size)
            for m in range(size):
                keys[m] = centres[mine[m], axis]
            mine[:] = mine[np.argsort(keys, kind="mergesort")]
        parts *= 2


@njit(cache=True, nogil=True, error_model="numpy")
def blocked(boxes, triangles, stack, ox, oy, oz, dx, dy, dz, far):
    """Whether a ray meets a triangle at a distance within (0, far); the direction need not be a unit vector.

    stack (64,) int32 is scratch. Triangles: T. Moeller, B. Trumbore, Fast, minimum storage ray/triangle intersection,
    Journal of Graphics Tools 1997.
    """
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
            if u < 0.0 or u > 1.0:
                continue
            qx, qy, qz = sy * az - sz * ay, sz * ax - sx * az, sx * ay - sy * ax
            v = (dx * qx + dy * qy + dz * qz) * share
            if v < 0.0 or u + v > 1.0:
                continue
            distance = (bx * qx + by * qy + bz * qz) * share
            if 0.0 < distance < far:
                return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def _cast(boxes, triangles, origins, directions, far, first, last, out):
    stack = np.empty(64, np.int32)
    for k in range(first, last):
        o, d = origins[k], directions[k]
        out[k] = blocked(boxes, triangles, stack, o[0], o[1], o[2], d[0], d[1], d[2], far[k])


def occluded(tree: Boxes, origins: np.ndarray, directions: np.ndarray, far: np.ndarray | float) -> np.ndarray:
    """(n,) bool: whether rays (n, 3), (n, 3) meet a triangle nearer than `far`, in multiples of their directions."""
    count = len(origins)
    out = np.zeros(count, np.bool_)
    origins = np.ascontiguousarray(origins, np.float64)
    directions = np.ascontiguousarray(np.broadcast_to(directions, origins.shape), np.float64)
    far = np.ascontiguousarray(np.broadcast_to(far, count), np.float64)
    if count:
        over_rows(lambda a, b: _cast(tree.boxes, tree.triangles, origins, directions, far, a, b, out), count)
    return out
