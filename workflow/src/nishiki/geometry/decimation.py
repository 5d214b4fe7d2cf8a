"""Reduce the triangles of a surface: collapse edges in the order of the error that this makes.

M. Garland and P. S. Heckbert, Surface simplification using quadric error metrics, SIGGRAPH 1997. Quadrics are weighted
by area. A collapse must keep the surface a surface (the edge's two ends share no neighbours but the two opposite
corners) and must not turn a triangle over.
"""

import heapq

import numpy as np
from numba import njit

from nishiki.geometry.mesh import face_vectors
from nishiki.small_matrices import solve_by_cofactors

JIT = {"cache": True, "nogil": True, "error_model": "numpy"}
STIFF = 1e-6
"""Share of a plane's own quadric that pulls a corner towards where it was: settles flat places."""
PRODUCTS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2), (0, 3), (1, 3), (2, 3), (3, 3))
"""Coefficients of a plane n . (x - point) whose products make a quadric: xx xy xz yy yz zz, x y z, constant."""


@njit(**JIT)
def _plane(a, b, c, out):
    """Compute unit normal and area of a triangle; (0, 0, 0) and 0 where it has none."""
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length = np.sqrt(x * x + y * y + z * z)
    if length <= 0.0:
        out[0], out[1], out[2] = 0.0, 0.0, 0.0
        return 0.0
    out[0], out[1], out[2] = x / length, y / length, z / length
    return 0.5 * length


@njit(**JIT)
def _best(first, second, a, b, out):
    """Find the place (into out) of least error of two summed quadrics, drawn weakly to the middle of a and b; error."""
    q = np.empty(10)
    for k in range(10):
        q[k] = first[k] + second[k]
    pull = STIFF * (q[0] + q[3] + q[5]) + 1e-300
    mx, my, mz = 0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]), 0.5 * (a[2] + b[2])
    xx, yy, zz = q[0] + pull, q[3] + pull, q[5] + pull
    bx, by, bz = pull * mx - q[6], pull * my - q[7], pull * mz - q[8]
    x, y, z, determinant = solve_by_cofactors((xx, q[1], q[2], yy, q[4], zz), bx, by, bz)
    if not determinant > 0.0:  # symmetric and positive definite by the pull, but for rounding
        out[0], out[1], out[2] = mx, my, mz
    else:
        out[0], out[1], out[2] = x / determinant, y / determinant, z / determinant
    x, y, z = out[0], out[1], out[2]
    squares = q[0] * x * x + q[3] * y * y + q[5] * z * z
    return max(
        0.0, squares + 2.0 * (q[1] * x * y + q[2] * x * z + q[4] * y * z + q[6] * x + q[7] * y + q[8] * z) + q[9]
    )


@njit(**JIT)
def _gather(vertex, head, following, faces, alive, marks, stamp, ring):
    """Gather a vertex's neighbours into ring, marked with stamp; return their number, and unlist its dead triangles."""
    count, previous, node = 0, -1, head[vertex]
    while node >= 0:
        face = node // 3
        if not alive[face]:
            if previous < 0:
                head[vertex] = following[node]
            else:
                following[previous] = following[node]
            node = following[node]
            continue
        for k in range(3):
            other = faces[face, k]
            if other != vertex and marks[other] != stamp:
                marks[other] = stamp
                if count < ring.shape[0]:
                    ring[count] = other
                count += 1
        previous, node = node, following[node]
    return count


@njit(**JIT)
def _turns(vertex, other, place, surface, scratch):
    """Return whether moving `vertex` to place turns over, or flattens, a triangle that does not vanish with `other`."""
    (vertices, head, following, faces, alive), (old, new, spot) = surface, scratch
    node = head[vertex]
    while node >= 0:
        face = node // 3
        node = following[node]
        if not alive[face]:
            continue
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        if a == other or b == other or c == other:
            continue
        before = _plane(vertices[a], vertices[b], vertices[c], old)
        for k in range(3):
            spot[0, k] = place[k] if a == vertex else vertices[a, k]
            spot[1, k] = place[k] if b == vertex else vertices[b, k]
            spot[2, k] = place[k] if c == vertex else vertices[c, k]
        area = _plane(spot[0], spot[1], spot[2], new)
        longest = 0.0
        for i in range(3):
            j = (i + 1) % 3
            side = (spot[i, 0] - spot[j, 0]) ** 2 + (spot[i, 1] - spot[j, 1]) ** 2 + (spot[i, 2] - spot[j, 2]) ** 2
            longest = max(longest, side)
        if area <= 0.01 * longest:
            return True
        if before > 0.0 and old[0] * new[0] + old[1] * new[1] + old[2] * new[2] < 0.3:
            return True
    return False


def collapse(vertices: np.ndarray, faces: np.ndarray, target: int) -> np.ndarray:
    """Collapse edges until `target` triangles are left or no edge may collapse. Changes both arrays.

    vertices (v, 3) float64, faces (f, 3) int64 of a surface (two triangles an edge at most). Returns alive (f,) bool.
    """
    count, nodes = len(vertices), faces.ravel()
    ends = np.stack([nodes, np.roll(faces, -1, axis=1).ravel()], axis=1)
    edge, uses = np.unique(ends.min(axis=1) * count + ends.max(axis=1), return_inverse=True, return_counts=True)[1:]
    is_open = uses[edge] == 1
    edges, ends, borders = ends[(ends[:, 0] < ends[:, 1]) | is_open], ends[is_open], np.flatnonzero(is_open) // 3
    del edge, uses
    # quadrics of the planes of all triangles, and of planes across open edges
    normals = face_vectors(vertices, faces)
    sizes = np.linalg.norm(normals, axis=1)
    normals /= np.where(sizes > 0, sizes, 1)[:, None]
    ends, borders = (each[sizes[borders] > 0] for each in (ends, borders))
    along = vertices[ends[:, 1]] - vertices[ends[:, 0]]
    lengths = np.linalg.norm(along, axis=1)
    across = np.cross(along, normals[borders]) / np.where(lengths > 0, lengths, 1)[:, None]
    places, quadrics = np.concatenate([nodes, ends.ravel()]) if len(ends) else nodes, np.empty((count, 10))
    values = np.empty(len(places))
    blocks = values[: len(nodes)].reshape(-1, 3), values[len(nodes) :].reshape(-1, 2)
    kinds = (normals, faces[:, 0], sizes / 6), (across, ends[:, 0], lengths**2)
    planes = [((*of.T, -(of * vertices[on]).sum(axis=1)), weights) for of, on, weights in kinds]
    for number, (i, j) in enumerate(PRODUCTS):  # one by one, which bounds the memory
        for block, (plane, weights) in zip(blocks, planes, strict=True):
            block[:] = (weights * plane[i] * plane[j])[:, None]
        quadrics[:, number] = np.bincount(places, values, count)
    # the triangles at each vertex as linked lists, the last one first
    order = np.argsort(nodes, kind="stable")
    same = nodes[order[1:]] == nodes[order[:-1]]
    head, following = np.full(count, -1), np.full(len(nodes), -1)
    head[nodes[order]] = order
    following[order[1:][same]] = order[:-1][same]
    return _collapse(vertices, faces, target, quadrics, (head, following), edges)


@njit(**JIT)
def _collapse(vertices, faces, target, quadrics, lists, edges):
    """Collapse as in `collapse`; lists: first node of each vertex, and the node that follows."""
    (head, following), count = lists, vertices.shape[0]
    alive = np.ones(faces.shape[0], np.bool_)
    version, marks = np.zeros(count, np.int64), np.full(count, -1)
    ring, ring2 = np.empty(1024, np.int64), np.empty(1024, np.int64)
    place, scratch = np.empty(3), (np.empty(3), np.empty(3), np.empty((3, 3)))
    heap = [(0.0, 0, 0, 0, 0) for _ in range(0)]  # cost, ends and their versions
    for a, b in edges:
        cost = _best(quadrics[a], quadrics[b], vertices[a], vertices[b], place)
        heap.append((cost, min(a, b), max(a, b), 0, 0))
    heapq.heapify(heap)
    left, stamp = faces.shape[0], 0
    while left > target and len(heap) > 0:
        _, a, b, version_a, version_b = heapq.heappop(heap)
        if version[a] != version_a or version[b] != version_b:
            continue
        stamp += 2
        near_b = _gather(b, head, following, faces, alive, marks, stamp, ring2)
        near_a = _gather(a, head, following, faces, alive, marks, stamp + 1, ring)
        if near_a > ring.shape[0] or near_b > ring2.shape[0]:
            continue
        shared, sides = 0, 0
        for i in range(near_b):
            if marks[ring2[i]] == stamp + 1:
                shared += 1
        node = head[a]
        while node >= 0:
            face = node // 3
            node = following[node]
            if alive[face] and (faces[face, 0] == b or faces[face, 1] == b or faces[face, 2] == b):
                sides += 1
        if shared != sides or sides == 0 or (sides == 2 and near_a <= 3 and near_b <= 3):
            continue
        _best(quadrics[a], quadrics[b], vertices[a], vertices[b], place)
        if _turns(a, b, place, (vertices, head, following, faces, alive), scratch):
            continue
        if _turns(b, a, place, (vertices, head, following, faces, alive), scratch):
            continue
        for k in range(3):
            vertices[a, k] = place[k]
        for k in range(10):
            quadrics[a, k] += quadrics[b, k]
        version[b] = -1
        last, node = -1, head[b]
        while node >= 0:
            face = node // 3
            if alive[face]:
                if faces[face, 0] == a or faces[face, 1] == a or faces[face, 2] == a:
                    alive[face] = False
                    left -= 1
                else:
                    faces[face, node % 3] = a
            last, node = node, following[node]
        following[last] = head[a]
        head[a] = head[b]
        version[a] += 1
        stamp += 2
        near_a = _gather(a, head, following, faces, alive, marks, stamp, ring)
        for i in range(min(near_a, ring.shape[0])):
            other = ring[i]
            cost = _best(quadrics[a], quadrics[other], vertices[a], vertices[other], place)
            first, second = min(a, other), max(a, other)
            heapq.heappush(heap, (cost, first, second, version[first], version[second]))
    return alive
