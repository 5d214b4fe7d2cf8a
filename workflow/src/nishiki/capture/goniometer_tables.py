"""Read tables of reflectances against angles, in every unit, and write them as captures."""

import re
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from nishiki.capture.frames import ANGLE_COLUMNS as ANGLES
from nishiki.capture.frames import RADIAN_COLUMNS
from nishiki.formats.coding import RGB
from nishiki.formats.files import bound
from nishiki.formats.problems import MOST_LISTED, CaptureError, Problem, error, raise_errors, refuse, warning
from nishiki.formats.text_tables import expect_rows, reading, table_lines, table_rows
from nishiki.optional_formats.reflectance_tables import BINARY_TABLES

ANGLE = re.compile(
    r"(?P<kind>theta|phi)[ _]?(?P<way>i|in|inc|incident|l|light|r|o|out|refl|reflected|v|view)"
    r"([ _]*[\[(]?(?P<unit>deg|degrees?|°|rad|radians?)[\])]?)?"
)
"""Names of columns of angles: to the light, to the view, and their unit where it is named."""
RADIANCE_FACTOR = "radiance factor or reflectance (no unit)"
QUANTITIES = {
    RADIANCE_FACTOR: re.compile(r"(radiance|reflectance|reflection)[ _-]*factor|(?<![a-z])brf(?![a-z])"),
    "error or count of a measurement": re.compile(
        r"(?<![a-z])(std|stderr|stdev|stddev|sigma|variance|var|error|err|uncertainty|count|samples|weight)(?![a-z])"
    ),
    "angle": re.compile(r"(?<![a-z])(theta|phi|angle|azimuth|polar)(?![a-z])"),
    "BRDF (1/sr)": re.compile(r"(?<![a-z])(brdf|sr)(?![a-z])"),
}
"""Patterns that identify a column's quantity, tried in this order, case-insensitive."""
BRDF, UNSAID = "BRDF (1/sr)", "no quantity in the name"
Lines = Iterator[tuple[int, str]]
Rows = Iterator[tuple[int, list[str]]]
FEWEST_ANGLES = 6  # measurements whose angles together tell their unit
LEAST_SPREAD = 0.1  # greatest theta, in whatever unit, below which angles tell nothing


@dataclass(frozen=True)
class ReflectanceTable:
    """A table of measured reflectances."""

    # incident_deg, outgoing_deg (n, 2) float64: theta and phi; values (n, channels) float64, sr^-1
    incident_deg: np.ndarray
    outgoing_deg: np.ndarray
    values: np.ndarray
    channels: tuple[str, ...]  # names
    warnings: tuple[Problem, ...] = ()  # what was tolerated


def read_table(path: Path, name: str, *, values: str = "brdf", azimuths: str = "cloth") -> ReflectanceTable:
    """Read `.brdf` (Cornell: angles in radians, a value a wavelength), `.bin` (UTIA), `.binary` (MERL) or CSV.

    values, azimuths: what the columns hold and what phi_r is counted from, see `goniometer_schema.Goniometer`; the
    table that is returned holds the BRDF, and azimuths from the weft. Raises CaptureError with all mistakes:
    table-missing, table-unreadable, table-many, table-columns, table-quantities, table-empty, angle-invalid,
    table-value, angles-radians.
    """
    suffix = path.suffix.lower()
    with reading(name, "table"):
        if suffix in BINARY_TABLES:
            rows, note = BINARY_TABLES[suffix].read(path, name)
            table = rows, RGB, array("q", range(1, len(rows) + 1)), [note]
        elif suffix == ".brdf":
            table = _cornell(table_lines(path, name, limit="reflectances_bytes"), name)
        else:
            table = _csv(table_rows(path, name, limit="reflectances_bytes"), name, values)
    return _as_brdf(_check_table(*table, name), values, azimuths)


def _as_brdf(table: ReflectanceTable, values: str, azimuths: str) -> ReflectanceTable:
    """Convert a table of `values` to the BRDF, and azimuths of the view to those from the weft."""
    cos_i, cos_r = (np.cos(np.radians(each[:, :1])) for each in (table.incident_deg, table.outgoing_deg))
    weight = {
        "brdf": 1.0,
        "radiance_factor": np.pi,
        "radiance_factor_percent": 100 * np.pi,
        "brdf_cos_view": cos_r,
        "brdf_cos_light": cos_i,
    }[values]
    outgoing = table.outgoing_deg
    if azimuths != "cloth":
        turn = np.where(table.incident_deg[:, 0] > 0, table.incident_deg[:, 1] + 180 * (azimuths == "mirror"), 0.0)
        outgoing = np.column_stack([outgoing[:, 0], (outgoing[:, 1] + turn) % 360])
    return replace(table, values=table.values / weight, outgoing_deg=outgoing)


def is_table(path: Path, *, named: bool = False) -> bool:
    """Check whether a file is a table of reflectances, by its suffix and its heading, or its length without a heading.

    named: the user names the file itself, so that the length does not matter: reading it tells what is wrong.
    """
    if path.suffix.lower() == ".brdf":
        return True
    if path.suffix.lower() in BINARY_TABLES:
        return named or path.stat().st_size == BINARY_TABLES[path.suffix.lower()].size
    if path.suffix.lower() != ".csv":
        return False
    try:
        with reading(path.name, "table"):
            _, heading = next(table_rows(path, path.name, limit="reflectances_bytes"), (0, []))
            return set(ANGLES) <= {angle_column(cell)[0] for cell in heading}
    except CaptureError:
        return False


def angle_column(column: str) -> tuple[str, str]:
    """Return which of ANGLES a column holds, and its unit (deg, rad or '' if not stated); else the column itself."""
    match = ANGLE.fullmatch(column.strip().casefold())
    if match is None:
        return column, ""
    kind, way, unit = match["kind"], match["way"], match["unit"] or ""
    return f"{kind}_{'i' if way[0] in 'il' else 'r'}_deg", "deg" if unit == "°" else unit[:3]


def _csv(lines: Rows, name: str, values: str) -> tuple[np.ndarray, tuple[str, ...], array, list[Problem]]:
    """Parse rows (n, 4 + channels), angles in degrees first; channel names; line number of each row; notes."""
    columns = next(lines, (0, []))[1]
    expect_rows(len(columns), "table_columns", name, "table")
    named = [angle_column(column) for column in columns]
    heading, units = [column for column, _ in named], {column: unit for column, unit in named if column in ANGLES}
    channels = tuple(cell for cell in heading if cell not in ANGLES)
    missing = [angle for angle in ANGLES if angle not in heading]
    if missing or not channels or len(set(heading)) != len(heading) or "" in heading:
        expected = f"the columns {', '.join(ANGLES)} and one a channel in the first line, each once"
        refuse("table-columns", name, f"expected {expected}, found {', '.join(heading)[:80]}")
    _expect_reflectances(channels, name, values)
    order = [heading.index(column) for column in (*ANGLES, *channels)]
    numbers, places, problems = array("d"), array("q"), []
    for line, row in lines:
        try:
            if len(row) != len(heading):
                raise ValueError(f"{len(row)} values")
            numbers.extend([float(row[i]) for i in order])
            places.append(line)
        except ValueError as e:
            what = f"expected {len(heading)} numbers, found {str(e)[:80]}"
            problems.append(error("table-unreadable", f"{name} line {line}", what))
            if len(problems) > MOST_LISTED:
                break
        expect_rows(len(numbers), "reflectances_values", name, "table")
    raise_errors(problems)
    rows = np.frombuffer(numbers).reshape(-1, len(order)).copy()
    return rows, channels, places, _to_degrees(rows, units, name)


def _to_degrees(rows: np.ndarray, units: dict[str, str], name: str) -> list[Problem]:
    """Convert angles, the first four columns, to degrees; report where their unit was inferred from their size.

    CaptureError (angles-radians) where columns named _deg hold radians.
    """
    notes, silent = [], [angle for angle in ANGLES if not units[angle]]
    radians = in_radians(rows[:, :4])
    if silent:
        what = f"the unit of {', '.join(angle[:-4] for angle in silent)} is not named: taken from their sizes"
        remedy = "If they are the others, name the columns theta_i_deg or theta_i_rad, and so on"
        notes.append(warning("angles-unit", name, what, found="radians" if radians else "degrees", remedy=remedy))
    elif radians and "rad" not in units.values():
        raise CaptureError(radians_problem(name))
    for place, angle in enumerate(ANGLES):
        if units[angle] == "rad" or (not units[angle] and radians):
            rows[:, place] = np.degrees(rows[:, place])
    return notes


def _expect_reflectances(channels: tuple[str, ...], name: str, values: str) -> None:
    """Raise CaptureError (table-quantities) unless all columns hold the quantity `values`, judged by their names."""
    held: dict[str, list[str]] = {}
    for channel in channels:
        words = channel.casefold().replace("_", " ").replace("-", " ")
        quantity = next((quantity for quantity, pattern in QUANTITIES.items() if pattern.search(words)), UNSAID)
        held.setdefault(quantity, []).append(channel)
    stated = RADIANCE_FACTOR if values.startswith("radiance_factor") else BRDF
    if set(held) <= {stated} or set(held) <= {UNSAID}:
        return
    found = "; ".join(
        f"{', '.join(names[:4])}{' ...' if len(names) > 4 else ''}: {quantity}" for quantity, names in held.items()
    )
    what = "columns are not all reflectances of one unit"
    remedy = "Keep the four angles and the columns in 1/sr (a radiance factor is pi times as much); delete the others"
    if set(held) == {RADIANCE_FACTOR}:
        remedy = "Convert it with --values radiance_factor, or radiance_factor_percent where a white has 100"
    refuse("table-quantities", name, what, expected="channels in 1/sr alone", found=found, remedy=remedy)


def _cornell(lines: Lines, name: str) -> tuple[np.ndarray, tuple[str, ...], array, list[Problem]]:
    """Parse the number of wavelengths, the wavelengths in nm, then rows of four angles in radians and the values."""
    numbers, places = array("d"), array("q")
    try:
        for number, line in lines:
            here = [float(cell) for cell in line.split("#")[0].split()]
            numbers.extend(here)
            places.extend([number] * len(here))
            expect_rows(len(numbers), "reflectances_values", name, "table")
        values = np.frombuffer(numbers)
        if not len(values) or not 1 <= values[0] <= min(bound("table_columns"), len(values) - 1) or values[0] % 1:
            raise ValueError(f"{len(values)} numbers" + (f", the first {values[0]:g}" if len(values) else ""))
        count = int(values[0])
    except ValueError as e:
        expected = "the number of wavelengths, the wavelengths, then rows of angles and values"
        raise CaptureError(error("table-unreadable", name, "table", expected=expected, found=str(e)[:80])) from e
    rest, wide = values[1 + count :], 4 + count
    if len(rest) % wide:
        what = f"table ends early: expected rows of {wide} numbers, found {len(rest) % wide} in the last"
        refuse("table-unreadable", name, what)
    rows = rest.reshape(-1, wide).copy()
    rows[:, :4] = np.degrees(rows[:, :4])
    return rows, tuple(f"{nm:g} nm" for nm in values[1 : 1 + count]), places[1 + count :: wide], []


def _check_table(
    rows: np.ndarray, channels: tuple[str, ...], lines: array, notes: list[Problem], name: str
) -> ReflectanceTable:
    """Return the table if it has rows of possible angles and finite values."""
    if not len(rows):
        refuse("table-empty", name, "no row of reflectances in it")
    theta, phi, values = rows[:, [0, 2]], rows[:, [1, 3]], rows[:, 4:]
    # angles that come from radians may pass 90 degrees by rounding
    possible = (np.isfinite(theta) & (theta >= 0) & (theta < 90) & (np.abs(phi) <= 360)).all(axis=1)
    problems = []
    for i in np.flatnonzero(~possible)[:MOST_LISTED]:
        what = "expected angles theta from 0 to below 90, phi from -360 to 360 degrees"
        found = ", ".join(f"{a:g}" for a in rows[i, :4])
        problems.append(error("angle-invalid", f"{name} line {lines[i]}", what, found=found))
    for i in np.flatnonzero(~np.isfinite(values).all(axis=1))[:MOST_LISTED]:
        problems.append(error("table-value", f"{name} line {lines[i]}", "a value is not finite"))
    raise_errors(problems)
    dark = int((values <= 0).any(axis=1).sum())
    if dark == len(rows):
        refuse("table-value", name, "no row has values above 0 in all its channels")
    if dark:
        what = "rows with values of 0 or below are not used"
        notes.append(warning("table-dark", name, what, found=f"{dark} of {len(rows)}"))
    return ReflectanceTable(rows[:, :2], rows[:, 2:4], values, channels, tuple(notes))


def in_radians(angles: np.ndarray) -> bool:
    """Return whether angles (n, 4) are radians: no theta above pi / 2, no phi above 2 pi."""
    theta, phi = np.abs(angles[:, [0, 2]]), np.abs(angles[:, [1, 3]])
    within = (theta <= np.pi / 2 + 1e-3).all() and (phi <= 2 * np.pi + 1e-3).all()
    return bool(within and len(angles) >= FEWEST_ANGLES and theta.max() > LEAST_SPREAD)


def radians_problem(file: str) -> Problem:
    """Make the problem angles-radians: angles named in degrees, none of which is above a turn in radians."""
    what, expected = "the angles are radians: no theta is above pi / 2, no phi above 2 pi", "degrees"
    remedy = f"Name the columns {', '.join(RADIAN_COLUMNS)}"
    return error("angles-radians", file, what, expected=expected, remedy=remedy)
