"""The direction of the weft at every vertex of a surface: from texture coordinates, or from a given direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nishiki.errors import UserError
from nishiki.render.cloth.transport import transported

FLAT = 1e-6
"""Sine of the angle below which a direction counts as parallel to the normal, relative area below which texture
coordinates of a triangle count as degenerate."""


@dataclass(frozen=True)
class TangentField:
    """weft (v, 3) float64: unit vectors across the normals; filled (v,) bool: transported from the neighbours, since
    nothing was known there; arbitrary: vertices in parts of the surface where nothing was known at all."""

    weft: np.ndarray
    filled: np.ndarray
    arbitrary: int


def from_texture(
    vertices: np.ndarray, triangles: np.ndarray, normals: np.ndarray, uv: np.ndarray, *, turn: float = 0.0
) -> TangentField:
    """Weft along u: texture coordinates (v, 2), u along the weft, v along the warp.

    In every triangle the surface's gradients of u and v are solved for; the weft is the direction that halves the error
    where u and v are not at right angles on the surface (cloth shears): the normalised sum of dP/du and of dP/dv turned
    back by 90 degrees. turn: radians by which the cloth is turned on the surface, from weft to warp. Triangles without
    area, on the surface or in (u, v), do not count; mirrored ones (u, v running the other way round) do.
    """
    uv = np.asarray(uv, np.float64)
    if uv.shape != (len(vertices), 2) or not np.isfinite(uv).all():
        raise UserError(f"tangent field: expected finite texture coordinates ({len(vertices)}, 2), found {uv.shape}")
    a, b, c = (np.asarray(vertices, np.float64)[triangles[:, k]] for k in range(3))
    (u1, v1), (u2, v2) = ((uv[triangles[:, k]] - uv[triangles[:, 0]]).T for k in (1, 2))
    area, flat = u1 * v2 - u2 * v1, np.cross(b - a, c - a)
    size = np.linalg.norm(flat, axis=1)
    scale = np.abs(u1 * v2) + np.abs(u2 * v1)
    known = (np.abs(area) > FLAT * scale) & (size > 0)
    safe = np.where(known, area, 1.0)[:, None]
    along_u = ((b - a) * v2[:, None] - (c - a) * v1[:, None]) / safe
    along_v = ((c - a) * u1[:, None] - (b - a) * u2[:, None]) / safe
    face = flat / np.where(size > 0, size, 1)[:, None]
    # Warp turned back by 90 degrees, the way round that (u, v) itself goes.
    back = -np.cross(face, along_v) * np.sign(safe)
    weft = _unit(along_u) + _unit(back)
    weft = np.where(known[:, None], _unit(weft), 0.0)
    return _settled(
        vertices, triangles, normals, _gathered(weft, np.where(known, size, 0), triangles, len(vertices)), turn
    )


def from_direction(
    vertices: np.ndarray, triangles: np.ndarray, normals: np.ndarray, direction: np.ndarray, *, turn: float = 0.0
) -> TangentField:
    """Weft along a direction (3,), or one for every vertex (v, 3), made orthogonal to the normals.

    Where the direction is parallel to the normal, zero or not finite, the weft is transported from the neighbours.
    """
    given = np.array(np.broadcast_to(np.asarray(direction, np.float64), np.shape(vertices)))
    given[~np.isfinite(given).all(axis=1)] = 0.0
    return _settled(vertices, triangles, normals, _unit(given), turn)


def _settled(vertices, triangles, normals, given: np.ndarray, turn: float) -> TangentField:
    """Directions (v, 3) of about unit length made tangential; transported where nothing is left of them; turned."""
    normals = _unit(np.asarray(normals, np.float64))
    across = given - np.sum(given * normals, axis=1, keepdims=True) * normals
    length = np.linalg.norm(across, axis=1)
    known = length > FLAT
    weft, arbitrary = _unit(across), 0
    if not known.all():
        weft, arbitrary = transported(len(vertices), triangles, normals, weft, known)
    if turn:
        weft = np.cos(turn) * weft + np.sin(turn) * np.cross(normals, weft)
    return TangentField(weft, ~known, arbitrary)


def _gathered(directions: np.ndarray, weights: np.ndarray, triangles: np.ndarray, count: int) -> np.ndarray:
    """Mean direction (count, 3) at the vertices of the triangles' (f, 3), by weight; unit length or 0."""
    sums = np.zeros((count, 3))
    for axis in range(3):
        for k in range(3):
            sums[:, axis] += np.bincount(triangles[:, k], weights=weights * directions[:, axis], minlength=count)
    total = sum(np.bincount(triangles[:, k], weights=weights, minlength=count) for k in range(3))
    # Directions that cancel each other say nothing.
    return np.where((np.linalg.norm(sums, axis=1) > FLAT * total)[:, None], _unit(sums), 0.0)


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 0, vectors / np.where(length > 0, length, 1), 0.0)
