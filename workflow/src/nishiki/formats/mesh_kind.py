"""Whether a file that a capture names as a mesh or a range scan looks like one, from its first bytes."""

from __future__ import annotations

import re
from pathlib import Path

from nishiki.formats.files import Refused
from nishiki.formats.mesh_heading import expect_mesh_file
from nishiki.formats.problems import CaptureError, error
from nishiki.formats.text_tables import refusal

MESHES = (".ply", ".obj")
HEADING = 1 << 16


def expect_mesh(path: Path, file: str, where: str, *, scan: bool) -> None:
    """CaptureError unless the file looks like a mesh: mesh-format by its suffix, mesh-unreadable, mesh-empty.

    Only the heading of a PLY file and the start of an OBJ file are looked at. A scan may be points without faces.
    """
    known = MESHES[:1] if scan else MESHES
    if path.suffix.lower() not in known:
        what, remedy = "mesh file", "Convert it, for example with MeshLab"
        raise CaptureError(error("mesh-format", where, what, expected=" or ".join(known), found=file, remedy=remedy))
    with path.open("rb") as stream:
        start = stream.read(HEADING)
    if path.suffix.lower() == ".obj":
        if not re.search(rb"^v\s", start, re.MULTILINE):
            raise CaptureError(error("mesh-unreadable", where, "OBJ file without vertices", found=file))
        _expect_complete(path, file)
        return
    end = start.find(b"end_header")
    if not start.startswith(b"ply") or end < 0:
        found = f"{start[:8]!r}"
        what = "not a PLY file, or its heading is damaged"
        raise CaptureError(error("mesh-unreadable", where, what, expected="ply ... end_header", found=found))
    counts = {name: int(count) for name, count in re.findall(rb"element\s+(\w+)\s+(\d{1,18})", start[:end])}
    for name in (b"vertex",) if scan else (b"vertex", b"face"):
        if not counts.get(name):
            what, found = f"PLY file without {name.decode()} elements", file
            remedy = "Give a surface of triangles under turntable.mesh, or points under turntable.scans"
            raise CaptureError(error("mesh-empty", where, what, found=found, remedy=remedy))
    _expect_complete(path, file)


def _expect_complete(path: Path, file: str) -> None:
    """CaptureError (mesh-unreadable) where the file is too large, or cannot hold what its heading claims."""
    try:
        expect_mesh_file(path, file)
    except Refused as e:
        raise CaptureError(refusal(e, "mesh-unreadable")) from e
