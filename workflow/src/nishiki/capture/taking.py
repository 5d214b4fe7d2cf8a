"""Copy or link photographs into a capture folder, with their names and channels."""

import csv
import io
import os
import shutil
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from nishiki.capture.frames import EXPOSURE_COLUMNS, LIT_ROLES
from nishiki.formats.coding import LUMA_WEIGHTS, RGB, choose_coding
from nishiki.formats.images import read_codes, read_exif, read_header
from nishiki.formats.masks import examine_mask
from nishiki.formats.picture_files import Exif, ImageHeader, several_layers
from nishiki.formats.problems import CaptureError, Problem, refuse, warning

SATURATED = 0.98  # of full scale, from which pixels count as saturated before a capture states more
SAME_EXPOSURE = 0.01  # cameras that measure the exposure time write it with such differences
FOLDERS = ("frames", "white", "dark", "ambient", "silhouettes")


def channel_names(header: ImageHeader) -> tuple[str, ...]:
    """Name a photograph's channels, alpha apart. CaptureError (layers-several): EXR layers, none of them all light."""
    if several_layers(header.names):
        what, found = "several layers, none of them called Combined or Beauty", ", ".join(header.names)[:200]
        remedy = "Write an EXR of one layer, or list the channels of one under camera.channels of a capture.yaml"
        refuse("layers-several", "photographs", what, found=found, remedy=remedy)
    if header.names:
        return RGB if header.names == ("R", "G", "B") else header.names
    count = header.channels - header.alpha
    known = {1: ("grey",), 3: RGB}
    return known.get(count, tuple(f"channel{i + 1}" for i in range(count)))


def usual_header(photographs: Sequence[Path]) -> ImageHeader:
    """Read the headers of all photographs and return one of the most frequent size, depth and format.

    CaptureError where none of them can be read; `check_capture` names those that differ.
    """
    headers, problems = [], []
    for path in photographs:
        try:
            headers.append(read_header(path))
        except CaptureError as e:
            problems += e.problems
    if not headers:
        raise CaptureError(problems)
    traits = [(h.kind, h.rows, h.columns, h.channels, h.sample) for h in headers]
    return headers[traits.index(Counter(traits).most_common(1)[0][0])]


def choose_encoding(
    header: ImageHeader, given: str | None, source: str, *, display: bool = False
) -> tuple[str, list[Problem]]:
    """Choose camera.encoding for photographs like this one, and list notes for the user.

    given: by the user, or None; display: 8-bit pictures that state nothing are coded for display, not linear. A curve
    that the file states is used; a linear one needs no statement.
    """
    stated = header.coding
    if stated is not None and stated.fault and given is None:
        return "file", []  # reported by the check
    if stated is not None and (given is None or stated.developed):
        if stated.linear and not stated.developed and stated.to_srgb is None:
            return "linear", []
        if not stated.differs_from(choose_coding(header.kind, None, "file")):
            return "file", []
        what, found = "photographs are decoded by the coding that they state", stated.name
        return "file", [warning("coding-stated", source, what, found=found)]
    if given is not None and stated is not None and header.choose_coding(given).curve.differs_from(stated.curve):
        what = "the photographs state another coding than the one that is given"
        return given, [warning("encoding-overruled", source, what, expected=given, found=stated.name)]
    if given is not None or header.kind == "jpeg":
        return given or "srgb", []
    if header.sample != "uint8":
        return "linear", []
    what = "8-bit photographs are taken to be " + ("coded for display (sRGB)" if display else "linear")
    remedy = "Give the encoding, linear or srgb, if it is the other one"
    return "srgb" if display else "linear", [warning("encoding-assumed", source, what, remedy=remedy)]


def file_names(photographs: tuple[Path, ...]) -> list[str]:
    """Name files in the capture: as they are, numbered where two from different folders have the same name."""
    names = [p.name for p in photographs]
    same = len(set(names)) != len(names)
    return [f"{i + 1:03d}_{name}" for i, name in enumerate(names)] if same else names


def take(origin: Path, place: Path, link: bool) -> str:
    """Copy or hard-link one file; return its name relative to the capture."""
    place.parent.mkdir(parents=True, exist_ok=True)
    if link:
        os.link(origin.resolve(), place)
    else:
        shutil.copyfile(origin, place)
    return f"{place.parent.name}/{place.name}" if place.parent.name in FOLDERS else place.name


def take_mask(origin: Path, place: Path, link: bool) -> tuple[str, list[Problem]]:
    """Copy or hard-link a mask or silhouette; return its name in the capture, and warnings about how it is read."""
    return take(origin, place, link), list(examine_mask(origin).problems)


def state_exposures(folder: Path, rows: list[dict[str, str]]) -> list[Problem]:
    """Add exposure time, f-number and ISO that cameras recorded to the rows of frames.csv.

    Only columns whose values differ between the lit photographs are added, and none where some photographs state
    nothing; returns a warning of either.
    """
    recorded = [read_exif(folder / row["file"], name=row["file"]) for row in rows]
    lit = [i for i, row in enumerate(rows) if row["role"] in (*LIT_ROLES, "ambient")]
    said, unknown = compare_exposures([recorded[i] for i in lit])
    found = ", ".join(said.values())
    if unknown:
        file = rows[lit[unknown[0]]]["file"]
        what = "photographs are differently exposed, and some do not state how"
        remedy = f"Exposures are not divided out. Give them for {file} too, in frames.csv of an open capture"
        return [warning("exposure-unstated", file, what, found=found, remedy=remedy)]
    if not said:
        return []
    for row, exif in zip(rows, recorded, strict=True):
        row |= {column: f"{v:.9g}" for column in said if (v := getattr(exif, column)) is not None}
    what = "photographs are differently exposed; the exposures that they record are divided out"
    remedy = "Set the camera to manual exposure"
    return [warning("exposure-differs", "frames.csv", what, found=found, remedy=remedy)]


def compare_exposures(recorded: Sequence[Exif]) -> tuple[dict[str, str], list[int]]:
    """Report each column of exposures that differs by more than SAME_EXPOSURE, and missing values."""
    said: dict[str, str] = {}
    unknown: set[int] = set()
    for column in EXPOSURE_COLUMNS:
        values = [getattr(exif, column) for exif in recorded]
        stated = [value for value in values if value is not None]
        if stated and max(stated) > min(stated) * (1 + SAME_EXPOSURE):
            said[column] = f"{column} {min(stated):.4g} to {max(stated):.4g}"
            unknown |= {i for i, value in enumerate(values) if value is None}
    return said, sorted(unknown)


def settings_text(settings: dict[str, Any]) -> str:
    """Write the content of capture.yaml."""
    text = yaml.safe_dump(settings, sort_keys=False, allow_unicode=True)
    return f"# Capture folder: see docs/capture-folder.md\n{text}"


def table_text(rows: Iterable[Iterable[Any]]) -> str:
    """Write a table of comma-separated values, its heading the first row."""
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(rows)
    return buffer.getvalue()


def lights_text(names: Sequence[str], vectors: np.ndarray) -> str:
    """Write a `.lp` file: the number of lamps, then name and vector of each."""
    lines = [f"{name} {x:.9g} {y:.9g} {z:.9g}\n" for name, (x, y, z) in zip(names, vectors, strict=True)]
    return f"{len(lines)}\n{''.join(lines)}"


def read_channels(path: Path) -> np.ndarray:
    """Read codes (rows, columns, channels) float32 without alpha, as stored or linear by the file's curve."""
    header = read_header(path)
    codes = read_codes(path, channel_names(header), header=header).astype(np.float32)
    if header.coding is None or header.coding.linear:
        return codes
    full = full_scale_of(path)
    return (full * header.coding.curve.decode(codes / full)).astype(np.float32)


def read_grey(path: Path) -> np.ndarray:
    """Read codes (rows, columns) float32: luma of colour, else the mean of the channels."""
    codes = read_channels(path)
    return codes @ np.float32(LUMA_WEIGHTS) if codes.shape[2] == 3 else codes.mean(axis=2)


def full_scale_of(path: Path) -> float:
    """Return the largest code that a photograph's samples can hold; 1 for float."""
    return {"uint8": 255.0, "uint16": 65535.0, "float32": 1.0}[read_header(path).sample]
