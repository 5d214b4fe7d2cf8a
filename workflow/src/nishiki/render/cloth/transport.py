"""Tangent directions carried over a surface from where they are known to where they are not."""

from __future__ import annotations

import numpy as np


def transported(
    count: int, triangles: np.ndarray, normals: np.ndarray, weft: np.ndarray, known: np.ndarray
) -> tuple[np.ndarray, int]:
    """Unit tangents (count, 3) at all vertices, and at how many of them they are arbitrary.

    Between two vertices a tangent is carried by the smallest rotation that takes one normal to the other. Unknown
    tangents, as complex numbers in each vertex's own frame, are those that differ least, squared and summed over the
    edges, from what their neighbours carry to them: the harmonic field of the connection Laplacian (N. Sharp, Y.
    Soliman, K. Crane, The vector heat method, ACM TOG 2019, with equal weights of the edges). Where the field is next
    to nothing (a singularity), a vertex takes the tangent of its strongest neighbour. Parts of the surface without
    any known tangent get one that changes as little as the frames allow: the projection of the axis that lies
    flattest.
    """
    from scipy.sparse import coo_matrix, diags
    from scipy.sparse.csgraph import connected_components
    from scipy.sparse.linalg import spsolve

    weft = weft.copy()
    edges = _edges(triangles)
    i, j = np.concatenate([edges, edges[:, ::-1]]).T
    ones = np.ones(len(i))
    labels = connected_components(coo_matrix((ones, (i, j)), (count, count)), directed=False)[1]
    fed = np.bincount(labels, weights=known, minlength=labels.max(initial=-1) + 1) > 0
    orphan = ~fed[labels]
    if orphan.any():
        weft[orphan] = _flattest(normals[orphan])
    unknown = ~known & ~orphan
    if not unknown.any():
        return weft, int(orphan.sum())
    right, up = _frames(normals)
    carried = _carry(normals[j], normals[i], right[j])
    # Angle of j's frame after it has come to i; a tangent z at j arrives as turn * z.
    turn = np.sum(carried * right[i], axis=1) + 1j * np.sum(carried * up[i], axis=1)
    turn /= np.maximum(np.abs(turn), 1e-300)
    gather = coo_matrix((turn, (i, j)), (count, count)).tocsr()
    degree = np.bincount(i, minlength=count).astype(float)
    values = np.sum(weft * right, axis=1) + 1j * np.sum(weft * up, axis=1)
    free = np.flatnonzero(unknown)
    fixed = np.flatnonzero(~unknown)
    matrix = (diags(degree[free]) - gather[free][:, free]).tocsc()
    values[free] = spsolve(matrix, gather[free][:, fixed] @ values[fixed])
    values = _rescued(values, free, gather)
    values /= np.maximum(np.abs(values), 1e-300)
    weft[free] = (values.real[:, None] * right + values.imag[:, None] * up)[free]
    return weft, int(orphan.sum())


def _edges(triangles: np.ndarray) -> np.ndarray:
    pairs = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    pairs = np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0)
    return pairs.astype(np.int64)


def _frames(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    right = _flattest(normals)
    return right, np.cross(normals, right)


def _flattest(normals: np.ndarray) -> np.ndarray:
    """Unit tangents (n, 3): the coordinate axis furthest from the normal, projected."""
    axis = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    across = axis - np.sum(axis * normals, axis=1, keepdims=True) * normals
    return across / np.linalg.norm(across, axis=1, keepdims=True)


def _carry(start: np.ndarray, end: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Vectors (n, 3) turned by the smallest rotations from unit vectors `start` to `end`; opposites: half a turn."""
    axis, cosine = np.cross(start, end), np.sum(start * end, axis=1, keepdims=True)
    safe = np.maximum(1 + cosine, 1e-9)
    turned = cosine * vectors + np.cross(axis, vectors) + axis * (np.sum(axis * vectors, axis=1, keepdims=True) / safe)
    return turned - np.sum(turned * end, axis=1, keepdims=True) * end


def _rescued(values: np.ndarray, free: np.ndarray, gather) -> np.ndarray:
    """Values of next to no length replaced by the strongest neighbour's, until none are left or nothing helps."""
    values = values.copy()
    for _ in range(8):
        weak = free[np.abs(values[free]) < 1e-9]
        if not len(weak):
            break
        before = values.copy()
        for vertex in weak:
            row = gather.indptr[vertex], gather.indptr[vertex + 1]
            brought = gather.data[row[0] : row[1]] * before[gather.indices[row[0] : row[1]]]
            values[vertex] = brought[np.argmax(np.abs(brought))] if len(brought) else 0
    weak = free[np.abs(values[free]) < 1e-9]
    values[weak] = 1.0
    return values
