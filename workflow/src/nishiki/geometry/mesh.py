"""Triangle meshes as three arrays, and their vertex normals."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nishiki.formats.stored import load_arrays


@dataclass(frozen=True)
class Mesh:
    """vertices (v, 3) float64 in the world's unit; triangles (f, 3) int32, counter-clockwise seen from outside;
    normals (v, 3) float32, unit length, outwards."""

    vertices: np.ndarray
    triangles: np.ndarray
    normals: np.ndarray

    @classmethod
    def of(cls, vertices: np.ndarray, triangles: np.ndarray) -> Mesh:
        """A mesh with normals averaged over the triangles at each vertex, weighted by their areas."""
        vertices = np.ascontiguousarray(vertices, np.float64)
        triangles = np.ascontiguousarray(triangles, np.int32)
        return cls(vertices, triangles, vertex_normals(vertices, triangles))

    def save(self, path: Path) -> None:
        """Write as .npz, deterministic."""
        np.savez(path, vertices=self.vertices, triangles=self.triangles, normals=self.normals)

    @classmethod
    def load(cls, path: Path) -> Mesh:
        """Read what `save` wrote."""
        arrays = load_arrays(path)
        return cls(arrays["vertices"], arrays["triangles"], arrays["normals"])


def face_vectors(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(f, 3) float64: normals of the triangles, their lengths twice the areas."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def vertex_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(v, 3) float32, unit length; (0, 0, 1) at vertices that no triangle of positive area uses."""
    faces = face_vectors(vertices, triangles)
    sums = np.zeros_like(vertices)
    for axis in range(3):
        sums[:, axis] = sum(
            np.bincount(triangles[:, k], weights=faces[:, axis], minlength=len(vertices)) for k in range(3)
        )
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.where(lengths > 0, sums / np.where(lengths > 0, lengths, 1), [0.0, 0.0, 1.0]).astype(np.float32)
