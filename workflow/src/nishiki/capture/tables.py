"""Tables of a capture beside frames.csv: projection matrices, points found in pictures, spectra."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

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
    """By view: projection matrices (3, 4) float64, and Brown's distortions k1, k2, p1, p2, k3, empty without."""

    matrices: dict[str, np.ndarray]
    distortions: dict[str, tuple[float, ...]]


def read_cameras(path: Path, name: str) -> CameraTable:
    """Columns view, p11 ... p34 (row by row), and k1, k2, p1, p2, k3 where the lenses are distorted.

    Raises CaptureError with every mistake: cameras-missing, cameras-unreadable, cameras-many, cameras-columns,
    camera-values, camera-not-finite, camera-singular, camera-duplicate, name-unusable.
    """
    matrices: dict[str, np.ndarray] = {}
    distortions: dict[str, tuple[float, ...]] = {}
    problems: list[Problem] = []
    with reading(name, "cameras"):
        rows = list(table_rows(path, name))
    expected = "view, then the 12 numbers p11 ... p34 of the 3x4 matrix, row by row; k1, k2, p1, p2, k3 may follow"
    expect_rows(len(rows) - 1, "views", name, "cameras")
    heading = [cell.casefold() for cell in rows[0][1]] if rows else []
    wide = [["view", *MATRIX_COLUMNS], ["view", *MATRIX_COLUMNS, *LENS_COLUMNS]]
    if heading not in wide:
        found = ",".join(rows[0][1])[:90] if rows else "no heading"
        refuse("cameras-columns", name, "columns", expected=expected, found=found)
    count = len(heading) - 1
    for number, cells in rows[1:]:
        where = f"{name} row {number}"
        values = _numbers(cells[1:])
        if values is None or len(values) != count or not np.isfinite(values[12:]).all():
            found = f"{len(cells) - 1} values" if len(cells) != count + 1 else ",".join(cells)[:60]
            problems.append(error("camera-values", where, "camera", expected=f"{count} numbers", found=found))
            continue
        view, matrix = cells[0], np.array(values[:12]).reshape(3, 4)
        if values[12:]:
            distortions[view] = tuple(values[12:])
        problems += label_problems(view, "view", where)
        if view in matrices:
            what = f"view '{view}' has two cameras"
            problems.append(error("camera-duplicate", where, what, remedy="Keep one row a view"))
        problems += camera_problems(view, matrix, where)
        matrices[view] = matrix
    raise_errors(problems)
    return CameraTable(matrices, distortions)


def arrange_cameras(
    table: CameraTable, views: tuple[str, ...], *, reverse: bool, camera_of: dict[str, str]
) -> CameraTable:
    """Cameras by view as capture.yaml arranges them: another row for some views, the turn reversed.

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
            what, remedy = "the cameras lie on no circle", "Leave turn out, and correct the cameras"
            refuse("turn-unknown", "capture.yaml turntable.turn", what, remedy=remedy)
        arranged = turned
    lenses = {view: table.distortions[camera_of.get(view, view)] for view in views} if table.distortions else {}
    return CameraTable(dict(zip(views, arranged, strict=True)), lenses)


def camera_problems(view: str, matrix: np.ndarray, where: str) -> list[Problem]:
    """Whether a 3x4 matrix is a camera at a finite place: finite, with a regular left part."""
    if not np.isfinite(matrix).all():
        found = f"{int((~np.isfinite(matrix)).sum())} of 12 values are not finite"
        return [error("camera-not-finite", where, f"camera of view '{view}'", expected="12 numbers", found=found)]
    try:
        Camera.from_matrix(view, matrix, rows=1, columns=1)
    except UserError:
        what = f"camera of view '{view}' is singular"
        remedy = "A 3x4 matrix K [R t] of a perspective camera is expected, row by row"
        return [error("camera-singular", where, what, remedy=remedy)]
    return []


def read_points(path: Path, name: str, views: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Image points with their places on the object, by view: (points, 5) float64 column, row, x, y, z.

    Raises CaptureError: points-missing, points-unreadable, points-columns, points-values, points-view, points-few.
    """
    with reading(name, "points"):
        rows = list(table_rows(path, name))
    if not rows or tuple(c.casefold() for c in rows[0][1]) != POINT_COLUMNS:
        found = ",".join(rows[0][1])[:90] if rows else "no heading"
        refuse("points-columns", name, "columns", expected=",".join(POINT_COLUMNS), found=found)
    rows_by_view: dict[str, list] = {}
    problems: list[Problem] = []
    for number, cells in rows[1:]:
        where, values = f"{name} row {number}", _numbers(cells[1:])
        if len(cells) != 6 or values is None or not all(map(math.isfinite, values)):
            expected, found = "a view and 5 finite numbers", ",".join(cells)[:60]
            problems.append(error("points-values", where, "point", expected=expected, found=found))
            continue
        if cells[0] not in views:
            remedy = "Name the view as frames.csv does"
            problems.append(error("points-view", where, f"no view '{cells[0]}'", remedy=remedy))
        rows_by_view.setdefault(cells[0], []).append(values)
    if not problems:
        for view in views:
            count = len(rows_by_view.get(view, ()))
            if count < FEWEST_POINTS:
                expected, remedy = f"at least {FEWEST_POINTS}", "Mark more points of the object in this view"
                what = f"points in view '{view}'"
                problems.append(error("points-few", name, what, expected=expected, found=str(count), remedy=remedy))
    raise_errors(problems)
    return {view: np.array(points) for view, points in rows_by_view.items()}


def camera_centre(matrix: np.ndarray) -> np.ndarray:
    """(3,) place of the camera of a 3x4 matrix: the point that it maps to zero."""
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
    header, rows = _table(path, label)
    if header[:1] != ["wavelength_nm"] or len(header) < 2:
        expected = "wavelength_nm, then one column a curve"
        refuse("spectra-columns", label, "columns", expected=expected, found=",".join(header)[:80])
    selected = list(names) if names else header[1:]
    missing = [n for n in selected if n not in header[1:]]
    if missing or len(set(header)) != len(header):
        what = f"no column for {', '.join(missing)}" if missing else "a column appears twice"
        remedy = "Name the columns as camera.channels does"
        refuse("spectra-columns", label, what, found=",".join(header)[:80], remedy=remedy)
    try:
        numbers = np.array([[float(v) for v in row] for row in rows], dtype=np.float64).reshape(-1, len(header))
    except ValueError as e:
        raise CaptureError(error("spectra-unreadable", label, "a value is not a number", found=str(e))) from e
    wavelengths, values = numbers[:, 0], numbers[:, [header.index(n) for n in selected]]
    raise_errors(_mistakes(wavelengths, values, label))
    return Curves(tuple(selected), wavelengths, values)


def _table(path: Path, label: str) -> tuple[list[str], list[list[str]]]:
    with reading(label, "spectra"):
        rows = [cells for _, cells in table_rows(path, label)]
    if not rows:
        refuse("spectra-unreadable", label, "empty file")
    expect_rows(len(rows[0]), "table_columns", label, "spectra")
    uneven = [i for i, row in enumerate(rows, start=1) if len(row) != len(rows[0])]
    if uneven:
        what = f"row {uneven[0]} has another number of values than the heading"
        refuse("spectra-unreadable", label, what, expected=f"{len(rows[0])} values")
    return rows[0], rows[1:]


def _mistakes(wavelengths: np.ndarray, values: np.ndarray, label: str) -> list:
    if not (np.isfinite(wavelengths).all() and np.isfinite(values).all()):
        bad = int((~np.isfinite(values)).sum() + (~np.isfinite(wavelengths)).sum())
        return [error("spectra-not-finite", label, f"{bad} values are not finite")]
    problems = []
    if len(wavelengths) > 1 and not (np.diff(wavelengths) > 0).all():
        at = wavelengths[1:][np.diff(wavelengths) <= 0][0]
        problems.append(error("spectra-order", label, "wavelengths do not increase", found=f"at {at:g} nm"))
    if len(wavelengths) < 2 or wavelengths.min() > FIRST_NM or wavelengths.max() < LAST_NM:
        found = f"{wavelengths.min():g}-{wavelengths.max():g} nm" if len(wavelengths) else "no rows"
        expected = f"at least {FIRST_NM:g}-{LAST_NM:g} nm"
        remedy = "Measure or extend the curve; it is not extrapolated"
        what = "wavelength range is too short"
        problems.append(error("spectra-range", label, what, expected=expected, found=found, remedy=remedy))
    if (values < 0).any():
        found = f"{values.min():g}"
        problems.append(error("spectra-negative", label, f"{int((values < 0).sum())} negative values", found=found))
    elif values.size and not (values > 0).any(axis=0).all():
        problems.append(error("spectra-zero", label, "a curve is zero everywhere"))
    return problems
