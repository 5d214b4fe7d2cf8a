"""Triangles across edges, and quantities smoothed or spread from triangle to triangle."""

import numba
import numpy as np


def across_edges(corners: np.ndarray) -> np.ndarray:
    """Neighbours (f, 3) int32 of triangles (f, 3): entry k lies across the edge from corner k to corner k + 1.

    -1 at an open edge, and at edges of more than two triangles, which belong to no smooth surface.
    """
    count = len(corners)
    start, end = corners.reshape(-1).astype(np.int64), np.roll(corners, -1, axis=1).reshape(-1).astype(np.int64)
    size = int(corners.max(initial=0)) + 1
    edge = np.minimum(start, end) * size + np.maximum(start, end)
    order = np.argsort(edge, kind="stable")
    ranked = edge[order]
    first = np.flatnonzero(np.diff(ranked, prepend=-1))
    lengths = np.diff(first, append=len(ranked))
    pair = first[lengths == 2]
    one, other = order[pair], order[pair + 1]
    neighbours = np.full(3 * count, -1, np.int32)
    neighbours[one], neighbours[other] = other // 3, one // 3
    return neighbours.reshape(count, 3)


def smoothed(vectors: np.ndarray, weights: np.ndarray, neighbours: np.ndarray, *, rounds: int) -> np.ndarray:
    """Average unit vectors (f, 3) `rounds` times over each triangle and its neighbours, weighted by (f,).

    Triangles around which nothing has weight keep (0, 0, 0).
    """
    vectors = np.ascontiguousarray(vectors, np.float64)
    for _ in range(rounds):
        vectors = average(vectors, np.ascontiguousarray(weights, np.float64), neighbours)
    return vectors


@numba.njit(cache=True, nogil=True, error_model="numpy")
def average(vectors, weights, neighbours):
    """One round of `smoothed`."""
    out = np.zeros_like(vectors)
    for i in range(len(vectors)):
        x, y, z = weights[i] * vectors[i, 0], weights[i] * vectors[i, 1], weights[i] * vectors[i, 2]
        for k in range(3):
            j = neighbours[i, k]
            if j >= 0:
                x += weights[j] * vectors[j, 0]
                y += weights[j] * vectors[j, 1]
                z += weights[j] * vectors[j, 2]
        length = np.sqrt(x * x + y * y + z * z)
        if length > 0:
            out[i, 0], out[i, 1], out[i, 2] = x / length, y / length, z / length
    return out


def smoothed_vertices(vertices: np.ndarray, corners: np.ndarray, *, rounds: int) -> np.ndarray:
    """Vertices (v, 3) float64 after `rounds` of moving half way to the mean of those that share an edge with them."""
    vertices = np.array(vertices, np.float64)
    for _ in range(rounds):
        vertices = half_way(vertices, np.ascontiguousarray(corners, np.int32))
    return vertices


@numba.njit(cache=True, nogil=True, error_model="numpy")
def half_way(vertices, corners):
    """One round of `smoothed_vertices`; a neighbour counts once for each triangle that has both."""
    sums = np.zeros_like(vertices)
    counts = np.zeros(len(vertices))
    for i in range(len(corners)):
        for k in range(3):
            here = corners[i, k]
            counts[here] += 2
            for other in (corners[i, (k + 1) % 3], corners[i, (k + 2) % 3]):
                for axis in range(3):
                    sums[here, axis] += vertices[other, axis]
    for i in range(len(vertices)):
        if counts[i] > 0:
            for axis in range(3):
                sums[i, axis] = (vertices[i, axis] + sums[i, axis] / counts[i]) / 2
        else:
            for axis in range(3):
                sums[i, axis] = vertices[i, axis]
    return sums


def components(labels: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """Count the connected triangles of equal label: (f,) int32 in the order of their first triangles.

    Triangles with a negative label get -1.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    named = labels >= 0
    joined = named[:, None] & (neighbours >= 0) & (labels[neighbours] == labels[:, None])
    places = np.nonzero(joined)[0], neighbours[joined]
    graph = coo_array((np.ones(len(places[0]), bool), places), shape=(len(labels), len(labels)))
    numbers = np.full(len(labels), -1, np.int32)
    numbers[named] = np.unique(connected_components(graph, directed=False)[1][named], return_inverse=True)[1]
    return numbers


@numba.njit(cache=True, nogil=True, error_model="numpy")
def spread(labels, neighbours):
    """Fill negative labels (f,) from labelled neighbours, ring by ring; what nothing labelled touches stays."""
    labels = labels.copy()
    count = len(labels)
    queue = np.empty(count, np.int32)
    tail = 0
    for i in range(count):
        if labels[i] >= 0:
            queue[tail] = i
            tail += 1
    head = 0
    while head < tail:
        here = queue[head]
        head += 1
        for k in range(3):
            there = neighbours[here, k]
            if there >= 0 and labels[there] < 0:
                labels[there] = labels[here]
                queue[tail] = there
                tail += 1
    return labels


def borders(labels: np.ndarray, neighbours: np.ndarray, lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (n, 2) of different labels that meet, each in both orders, and the length (n,) of their common border.

    lengths (f, 3): of the edges, in the order of `across_edges`.
    """
    inside = (neighbours >= 0) & (labels[:, None] >= 0)
    one = np.broadcast_to(labels[:, None], neighbours.shape)[inside].astype(np.int64)
    other = labels[neighbours[inside]].astype(np.int64)
    size = int(labels.max(initial=0)) + 1
    met = (one != other) & (other >= 0)
    keys, index = np.unique((one * size + other)[met], return_inverse=True)
    return np.stack([keys // size, keys % size], axis=1), np.bincount(index, lengths[inside][met], minlength=len(keys))
