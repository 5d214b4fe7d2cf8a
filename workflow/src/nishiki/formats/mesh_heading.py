"""What a mesh file claims to hold, from its heading, before a reader allocates it.

PLY as described by G. Turk (The PLY Polygon File Format, Stanford, 1994).
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from nishiki.formats.files import Refused, expect_bound, open_regular

_BYTES = {"char": 1, "uchar": 1, "short": 2, "ushort": 2, "int": 4, "uint": 4, "float": 4, "double": 8}
_BYTES |= {"int8": 1, "uint8": 1, "int16": 2, "uint16": 2, "int32": 4, "uint32": 4, "float32": 4, "float64": 8}
FORMATS = ("ascii", "binary_little_endian", "binary_big_endian")
LONGEST = 1 << 16  # bytes of a heading
MOST = 256  # elements, or properties of one
REMEDY = "Export the mesh again"
UNREADABLE = "damaged PLY file: its heading cannot be read"


@dataclass(frozen=True)
class Element:
    """name, count; least: bytes of one in the file, lists counted as empty; properties: how many."""

    name: str
    count: int
    least: int
    properties: int


def expect_mesh_file(path: Path, file: str) -> None:
    """Refused where a PLY or OBJ file is larger than is read, or a PLY file cannot hold what its heading claims.

    FileNotFoundError where there is none.
    """
    handle = open_regular(path, file)
    with os.fdopen(handle, "rb") as stream:
        size = os.fstat(handle).st_size
        expect_bound(size, "mesh_bytes", file)
        if Path(path).suffix.lower() != ".ply":
            return
        text_file, elements, start = read_heading(stream, file)
    for name, limit in (("vertex", "mesh_vertices"), ("face", "mesh_faces")):
        expect_bound(sum(e.count for e in elements if e.name == name), limit, file)
    # in text a value is a digit and a blank; the very last needs no blank
    needed = sum(e.count * (2 * e.properties if text_file else e.least) for e in elements)
    if needed > size - start + 1:
        expected, found = f"{needed} bytes or more for {_counts(elements)}", f"{size - start} bytes after its heading"
        what = "damaged PLY file: it is cut off, or its heading is wrong"
        raise Refused(file, what, expected=expected, found=found, remedy=REMEDY)


def read_heading(stream: BinaryIO, file: str) -> tuple[bool, list[Element], int]:
    """Whether a PLY file is text, its elements, and where its data begin. Refused where the heading is none."""
    start = stream.read(LONGEST)
    end = start.find(b"end_header")
    if not start.startswith(b"ply") or end < 0:
        raise Refused(file, "damaged PLY file, or none", expected="ply ... end_header", remedy=REMEDY)
    form, elements = "", []
    for line in start[:end].decode("latin-1").splitlines()[1:]:
        words = line.split()
        match words:
            case ["format", form, *_] if form in FORMATS:
                pass
            case ["element", name, count] if count.isascii() and count.isdecimal() and len(count) <= 18:
                elements.append(Element(name, int(count), 0, 0))
            case ["property", "list", count, kind, _] if elements and {count, kind} <= _BYTES.keys():
                elements[-1] = _with_property(elements[-1], _BYTES[count])
            case ["property", kind, _] if elements and kind in _BYTES:
                elements[-1] = _with_property(elements[-1], _BYTES[kind])
            case ["comment" | "obj_info", *_] | []:
                pass
            case _:
                raise Refused(file, UNREADABLE, found=repr(line[:60]), remedy=REMEDY)
    hollow = [e.name for e in elements if e.count and not e.properties]
    if form not in FORMATS or hollow or len(elements) > MOST or any(e.properties > MOST for e in elements):
        found = f"elements {', '.join(hollow)} without properties" if hollow else f"format {form!r}"
        raise Refused(file, UNREADABLE, found=found, remedy=REMEDY)
    return form == "ascii", elements, end + len(b"end_header") + 1


def _with_property(element: Element, size: int) -> Element:
    return Element(element.name, element.count, element.least + size, element.properties + 1)


def _counts(elements: list[Element]) -> str:
    return ", ".join(f"{e.count} {e.name[:20]}" for e in elements[:4])
