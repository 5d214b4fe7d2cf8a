"""The object as triangles: the zero of the distance field, evenly meshed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nishiki.packages import optional
from nishiki.simulate.turntable.shape import HIGH, LOW, PARTS, sample_layers, settle
from nishiki.threads import over_rows

_COARSE_MM = 5.0
_CREASE = 0.9  # cosine between the gradient and the mean normal of the triangles


@dataclass(frozen=True)
class Surface:
    """vertices (v, 3) float64 mm; triangles (f, 3) int32, counter-clockwise seen from outside; normals (v, 3) float64,
    unit, of the smooth surface; parts (v, parts) float64, distances from the parts, which decide the material."""

    vertices: np.ndarray
    triangles: np.ndarray
    normals: np.ndarray
    parts: np.ndarray


def make_surface(triangles: int) -> Surface:
    """The object with about so many triangles (within some 5 %)."""
    # The number of triangles grows with 1/spacing²; two coarser rounds tell the factor well enough.
    spacing = _COARSE_MM
    for _ in range(2):
        count = len(_march(spacing)[1])
        spacing = min(spacing * (count / triangles) ** 0.5, 8.0)
        if count > triangles / 6:
            break
    vertices, faces = _march(spacing)
    surface = _settled(vertices, faces)
    for _ in range(4):
        surface = _settled(_relaxed(surface), faces)
    return _without_slivers(surface, spacing)


def scanned(surface: Surface, *, noise_mm: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) and triangles as a scanner would deliver them: vertices off along the normal."""
    from nishiki.simulate.randomness import subkey

    random = np.random.default_rng(subkey(seed, "turntable scan"))
    offset = noise_mm * random.standard_normal(len(surface.vertices))
    return surface.vertices + offset[:, None] * surface.normals, surface.triangles


def _march(spacing: float) -> tuple[np.ndarray, np.ndarray]:
    optional("scikit-image")
    from skimage.measure import marching_cubes

    shape = [int(np.ceil((high - low) / spacing)) + 1 for low, high in zip(LOW, HIGH, strict=True)]
    field = np.empty(shape, np.float32)
    over_rows(sample_layers, shape[0], np.array(LOW), float(spacing), field)
    vertices, faces, _, _ = marching_cubes(field, 0.0, spacing=(spacing,) * 3, allow_degenerate=False)
    vertices = vertices.astype(np.float64) + LOW
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    if np.einsum("ij,ij->", a, np.cross(b, c)) < 0:  # six times the volume
        faces = faces[:, ::-1]
    return vertices, np.ascontiguousarray(faces, np.int32)


def _settled(vertices: np.ndarray, faces: np.ndarray) -> Surface:
    points = np.ascontiguousarray(vertices, np.float64)
    normals, parts = np.empty_like(points), np.empty((len(points), len(PARTS)))
    over_rows(settle, len(points), points, normals, parts, 3)
    # Where two parts meet in a crease the gradient is that of one of them only: there use the triangles'.
    mean = _triangle_normals(points, faces)
    crease = np.einsum("ij,ij->i", mean, normals) < _CREASE
    normals[crease] = mean[crease]
    return Surface(points, faces, normals, parts)


def _triangle_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(v, 3) unit normals: means over the triangles at each vertex, weighted by area."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    cross = np.cross(b - a, c - a)
    sums = np.zeros_like(vertices)
    for corner in range(3):
        for axis in range(3):
            sums[:, axis] += np.bincount(faces[:, corner], cross[:, axis], len(vertices))
    return sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-300)


def _relaxed(surface: Surface) -> np.ndarray:
    """Vertices moved half way to the mean of their neighbours, along the surface only: evens out the triangles."""
    count = len(surface.vertices)
    ends = np.concatenate([surface.triangles[:, [a, b]] for a in range(3) for b in range(3) if a != b])
    degree = np.bincount(ends[:, 0], minlength=count)
    mean = (
        np.column_stack([np.bincount(ends[:, 0], surface.vertices[ends[:, 1], axis], count) for axis in range(3)])
        / np.maximum(degree, 1)[:, None]
    )
    move = 0.5 * (mean - surface.vertices)
    return surface.vertices + move - np.einsum("ij,ij->i", move, surface.normals)[:, None] * surface.normals


def _without_slivers(surface: Surface, spacing: float) -> Surface:
    """Without triangles of no area worth the name, and without vertices that nothing uses."""
    a, b, c = (surface.vertices[surface.triangles[:, corner]] for corner in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    faces = surface.triangles[area > 1e-9 * spacing * spacing]
    used, faces = np.unique(faces, return_inverse=True)
    return Surface(
        surface.vertices[used],
        np.ascontiguousarray(faces.reshape(-1, 3), np.int32),
        surface.normals[used],
        surface.parts[used],
    )
