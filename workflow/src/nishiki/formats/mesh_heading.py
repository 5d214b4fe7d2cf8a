"""Write headings of PLY files; check the size that one claims, before a reader allocates it.

PLY as described by G. Turk (The PLY Polygon File Format, Stanford, 1994).
"""

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np

from nishiki.formats.files import Refused, expect_bound, open_regular
from nishiki.formats.problems import CaptureError, refuse
from nishiki.formats.text_tables import refusal

FACE = np.dtype([("count", "u1"), ("corner", "<i4", 3)])


def ply_heading(vertices: int, triangles: int, properties: Iterable[str], comments: Iterable[str] = ()) -> str:
    """Write the text before the values of a binary little-endian PLY file.

    Parameters
    ----------
    vertices, triangles : int
        Their numbers.
    properties : iterable of str
        Type and name of each value of a vertex, such as `float x`.
    comments : iterable of str
        Lines for people; line ends in them become blanks.
    """
    lines = [
        *("ply", "format binary_little_endian 1.0", *(f"comment {each}".replace("\n", " ") for each in comments)),
        *(f"element vertex {vertices}", *(f"property {each}" for each in properties)),
        *(f"element face {triangles}", "property list uchar int vertex_indices", "end_header"),
    ]
    return "\n".join(lines) + "\n"


def faces(triangles: np.ndarray) -> bytes:
    """Encode triangles (t, 3), numbers of vertices."""
    corners = np.empty(len(triangles), FACE)
    corners["count"], corners["corner"] = 3, triangles
    return corners.tobytes()


KINDS = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
KINDS |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
KINDS |= {"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"}
FORMATS = ("ascii", "binary_little_endian", "binary_big_endian")
MESHES = (".ply", ".obj")
LONGEST = 1 << 16  # bytes of a heading
MOST = 256  # elements, or properties of one
REMEDY = "Export the mesh again"
UNREADABLE = "damaged PLY file: its heading cannot be read"


@dataclass(frozen=True)
class Element:
    """name, count; properties: (name, type of a list's count or '', type), types as in `KINDS`."""

    name: str
    count: int
    properties: list[tuple[str, str, str]] = field(default_factory=list)

    @property
    def least(self) -> int:
        """Least size of one element in bytes in a binary file, lists counted as empty."""
        return sum(np.dtype(KINDS[count or kind]).itemsize for _, count, kind in self.properties)


def expect_mesh(path: Path, file: str, where: str, *, scan: bool) -> None:
    """Raise CaptureError unless the file looks like a mesh: mesh-format by its suffix, mesh-unreadable, mesh-empty.

    Only the heading of a PLY file and the start of an OBJ file are looked at. A scan may be points without faces.
    """
    known = MESHES[:1] if scan else MESHES
    if path.suffix.lower() not in known:
        what, remedy = "mesh file", "Convert it, for example with MeshLab"
        refuse("mesh-format", where, what, expected=" or ".join(known), found=file, remedy=remedy)
    try:
        elements = expect_mesh_file(path, file)
    except Refused as e:
        raise CaptureError(refusal(e, "mesh-unreadable")) from e
    if path.suffix.lower() == ".obj":
        with path.open("rb") as stream:
            if not re.search(rb"^v\s", stream.read(LONGEST), re.MULTILINE):
                refuse("mesh-unreadable", where, "OBJ file without vertices", found=file)
        return
    for name in ("vertex",) if scan else ("vertex", "face"):
        if not sum(element.count for element in elements if element.name == name):
            remedy = "Give a surface of triangles under turntable.mesh, or points under turntable.scans"
            refuse("mesh-empty", where, f"PLY file without {name} elements", found=file, remedy=remedy)


def expect_mesh_file(path: Path, file: str) -> list[Element]:
    """Return the elements of a PLY file, none of an OBJ file.

    Refused where it is larger than is read, or a PLY file cannot hold what its heading claims. FileNotFoundError where
    there is none.
    """
    handle = open_regular(path, file)
    with os.fdopen(handle, "rb") as stream:
        size = os.fstat(handle).st_size
        expect_bound(size, "mesh_bytes", file)
        if Path(path).suffix.lower() != ".ply":
            return []
        text_file, elements, start = read_heading(stream, file)
    for name, limit in (("vertex", "mesh_vertices"), ("face", "mesh_faces")):
        expect_bound(sum(e.count for e in elements if e.name == name), limit, file)
    # in text a value is a digit and a blank; the very last needs no blank
    needed = sum(e.count * (2 * len(e.properties) if text_file else e.least) for e in elements)
    if needed > size - start + 1:
        counts = ", ".join(f"{e.count} {e.name[:20]}" for e in elements[:4])
        expected, found = f"{needed} bytes or more for {counts}", f"{size - start} bytes after its heading"
        what = "damaged PLY file: it is cut off, or its heading is wrong"
        raise Refused(file, what, expected=expected, found=found, remedy=REMEDY)
    return elements


def read_heading(stream: BinaryIO, file: str) -> tuple[bool, list[Element], int]:
    """Read whether a PLY file is text, its elements, and the offset of its data. Refused without a valid heading."""
    start = stream.read(LONGEST)
    end = start.find(b"end_header")
    if not start.startswith(b"ply") or end < 0:
        raise Refused(file, "damaged PLY file, or not a PLY file", expected="ply ... end_header", remedy=REMEDY)
    form, elements = "", []
    for line in start[:end].decode("latin-1").splitlines()[1:]:
        words = line.split()
        match words:
            case ["format", form, *_] if form in FORMATS:
                pass
            case ["element", name, count] if count.isascii() and count.isdecimal() and len(count) <= 18:
                elements.append(Element(name, int(count)))
            case ["property", "list", count, kind, name] if elements and {count, kind} <= KINDS.keys():
                elements[-1].properties.append((name, count, kind))
            case ["property", kind, name] if elements and kind in KINDS:
                elements[-1].properties.append((name, "", kind))
            case ["comment" | "obj_info", *_] | []:
                pass
            case _:
                raise Refused(file, UNREADABLE, found=repr(line[:60]), remedy=REMEDY)
    hollow = [e.name for e in elements if e.count and not e.properties]
    if form not in FORMATS or hollow or len(elements) > MOST or any(len(e.properties) > MOST for e in elements):
        found = f"elements {', '.join(hollow)} without properties" if hollow else f"format {form!r}"
        raise Refused(file, UNREADABLE, found=found, remedy=REMEDY)
    end += len(b"end_header")
    return form == "ascii", elements, end + (2 if start[end : end + 2] == b"\r\n" else 1)
