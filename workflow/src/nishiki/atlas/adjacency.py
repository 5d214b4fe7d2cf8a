"""Find triangles across edges, and smooth or spread quantities from triangle to triangle."""

import numpy as np


def across_edges(corners: np.ndarray) -> np.ndarray:
    """Find neighbours (f, 3) int32 of triangles (f, 3): entry k lies across the edge from corner k to corner k + 1.

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


def smooth_over_triangles(
    vectors: np.ndarray, weights: np.ndarray, neighbours: np.ndarray, *, rounds: int
) -> np.ndarray:
    """Average unit vectors (f, 3) `rounds` times over each triangle and its neighbours, weighted by (f,).

    Triangles around which nothing has weight keep (0, 0, 0).
    """
    from scipy.sparse import csr_array

    count, vectors = len(vectors), np.asarray(vectors, np.float64)
    around = np.column_stack([np.arange(count), neighbours])
    met, starts = around >= 0, np.append(0, np.cumsum((around >= 0).sum(axis=1)))
    sums = csr_array((np.ones(starts[-1]), around[met], starts), shape=(count, count))
    for _ in range(rounds):
        vectors = sums @ (np.reshape(weights, (-1, 1)) * vectors)
        lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
        vectors = vectors / np.where(lengths > 0, lengths, 1)
    return vectors


def smoothed_vertices(vertices: np.ndarray, corners: np.ndarray, *, rounds: int) -> np.ndarray:
    """Move vertices (v, 3) `rounds` times half way to the mean of those that share an edge with them; float64.

    A neighbour counts once for each triangle that has both; vertices without a triangle stay.
    """
    from scipy.sparse import coo_array

    vertices = np.array(vertices, np.float64)
    here, there = np.repeat(corners, 2, axis=1).ravel(), corners[:, [1, 2, 2, 0, 0, 1]].ravel()
    sums = coo_array((np.ones(len(here)), (here, there)), shape=(len(vertices), len(vertices))).tocsr()
    counts = np.bincount(here, minlength=len(vertices))[:, None]
    for _ in range(rounds):
        mean = sums @ vertices / np.maximum(counts, 1)
        vertices = np.where(counts > 0, (vertices + mean) / 2, vertices)
    return vertices


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


def spread(labels: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """Fill negative labels (f,) from labelled neighbours, ring by ring; what nothing labelled touches stays."""
    labels = labels.copy()
    ring = np.flatnonzero(labels >= 0)
    while len(ring):
        there, source = neighbours[ring].ravel(), np.repeat(labels[ring], 3)
        free = (there >= 0) & (labels[there] < 0)
        there, first = np.unique(there[free], return_index=True)
        labels[there] = source[free][first]
        ring = there[np.argsort(first)]
    return labels


def borders(labels: np.ndarray, neighbours: np.ndarray, lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find pairs (n, 2) of different labels that meet, in both orders, and the length (n,) of their common border.

    lengths (f, 3): of the edges, in the order of `across_edges`.
    """
    inside = (neighbours >= 0) & (labels[:, None] >= 0)
    one = np.broadcast_to(labels[:, None], neighbours.shape)[inside].astype(np.int64)
    other = labels[neighbours[inside]].astype(np.int64)
    size = int(labels.max(initial=0)) + 1
    met = (one != other) & (other >= 0)
    keys, index = np.unique((one * size + other)[met], return_inverse=True)
    return np.stack([keys // size, keys % size], axis=1), np.bincount(index, lengths[inside][met], minlength=len(keys))
