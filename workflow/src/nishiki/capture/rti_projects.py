"""Read RTI projects of other programs: Relight and RelightLab, and RTIBuilder.

Relight: projects (`.relight`), `.dome` and `info.json`. A project lists its photographs, each with its file name; one
with `skip` is not used, nor one with `visible` false. They lie in its `folder`. Directions stand with the photographs
(`direction`) in old projects, else in `dome.directions`: one for each photograph that is not skipped. A dome, in a
project or in a file of its own, has in millimetres `positionsSphere` where its `lightConfiguration` is `spherical`
(else `domeDiameter` and `verticalOffset` give them), `positions3d` where it is `lights3d`, the width of the pictures in
`imageWidth`, and in `ledAdjust` factors that even the lamps out. `crop` is in pixels, turned about the middle of the
picture; `aligns` hold in `offsets` the place (column, row) in each photograph of what the first one shows at 0, 0;
their mean counts. `info.json` of a relightable image holds `lights`, three numbers a photograph, without file names,
and perhaps `pixelSizeInMM`. Axes as in `.lp`.

RTIBuilder: a project has `assembly-files` (the `.lp` that was made from mirror spheres or a dome, and pictures of the
spheres), `jpeg-exports` (the photographs that it worked on), and perhaps `cropped-files`, `edited-captures`,
`original-captures` (raw or TIFF) and `finished-files` (`.ptm`, `.rti`).
"""

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nishiki.capture.lights import Lights, lights_from_vectors
from nishiki.capture.options import ConvertOptions
from nishiki.capture.stated_lights import StatedLights
from nishiki.formats.files import files_with, json_object, leads_out, read_text, same_name
from nishiki.formats.images import LEAST_SHIFT
from nishiki.formats.picture_files import IMAGE_SUFFIXES
from nishiki.formats.problems import CaptureError, Problem, error, expect_one, left_out, refuse, warning
from nishiki.formats.text_tables import expect_rows, reading

REMEDY = "Save the project again in Relight with its directions, or export a .lp file"
CROPPED = "project-crop"
RELIGHT_SUFFIXES = (".relight", ".json", ".dome")


def find_relight(source: Path) -> Path | None:
    """Find the one project of Relight in a folder, else its `.dome`, else its info.json where that holds lights.

    None without these. CaptureError (layout-unknown) where there are several projects, or domes.
    """
    for suffix in (".relight", ".dome"):
        hidden = source / suffix  # a project that was saved without a name
        files = [*files_with(source, (suffix,)), *([hidden] if hidden.is_file() else [])]
        if one := expect_one(files, source, f"several {suffix} files", "Name one: --lights FILE"):
            return one
    info = source / "info.json"
    try:
        return info if info.is_file() and "lights" in _read(info) else None
    except CaptureError:
        return None


def read_relight(path: Path, kind: str | None = None, width_mm: float | None = None) -> StatedLights:
    """Read the lamps of a `.relight` project, a `.dome` or an `info.json`.

    kind : `direction` or `position_mm` where the user says which, else as the file is configured; width_mm : of the
    photographs, in place of the file's. CaptureError: lights-missing, lights-unreadable, lights-many,
    photograph-missing and those of `lights_from_vectors`.
    """
    content = _read(path)
    images = content.get("images")
    if isinstance(images, list):
        return _read_project_lights(content, images, path, kind, width_mm)
    if isinstance(content.get("lights"), list):
        numbers = content["lights"]
        expect_rows(len(numbers) // 3, "lights", path.name, "lights")
        if len(numbers) % 3:
            raise _unreadable(path.name, "three numbers a light", f"{len(numbers)} numbers")
        rows = [_vector(numbers[i : i + 3], path.name) for i in range(0, len(numbers), 3)]
        lights = lights_from_vectors([None] * len(rows), np.array(rows, float).reshape(-1, 3), file=path.name)
        return StatedLights(lights, pitch_mm=_positive(content, "pixelSizeInMM"))
    lamps = _read_dome_lamps(content, path, kind, width_mm)
    count = len(lamps.vectors)
    return lamps.state([None] * count, list(range(count)), _strengths(content, count, path.name), path.name)


def _read_project_lights(
    content: dict, images: list, path: Path, kind: str | None, width_mm: float | None
) -> StatedLights:
    """Read photographs that are neither skipped nor hidden and have a lamp, with these lamps."""
    expect_rows(len(images), "lights", path.name, "lights")
    names: list[str] = []
    for image in images:
        name = image.get("filename") if isinstance(image, dict) else None
        if not isinstance(name, str) or not name:
            raise _unreadable(path.name, "images with 'filename'", repr(image)[:80])
        names.append(name)
    stated_dome = content.get("dome")
    dome = stated_dome if isinstance(stated_dome, dict) else {}
    taken = [i for i, image in enumerate(images) if image.get("skip") is not True]
    own = [images[i].get("direction") for i in taken]
    if own and all(isinstance(each, dict) for each in own) and any(each.get(axis) for each in own for axis in "xyz"):
        dome = {"imageWidth": dome.get("imageWidth"), "directions": own}
    if not _vectors(dome.get("directions"), path.name).size and not _vectors(dome.get("positions3d"), path.name).size:
        remedy = "Find the lights in Relight and save it again, or give the directions with --lights FILE"
        refuse("lights-unreadable", path.name, "a project without directions of its lamps", remedy=remedy)
    lamps = _read_dome_lamps(dome, path, kind, width_mm)
    strengths = _strengths(dome, len(lamps.vectors), path.name)
    stated = taken if len(lamps.vectors) == len(taken) else list(range(len(images)))
    if len(lamps.vectors) != len(stated):
        expected = f"{len(taken)} lamps, one for each photograph that is not skipped"
        raise _unreadable(path.name, expected, f"{len(lamps.vectors)}")
    dark = [i for i, vector in zip(stated, lamps.vectors, strict=True) if not vector.any()]
    used = [k for k, i in enumerate(stated) if i in taken and images[i].get("visible") is not False and i not in dark]
    notes = []
    notes += left_out([names[i] for i in dark], path.name, "photographs without a direction")
    if skipped := len(images) - len(used) - len(dark):
        what = "photographs that the project skips were left out"
        notes.append(warning("photograph-unlisted", path.name, what, found=f"{skipped}"))
    region, more = _crop(content, path.name)
    shifts, remarks = _shifts(content, [stated[k] for k in used], path.name)
    notes += [*more, *remarks]
    folder = content.get("folder")
    prefix = f"{folder.rstrip('/')}/" if isinstance(folder, str) and folder.strip("/") not in ("", ".") else ""
    files: list[str | None] = [f"{prefix}{names[stated[k]]}" for k in used]
    stated_lights = lamps.state(files, used, strengths, path.name)
    lights = replace(stated_lights.lights, warnings=(*stated_lights.lights.warnings, *notes))
    pitch_mm = _positive(content, "pixelSize")
    return replace(stated_lights, lights=lights, pitch_mm=pitch_mm, region=region, shifts=shifts)


class _DomeLamps(NamedTuple):
    """Vectors (lamps, 3) of a dome, positions in mm or directions; width of the pictures in millimetres or 0."""

    vectors: np.ndarray
    kind: str
    width_mm: float
    directions: np.ndarray | None = None  # where vectors are positions that the photographs have to bear out, else None

    def state(self, files: list[str | None], used: list[int], strengths: np.ndarray | None, file: str) -> StatedLights:
        """Return the used lamps of these photographs as stated lights."""
        far = None if self.directions is None else self.directions[used]
        kind = self.kind if far is None else "position_mm"
        lights = lights_from_vectors(files, self.vectors[used], file=file, kind=kind)
        strengths = None if strengths is None else strengths[used]
        stated = StatedLights(lights, self.kind, self.width_mm, intensities=strengths, rival=far)
        return replace(stated, open_kind=far is not None, scaled=far is not None)


def _read_dome_lamps(dome: dict, path: Path, kind: str | None, width_mm: float | None) -> _DomeLamps:
    """Read positions where the file or the user sets them and the width is known, else directions.

    A dome that states positions or a diameter, but no width, or that near lamps are not wanted, leaves it open.
    """
    width = width_mm or _positive(dome, "imageWidth")
    configured = str(dome.get("lightConfiguration"))
    directions = _vectors(dome.get("directions"), path.name)
    diameter = _positive(dome, "domeDiameter") or _positive(dome, "diameter")
    keys = ("positions3d", "positions") if configured == "lights3d" else ("positionsSphere", "positions", "positions3d")
    stated = [_vectors(dome.get(key), path.name) for key in keys]
    positions = next((each for each in stated if each.any()), np.zeros((0, 3)))
    if not positions.size and diameter and directions.any():
        lengths = np.maximum(np.linalg.norm(directions, axis=1), 1e-9)
        offset = dome.get("verticalOffset")
        height = float(offset) if isinstance(offset, int | float) else 0.0
        positions = directions / lengths[:, None] * (diameter / 2) + [0, 0, height]
        positions[~directions.any(axis=1)] = 0
    near = kind == "position_mm" or (kind is None and configured in ("spherical", "lights3d"))
    if positions.size and near and (width or kind):
        return _DomeLamps(positions, "position_mm", width)
    if kind == "position_mm" or not directions.size:
        expected, found = "'directions', or positions with 'imageWidth'", ", ".join(map(repr, dome))[:80]
        raise _unreadable(path.name, expected, found)
    if positions.shape == directions.shape and kind is None:
        return _DomeLamps(positions, "direction", width, directions)
    return _DomeLamps(directions, "direction", width)


def _strengths(dome: dict, count: int, file: str) -> np.ndarray | None:
    """Compute relative strengths (lamps, 3), the inverse of the factors in `ledAdjust`; None without."""
    factors = dome.get("ledAdjust")
    if not isinstance(factors, list) or not factors:
        return None
    values = [[each.get(c) if isinstance(each, dict) else None for c in "rgb"] for each in factors]
    numbers = np.array([_vector(row, file) for row in values])
    if len(numbers) != count or not (numbers > 0).all():
        raise _unreadable(file, f"{count} factors above 0 in 'ledAdjust'", f"{len(numbers)}")
    return 1 / numbers if np.ptp(numbers) > 0 else None


def _crop(content: dict, file: str) -> tuple[tuple[int, int, int, int] | None, list[Problem]]:
    """Compute row, column, rows, columns of the upright rectangle around a project's crop; None for no crop."""
    crop = content.get("crop")
    size = np.array([_positive(content, "width"), _positive(content, "height")])
    if not isinstance(crop, dict) or not size.all() or not _positive(crop, "width") or not _positive(crop, "height"):
        return None, []
    left, top, width, height, angle = _vector(
        [crop.get(k, 0) for k in ("left", "top", "width", "height", "angle")], file
    )
    turn = math.radians(angle)
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    corners = np.array([[left, top], [left + width, top], [left, top + height], [left + width, top + height]])
    upright = (corners - np.abs(rotation) @ size / 2) @ rotation + size / 2
    first = np.clip(np.floor(upright.min(axis=0) + 1e-6), 0, size).astype(int)
    last = np.clip(np.ceil(upright.max(axis=0) - 1e-6), 0, size).astype(int)
    if not (last > first).all() or (last - first == size).all():
        return None, []
    region = int(first[1]), int(first[0]), int(last[1] - first[1]), int(last[0] - first[0])
    turned = f", around the rectangle that it turns by {angle:g} degrees" if angle else ""
    what = f"the crop of the project is the region of interest{turned}"
    return region, [warning(CROPPED, file, what, found="row {}, column {}, {} rows, {} columns".format(*region))]


def _shifts(content: dict, used: list[int], file: str) -> tuple[np.ndarray | None, list[Problem]]:
    """Return the shifts (used, 2) of photographs that a project states, None for none, and notes about them."""
    shifts = []
    aligns = content.get("aligns")
    for align in aligns if isinstance(aligns, list) else []:
        offsets = align.get("offsets") if isinstance(align, dict) else None
        if isinstance(offsets, list) and len(offsets) > max(used, default=-1):
            shifts.append([_vector(offsets[i][:2] if isinstance(offsets[i], list) else [], file) for i in used])
    if not shifts or np.abs(largest := np.mean(shifts, axis=0)).max(initial=0.0) < LEAST_SHIFT:
        return None, []
    what = "the project aligns its photographs; they are moved back by its shifts"
    return largest, [warning("project-aligns", file, what, found=f"shifts of up to {np.abs(largest).max():.1f} pixels")]


def _read(path: Path) -> dict:
    with reading(path.name, "lights"):
        text = read_text(path, "table_bytes")
    try:
        return json_object(text)
    except ValueError as e:
        raise _unreadable(path.name, "a JSON object", str(e)[:80]) from e


def _vectors(listed: object, file: str) -> np.ndarray:
    """Parse a list of objects with x, y and z as (n, 3); (0, 3) where there is no list."""
    if not isinstance(listed, list):
        return np.zeros((0, 3))
    expect_rows(len(listed), "lights", file, "lights")
    rows = [_vector([each.get(axis) if isinstance(each, dict) else None for axis in "xyz"], file) for each in listed]
    return np.array(rows, np.float64).reshape(-1, 3)


def _vector(values: list, file: str) -> list[float]:
    if not all(isinstance(v, int | float) and not isinstance(v, bool) and abs(v) < 1e9 for v in values):
        raise _unreadable(file, "directions of three numbers", repr(values)[:80])
    return [float(v) for v in values]


def _positive(content: dict, key: str) -> float:
    """Parse a number above 0; 0 where there is none."""
    value: Any = content.get(key)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < 1e9 else 0.0


def _unreadable(file: str, expected: str, found: str) -> CaptureError:
    what = "not a file of lights by Relight"
    return CaptureError(error("lights-unreadable", file, what, expected=expected, found=found, remedy=REMEDY))


ASSEMBLY, FINISHED = "assembly-files", "finished-files"
PHOTOGRAPHS = ("jpeg-exports", "cropped-files", "edited-captures", "original-captures")
"""Folders that may hold the photographs, in search order."""


def find_rti_project(source: Path, options: ConvertOptions) -> dict[str, Path] | None:
    """Find the folders of a project by name, of which `assembly-files` or `jpeg-exports` is one; None without.

    None, too, where only the folder itself holds pictures: those of the project may be lost, or never were.
    """
    present = {path.name.casefold(): path for path in source.iterdir() if path.is_dir()}
    known = (*PHOTOGRAPHS, ASSEMBLY, FINISHED)
    folders = {name: present[name] for name in known if name in present and not leads_out(present[name], source)}
    if not {ASSEMBLY, PHOTOGRAPHS[0]} & set(folders):
        return None
    filled = any(_stems_in(folders[name]) for name in PHOTOGRAPHS if name in folders)
    return folders if filled or not _stems_in(source) else None


def find_project_lights(source: Path, folders: dict[str, Path]) -> Path:
    """Find the only `.lp` in `assembly-files`, or in the project's own folder. CaptureError (layout-unknown)."""
    for place in (folders.get(ASSEMBLY, source), source):
        files = files_with(place, (".lp",))
        if one := expect_one(files, place, "several .lp files", f"Name one: --lights {next(iter(files), '')}"):
            return one
    what = f"an RTIBuilder project without a .lp file in {ASSEMBLY}"
    refuse("layout-unknown", str(source), what, remedy=_recovery(folders, "Name one with --lights"))


def find_project_photographs(source: Path, folders: dict[str, Path], lights: Lights) -> tuple[Path, list[str]]:
    """Find the folder that the lights file names, if it holds its photographs, else the first that does; and others.

    CaptureError (photograph-missing) where none does.
    """
    named = [part.casefold() for file in lights.files if file for part in re.split(r"[\\/]", file)[-2:-1]]
    asked = {same_name(light) for light in lights.names}
    places = sorted((name for name in PHOTOGRAPHS if name in folders), key=lambda name: -named.count(name))
    counts = {name: len(asked & _stems_in(folders[name])) for name in places}
    whole = [name for name, count in counts.items() if count == len(asked)]
    if whole:
        return folders[whole[0]], whole[1:]
    found = ", ".join(f"{count} in {name}" for name, count in counts.items()) or "no folder of photographs"
    what = f"an RTIBuilder project without the {len(asked)} photographs that the .lp names"
    refuse("photograph-missing", str(source), what, found=found, remedy=_recovery(folders, "Copy them back"))


def _recovery(folders: dict[str, Path], remedy: str) -> str:
    """Return a remedy, and the finished image of a project where there is one."""
    finished = files_with(folders[FINISHED], (".rti", ".ptm")) if FINISHED in folders else []
    return f"{remedy}, or convert {finished[0]}, from which pictures are rendered" if finished else remedy


def _stems_in(folder: Path) -> set[str]:
    """List names of the pictures in a folder, without suffix."""
    return {same_name(path.stem) for path in files_with(folder, IMAGE_SUFFIXES)}
