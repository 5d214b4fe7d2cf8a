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
def _corner(vertices, n):
    """Return vertex n as three numbers: a row that is taken from an array would count references, which costs more."""
    return vertices[n, 0], vertices[n, 1], vertices[n, 2]


@njit(**JIT)
def _plane(a, b, c):
    """Compute unit normal and area of a triangle; all 0 where it has none."""
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length = np.sqrt(x * x + y * y + z * z)
    if length <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    return x / length, y / length, z / length, 0.5 * length


@njit(**JIT)
def _best(quadrics, vertices, a, b):
    """Find the place of least error of two vertices' summed quadrics, drawn weakly to their middle; error and place."""
    xx, xy, xz = quadrics[a, 0] + quadrics[b, 0], quadrics[a, 1] + quadrics[b, 1], quadrics[a, 2] + quadrics[b, 2]
    yy, yz, zz = quadrics[a, 3] + quadrics[b, 3], quadrics[a, 4] + quadrics[b, 4], quadrics[a, 5] + quadrics[b, 5]
    qx, qy, qz = quadrics[a, 6] + quadrics[b, 6], quadrics[a, 7] + quadrics[b, 7], quadrics[a, 8] + quadrics[b, 8]
    pull = STIFF * (xx + yy + zz) + 1e-300
    (ax, ay, az), (bx, by, bz) = _corner(vertices, a), _corner(vertices, b)
    mx, my, mz = 0.5 * (ax + bx), 0.5 * (ay + by), 0.5 * (az + bz)
    matrix = (xx + pull, xy, xz, yy + pull, yz, zz + pull)
    x, y, z, determinant = solve_by_cofactors(matrix, pull * mx - qx, pull * my - qy, pull * mz - qz)
    if not determinant > 0.0:  # symmetric and positive definite by the pull, but for rounding
        x, y, z = mx, my, mz
    else:
        x, y, z = x / determinant, y / determinant, z / determinant
    squares, constant = xx * x * x + yy * y * y + zz * z * z, quadrics[a, 9] + quadrics[b, 9]
    error = squares + 2.0 * (xy * x * y + xz * x * z + yz * y * z + qx * x + qy * y + qz * z) + constant
    return max(0.0, error), (x, y, z)


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
def _turns(vertex, other, place, surface):
    """Return whether moving `vertex` to place turns over, or flattens, a triangle that does not vanish with `other`."""
    vertices, head, following, faces, alive = surface
    node = head[vertex]
    while node >= 0:
        face = node // 3
        node = following[node]
        if not alive[face]:
            continue
        i, j, k = faces[face, 0], faces[face, 1], faces[face, 2]
        if i == other or j == other or k == other:
            continue
        a, b, c = _corner(vertices, i), _corner(vertices, j), _corner(vertices, k)
        x, y, z, before = _plane(a, b, c)
        a, b, c = place if i == vertex else a, place if j == vertex else b, place if k == vertex else c
        u, v, w, area = _plane(a, b, c)
        longest = 0.0
        for p, q in ((a, b), (b, c), (c, a)):
            longest = max(longest, (p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2)
        if area <= 0.01 * longest or (before > 0.0 and x * u + y * v + z * w < 0.3):
            return True
    return False


def collapse(vertices: np.ndarray, faces: np.ndarray, target: int) -> np.ndarray:
    """Collapse edges until `target` triangles are left or no edge may collapse. Changes both arrays.

    vertices (v, 3) float64, faces (f, 3) int32 of a surface (two triangles an edge at most). Returns alive (f,) bool.
    """
    count, nodes = len(vertices), faces.ravel()
    ends = np.stack([nodes, np.roll(faces, -1, axis=1).ravel()], axis=1)
    keys = ends.min(axis=1).astype(np.int64) * count + ends.max(axis=1)
    edge, uses = np.unique(keys, return_inverse=True, return_counts=True)[1:]
    is_open = uses[edge] == 1
    edges, ends, borders = ends[(ends[:, 0] < ends[:, 1]) | is_open], ends[is_open], np.flatnonzero(is_open) // 3
    del keys, edge, uses
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
    head, following = np.full(count, -1, np.int32), np.full(len(nodes), -1, np.int32)
    head[nodes[order]] = order
    following[order[1:][same]] = order[:-1][same]
    del normals, sizes, values, blocks, kinds, planes, order, same  # the queue of edges takes the memory
    return _collapse(vertices, faces, target, quadrics, (head, following), edges)


@njit(**JIT)
def _collapse(vertices, faces, target, quadrics, lists, edges):
    """Collapse as in `collapse`; lists: first node of each vertex, and the node that follows."""
    (head, following), count = lists, vertices.shape[0]
    alive = np.ones(faces.shape[0], np.bool_)
    version, marks = np.zeros(count, np.int64), np.full(count, -1)
    ring, ring2 = np.empty(1024, np.int64), np.empty(1024, np.int64)
    surface = vertices, head, following, faces, alive
    heap = [(0.0, 0, 0, 0, 0) for _ in range(0)]  # cost, ends and their versions
    for n in range(len(edges)):
        a, b = min(edges[n, 0], edges[n, 1]), max(edges[n, 0], edges[n, 1])
        heap.append((_best(quadrics, vertices, a, b)[0], a, b, 0, 0))
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
        _, place = _best(quadrics, vertices, a, b)
        if _turns(a, b, place, surface) or _turns(b, a, place, surface):
            continue
        vertices[a, 0], vertices[a, 1], vertices[a, 2] = place
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
            first, second = min(a, ring[i]), max(a, ring[i])
            cost, _ = _best(quadrics, vertices, first, second)
            heapq.heappush(heap, (cost, first, second, version[first], version[second]))
    return alive
