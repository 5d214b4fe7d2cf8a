"""Surfaces from files, with texture coordinates where they have them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nishiki.artifacts.provenance import file_digest
from nishiki.errors import UserError
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.mesh_files import load_geometry, read_triangles
from nishiki.packages import optional


@dataclass(frozen=True)
class FileSurface:
    """mesh; uv (v, 2) float64 or None; sha256 of the file."""

    mesh: Mesh
    uv: np.ndarray | None
    sha256: str


def read_surface(path: Path, *, sha256: str = "", smooth: bool = True) -> FileSurface:
    """A PLY or OBJ file. smooth: normals averaged over the triangles of a vertex; otherwise each triangle its own.

    UserError where it is no surface (see `geometry.mesh_files.read_triangles`) or not the file with this digest.
    """
    path = Path(path)
    vertices, triangles = read_triangles(path)
    digest = file_digest(path)
    if sha256 and digest != sha256:
        raise UserError(f"{path}: expected the file with SHA-256 {sha256}, found {digest}. Remedy: correct mesh.sha256")
    uv = _texture(path, len(vertices))
    if not smooth:
        vertices, uv = vertices[triangles.reshape(-1)], None if uv is None else uv[triangles.reshape(-1)]
        triangles = np.arange(len(vertices)).reshape(-1, 3)
    return FileSurface(Mesh.of(vertices, triangles), uv, digest)


def _texture(path: Path, count: int) -> np.ndarray | None:
    """Texture coordinates (count, 2), one pair a vertex as the reader splits them at seams, or None."""
    trimesh = optional("trimesh")

    with open(path, "rb") as stream:
        loaded = load_geometry(stream, path.suffix.lower().lstrip("."))
    parts = list(loaded.geometry.values()) if isinstance(loaded, trimesh.Scene) else [loaded]
    known = [getattr(getattr(part, "visual", None), "uv", None) for part in parts]
    if any(uv is None for uv in known):
        return None
    uv = np.concatenate([np.asarray(uv, np.float64) for uv in known])
    return uv if uv.shape == (count, 2) and np.isfinite(uv).all() else None
