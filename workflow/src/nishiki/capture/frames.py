"""frames.csv: role, light, view and polariser state of each photograph, for captures of all geometries."""

import difflib
import math
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from nishiki.capture.lights import Lights, light_name
from nishiki.capture.tables import Curves
from nishiki.formats.files import bound, leads_out, name_fault
from nishiki.formats.images import read_coarse
from nishiki.formats.problems import MOST_LISTED, CaptureError, Problem, error, raise_errors, refuse, warning
from nishiki.formats.text_tables import expect_rows, label_problems, number_of, reading, table_rows
from nishiki.polarisation.series import fits_by_chance, series_design

Kind = Literal["none", "circular", "linear", "generator"]
FEWEST_ANGLES = 3  # of a polariser that is turned: a mean, a cosine and a sine are unknown
LEAST_ALIKE = 0.3  # median correlation of photographs of one view; those of the measured badges have 0.997
NO_SERIES = "Give the photographs other names if they are none, with --lights FILE or their cameras"
MEANS = {
    "none": "no polariser",
    "circular": "circular polarisers off or on",
    "linear": "analyser angle",
    "generator": "generator/analyser angles",
}


@dataclass(frozen=True)
class State:
    """name: canonical ('' | 'off' | 'on' | '45' | '0/90'); angles_deg: analyser, or generator and analyser."""

    name: str
    kind: Kind
    angles_deg: tuple[float, ...] = ()


def parse_state(text: str, where: str = "polariser") -> State:
    """Parse the polariser state of a cell of frames.csv. CaptureError (polariser-unknown) where it is none."""
    text = text.strip()
    if not text:
        return State("", "none")
    if text in ("off", "on"):
        return State(text, "circular")
    angles = tuple(number_of(part) for part in text.split("/"))
    if len(angles) in (1, 2) and all(math.isfinite(a) and abs(a) <= 360 for a in angles):
        return State("/".join(f"{a + 0.0:g}" for a in angles), "linear" if len(angles) == 1 else "generator", angles)
    near = difflib.get_close_matches(text.casefold(), ("off", "on"), n=1, cutoff=0.6)
    remedy = f"Did you mean '{near[0]}'?" if near else "Angles are in degrees, at most 360"
    expected = "empty, off, on, an analyser angle (45), or generator/analyser angles (0/90)"
    refuse("polariser-unknown", where, "polariser state", expected=expected, found=repr(text), remedy=remedy)


def state_problems(states: tuple[str, ...], file: str) -> list[Problem]:
    """Check that states belong together: all of one kind, circular ones both off and on, enough angles."""
    kinds = {parse_state(name).kind for name in states}
    if len(kinds) > 1:
        found = ", ".join(MEANS[kind] for kind in sorted(kinds))
        return [error("polariser-mixed", file, "polariser states of several kinds in one capture", found=found)]
    if kinds == {"circular"} and len(states) == 1:
        what = f"expected every view with the polariser off and on, or no states, found only '{states[0]}'"
        return [error("polariser-pair", file, what)]
    if kinds == {"linear"}:
        angles = {round(parse_state(name).angles_deg[0] % 180, 3) % 180 for name in states}
        if len(angles) < FEWEST_ANGLES:
            what = f"{len(angles)} analyser angles, half a turn apart counting once, are too few to separate reflection"
            return [warning("polariser-few", file, what, remedy="Photograph 0, 45, 90 and 135 degrees")]
    return []


def state_warnings(photographs: Sequence[Path], states: Sequence[str], source: str) -> list[Problem]:
    """Warn where photographs do not vary with the angles of generator and analyser as behind polarisers.

    CaptureError (states-contradicted) where the photographs do not show one view, or not in one size.
    """
    values = [read_coarse(path, "linear") for path in photographs]
    if len({value.shape for value in values}) > 1:
        refuse("states-contradicted", source, "named as states of one view, but of different sizes", remedy=NO_SERIES)
    stack = np.array([value.ravel() for value in values])
    varied = stack[stack.std(axis=1) > 0]
    if len(varied) > 1 and (alike := float(np.median(np.corrcoef(varied)))) < LEAST_ALIKE:
        what, found = "named as states of one view, but they show different things", f"correlation {alike:.2f}"
        refuse("states-contradicted", source, what, found=found, remedy=NO_SERIES)
    if not fits_by_chance(stack, series_design(np.array([parse_state(state).angles_deg for state in states]))):
        return []
    what = "the photographs do not vary with these angles as light behind polarisers does"
    return [warning("states-unexplained", source, what, remedy="Check that the names are angles in degrees")]


TABLE = "frames.csv"
ROLES = ("sample", "check", "white", "dark", "flat", "ambient")
LIT_ROLES = ("sample", "check", "white")
EXPOSURE_COLUMNS = {"exposure_s": "seconds above 0", "f_number": "a number above 0", "iso": "a number above 0"}
SHIFT_COLUMNS = ("shift_x_px", "shift_y_px")
COLUMNS = ("file", "role", "light", *EXPOSURE_COLUMNS, *SHIFT_COLUMNS, "view", "band")
TURNTABLE_ROLES = ("sample", "white", "dark", "board")
TURNTABLE_COLUMNS = ("file", "role", "view", "light", "polariser", *EXPOSURE_COLUMNS, "silhouette")
GONIOMETER_ROLES = ("sample", "white", "dark")
ANGLE_COLUMNS = ("theta_i_deg", "phi_i_deg", "theta_r_deg", "phi_r_deg")
RADIAN_COLUMNS = tuple(name.replace("_deg", "_rad") for name in ANGLE_COLUMNS)
GONIOMETER_COLUMNS = ("file", "role", *ANGLE_COLUMNS, "exposure_s")
LARGEST_SHIFT = 1e4  # pixels
DIALECTS = {
    "plane": (ROLES, COLUMNS),
    "turntable": (TURNTABLE_ROLES, TURNTABLE_COLUMNS),
    "goniometer": (GONIOMETER_ROLES, GONIOMETER_COLUMNS),
}


class Band(NamedTuple):
    """Channels stored in a file of their own; file: as written, relative to the payload."""

    channels: tuple[str, ...]
    file: str
    path: Path


@dataclass(frozen=True)
class Frame:
    """One photograph. file: as written, relative to the payload; light: its lamp's name ('' for no burning lamp)."""

    file: str
    path: Path
    role: str
    light: str = ""
    exposure_s: float | None = None
    view: str = ""
    row: int = 0
    polariser: str = ""  # state of the polarisers ('' for none)
    silhouette: str = ""  # picture of the object's outline in this view, or ''
    silhouette_path: Path | None = None
    # theta_i, phi_i, theta_r, phi_r of a goniometer, None where not given
    angles_deg: tuple[Any, ...] = (None, None, None, None)
    # its channels by file, where they have several, of which `file` is the first; else empty
    bands: tuple[Band, ...] = ()
    f_number: float | None = None  # focal length over aperture
    iso: float | None = None  # sensitivity; None where not stated
    # column and row at which it shows what the photograph without shift shows at 0, 0
    shift_px: tuple[float, float] = (0.0, 0.0)

    @property
    def parts(self) -> tuple[Band, ...]:
        """Every file: one per band, or the photograph's single file, without channel names."""
        return self.bands or (Band((), self.file, self.path),)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the files."""
        return tuple(part.file for part in self.parts)

    @property
    def exposure(self) -> float | None:
        """Exposure time times ISO over 100 over the square of the f-number, of those stated; None where none is."""
        if self.exposure_s is self.f_number is self.iso is None:
            return None
        return (self.exposure_s or 1.0) * ((self.iso or 100.0) / 100.0) / (self.f_number or 1.0) ** 2


def read_frames(table: Path, *, geometry: str = "plane") -> tuple[Frame, ...]:
    """Parse frames.csv of a plane, a turntable or a goniometer; CaptureError lists all mistakes.

    Kinds: frames-missing, frames-unreadable, frames-many, unknown-column, role-unknown, light-empty, name-unusable,
    exposure-invalid, shift-invalid, frame-duplicate, outside-folder, image-missing, frames-none, polariser-unknown,
    silhouette-role, angle-invalid.
    """
    with reading(table.name, "frames"):
        columns, *rows = [cells for _, cells in islice(table_rows(table, table.name), bound("frames") + 2)] or [[]]
    roles, known = DIALECTS[geometry]
    radians = geometry == "goniometer" and set(RADIAN_COLUMNS) <= set(columns)
    if radians:
        columns = [column.replace("_rad", "_deg") for column in columns]
    _check_columns(columns, table.name, known)
    expect_rows(len(rows), "frames", table.name, "frames")
    problems: list[Problem] = []
    frames: list[Frame] = []
    seen: dict[str, int] = {}
    for number, row in enumerate(rows, start=2):
        where = f"{table.name} row {number}"
        if len(row) != len(columns):
            what = f"expected {len(columns)} values, found {len(row)}"
            problems.append(error("frames-unreadable", where, what))
            continue
        cells = dict(zip(columns, row, strict=True))
        frame = _frame(cells, table.parent, number, where, problems, roles)
        if geometry == "turntable":
            frame = _round_about(frame, cells, table.parent, where, problems)
        elif geometry == "goniometer":
            unit = math.degrees(1) if radians else 1.0
            angles = tuple(_angle(cells, key, unit, where, problems) for key in ANGLE_COLUMNS)
            frame = replace(frame, angles_deg=angles)
        if seen.setdefault(frame.file, number) != number:
            what = f"'{frame.file}' is listed twice (also row {seen[frame.file]})"
            problems.append(error("frame-duplicate", where, what))
        if cells.get("band"):
            frame = replace(frame, bands=(Band(tuple(cells["band"].split("+")), frame.file, frame.path),))
        frames.append(frame)
    if not frames and not problems:
        problems.append(error("frames-none", table.name, "no photographs listed"))
    frames = _join_bands(frames, table.name, problems)
    raise_errors(problems)
    return tuple(frames)


def _join_bands(frames: list[Frame], file: str, problems: list[Problem]) -> list[Frame]:
    """Join the rows of one photograph, a row a band; a dark frame without a band is that of every band.

    Several photographs of one role and light (dark frames) are told apart by the order of the rows.
    """
    present = tuple(dict.fromkeys(part.channels for frame in frames for part in frame.bands))
    if not present:
        return frames
    taken: Counter[tuple[str, str, tuple[str, ...]]] = Counter()
    joined: dict[tuple[str, str, int], Frame] = {}
    for frame in frames:
        bands = frame.bands
        if not bands and frame.role == "dark":
            bands = tuple(Band(channels, frame.file, frame.path) for channels in present)
        elif not bands:
            what = "a row without a band, one of camera.channels, among rows with one"
            problems.append(error("band-empty", f"{file} row {frame.row}", what))
            continue
        key = (frame.role, frame.light, taken[frame.role, frame.light, bands[0].channels])
        taken.update((frame.role, frame.light, band.channels) for band in bands)
        first = joined.get(key)
        if first is not None and first.exposure_s != frame.exposure_s:
            what = f"exposure times of one photograph differ: {first.exposure_s:g} and {frame.exposure_s:g}"
            remedy = "Leave the column out: white boards of the same exposures, band by band, give the scale"
            problems.append(error("band-exposure", f"{file} row {frame.row}", what, remedy=remedy))
        joined[key] = replace(frame, bands=bands) if first is None else replace(first, bands=first.bands + bands)
    return list(joined.values())


def _check_columns(columns: list[str], file: str, known: tuple[str, ...]) -> None:
    problems = []
    for name in [c for c in columns if c not in known][:MOST_LISTED]:
        near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
        remedy = f"Did you mean '{near[0]}'?" if near else f"Known columns: {', '.join(known)}"
        problems.append(error("unknown-column", file, f"unknown column '{name}'", remedy=remedy))
    if not {"file", "role"} <= set(columns) or len(set(columns)) != len(columns):
        what = f"expected the columns file and role, each column once, found {','.join(columns)[:80]}"
        problems.append(error("frames-unreadable", file, what))
    raise_errors(problems)


def _frame(
    row: dict[str, str], payload: Path, number: int, where: str, problems: list[Problem], roles: tuple[str, ...]
) -> Frame:
    role, light = row["role"], row.get("light", "")
    if role not in roles:
        problems.append(error("role-unknown", where, "role", expected=" | ".join(roles), found=repr(role)))
    if roles is ROLES and role in LIT_ROLES and not light:
        problems.append(error("light-empty", where, f"a {role} frame needs its light"))
    problems += label_problems(row.get("view", ""), "view", where)
    problems += label_problems(light_name(light), "light", where)
    exposure: dict[str, Any] = dict.fromkeys(EXPOSURE_COLUMNS)
    for column, expected in EXPOSURE_COLUMNS.items():
        if text := row.get(column, ""):
            value = number_of(text)
            if 0 < value < math.inf:
                exposure[column] = value
            else:
                problems.append(error("exposure-invalid", where, column, expected=expected, found=text))
    across, down = (number_of(row.get(column) or "0") for column in SHIFT_COLUMNS)
    for column, shift in zip(SHIFT_COLUMNS, (across, down), strict=True):
        if not abs(shift) < LARGEST_SHIFT:
            expected = f"pixels, less than {LARGEST_SHIFT:g}"
            problems.append(error("shift-invalid", where, column, expected=expected, found=row[column]))
    path = payload
    try:
        path = inside(payload, row["file"], where)
    except CaptureError as e:
        problems.extend(e.problems)
    view, shift_px = row.get("view", ""), (across, down)
    return Frame(row["file"], path, role, light, view=view, row=number, shift_px=shift_px, **exposure)


def _round_about(frame: Frame, row: dict[str, str], payload: Path, where: str, problems: list[Problem]) -> Frame:
    """Add to the frame what only a turntable's table states: polariser state and silhouette."""
    state, outline, path = "", row.get("silhouette", ""), None
    try:
        state = parse_state(row.get("polariser", ""), where).name
        path = inside(payload, outline, f"{where} silhouette") if outline else None
    except CaptureError as e:
        problems.extend(e.problems)
    if outline and frame.role != "sample":
        what = f"a {frame.role} frame has the silhouette {outline}, which belongs to a sample frame of the view"
        problems.append(error("silhouette-role", where, what))
    return replace(frame, polariser=state, silhouette=outline, silhouette_path=path)


def _angle(row: dict[str, str], key: str, unit_deg: float, where: str, problems: list[Problem]) -> float | None:
    """Parse an angle in degrees; None where the cell is empty or, with a problem added, the value is impossible."""
    text = row.get(key, "")
    if not text:
        return None
    least, most = (0.0, 90.0) if key.startswith("theta") else (-360.0, 360.0)
    value = number_of(text) * unit_deg
    if least <= value <= most and (value < 90 or not key.startswith("theta")):
        return value
    expected = "degrees from the normal, 0 to below 90" if key.startswith("theta") else "degrees, -360 to 360"
    problems.append(error("angle-invalid", where, key, expected=expected, found=repr(text)))
    return None


def lamp_problems(frames: Iterable[Frame], lights: Lights, file: str) -> list[Problem]:
    """List mismatches of frames and a lights file (frame-without-light, light-without-frame)."""
    frames, problems = list(frames), []
    for frame in frames:
        if frame.light and lights.find(frame.light) is None:
            what = f"light '{frame.light}' is not in {file}"
            problems.append(error("frame-without-light", f"frames.csv row {frame.row}", what))
    observed = {lights.find(f.light) for f in frames if f.role in ("sample", "check")}
    return problems + [
        error("light-without-frame", file, f"light '{name}' has no photograph in frames.csv")
        for place, name in enumerate(lights.names)
        if place not in observed
    ]


def exposure_problems(frames: Iterable[Frame]) -> list[Problem]:
    """List exposure-partial where only some lit frames have an exposure time, f-number or ISO."""
    lit = [f for f in frames if f.role in (*LIT_ROLES, "ambient")]
    problems = []
    for column in EXPOSURE_COLUMNS:
        without = [f for f in lit if getattr(f, column) is None]
        if without and len(without) < len(lit):
            found = f"{len(without)} of {len(lit)} rows without, the first in row {without[0].row}"
            remedy = f"Give {column} for every {', '.join(dict.fromkeys(f.role for f in lit))} frame, or for none"
            problems.append(error("exposure-partial", "frames.csv", column, found=found, remedy=remedy))
    return problems


def inside(payload: Path, file: str, where: str) -> Path:
    """Return the path of a file that the capture names; CaptureError if it is missing or lies outside the capture.

    Absolute names, '..' and links that lead out are refused: a capture must be whole when it is moved or archived.
    """
    remedy = "Put the file into the capture folder and name it relative to capture.yaml, with forward slashes"
    fault = name_fault(file)
    if fault:
        refuse("outside-folder", where, fault, found=repr(file[:200]), remedy=remedy)
    path = payload / file
    try:
        there = path.is_file()
    except OSError as e:
        raise CaptureError(error("image-missing", where, f"'{file}' cannot be reached", found=str(e.strerror))) from e
    if not there:
        refuse("image-missing", where, f"'{file}' is missing")
    if leads_out(path, payload):
        found = f"'{file}' leads to {os.path.realpath(path)}"
        refuse("outside-folder", where, "link out of the folder", found=found, remedy=remedy)
    return path


class SourcePhotographs:
    """Photographs of a folder that `convert` reads, of any geometry; channels: their names where a file states them."""

    photographs: tuple[Path, ...]
    channels: tuple[str, ...] = ()

    @property
    def count(self) -> int:
        """Number of the photographs."""
        return len(self.photographs)


@dataclass(frozen=True)
class BaseCapture:
    """The folder and the photographs of a capture of any geometry."""

    root: Path  # the folder
    payload: Path  # where capture.yaml lies (root, or root/data of a sealed one)
    settings: Any  # the CaptureFile, TurntableFile or GoniometerFile
    frames: tuple[Frame, ...]  # in the order of frames.csv
    sensitivities: Curves | None  # curves in the order of camera.channels, or None
    illuminant: Curves | str | None  # curves, the name of a CIE illuminant, or None

    @property
    def geometry(self) -> str:
        """plane, turntable or goniometer."""
        return self.settings.geometry

    @property
    def sealed(self) -> bool:
        """Return whether the folder is a bag with the digests of all its files."""
        return (self.root / "bagit.txt").is_file()

    def frames_of(self, role: str) -> tuple[Frame, ...]:
        """Return the frames of one role, in the order of the table."""
        return tuple(f for f in self.frames if f.role == role)
