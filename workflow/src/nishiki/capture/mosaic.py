"""Read the capture of a painting in overlapping fields: one table, and an ordinary plane capture for each field."""

import hashlib
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

from nishiki.capture.seal import capture_digest
from nishiki.formats.files import bound, leads_out, name_fault
from nishiki.formats.problems import CaptureError, Problem, error, raise_errors, refuse, warning
from nishiki.formats.text_tables import expect_rows, number_of, reading, table_rows

TABLE = "fields.csv"
COLUMNS = ("field", "path", "x_mm", "y_mm")
NAME = re.compile(r"(?=.{1,30}$)\w+(-\w+)*", re.ASCII)
"""Names of fields become parts of names of scenes, SCENE--FIELD."""


@dataclass(frozen=True)
class FieldRow:
    """One row of the table."""

    name: str
    place: str  # folder relative to the table, with forward slashes
    path: Path  # that folder
    # x (right) and y (up) of the middle of its photographs on the object, as a stage gave them; None where unknown
    position_mm: tuple[float, float] | None = None


@dataclass(frozen=True)
class MosaicCapture:
    """A painting photographed in overlapping fields."""

    root: Path  # folder of the table
    fields: tuple[FieldRow, ...]  # rows of the table
    captures: tuple[Any, ...]  # Capture of each field
    warnings: tuple[Problem, ...] = ()  # what was tolerated
    geometry = "mosaic"

    @property
    def sealed(self) -> bool:
        """Return whether every field is sealed."""
        return all(capture.sealed for capture in self.captures)

    @property
    def digest(self) -> str:
        """SHA-256 over names, positions and digests of the fields: the identity of the mosaic."""
        rows = [f"{each.name},{each.position_mm},{capture_digest(each.path)}\n" for each in self.fields]
        return hashlib.sha256("".join(sorted(rows)).encode()).hexdigest()

    def __getattr__(self, name: str) -> Any:
        """Return attributes that all fields share (settings, curves), from the first field."""
        if name in ("settings", "sensitivities", "illuminant"):
            return getattr(self.captures[0], name)
        raise AttributeError(name)


def is_capture(folder: Path) -> bool:
    """Return whether a folder holds the description of a capture, sealed or not, or a table of fields that do."""
    if any((folder / part).is_file() for part in ("capture.yaml", "data/capture.yaml")):
        return True
    try:
        return is_mosaic(folder) and any(is_capture(field.path) for field in read_fields(folder))
    except CaptureError:
        return any(is_capture(place) for place in folder.iterdir() if place.is_dir())


def is_mosaic(root: Path) -> bool:
    """Return whether a folder holds a table of fields."""
    return (root / TABLE).is_file()


def read_fields(root: Path) -> tuple[FieldRow, ...]:
    """Read the table of fields in a folder.

    Raises
    ------
    CaptureError
        With every mistake: fields-missing, fields-unreadable, fields-many, fields-columns, fields-few, field-name,
        field-repeated, field-position, outside-folder, folder-missing.
    """
    with reading(TABLE, "fields"):
        columns, *rows = [cells for _, cells in islice(table_rows(root / TABLE, TABLE), bound("views") + 2)] or [[]]
    expect_rows(len(rows), "views", TABLE, "fields")
    if not {"field", "path"} <= set(columns) <= set(COLUMNS) or len(set(columns)) < len(columns):
        found = ", ".join(columns)[:90] or "no heading"
        refuse(
            "fields-columns", TABLE, "columns", expected=f"{', '.join(COLUMNS)}; x_mm and y_mm may miss", found=found
        )
    problems: list[Problem] = []
    fields, before = [], dict[str | Path, FieldRow]()
    for number, row in enumerate(rows, start=2):
        cells = dict(zip(columns, row, strict=False))
        fields.append(_field(root, cells, f"{TABLE} row {number}", before, problems))
    if len(fields) < 2:
        remedy = "List the others; a single field is an ordinary capture: name its own folder"
        problems.append(
            error("fields-few", TABLE, "fields", expected="two or more", found=str(len(fields)), remedy=remedy)
        )
    raise_errors(problems)
    return tuple(fields)


def _field(
    root: Path, cells: dict[str, str], where: str, before: dict[str | Path, FieldRow], problems: list[Problem]
) -> FieldRow:
    """Read one row; add its faults to the problems."""
    name, place = cells.get("field", ""), cells.get("path", "").rstrip("/")
    if not NAME.fullmatch(name):
        expected = "letters, digits and _, single - between them, at most 30 characters"
        problems.append(error("field-name", where, "name of a field", expected=expected, found=repr(name[:60])))
    given = [cells.get(column, "") for column in ("x_mm", "y_mm")]
    x, y = map(number_of, given)
    if any(given) and not (math.isfinite(x) and math.isfinite(y)):
        expected = "millimetres in x_mm and y_mm, or both empty"
        problems.append(error("field-position", where, "position", expected=expected, found=", ".join(given)[:60]))
    field = FieldRow(name, place, root / place, (x, y) if any(given) else None)
    if name_fault(place) or field.path == root or leads_out(field.path, root):
        remedy = f"Put the field into the folder of {TABLE} and name it relative to that"
        problems.append(error("outside-folder", where, "folder of a field", found=repr(place[:200]), remedy=remedy))
    elif not field.path.is_dir():
        remedy = "Correct the path, or take the row out"
        problems.append(error("folder-missing", where, f"field {name}: no folder {place!r}", remedy=remedy))
    for key in (name.casefold(), field.path):
        other = before.setdefault(key, field)
        if other is not field:
            found = f"{other.name} ({other.place}) and {name} ({place})"
            what, remedy = "two fields of one name or folder", "Give each field a name and a folder of its own"
            problems.append(error("field-repeated", where, what, found=found, remedy=remedy))
    return field


def examine_mosaic(root: Path, examine: Callable) -> tuple[MosaicCapture | None, list[Problem]]:
    """Read the table and all fields' captures by `examine`; None where some cannot be read; list every problem."""
    try:
        fields = read_fields(root)
    except CaptureError as e:
        return None, list(e.problems)
    captures, problems = [], []
    for field in fields:
        capture, found = examine(field.path)
        captures.append(capture)
        problems += within(field, found)
    if any(capture is None for capture in captures):
        return None, problems
    for field, capture in zip(fields, captures, strict=True):
        problems += _differences(fields[0].place, captures[0], field.place, capture)
    digests: dict[str, FieldRow] = {}
    for field, capture in zip(fields, captures, strict=True):
        twin = digests.setdefault(capture_digest(field.path), field) if capture.sealed else field
        if twin is not field:
            found, remedy = f"as {twin.name}", "Correct the path, or take one of the two rows out"
            problems.append(error("field-repeated", field.place, "the same photographs", found=found, remedy=remedy))
    if any(field.position_mm for field in fields) and captures[0].settings.pixel_pitch_mm is None:
        what = "positions are not used: the fields have no scale"
        remedy = "State pixel_pitch_mm in each capture.yaml, or convert again with --width-mm"
        problems.append(warning("positions-unused", TABLE, what, remedy=remedy))
    doubts = tuple(problem for problem in problems if problem.severity == "warning")
    return MosaicCapture(root, fields, tuple(captures), doubts), problems


def within(field: FieldRow, problems: list[Problem]) -> list[Problem]:
    """Return problems of a field's capture with files relative to the mosaic."""
    return [replace(problem, file=f"{field.place}/{problem.file}") for problem in problems]


def _differences(first: str, usual: Any, place: str, other: Any) -> list[Problem]:
    """List properties in which a field differs from the first, where all fields of a mosaic must be equal."""
    remedy = "All fields are planes, photographed by one camera under the same lamps; all or none state their scale"
    if other.geometry != "plane":
        return [error("fields-differ", place, "geometry", expected="plane", found=other.geometry, remedy=remedy)]
    facts: dict[str, Callable[[Any], Any]] = {
        "camera.channels": lambda capture: capture.settings.camera.channels,
        "camera.sensitivities": lambda capture: _values_of(capture.sensitivities),
        "illuminant": lambda capture: _values_of(capture.illuminant),
        "white frames": lambda capture: bool(capture.frames_of("white")),
        "pixel_pitch_mm": lambda capture: capture.settings.pixel_pitch_mm is not None,
    }
    what = f"differs from the field in {first}"
    return [
        error("fields-differ", f"{place}/capture.yaml {key}", what, remedy=remedy)
        for key, value in facts.items()
        if usual.geometry == "plane" and value(usual) != value(other)
    ]


def _values_of(curves: Any) -> Any:
    """Return curves (or the name of an illuminant, or None) as values that can be compared."""
    if curves is None or isinstance(curves, str):
        return curves
    return curves.names, curves.wavelengths_nm.tobytes(), curves.values.tobytes()
