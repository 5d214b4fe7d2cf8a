"""A mesh in few bytes: grid positions predicted from their neighbours, and the triangles as a walk.

What a renderer needs beside the residual.  The bytes are those of a form that `decode_mesh` reads back; its vertices
and triangles come in the order of the walk.  Prediction: the mean over the parallelograms that known triangles span
(C. Touma and C. Gotsman, Triangle mesh compression, Graphics Interface 1998; several of them: M. Isenburg and
P. Alliez, Compressing polygon mesh geometry with parallelogram prediction, IEEE Visualization 2002).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numba import njit

from nishiki.codec.connectivity import CONTEXTS, describe, follow, twins_of
from nishiki.codec.integer_code import code_integer, decoder, encode_integers, new_chances
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh

_HEADER = struct.Struct("<4sIIIIi3i")  # magic, vertices, triangles, bytes of triangles, of positions, step, origin
_MAGIC = b"nms2"
CONTEXT_SIZES = 14  # contexts of one axis: size of the last residuals


@dataclass(frozen=True)
class CompactMesh:
    """data: the bytes; vertices (v,) and triangles (f,) int64: numbers, in the mesh that was coded, of the decoded
    vertices and triangles, first (f,) the corner each starts with; parts: bytes by what they hold; unused: vertices of
    no triangle, which are not coded; step: of the grid."""

    data: bytes
    vertices: np.ndarray
    triangles: np.ndarray
    first: np.ndarray
    parts: dict[str, int]
    unused: int
    step: float

    def restored(self, mesh: Mesh) -> Mesh:
        """The decoded positions in the order of `mesh`, the mesh that was coded: what a renderer of the bytes sees,
        with triangles numbered as the atlas numbers them.  Normals are computed from the decoded positions."""
        decoded = decode_mesh(self.data)
        vertices = mesh.vertices.copy()
        vertices[self.vertices] = decoded.vertices
        return Mesh.of(vertices, mesh.triangles)


def encode_mesh(mesh: Mesh, *, step: float) -> CompactMesh:
    """Positions rounded to multiples of `step` (a power of two, world's unit), triangles without loss.

    Raises ValueError where the step is no power of two, or so small that positions do not fit in 31 bits.
    """
    exponent = int(np.log2(step))
    if 2.0**exponent != step:
        raise ValueError(f"expected a step that is a power of two, found {step!r}")
    triangles = np.ascontiguousarray(mesh.triangles, np.int64)
    grid = np.round(np.asarray(mesh.vertices, np.float64) / step)
    used = np.unique(triangles)
    if len(used) and np.abs(grid[used]).max() >= 2**31:
        raise ValueError(f"step {step!r} is too small for positions up to {np.abs(mesh.vertices[used]).max()!r}")
    twins = twins_of(triangles)
    values, contexts, order, first, number = describe(triangles, twins, len(mesh.vertices))
    vertices = np.argsort(np.where(number < 0, len(number), number), kind="stable")[: len(used)]
    walk = encode_integers(values, contexts, CONTEXTS)
    corners = (first[:, None] + np.arange(3)) % 3
    renumbered = number[np.take_along_axis(triangles[order], corners, axis=1)]
    points = np.ascontiguousarray(grid[vertices], np.int64).reshape(-1, 3)
    origin = points[0] if len(points) else np.zeros(3, np.int64)
    residuals, sizes = predict(points - origin, renumbered, twins_of(renumbered))
    places = encode_integers(residuals.reshape(-1), sizes.reshape(-1), 3 * CONTEXT_SIZES)
    head = _HEADER.pack(_MAGIC, len(used), len(order), len(walk), len(places), exponent, *(int(v) for v in origin))
    parts = {"header": len(head), "triangles": len(walk), "positions": len(places)}
    data = head + walk.tobytes() + places.tobytes()
    return CompactMesh(data, vertices, order, first, parts, len(mesh.vertices) - len(used), step)


def decode_mesh(data: bytes) -> Mesh:
    """The mesh of the bytes of `encode_mesh`.  Raises ValueError where they are not such bytes or are cut short."""
    if len(data) < _HEADER.size or data[:4] != _MAGIC:
        raise ValueError("not a compact mesh")
    _, vertices, count, walk, places, exponent, *origin = _HEADER.unpack_from(data)
    if len(data) != _HEADER.size + walk + places:
        raise ValueError(f"compact mesh: expected {_HEADER.size + walk + places} bytes, found {len(data)}")
    body = np.frombuffer(data, np.uint8, offset=_HEADER.size)
    triangles = follow(body[:walk].copy(), count, vertices)
    wide = triangles.astype(np.int64)
    points = restore(body[walk:].copy(), wide, twins_of(wide), vertices)
    return Mesh.of((points + np.array(origin, np.int64)) * 2.0**exponent, triangles)


@njit(cache=True, nogil=True, error_model="numpy")
def _corner_lists(triangles, vertices):
    """Corners of each vertex: first (vertices + 1,), and (3 f,) numbers 3 t + k with triangles[t, k] = vertex."""
    first = np.zeros(vertices + 1, np.int64)
    for t in range(len(triangles)):
        for k in range(3):
            first[triangles[t, k] + 1] += 1
    for v in range(vertices):
        first[v + 1] += first[v]
    place, found = first.copy(), np.empty(3 * len(triangles), np.int64)
    for t in range(len(triangles)):
        for k in range(3):
            v = triangles[t, k]
            found[place[v]] = 3 * t + k
            place[v] += 1
    return first, found


@njit(cache=True, nogil=True, error_model="numpy")
def _expected(vertex, points, triangles, twins, first, found, guess):
    """Prediction of a vertex from those of lower numbers, into guess (3,) int64."""
    total, count = np.zeros(3, np.int64), 0
    near, beside = np.zeros(3, np.int64), 0
    for at in range(first[vertex], first[vertex + 1]):
        t, k = found[at] // 3, found[at] % 3
        a, b = triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3]
        for v in (a, b):
            if v < vertex:
                near += points[v]
                beside += 1
        twin = twins[3 * t + (k + 1) % 3]
        if a < vertex and b < vertex and twin >= 0:
            across = triangles[twin // 3, (twin % 3 + 2) % 3]
            if across < vertex:
                total += points[a] + points[b] - points[across]
                count += 1
    for axis in range(3):
        if count:
            guess[axis] = (2 * total[axis] + count) // (2 * count)
        elif beside:
            guess[axis] = (2 * near[axis] + beside) // (2 * beside)
        else:
            guess[axis] = points[vertex - 1, axis] if vertex else 0
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _size(value):
    size = 0
    while value >> size:
        size += 1
    return min(size, CONTEXT_SIZES - 1)


@njit(cache=True, nogil=True, error_model="numpy")
def predict(points, triangles, twins):
    """Residuals (v, 3) int64 of the positions against their predictions, and the contexts to code them in."""
    first, found = _corner_lists(triangles, len(points))
    residuals, contexts = np.empty_like(points), np.empty_like(points)
    guess, recent = np.zeros(3, np.int64), np.zeros(3, np.int64)
    for v in range(len(points)):
        _expected(v, points, triangles, twins, first, found, guess)
        for axis in range(3):
            contexts[v, axis] = axis * CONTEXT_SIZES + _size(recent[axis])
            residuals[v, axis] = points[v, axis] - guess[axis]
            recent[axis] = (recent[axis] + 2 * abs(residuals[v, axis]) + 1) // 2
    return residuals, contexts


@njit(cache=True, nogil=True, error_model="numpy")
def restore(data, triangles, twins, vertices):
    """Positions (v, 3) int64 from the coded residuals of `predict`."""
    first, found = _corner_lists(triangles, vertices)
    points = np.zeros((vertices, 3), np.int64)
    guess, recent = np.zeros(3, np.int64), np.zeros(3, np.int64)
    chances, state = new_chances(3 * CONTEXT_SIZES), decoder(data)
    for v in range(vertices):
        _expected(v, points, triangles, twins, first, found, guess)
        for axis in range(3):
            context = axis * CONTEXT_SIZES + _size(recent[axis])
            residual = code_integer(0, context, chances, state, data, True)
            points[v, axis] = guess[axis] + residual
            recent[axis] = (recent[axis] + 2 * abs(residual) + 1) // 2
    return points


def grid_step(mesh: Mesh, cameras: list[Camera], *, shift_px: float = 0.05) -> float:
    """Largest power of two (world's unit) whose grid moves no vertex by more than `shift_px` in any view."""
    used = np.unique(mesh.triangles)
    points = np.asarray(mesh.vertices, np.float64)[used]
    if not len(points):
        return 1.0
    extent = float(np.ptp(points, axis=0).max()) or 1.0
    step = 2.0 ** np.floor(np.log2(extent / 64))
    while shift(points, np.round(points / step) * step, cameras) > shift_px and step > extent * 2.0**-30:
        step *= 0.5
    return float(step)


def shift(points: np.ndarray, moved: np.ndarray, cameras: list[Camera]) -> float:
    """Largest distance in pixels, over all cameras that have it in front, between points (n, 3) and their copies."""
    worst = 0.0
    for camera in cameras:
        (before, depth), (after, depth_after) = camera.project(points), camera.project(moved)
        front = (depth > 0) & (depth_after > 0)
        if front.any():
            worst = max(worst, float(np.linalg.norm(after[front] - before[front], axis=1).max()))
    return worst


def own_step(mesh: Mesh, cameras: list[Camera]) -> float:
    """The step to code a mesh with: that of the grid its vertices lie on, so that nothing changes, where there is one
    at most 16 times finer than needed; else that of `grid_step`."""
    needed = grid_step(mesh, cameras)
    points = np.asarray(mesh.vertices, np.float64)[np.unique(mesh.triangles)]
    for halvings in range(-10, 5):
        step = needed * 0.5**halvings
        if np.array_equal(np.round(points / step) * step, points):
            return step
    return needed
