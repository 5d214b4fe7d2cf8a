"""Tables of reflectances: CSV with a column a channel, and the Cornell `.brdf` format."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nishiki.capture.problems import CaptureError, Problem, error, raise_errors, warning

ANGLES = ("theta_i_deg", "phi_i_deg", "theta_r_deg", "phi_r_deg")
SHOWN = 5  # wrong rows told of one kind


@dataclass(frozen=True)
class ReflectanceTable:
    """incident_deg, outgoing_deg (n, 2) float64: theta and phi; values (n, channels) float64, sr^-1; channels: names;
    warnings: what was tolerated."""

    incident_deg: np.ndarray
    outgoing_deg: np.ndarray
    values: np.ndarray
    channels: tuple[str, ...]
    warnings: tuple[Problem, ...] = ()


def read_table(path: Path, name: str) -> ReflectanceTable:
    """Read `.brdf` (Cornell: angles in radians, a value a wavelength) or CSV.

    Raises CaptureError with all mistakes: table-unreadable, table-columns, table-empty, angle-invalid, table-value.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as e:
        raise CaptureError(error("table-unreadable", name, "not UTF-8 text", remedy="Save it as UTF-8")) from e
    return _checked(*(_cornell if path.suffix.lower() == ".brdf" else _csv)(text, name), name)


def is_table(path: Path) -> bool:
    """Whether a file is a table of reflectances, by its suffix and its heading."""
    if path.suffix.lower() == ".brdf":
        return True
    if path.suffix.lower() != ".csv":
        return False
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        lines = (line for line in file if line.strip() and not line.lstrip().startswith("#"))
        return set(ANGLES) <= {cell.strip() for cell in next(lines, "").split(",")}


def _csv(text: str, name: str) -> tuple[np.ndarray, tuple[str, ...], list[int]]:
    """Rows (n, 4 + channels), angles in degrees first; channel names; line number of each row."""
    lines = [(i, t) for i, t in enumerate(text.splitlines(), start=1) if t.strip() and not t.lstrip().startswith("#")]
    rows = [[cell.strip() for cell in row] for row in csv.reader(t for _, t in lines)]
    heading = rows[0] if rows else []
    channels = tuple(cell for cell in heading if cell not in ANGLES)
    missing = [angle for angle in ANGLES if angle not in heading]
    if missing or not channels or len(set(heading)) != len(heading) or "" in heading:
        expected, found = f"{', '.join(ANGLES)} and one column a channel, each once", ", ".join(heading)[:80]
        remedy = "Name the columns in the first line"
        raise CaptureError(error("table-columns", name, "columns", expected=expected, found=found, remedy=remedy))
    order = [heading.index(column) for column in (*ANGLES, *channels)]
    numbers, problems = [], []
    for (line, _), row in zip(lines[1:], rows[1:], strict=True):
        try:
            if len(row) != len(heading):
                raise ValueError(f"{len(row)} values")
            numbers.append([float(row[i]) for i in order])
        except ValueError as e:
            expected = f"{len(heading)} numbers"
            problems.append(error("table-unreadable", f"{name} line {line}", "row", expected=expected, found=str(e)))
    raise_errors(problems)
    return np.array(numbers).reshape(-1, len(order)), channels, [line for line, _ in lines[1:]]


def _cornell(text: str, name: str) -> tuple[np.ndarray, tuple[str, ...], list[int]]:
    """The number of wavelengths, the wavelengths in nm, then rows of four angles in radians and the values."""
    cells, lines = [], []
    for number, line in enumerate(text.splitlines(), start=1):
        here = line.split("#")[0].split()
        cells += here
        lines += [number] * len(here)
    try:
        values = np.array([float(cell) for cell in cells])
        count = int(values[0])
        if count < 1 or count != values[0] or len(values) < 1 + count:
            raise ValueError(f"{len(values)} numbers, the first {values[0]:g}")
    except (ValueError, IndexError) as e:
        expected = "the number of wavelengths, the wavelengths, then rows of angles and values"
        raise CaptureError(error("table-unreadable", name, "table", expected=expected, found=str(e)[:80])) from e
    rest, wide = values[1 + count :], 4 + count
    if len(rest) % wide:
        expected, found = f"rows of {wide} numbers", f"{len(rest) % wide} numbers in the last"
        remedy = "Copy the file again from where it came"
        raise CaptureError(
            error("table-unreadable", name, "table ends early", expected=expected, found=found, remedy=remedy)
        )
    rows = rest.reshape(-1, wide).copy()
    rows[:, :4] = np.degrees(rows[:, :4])
    return rows, tuple(f"{nm:g} nm" for nm in values[1 : 1 + count]), lines[1 + count :: wide]


def _checked(rows: np.ndarray, channels: tuple[str, ...], lines: list[int], name: str) -> ReflectanceTable:
    """The table, if it has rows of possible angles and finite values."""
    if not len(rows):
        raise CaptureError(error("table-empty", name, "no reflectances in it", remedy="Add a row for each measurement"))
    theta, phi, values = rows[:, [0, 2]], rows[:, [1, 3]], rows[:, 4:]
    # angles that come from radians may pass 90 degrees by rounding
    possible = (np.isfinite(theta) & (theta >= 0) & (theta < 90) & (np.abs(phi) <= 360)).all(axis=1)
    problems = []
    for i in np.flatnonzero(~possible)[:SHOWN]:
        found = ", ".join(f"{a:g}" for a in rows[i, :4])
        expected = "theta from 0 to below 90, phi from -360 to 360 degrees"
        problems.append(error("angle-invalid", f"{name} line {lines[i]}", "angles", expected=expected, found=found))
    for i in np.flatnonzero(~np.isfinite(values).all(axis=1))[:SHOWN]:
        remedy = "Leave the row out"
        problems.append(error("table-value", f"{name} line {lines[i]}", "a value is not finite", remedy=remedy))
    raise_errors(problems)
    notes = []
    dark = int((values <= 0).any(axis=1).sum())
    if dark == len(rows):
        raise CaptureError(error("table-value", name, "no row has values above 0 in all its channels"))
    if dark:
        what = "rows with values of 0 or below are not used"
        notes.append(warning("table-dark", name, what, found=f"{dark} of {len(rows)}"))
    return ReflectanceTable(rows[:, :2], rows[:, 2:4], values, channels, tuple(notes))
