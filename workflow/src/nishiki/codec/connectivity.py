"""Triangles as a string of symbols: a walk over the surface from edge to edge.

The walk keeps the border of the part already described as linked lists of edges (gates) and tells for each gate what
lies across it, after J. Rossignac, Edgebreaker, IEEE Trans. Visualization and Computer Graphics 5(1), 1999.  Unlike
there, any set of triangles is taken: open or non-manifold edges, several components, handles.  A vertex that is already
known but no neighbour on the border is named by its distance along the border, else by its number.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from nishiki.codec.integer_code import code_integer, decoder, new_chances

NEW, NEXT, PREVIOUS, CLOSE, SPLIT, OPEN, NAMED = 0, 1, -1, 2, -2, 3, -3
_SYMBOLS = 7
_AROUND, _NAME = _SYMBOLS * _SYMBOLS, _SYMBOLS * _SYMBOLS + 1
CONTEXTS = _SYMBOLS * _SYMBOLS + 2
_REACH = 4096  # border edges searched for a known vertex


@njit(cache=True, nogil=True, error_model="numpy")
def _around(gate, vertex, start, following, preceding):
    """Signed number of border edges from the gate to one that starts at the vertex; 0 where it is not within reach."""
    ahead, behind = following[gate], gate
    for k in range(1, _REACH):
        if start[ahead] == vertex and k > 1:
            return k
        if k > 1 and start[behind] == vertex:
            return -k
        ahead, behind = following[ahead], preceding[behind]
    return 0


@njit(cache=True, nogil=True, error_model="numpy")
def _vertex_at(gate, distance, start, following, preceding):
    """The vertex that `_around` gave this distance to."""
    at = following[gate] if distance > 0 else gate
    for _ in range(abs(distance) - 1):
        at = following[at] if distance > 0 else preceding[at]
    return start[at]


@njit(cache=True, nogil=True, error_model="numpy")
def _join(first, second, following, preceding):
    following[first], preceding[second] = second, first


@njit(cache=True, nogil=True, error_model="numpy")
def _advance(symbol, gate, third, nodes, start, end, following, preceding, live, leaves):
    """Change the border at a gate as the symbol says; number of nodes after it.

    New nodes are appended: the triangle's edges a -> c, then c -> b, as far as they are on the border.
    leaves[v]: the latest node that starts at v, -1 where there is none.
    """
    a, b = start[gate], end[gate]
    before, after = preceding[gate], following[gate]
    live[gate] = False
    if symbol == OPEN:
        return nodes
    if symbol == CLOSE:
        live[before], live[after] = False, False
        return nodes
    if symbol == NEXT or symbol == PREVIOUS:
        node = nodes
        if symbol == NEXT:
            live[after] = False
            start[node], end[node] = a, end[after]
            _join(before, node, following, preceding)
            _join(node, following[after], following, preceding)
        else:
            live[before] = False
            start[node], end[node] = start[before], b
            _join(preceding[before], node, following, preceding)
            _join(node, after, following, preceding)
        leaves[start[node]] = node
        live[node] = True
        return nodes + 1
    left, right = nodes, nodes + 1
    start[left], end[left], start[right], end[right] = a, third, third, b
    across = leaves[third]
    _join(before, left, following, preceding)
    _join(right, after, following, preceding)
    if across >= 0 and symbol != NEW and across != gate:
        _join(preceding[across], right, following, preceding)
        _join(left, across, following, preceding)
    else:
        _join(left, right, following, preceding)
    leaves[a], leaves[third] = left, right
    live[left], live[right] = True, True
    return nodes + 2


@njit(cache=True, nogil=True, error_model="numpy")
def _seed(corners, nodes, start, end, following, preceding, live, leaves, stack, depth):
    """A new loop of three edges; they go on the stack."""
    for k in range(3):
        node = nodes + k
        start[node], end[node] = corners[k], corners[(k + 1) % 3]
        following[node], preceding[node] = nodes + (k + 1) % 3, nodes + (k + 2) % 3
        live[node] = True
        leaves[corners[k]] = node
        stack[depth + k] = node


@njit(cache=True, nogil=True, error_model="numpy")
def describe(triangles, twins, vertices):
    """Walk over the triangles (f, 3); twins (3 f,): half-edge across each half-edge 3 t + k, or -1.

    Returns values and contexts for the range coder, order (f,) of the triangles as they are described, first (f,) the
    corner of each that comes first, and number (vertices,) of each vertex in the order of appearance (-1: unused).
    """
    count = len(triangles)
    size = 6 * count + 8
    start, end = np.empty(size, np.int64), np.empty(size, np.int64)
    following, preceding = np.empty(size, np.int64), np.empty(size, np.int64)
    live, half = np.zeros(size, np.bool_), np.empty(size, np.int64)
    stack = np.empty(size, np.int64)
    leaves, number = np.full(vertices, -1, np.int64), np.full(vertices, -1, np.int64)
    values, contexts = np.empty(8 * count + 8, np.int64), np.empty(8 * count + 8, np.int64)
    order, first, done = np.empty(count, np.int64), np.empty(count, np.int64), np.zeros(count, np.bool_)
    nodes, depth, told, made, known = 0, 0, 0, 0, 0
    last, before_last = 0, 0
    corners = np.empty(3, np.int64)
    for seed in range(count):
        if done[seed]:
            continue
        done[seed] = True
        order[made], first[made] = seed, 0
        made += 1
        for k in range(3):
            vertex = triangles[seed, k]
            if number[vertex] < 0:
                number[vertex] = known
                known += 1
                values[told] = 0
            else:
                values[told] = known - number[vertex]
            contexts[told] = _NAME
            told += 1
            corners[k] = number[vertex]
        # seeds need no room for more: every node is an edge of a triangle
        _seed(corners, nodes, start, end, following, preceding, live, leaves, stack, depth)
        for k in range(3):
            half[nodes + k] = 3 * seed + k
        nodes, depth = nodes + 3, depth + 3
        while depth:
            depth -= 1
            gate = stack[depth]
            if not live[gate]:
                continue
            twin = twins[half[gate]]
            symbol, third, distance = OPEN, np.int64(-1), 0
            if twin >= 0 and not done[twin // 3]:
                triangle, corner = twin // 3, twin % 3
                vertex = triangles[triangle, (corner + 2) % 3]
                done[triangle] = True
                order[made], first[made] = triangle, corner
                made += 1
                if number[vertex] < 0:
                    symbol, third = NEW, known
                    number[vertex] = known
                    known += 1
                else:
                    third = number[vertex]
                    after, before = end[following[gate]], start[preceding[gate]]
                    if third == after and third == before and following[following[gate]] == preceding[gate]:
                        symbol = CLOSE
                    elif third == after and following[gate] != gate and live[following[gate]]:
                        symbol = NEXT
                    elif third == before and preceding[gate] != gate and live[preceding[gate]]:
                        symbol = PREVIOUS
                    else:
                        distance = _around(gate, third, start, following, preceding)
                        symbol = SPLIT if distance else NAMED
            values[told], contexts[told] = symbol, (last + 3) * _SYMBOLS + before_last + 3
            before_last, last = last, symbol
            told += 1
            if symbol == SPLIT:
                values[told], contexts[told] = distance, _AROUND
                told += 1
            elif symbol == NAMED:
                values[told], contexts[told] = known - third, _NAME
                told += 1
            fresh = nodes
            nodes = _advance(symbol, gate, third, nodes, start, end, following, preceding, live, leaves)
            for node in range(fresh, nodes):
                # in the triangle (b, a, c): half-edge corner + 1 is a -> c, corner + 2 is c -> b
                shift = 2 if symbol == PREVIOUS or (node == fresh + 1) else 1
                half[node] = 3 * (twin // 3) + (twin % 3 + shift) % 3
                stack[depth] = node
                depth += 1
    return values[:told].copy(), contexts[:told].copy(), order, first, number


@njit(cache=True, nogil=True, error_model="numpy")
def follow(data, count, vertices):
    """Inverse of `describe`: triangles (count, 3) int32 over `vertices` vertices, from the coded bytes (uint8)."""
    size = 6 * count + 8
    start, end = np.empty(size, np.int64), np.empty(size, np.int64)
    following, preceding = np.empty(size, np.int64), np.empty(size, np.int64)
    live, stack = np.zeros(size, np.bool_), np.empty(size, np.int64)
    leaves = np.full(max(vertices, 1), -1, np.int64)
    triangles = np.empty((count, 3), np.int32)
    chances, state = new_chances(CONTEXTS), decoder(data)
    nodes, depth, made, known = 0, 0, 0, 0
    last, before_last = 0, 0
    corners = np.empty(3, np.int64)
    while made < count:
        for k in range(3):
            back = code_integer(0, _NAME, chances, state, data, True)
            corners[k] = known - back
            if back == 0:
                known += 1
            triangles[made, k] = corners[k]
        made += 1
        _seed(corners, nodes, start, end, following, preceding, live, leaves, stack, depth)
        nodes, depth = nodes + 3, depth + 3
        while depth:
            depth -= 1
            gate = stack[depth]
            if not live[gate]:
                continue
            context = (last + 3) * _SYMBOLS + before_last + 3
            symbol = code_integer(0, context, chances, state, data, True)
            before_last, last = last, symbol
            third = np.int64(-1)
            if symbol == NEW:
                third = known
                known += 1
            elif symbol == NEXT or symbol == CLOSE:
                third = end[following[gate]]
            elif symbol == PREVIOUS:
                third = start[preceding[gate]]
            elif symbol == SPLIT:
                distance = code_integer(0, _AROUND, chances, state, data, True)
                third = _vertex_at(gate, distance, start, following, preceding)
            elif symbol == NAMED:
                third = known - code_integer(0, _NAME, chances, state, data, True)
            if symbol != OPEN:
                triangles[made, 0], triangles[made, 1], triangles[made, 2] = end[gate], start[gate], third
                made += 1
            fresh = nodes
            nodes = _advance(symbol, gate, third, nodes, start, end, following, preceding, live, leaves)
            for node in range(fresh, nodes):
                stack[depth] = node
                depth += 1
    return triangles


def twins_of(triangles: np.ndarray) -> np.ndarray:
    """(3 f,) int64: for the half-edge 3 t + k, from corner k to corner k + 1 of triangle t, the one that runs the other
    way; -1 at open edges and where the pairing is not unique."""
    start, end = triangles.reshape(-1).astype(np.int64), np.roll(triangles, -1, axis=1).reshape(-1).astype(np.int64)
    size = int(triangles.max(initial=0)) + 1
    here, there = start * size + end, end * size + start
    order = np.argsort(here, kind="stable")
    ranked = here[order]
    left, right = np.searchsorted(ranked, there, "left"), np.searchsorted(ranked, there, "right")
    unique = right - left == 1
    twins = np.where(unique, order[np.minimum(left, len(order) - 1)], -1) if len(order) else np.zeros(0, np.int64)
    mutual = (twins >= 0) & (twins[np.maximum(twins, 0)] == np.arange(len(twins)))
    return np.where(mutual, twins, -1)
