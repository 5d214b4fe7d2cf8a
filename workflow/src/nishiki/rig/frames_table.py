"""Read and write the table of frames that a rig takes, and choose the oblique pairs of a cloth.

The cloth chain chooses oblique images from its fit to normal incidence (`nishiki.brdf.cloth.yarn_fit`). Before any
photograph, its prior knowledge of yarns stands for that fit, with the information that the planned views of normal
incidence will add to it.
"""

import csv
import math
import shutil
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.brdf.cloth.yarn_facets import CENTRE, SPREAD
from nishiki.brdf.cloth.yarn_fit import LAMBERT, Measured, ShapeFit, choose_oblique, normal_weights, parts_of
from nishiki.capture.frames import ANGLE_COLUMNS as ANGLES
from nishiki.capture.frames import ROLES, TURNTABLE_ROLES
from nishiki.errors import UserError
from nishiki.formats.files import name_fault
from nishiki.goniometry.directions import between, unit

AUTOMATIC = {"object": "auto:object", "white": "auto:white"}
"""Placeholders of an exposure measured when the frames are taken, by the subject before the camera."""
COLUMNS = ("file", "role", "lamp", "light", "view", "polariser", *ANGLES, "exposure_s", "aperture", "iso")
AXIS, POLARISER = "axis:", "polariser:"
"""Prefixes of the columns named after a rig's axes and polarisers."""
FIELDS = "fields"
"""Folder of the fields of a mosaic; each field has a folder of its name there."""
ESTIMATES = ("seconds", "bytes")
PLAN_LINE = "# plan: "
ALL_ROLES = tuple(dict.fromkeys(ROLES + TURNTABLE_ROLES))


@dataclass(frozen=True)
class PlannedFrame:
    """Photograph that a rig takes."""

    file: str  # name in the capture
    role: str  # role, light, view, polariser, angles_deg: as in frames.csv
    lamp: int | None = None  # number of the lamp, from 1; None: lamps stay as they are, and are off for dark frames
    light: str = ""
    view: str = ""
    polariser: str = ""
    angles_deg: tuple[float, ...] = ()
    # axes, polarisers: angle in degrees (straight: millimetres) of each axis, state of each polariser, by name
    axes: tuple[tuple[str, float], ...] = ()
    polarisers: tuple[tuple[str, str], ...] = ()
    exposure_s: float | str | None = None  # seconds; `auto:object` or `auto:white`; None: as the camera is set
    aperture: float | None = None
    iso: int | None = None
    seconds: float = 0.0  # seconds, bytes: what the frame is expected to take
    bytes: int = 0

    @property
    def group(self) -> str:
        """Subject before the camera: object, white, board or dark."""
        return self.role if self.role in ("white", "board", "dark") else "object"


def by_field(frames: tuple[PlannedFrame, ...]) -> dict[str, tuple[PlannedFrame, ...]]:
    """Divide the frames of a mosaic into those of each field, with boards and darks; empty where they have no fields.

    Files are named within the field.
    """
    parts = [frame.file.split("/", 2) for frame in frames]
    names = dict.fromkeys(part[1] for part in parts if part[0] == FIELDS and len(part) > 2)
    return {
        name: tuple(
            replace(frame, file=part[2]) if part[0] == FIELDS else frame
            for frame, part in zip(frames, parts, strict=True)
            if part[0] != FIELDS or part[1] == name
        )
        for name in names
    }


def table_text(frames: tuple[PlannedFrame, ...], plan: Path | str) -> str:
    """Format the table as text without unused columns. plan: the plan's file, relative to the table."""
    rows = [_cells(frame) for frame in frames]
    order = [*COLUMNS, *sorted({key for row in rows for key in row} - set(COLUMNS) - set(ESTIMATES)), *ESTIMATES]
    used = [key for key in order if any(row.get(key) for row in rows)]
    lines = ["\t".join(used), *("\t".join(row.get(key, "") for key in used) for row in rows)]
    return f"{PLAN_LINE}{plan}\n" + "\n".join(lines) + "\n"


def _cells(frame: PlannedFrame) -> dict[str, str]:
    cells = {key: _text(getattr(frame, key)) for key in (*COLUMNS, *ESTIMATES) if key not in ANGLES}
    cells |= dict(zip(ANGLES, map(_text, frame.angles_deg), strict=False))
    cells |= {AXIS + name: _text(angle) for name, angle in frame.axes}
    return cells | {POLARISER + name: state for name, state in frame.polarisers}


def _text(value: object) -> str:
    return "" if value is None else f"{value:.10g}" if isinstance(value, float) else str(value)


def read_table(path: Path) -> tuple[Path, tuple[PlannedFrame, ...]]:
    """Read a table: its plan and its frames. UserError names the line and the column of a mistake."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        raise UserError(f"{path}: file not found. Remedy: ./nishiki rig plan PLAN.yaml --table {path}") from None
    except UnicodeDecodeError:
        raise UserError(f"{path}: expected text in UTF-8. Remedy: save it as UTF-8") from None
    if not lines or not lines[0].startswith(PLAN_LINE.strip()):
        raise UserError(f"{path} line 1: expected '{PLAN_LINE}PLAN.yaml', relative to the table. Remedy: restore it")
    plan = path.parent / lines[0].strip().strip('"').removeprefix(PLAN_LINE.strip()).strip()
    reader = csv.DictReader(lines[1:], delimiter="\t")
    unknown = [
        c for c in reader.fieldnames or () if c not in (*COLUMNS, *ESTIMATES) and not c.startswith((AXIS, POLARISER))
    ]
    if unknown or not {"file", "role"} <= set(reader.fieldnames or ()):
        found = ", ".join(unknown) or "no file and role"
        raise UserError(f"{path} line 2: expected columns of a table of frames, found {found}")
    frames = tuple(_parse_row(row, f"{path} line {number}") for number, row in enumerate(reader, start=3))
    twice = [file for file, count in Counter(frame.file for frame in frames).items() if count > 1]
    if twice or not frames:
        found = f"{twice[0]} twice" if twice else "none"
        raise UserError(f"{path}: expected frames with names of their own, found {found}")
    return plan, frames


def _parse_row(row: dict[str, str], where: str) -> PlannedFrame:
    if None in row or None in row.values():
        raise UserError(f"{where}: expected a value for each column, between tabs; empty ones count")

    def number(key: str, kind: type = float) -> Any:
        text = (row.get(key) or "").strip()
        try:
            value = kind(text) if text else None
        except ValueError:
            value = math.nan
        if value is not None and not math.isfinite(value):
            raise UserError(f"{where}: {key}: expected a number, found {text!r}")
        return value

    fault = name_fault(row["file"])
    if fault or row["role"] not in ALL_ROLES:
        found = f"{fault} {row['file']!r}" if fault else f"role {row['role']!r}"
        raise UserError(f"{where}: expected a file name inside the capture, and a role of frames.csv; found {found}")
    exposure = row.get("exposure_s", "").strip()
    angles = tuple(number(key) for key in ANGLES)
    return PlannedFrame(
        file=row["file"],
        role=row["role"],
        lamp=number("lamp", int),
        light=row.get("light", ""),
        view=row.get("view", ""),
        polariser=row.get("polariser", ""),
        angles_deg=angles if None not in angles else (),
        axes=tuple((key.removeprefix(AXIS), number(key)) for key in row if key.startswith(AXIS) and row[key]),
        polarisers=tuple(
            (key.removeprefix(POLARISER), row[key]) for key in row if key.startswith(POLARISER) and row[key]
        ),
        exposure_s=exposure if exposure in AUTOMATIC.values() else number("exposure_s"),
        aperture=number("aperture"),
        iso=number("iso", int),
        seconds=number("seconds") or 0.0,
        bytes=number("bytes", int) or 0,
    )


def summary(frames: tuple[PlannedFrame, ...], destination: Path) -> str:
    """Format frames of each role, duration, size and free space in two lines."""
    roles = Counter(frame.role for frame in frames)
    folder = destination.absolute()
    while not folder.exists():
        folder = folder.parent
    size, free = sum(frame.bytes for frame in frames), shutil.disk_usage(folder).free
    counts = ", ".join(f"{count} {role}" for role, count in roles.items())
    room = "enough" if free > size else "NOT ENOUGH"
    return (
        f"{len(frames)} frames: {counts}\n"
        f"about {duration(sum(frame.seconds for frame in frames))}, {size / 1e9:.2f} GB; "
        f"free space {free / 1e9:.2f} GB: {room}"
    )


def duration(seconds: float) -> str:
    """Format hours, minutes and seconds, without insignificant ones."""
    minutes, rest = divmod(round(seconds), 60)
    if minutes >= 60:
        return f"{minutes // 60} h {minutes % 60} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


BODY_ALBEDO = 0.2  # of a cloth of medium colour
GRID_DEG = 15.0  # of the candidates


def expected_fit(views: np.ndarray) -> ShapeFit:
    """Estimate the uncertainty of a fit to views (n, 3) of normal incidence before they are measured."""
    from scipy.optimize import approx_fprime

    incident = np.tile([0.0, 0.0, 1.0], (len(views), 1))
    parts = parts_of(incident, views)
    coefficients = np.array([[BODY_ALBEDO, LAMBERT]])

    def predict(x: np.ndarray) -> np.ndarray:
        fixed, columns = parts(x)
        return fixed + columns @ coefficients[0]

    values = predict(CENTRE)
    measured = Measured(incident, views, values[:, None], np.ones(len(views), bool), True)
    slopes = approx_fprime(CENTRE, predict)
    weighted = slopes * normal_weights(measured)[:, None]
    information = weighted.T @ weighted + np.diag(1 / SPREAD**2)
    return ShapeFit(CENTRE.copy(), coefficients, information, cost=0.0, misfit=0.0, evaluations=0)


def candidate_pairs(separation_deg: float) -> np.ndarray:
    """List (n, 4) degrees: theta_i, phi_i, theta_r, phi_r of oblique pairs of a weave with two mirror planes.

    The lamp stays in the quarter from weft to warp; the camera goes all round.
    """
    lamps = [(t, p) for t in np.arange(GRID_DEG, 90, GRID_DEG) for p in np.arange(0, 91, GRID_DEG)]
    views = [(0.0, 0.0)]
    views += [(t, p) for t in np.arange(GRID_DEG, 90, GRID_DEG) for p in np.arange(0, 360, GRID_DEG)]
    pairs = np.array([(*lamp, *view) for lamp in lamps for view in views])
    incident, outgoing = unit(*np.radians(pairs[:, :2]).T), unit(*np.radians(pairs[:, 2:]).T)
    return pairs[np.degrees(between(incident, outgoing)) >= separation_deg - 1e-6]


def recommend_oblique(
    views_deg: np.ndarray, count: int, separation_deg: float
) -> list[tuple[float, float, float, float]]:
    """Choose pairs (theta_i, phi_i, theta_r, phi_r) in degrees, by lamp, to add to views (n, 2) of normal incidence."""
    pairs = candidate_pairs(separation_deg)
    fit = expected_fit(unit(*np.radians(views_deg).T))
    incident, outgoing = unit(*np.radians(pairs[:, :2]).T), unit(*np.radians(pairs[:, 2:]).T)
    chosen = pairs[choose_oblique(fit, incident, outgoing, count)]
    return [(a, b, c, d) for a, b, c, d in chosen[np.lexsort(chosen.T[::-1])].tolist()]
