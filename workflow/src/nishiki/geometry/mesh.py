"""Hold triangle meshes as three arrays, and read and write files of meshes and range scans."""

import io
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np

from nishiki.errors import UserError
from nishiki.formats.mesh_heading import KINDS, Element, expect_mesh_file, faces, ply_heading, read_heading
from nishiki.formats.stored import load_arrays
from nishiki.installation import optional


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh."""

    vertices: np.ndarray  # (v, 3) float64 in the world's unit
    triangles: np.ndarray  # (f, 3) int32, counter-clockwise seen from outside
    normals: np.ndarray  # (v, 3) float32, unit length, outwards

    @classmethod
    def of(cls, vertices: np.ndarray, triangles: np.ndarray) -> "Mesh":
        """Build a mesh with normals averaged over the triangles at each vertex, weighted by their areas."""
        vertices = np.ascontiguousarray(vertices, np.float64)
        triangles = np.ascontiguousarray(triangles, np.int32)
        return cls(vertices, triangles, vertex_normals(vertices, triangles))

    def save(self, path: Path) -> None:
        """Write as .npz, deterministic."""
        np.savez(path, vertices=self.vertices, triangles=self.triangles, normals=self.normals)

    @classmethod
    def load(cls, path: Path) -> "Mesh":
        """Read a file that `save` wrote."""
        arrays = load_arrays(path)
        return cls(arrays["vertices"], arrays["triangles"], arrays["normals"])


def row_numbers(rows: np.ndarray) -> np.ndarray:
    """Return the number (n,) of each row of an array (n, k) among its distinct rows, in their lexicographic order."""
    number, size = np.zeros(len(rows), np.int64), 1
    for column in rows.T:
        whole = column.dtype.kind == "i"
        place = column - column.min(initial=0) if whole else np.unique(column, return_inverse=True)[1]
        span = int(place.max(initial=0)) + 1
        if size * span > np.iinfo(np.int64).max:
            number = np.unique(number, return_inverse=True)[1]
            size = len(rows)
        number, size = number * np.int64(span) + place, size * span
    return np.unique(number, return_inverse=True)[1]


def face_vectors(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Compute normals (f, 3) float64 of the triangles, their lengths twice the areas."""
    first, *others = (vertices.take(triangles[:, k], axis=0) for k in range(3))
    for other in others:
        other -= first
    return np.cross(*others)


def vertex_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Compute unit normals (v, 3) float32; (0, 0, 1) at vertices that no triangle of positive area uses."""
    faces, sums, corners = face_vectors(vertices, triangles), np.zeros_like(vertices), triangles.T.astype(np.intp)
    for axis, parts in enumerate(np.ascontiguousarray(faces.T)):
        sums[:, axis] = sum(np.bincount(each, weights=parts, minlength=len(vertices)) for each in corners)
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.where(lengths > 0, sums / np.where(lengths > 0, lengths, 1), [0.0, 0.0, 1.0]).astype(np.float32)


TILT_STEP = 0.03  # tangent of the angle by which steps of a tilt are apart
MOST_STEPS = 127  # of a tilt along either axis: 8 bits, 75 degrees


def compute_tangents(normals: np.ndarray) -> np.ndarray:
    """Compute two unit vectors (v, 2, 3) across unit normals (v, 3).

    A reflection carries a fixed axis there, so that they change smoothly but near the opposite of that axis.
    """
    axis, across = np.array([0.36, 0.48, 0.8]), np.array([[0.8, -0.6, 0.0], [0.48, 0.64, -0.6]])
    sums = normals + axis
    share = 2 / np.maximum(np.einsum("vi,vi->v", sums, sums), 1e-12)
    return across - share[:, None, None] * (sums @ across.T)[:, :, None] * sums[:, None]


def measure_tilts(mesh: Mesh) -> np.ndarray:
    """Compute the steps (v, 2) int8 by which a mesh's normals are tilted against those of its triangles."""
    plain = vertex_normals(mesh.vertices, mesh.triangles).astype(float)
    along = np.maximum(np.einsum("vi,vi->v", plain, mesh.normals), 1e-3)
    steps = np.einsum("vki,vi->vk", compute_tangents(plain), mesh.normals) / (TILT_STEP * along[:, None])
    return np.clip(np.rint(steps), -MOST_STEPS, MOST_STEPS).astype(np.int8)


def tilt_normals(vertices: np.ndarray, triangles: np.ndarray, steps: np.ndarray) -> Mesh:
    """Build a mesh whose normals are tilted by steps (v, 2) against those of its triangles."""
    plain = vertex_normals(vertices, triangles)
    normals = plain + TILT_STEP * np.einsum("vk,vki->vi", steps.astype(float), compute_tangents(plain.astype(float)))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    return Mesh(vertices, triangles, np.where(steps.any(axis=1, keepdims=True), normals, plain))


def read_triangles(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read vertices (v, 3) float64 and triangles (f, 3) int64 of a PLY or OBJ file, as they are.

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
    """Read points (n, 3) float64 of a range scan, and its triangles (f, 3) or None where it is a cloud of points."""
    vertices, triangles = _read(path)
    if len(vertices) < 10:
        raise UserError(f"{path}: expected a range scan, found {len(vertices)} points. Remedy: export the scan again")
    return vertices, triangles if len(triangles) else None


class _Nothing:
    """A resolver that finds no file: a mesh may name pictures and materials anywhere on the disk; none is used."""

    file_name = None

    def get(self, name: str) -> bytes:
        raise FileNotFoundError(name)

    __getitem__ = get


def load_geometry(stream: BinaryIO, kind: str):
    """Load an open file of this kind, 'ply' or 'obj', with trimesh, vertices in the file's order.

    No other file is opened, whatever the mesh names. Any error of the library may come.
    """
    trimesh = optional("trimesh")
    options = {"process": False, "maintain_order": True, "skip_materials": True}
    if kind == "ply":
        stream = io.BytesIO(triangulate_ply(stream.read()))
    return trimesh.load(stream, file_type=kind, resolver=_Nothing(), **options)


def triangulate_ply(content: bytes) -> bytes:
    """Rewrite a binary PLY file whose faces have different numbers of corners, with fans of triangles.

    The library's reader takes one size of faces for granted. Other files are returned as they are. Texture coordinates
    of the corners go along, other properties of the faces and later elements do not. ValueError where the file ends
    within its faces.
    """
    text, elements, first = read_heading(io.BytesIO(content), "mesh.ply")
    names = [element.name for element in elements]
    before = elements[: names.index("face")] if "face" in names else []
    if text or not before or any(count for element in before for _, count, _ in element.properties):
        return content
    face = elements[len(before)]
    begin = first + sum(element.count * element.least for element in before)
    lists = _lists(content, begin, face, little=b"binary_little_endian" in content[:first])
    corners_of = next((each for name, each in lists.items() if name.startswith("vertex_ind")), None)
    if corners_of is None or len(np.unique(corners_of[0])) < 2:
        return content
    counts, starts, kind = corners_of
    fans = np.maximum(counts - 2, 0)
    owner = np.repeat(np.arange(len(counts)), fans)
    step = np.arange(len(owner)) - np.repeat(np.cumsum(fans) - fans, fans)
    corners = np.column_stack([np.zeros_like(step), step + 1, step + 2])
    data, heading = np.frombuffer(content, np.uint8), re.split(rb"\r?\n", content[:first])
    heading = heading[: next(i for i, line in enumerate(heading) if line.split()[:2] == [b"element", b"face"])]
    heading.append(f"element face {len(owner)}\nproperty list uchar {kind} vertex_indices".encode())
    columns = [np.full((len(owner), 1), 3, np.uint8), _values(data, starts[owner], corners, kind)]
    lengths, starts, kind = lists.get("texcoord", (counts, starts, kind))
    if (lengths == 2 * counts).all():
        heading.append(f"property list uchar {kind} texcoord".encode())
        pairs = (2 * corners[:, :, None] + np.arange(2)).reshape(-1, 6)
        columns += [np.full((len(owner), 1), 6, np.uint8), _values(data, starts[owner], pairs, kind)]
    return b"\n".join([*heading, b"end_header\n"]) + content[first:begin] + np.hstack(columns).tobytes()


def _values(data: np.ndarray, starts: np.ndarray, places: np.ndarray, kind: str) -> np.ndarray:
    """Gather the bytes (n, ..) of the values at places (n, k) of lists that begin at `starts` (n,)."""
    size = np.dtype(KINDS[kind]).itemsize
    return data[((starts[:, None] + size * places)[:, :, None] + np.arange(size)).reshape(len(starts), -1)]


def _lists(content: bytes, at: int, face: Element, *, little: bool) -> dict[str, tuple[np.ndarray, np.ndarray, str]]:
    """Locate each list property of the faces: its lengths, where its values begin, and their type."""
    order: Literal["little", "big"] = "little" if little else "big"
    sizes = [
        (name, np.dtype(KINDS[count or kind]).itemsize, np.dtype(KINDS[kind]).itemsize if count else 0)
        for name, count, kind in face.properties
    ]
    found: dict[str, list[int]] = {name: [] for name, count, _ in face.properties if count}
    for _ in range(face.count):
        for name, size, each in sizes:
            if each:
                length = int.from_bytes(content[at : at + size], order)
                found[name] += (length, at + size)
                at += length * each
            at += size
        if at > len(content):
            raise ValueError("it ends within its faces")
    kinds = {name: kind for name, _, kind in face.properties}
    pairs = {name: np.array(values, np.int64).reshape(-1, 2) for name, values in found.items()}
    return {name: (each[:, 0], each[:, 1], kinds[name]) for name, each in pairs.items()}


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
    """Write a binary little-endian PLY of a mesh, positions double, normals float; the stamp and the unit as comments.

    At the vertices, uv: texture coordinates (v, 2); attributes: more float values (v, k), NAME becomes the properties
    NAME_0, NAME_1, ..
    """
    more = {name: np.asarray(values, np.float32) for name, values in (attributes or {}).items()}
    names = [f"{name}_{k}" for name, values in more.items() for k in range(values.shape[1])]
    if uv is not None:
        more, names = {"uv": np.asarray(uv, np.float32), **more}, ["u", "v", *names]
    comments = [*(f"{name} {value}" for name, value in sorted(stamp.items())), f"unit {unit}"]
    properties = [*(f"double {axis}" for axis in "xyz"), *(f"float {name}" for name in ("nx", "ny", "nz", *names))]
    kinds = [
        ("place", "<f8", 3),
        ("normal", "<f4", 3),
        *((name, "<f4", values.shape[1]) for name, values in more.items()),
    ]
    points = np.empty(len(mesh.vertices), np.dtype(kinds))
    points["place"], points["normal"] = mesh.vertices, mesh.normals
    for name, values in more.items():
        points[name] = values
    text = ply_heading(len(mesh.vertices), len(mesh.triangles), properties, comments)
    Path(path).write_bytes(text.encode("utf-8") + points.tobytes() + faces(mesh.triangles))
