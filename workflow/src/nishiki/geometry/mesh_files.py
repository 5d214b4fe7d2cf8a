"""Files of meshes and of range scans: PLY and OBJ in, binary PLY out."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np

from nishiki.errors import UserError
from nishiki.formats.mesh_heading import expect_mesh_file
from nishiki.geometry.mesh import Mesh
from nishiki.packages import optional


def read_triangles(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) float64 and triangles (f, 3) int64 of a PLY or OBJ file, as they are.

    Polygons of more than three corners are cut into fans. Raises UserError where the file is damaged, holds no
    triangles, names vertices that are not there, or has coordinates that are not finite.
    """
    vertices, triangles = _read(path)
    if not len(triangles):
        raise UserError(
            f"{path}: expected a surface of triangles, found {len(vertices)} points without faces. Remedy: give points "
            "as scans (turntable.scans), or make a surface of them first"
        )
    lowest, highest = int(triangles.min()), int(triangles.max())
    if lowest < 0 or highest >= len(vertices):
        raise UserError(
            f"{path}: a face names vertex {highest if highest >= len(vertices) else lowest}, expected 0 to "
            f"{len(vertices) - 1}. Remedy: export the mesh again"
        )
    return vertices, triangles


def read_points(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Points (n, 3) float64 of a range scan, and its triangles (f, 3) or None where it is a cloud of points."""
    vertices, triangles = _read(path)
    if len(vertices) < 10:
        raise UserError(f"{path}: expected a range scan, found {len(vertices)} points. Remedy: export the scan again")
    return vertices, triangles if len(triangles) else None


class _Nothing:
    """Finds no file: pictures and materials that a mesh names may lie anywhere on the disk, and none is used."""

    file_name = None

    def get(self, name: str) -> bytes:
        raise FileNotFoundError(name)

    __getitem__ = get


def load_geometry(stream: BinaryIO, kind: str):
    """What trimesh finds in an open file of this kind, 'ply' or 'obj', vertices in the file's order; no other file is
    opened, whatever the mesh names. Any error of the library may come."""
    trimesh = optional("trimesh")

    options = {"process": False, "maintain_order": True, "skip_materials": True}
    return trimesh.load(stream, file_type=kind, resolver=_Nothing(), **options)


def _read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    trimesh = optional("trimesh")

    kind = Path(path).suffix.lower().lstrip(".")
    if kind not in ("ply", "obj"):
        raise UserError(f"{path}: expected a .ply or .obj file. Remedy: convert it, for example with MeshLab")
    try:
        expect_mesh_file(path, str(path))
        with open(path, "rb") as stream:
            loaded = load_geometry(stream, kind)
    except FileNotFoundError:
        raise UserError(f"{path}: file not found") from None
    except UserError:
        raise
    except Exception as error:  # whatever a damaged file makes the reader stumble over
        raise UserError(f"{path}: damaged {kind.upper()} file ({error}). Remedy: export the mesh again") from None
    if isinstance(loaded, trimesh.Scene):
        parts = [part for part in loaded.geometry.values() if hasattr(part, "faces")]
        vertices, triangles, count = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], 0
        for part in parts:
            vertices.append(np.asarray(part.vertices))
            triangles.append(np.asarray(part.faces) + count)
            count += len(part.vertices)
        vertices, triangles = np.concatenate(vertices), np.concatenate(triangles)
    else:
        vertices, triangles = np.asarray(loaded.vertices), np.asarray(getattr(loaded, "faces", np.empty((0, 3))))
    if not len(vertices):
        raise UserError(f"{path}: no vertices in it. Remedy: export the mesh again")
    bad = ~np.isfinite(vertices).all(axis=1)
    if bad.any():
        raise UserError(
            f"{path}: {int(bad.sum())} of {len(vertices)} vertices are not finite, the first is number "
            f"{int(np.argmax(bad))}. Remedy: remove them (MeshLab: Remove Vertices wrt NaN) and export again"
        )
    return np.array(vertices, np.float64), np.array(triangles, np.int64).reshape(-1, 3)


def write_ply(
    path: Path,
    mesh: Mesh,
    *,
    stamp: Mapping[str, str],
    unit: str,
    uv: np.ndarray | None = None,
    attributes: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Binary little-endian PLY of a mesh, positions double, normals float; the stamp and the unit as comments.

    At the vertices, uv: texture coordinates (v, 2); attributes: more float values (v, k), NAME becomes the properties
    NAME_0, NAME_1, ..
    """
    more = {name: np.asarray(values, np.float32) for name, values in (attributes or {}).items()}
    names = [f"{name}_{k}" for name, values in more.items() for k in range(values.shape[1])]
    if uv is not None:
        more, names = {"uv": np.asarray(uv, np.float32), **more}, ["u", "v", *names]
    comments = [f"comment {name} {value}" for name, value in sorted(stamp.items())]
    heading = [
        "ply",
        "format binary_little_endian 1.0",
        *comments,
        f"comment unit {unit}",
        f"element vertex {len(mesh.vertices)}",
        *(f"property double {axis}" for axis in "xyz"),
        *(f"property float n{axis}" for axis in "xyz"),
        *(f"property float {name}" for name in names),
        f"element face {len(mesh.triangles)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    kinds = [
        ("place", "<f8", 3),
        ("normal", "<f4", 3),
        *((name, "<f4", values.shape[1]) for name, values in more.items()),
    ]
    points = np.empty(len(mesh.vertices), np.dtype(kinds))
    points["place"], points["normal"] = mesh.vertices, mesh.normals
    for name, values in more.items():
        points[name] = values
    faces = np.empty(len(mesh.triangles), np.dtype([("count", "u1"), ("corner", "<i4", 3)]))
    faces["count"], faces["corner"] = 3, mesh.triangles
    text = "\n".join(line.replace("\n", " ") for line in heading) + "\n"
    Path(path).write_bytes(text.encode("utf-8") + points.tobytes() + faces.tobytes())
