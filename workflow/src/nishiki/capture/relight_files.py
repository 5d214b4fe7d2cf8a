"""Lamp directions from the files that the program Relight writes: `NAME.relight` (its project) and `info.json`.

A project lists the photographs, each with its file name and `direction` {x, y, z}; one with `skip` is not used. They
lie in its `folder`.
`info.json` of a relightable image holds `lights`, three numbers a photograph, without file names. A `.dome` holds the
lamps of a rig in order: `directions`, and `positions3d` in millimetres where `lightConfiguration` is `lights3d`, with
the width of the pictures in `imageWidth`. Axes as in `.lp`.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from nishiki.capture.lights import Lights, lights_from_vectors
from nishiki.formats.files import files_with, read_text
from nishiki.formats.problems import CaptureError, error, warning
from nishiki.formats.text_tables import expect_rows, reading

REMEDY = "Save the project again in Relight with its directions, or export a .lp file"


def find_relight(source: Path) -> Path | None:
    """The one project of Relight in a folder, else its info.json where that holds lights; None without either.

    CaptureError (layout-unknown) where there are several projects.
    """
    projects = files_with(source, (".relight",))
    if len(projects) > 1:
        found = ", ".join(p.name for p in projects[:5])
        what, remedy = "several .relight files", "Name one: --lights FILE"
        raise CaptureError(error("layout-unknown", str(source), what, found=found, remedy=remedy))
    if projects:
        return projects[0]
    info = source / "info.json"
    try:
        return info if info.is_file() and "lights" in _read(info) else None
    except CaptureError:
        return None


def read_relight(path: Path) -> Lights:
    """Lamps of a `.relight` project or of an `info.json`; the names of photographs that are skipped are left out.

    CaptureError: lights-missing, lights-unreadable, lights-many, and those of `lights_from_vectors`.
    """
    content = _read(path)
    notes, images = [], content.get("images")
    if isinstance(images, list):
        expect_rows(len(images), "lights", path.name, "lights")
        kept = [image for image in images if not (isinstance(image, dict) and image.get("skip") is True)]
        names = [_name(image, path.name) for image in kept]
        folder = content.get("folder")
        if isinstance(folder, str) and folder not in ("", "."):
            names = [f"{folder.rstrip('/')}/{name}" for name in names]
        vectors = [_vector([image["direction"].get(axis) for axis in "xyz"], path.name) for image in kept]
        if len(kept) < len(images):
            what = "photographs that the project skips were left out"
            notes.append(warning("photograph-unlisted", path.name, what, found=f"{len(images) - len(kept)}"))
    elif isinstance(content.get("lights"), list):
        numbers = content["lights"]
        expect_rows(len(numbers) // 3, "lights", path.name, "lights")
        if len(numbers) % 3:
            raise _unreadable(path.name, "three numbers a light", f"{len(numbers)} numbers")
        vectors = [_vector(numbers[i : i + 3], path.name) for i in range(0, len(numbers), 3)]
        names = [None] * len(vectors)
    else:
        raise _unreadable(path.name, "'images' with directions, or 'lights'", ", ".join(map(repr, content))[:80])
    lights = lights_from_vectors(names, np.array(vectors, np.float64).reshape(-1, 3), file=path.name)
    return Lights(lights.names, lights.files, lights.vectors, lights.directions, (*lights.warnings, *notes))


def read_dome(path: Path) -> tuple[Lights, float]:
    """Lamps of a `.dome` in order, without file names, and the width of its pictures in millimetres.

    The vectors are positions in millimetres where the width is above 0, else directions.
    CaptureError: lights-missing, lights-unreadable, lights-many, and those of `lights_from_vectors`.
    """
    content = _read(path)
    width = content.get("imageWidth", 0)
    known = isinstance(width, int | float) and not isinstance(width, bool) and 0 < width < 1e9
    near = content.get("lightConfiguration") == "lights3d" and known
    listed = content.get("positions3d" if near else "directions")
    if not isinstance(listed, list) or not listed:
        raise _unreadable(
            path.name, "'directions', or 'positions3d' with 'imageWidth'", ", ".join(map(repr, content))[:80]
        )
    expect_rows(len(listed), "lights", path.name, "lights")
    vectors = [
        _vector([each.get(axis) if isinstance(each, dict) else None for axis in "xyz"], path.name) for each in listed
    ]
    kind = "position_mm" if near else "direction"
    lights = lights_from_vectors([None] * len(vectors), np.array(vectors, np.float64), file=path.name, kind=kind)
    return lights, float(width) if near else 0.0


def _read(path: Path) -> dict:
    with reading(path.name, "lights"):
        text = read_text(path, "table_bytes")
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as e:
        found = "nested too deeply" if isinstance(e, RecursionError) else str(e)[:80]
        raise _unreadable(path.name, "JSON", found) from e
    if not isinstance(content, dict):
        raise _unreadable(path.name, "a JSON object", type(content).__name__)
    return content


def _name(image: object, file: str) -> str:
    """File name of one photograph of a project, whose direction is an object, too."""
    name = image.get("filename") if isinstance(image, dict) else None
    if not isinstance(name, str) or not name or not isinstance(image.get("direction"), dict):
        raise _unreadable(file, "images with 'filename' and 'direction'", repr(image)[:80])
    return name


def _vector(values: list, file: str) -> list[float]:
    if not all(isinstance(v, int | float) and not isinstance(v, bool) and abs(v) < 1e9 for v in values):
        raise _unreadable(file, "directions of three numbers", repr(values)[:80])
    return [float(v) for v in values]


def _unreadable(file: str, expected: str, found: str) -> CaptureError:
    what = "not a file of lights by Relight"
    return CaptureError(error("lights-unreadable", file, what, expected=expected, found=found, remedy=REMEDY))


def is_relight(path: Path) -> bool:
    """Whether a lights file is one of Relight's, by its suffix."""
    return path.suffix.lower() in (".relight", ".json")
