"""Read tables of a capture beside frames.csv: projection matrices, image points, spectra."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from nishiki.artifacts.declaration import Closed
from nishiki.capture.schema import Positive, read_mapping, validate
from nishiki.errors import UserError
from nishiki.formats.problems import CaptureError, Problem, error, raise_errors, refuse
from nishiki.formats.text_tables import expect_rows, label_problems, reading, table_rows
from nishiki.geometry.camera import Camera
from nishiki.geometry.turn import scale_turn

MATRIX_COLUMNS = tuple(f"p{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3, 4))
LENS_COLUMNS = ("k1", "k2", "p1", "p2", "k3")
POINT_COLUMNS = ("view", "column", "row", "x", "y", "z")
FEWEST_POINTS = 4  # of a view


@dataclass(frozen=True)
class CameraTable:
    """Cameras by view: projection matrices (3, 4) float64; Brown's distortions k1, k2, p1, p2, k3, empty without."""

    matrices: dict[str, np.ndarray]
    distortions: dict[str, tuple[float, ...]]


def read_cameras(path: Path, name: str) -> CameraTable:
    """Read columns view, p11 ... p34 (row by row), and k1, k2, p1, p2, k3 where the lenses are distorted.

    Raises CaptureError with every mistake: cameras-missing, cameras-unreadable, cameras-many, cameras-columns,
    camera-values, camera-not-finite, camera-singular, camera-duplicate, name-unusable.
    """
    matrices: dict[str, np.ndarray] = {}
    distortions: dict[str, tuple[float, ...]] = {}
    problems: list[Problem] = []
    wide = ("view", *MATRIX_COLUMNS)
    rows, count = _read_rows(path, name, "cameras", wide, (*wide, *LENS_COLUMNS))
    expect_rows(len(rows), "views", name, "cameras")
    for where, cells in rows:
        values = _numbers(cells[1:])
        if values is None or len(values) != count or not np.isfinite(values[12:]).all():
            what = f"expected {count} numbers, found {','.join(cells[1:])[:60]}"
            problems.append(error("camera-values", where, what))
            continue
        view, matrix = cells[0], np.array(values[:12]).reshape(3, 4)
        if values[12:]:
            distortions[view] = tuple(values[12:])
        if view in matrices:
            problems.append(error("camera-duplicate", where, f"view '{view}' has two cameras"))
        problems += label_problems(view, "view", where) + camera_problems(view, matrix, where)
        matrices[view] = matrix
    raise_errors(problems)
    return CameraTable(matrices, distortions)


def _read_rows(path: Path, name: str, kind: str, *headings: Sequence[str]) -> tuple[list[tuple[str, list[str]]], int]:
    """Read a table with a row a view or a point: place and cells of each row, and the number of its numbers.

    CaptureError (KIND-columns) unless it has one of these headings.
    """
    with reading(name, kind):
        rows = list(table_rows(path, name))
    heading = tuple(cell.casefold() for cell in rows[0][1]) if rows else ()
    if heading not in headings:
        expected = " or ".join(",".join(each) for each in headings)
        refuse(f"{kind}-columns", name, f"expected {expected}, found {','.join(heading)[:90] or 'no heading'}")
    return [(f"{name} row {number}", cells) for number, cells in rows[1:]], len(heading) - 1


def arrange_cameras(
    table: CameraTable, views: tuple[str, ...], *, reverse: bool, camera_of: dict[str, str]
) -> CameraTable:
    """Arrange cameras by view as in capture.yaml: another row for some views, the turn reversed.

    Raises CaptureError: view-unknown for names that are no view or no row; turn-unknown where the cameras
    to reverse lie on no circle.
    """
    where, matrices = "capture.yaml turntable.camera_of", table.matrices
    unknown = [name for name in camera_of if name not in views] + [n for n in camera_of.values() if n not in matrices]
    raise_errors(error("view-unknown", where, "no such view or camera", found=name) for name in unknown)
    if any(view not in matrices for view in views):
        return table  # reported as view-without-camera
    arranged = np.array([matrices[camera_of.get(view, view)] for view in views])
    if reverse:
        turned = scale_turn(arranged, np.array([camera_centre(matrix) for matrix in arranged]), -1.0)
        if turned is None:
            refuse("turn-unknown", "capture.yaml turntable.turn", "the cameras lie on no circle, which turn needs")
        arranged = turned
    lenses = {view: table.distortions[camera_of.get(view, view)] for view in views} if table.distortions else {}
    return CameraTable(dict(zip(views, arranged, strict=True)), lenses)


def camera_problems(view: str, matrix: np.ndarray, where: str) -> list[Problem]:
    """Check that a 3x4 matrix is a camera at a finite place: finite, with a regular left part."""
    if not np.isfinite(matrix).all():
        what = f"camera of view '{view}': {int((~np.isfinite(matrix)).sum())} of 12 values are not finite"
        return [error("camera-not-finite", where, what)]
    try:
        Camera.from_matrix(view, matrix, rows=1, columns=1)
    except UserError:
        remedy = "A 3x4 matrix K [R t] of a perspective camera is expected, row by row"
        return [error("camera-singular", where, f"camera of view '{view}' is singular", remedy=remedy)]
    return []


def read_points(path: Path, name: str, views: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Read image points with their places on the object, by view: (points, 5) float64 column, row, x, y, z.

    Raises CaptureError: points-missing, points-unreadable, points-columns, points-values, points-view, points-few.
    """
    points: dict[str, list] = {view: [] for view in views}
    problems: list[Problem] = []
    for where, cells in _read_rows(path, name, "points", POINT_COLUMNS)[0]:
        values = _numbers(cells[1:])
        if len(cells) != 6 or values is None or not all(map(math.isfinite, values)):
            what = f"expected a view and 5 finite numbers, found {','.join(cells)[:60]}"
            problems.append(error("points-values", where, what))
        elif cells[0] not in points:
            problems.append(error("points-view", where, f"no view '{cells[0]}' in frames.csv"))
        else:
            points[cells[0]].append(values)
    for view, listed in points.items() if not problems else ():
        if len(listed) < FEWEST_POINTS:
            what = f"expected {FEWEST_POINTS} points or more in view '{view}', found {len(listed)}"
            problems.append(error("points-few", name, what))
    raise_errors(problems)
    return {view: np.array(listed) for view, listed in points.items()}


def camera_centre(matrix: np.ndarray) -> np.ndarray:
    """Compute the centre (3,) of a camera from its 3x4 matrix: the point that it maps to zero."""
    return -np.linalg.solve(matrix[:, :3], matrix[:, 3])


def _numbers(cells: list[str]) -> list[float] | None:
    try:
        return [float(cell) for cell in cells]
    except ValueError:
        return None


FIRST_NM, LAST_NM = 400.0, 700.0


@dataclass(frozen=True)
class Curves:
    """wavelengths_nm (n,) float64 increasing; values (n, curves) float64, >= 0; names: one a curve."""

    names: tuple[str, ...]
    wavelengths_nm: np.ndarray
    values: np.ndarray


def read_curves(path: Path, *, names: tuple[str, ...] | None = None, label: str | None = None) -> Curves:
    """Read wavelength_nm and one column a curve, covering 400-700 nm.

    names: the columns wanted, in this order (None: all). Raises CaptureError with all mistakes: spectra-missing,
    spectra-unreadable, spectra-many, spectra-columns, spectra-not-finite, spectra-negative, spectra-order,
    spectra-range, spectra-zero.
    """
    label = label or path.name
    with reading(label, "spectra"):
        header, *rows = [cells for _, cells in table_rows(path, label)] or [[]]
    expect_rows(len(header), "table_columns", label, "spectra")
    selected = list(names) if names else header[1:]
    missing = [name for name in selected if name not in header[1:]]
    if header[:1] != ["wavelength_nm"] or not selected or missing or len(set(header)) != len(header):
        expected = f"wavelength_nm and a column for {', '.join(selected) or 'each curve'}, each once"
        refuse("spectra-columns", label, f"expected {expected}, found {','.join(header)[:80] or 'an empty file'}")
    uneven = next((number for number, row in enumerate(rows, start=2) if len(row) != len(header)), None)
    if uneven:
        refuse("spectra-unreadable", label, f"row {uneven} has another number of values than the heading")
    try:
        numbers = np.array([[float(v) for v in row] for row in rows], dtype=np.float64).reshape(-1, len(header))
    except ValueError as e:
        raise CaptureError(error("spectra-unreadable", label, "a value is not a number", found=str(e))) from e
    wavelengths, values = numbers[:, 0], numbers[:, [header.index(n) for n in selected]]
    raise_errors(_mistakes(wavelengths, values, label))
    return Curves(tuple(selected), wavelengths, values)


def _mistakes(wavelengths: np.ndarray, values: np.ndarray, label: str) -> list:
    if not (np.isfinite(wavelengths).all() and np.isfinite(values).all()):
        bad = int((~np.isfinite(values)).sum() + (~np.isfinite(wavelengths)).sum())
        return [error("spectra-not-finite", label, f"{bad} values are not finite")]
    problems, falls = [], np.diff(wavelengths) <= 0
    if falls.any():
        at = wavelengths[1:][falls][0]
        problems.append(error("spectra-order", label, f"wavelengths do not increase at {at:g} nm"))
    if len(wavelengths) < 2 or wavelengths.min() > FIRST_NM or wavelengths.max() < LAST_NM:
        found = f"{wavelengths.min():g}-{wavelengths.max():g} nm" if len(wavelengths) else "no rows"
        what = f"expected wavelengths over {FIRST_NM:g}-{LAST_NM:g} nm or more, found {found}"
        problems.append(
            error("spectra-range", label, what, remedy="The curve is not extrapolated: measure or extend it")
        )
    if (values < 0).any():
        what = f"{int((values < 0).sum())} negative values, the lowest {values.min():g}"
        problems.append(error("spectra-negative", label, what))
    elif values.size and not (values > 0).any(axis=0).all():
        problems.append(error("spectra-zero", label, "a curve is zero everywhere"))
    return problems


Finite = Annotated[float, Field(allow_inf_nan=False)]


class Intrinsics(Closed):
    """intrinsics.yaml: focal lengths and principal point in pixels, Brown's distortion k1, k2, p1, p2, k3."""

    fx: Positive
    fy: Positive
    cx: Finite
    cy: Finite
    skew: Finite = 0.0
    distortion: tuple[Finite, Finite, Finite, Finite, Finite] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def as_dict(self) -> dict:
        """Return matrix (3 rows of 3) and distortion as plain lists."""
        matrix = [[self.fx, self.skew, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]
        return {"matrix": matrix, "distortion": list(self.distortion)}


def read_intrinsics(path: Path, name: str) -> Intrinsics:
    """Parse intrinsics.yaml. CaptureError: yaml-missing, yaml-invalid, unknown-key, missing-key, wrong-value."""
    return validate(Intrinsics, read_mapping(path), name)
