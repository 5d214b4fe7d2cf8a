"""Read folders of turntables and polarisation series from other projects: which camera took which picture."""

import io
import re
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from nishiki.capture.frames import FEWEST_ANGLES, SourcePhotographs, parse_state, state_warnings
from nishiki.capture.layouts import natural_key, natural_parts, photographs_in, source_problems
from nishiki.capture.options import ConvertOptions
from nishiki.capture.registered import PictureIndex, Registration, aim_problems, reading_cameras
from nishiki.capture.seal import sha256_of
from nishiki.capture.tables import camera_centre, camera_problems
from nishiki.errors import require
from nishiki.formats.files import bound, files_with, read_text
from nishiki.formats.images import read_header
from nishiki.formats.picture_files import IMAGE_SUFFIXES
from nishiki.formats.picture_process import read_matlab
from nishiki.formats.problems import (
    CaptureError,
    Problem,
    error,
    expect_one,
    left_out,
    name_some,
    raise_errors,
    refuse,
    warning,
)
from nishiki.formats.text_tables import expect_rows, number_of, reading
from nishiki.geometry.camera import Camera
from nishiki.geometry.turn import FEWEST_VIEWS, order_round, turn_of

STATES = re.compile(r"(\d+(?:\.\d+)?)_(\d+(?:\.\d+)?)")
SEVERAL = ("several files of cameras", "Keep the one that belongs to these photographs")
TURN = "photographs of a turn"  # name of their layout
LEAST_TURN = 20.0  # degrees between the outermost angles of a polariser that is turned


@dataclass(frozen=True)
class RoundLayout(SourcePhotographs):
    """Photographs of an object from many sides, with their cameras.

    photographs[i] shows views[i] in the polariser state states[i] ('' for none); matrices (views, 3, 4) or None;
    calibration: the instrument's own file, or None; distortions (views, 5): k1, k2, p1, p2, k3, or None.
    """

    name: str
    photographs: tuple[Path, ...]
    views: tuple[str, ...]
    states: tuple[str, ...]
    matrices: np.ndarray | None
    full_turn: bool
    calibration: Path | None
    warnings: tuple[Problem, ...]
    distortions: np.ndarray | None = None
    geometry = "turntable"

    @property
    def parts(self) -> str:
        """Photographs and cameras, or states, in words."""
        known = "no cameras" if self.full_turn else f"{len(set(self.states))} polariser states"
        known = known if self.matrices is None else f"{len(self.matrices)} cameras"
        return f"{self.count} photographs, {known}"


def find_camera_list(source: Path, options: ConvertOptions) -> Path | None:
    """Find a list of cameras as the Middlebury multi-view sets have it. CaptureError where there are several."""
    lists = [path for path in files_with(source, (".txt",)) if _is_camera_list(path)]
    return expect_one(lists, source, *SEVERAL)


def find_matrices(source: Path, options: ConvertOptions) -> tuple[Path, np.ndarray] | None:
    """Find the MATLAB file beside photographs that holds projection matrices P, with the matrices.

    Beside a polarisation series a file that cannot be read is its calibration, which is taken along unread.
    CaptureError where one cannot be read, or several hold matrices.
    """
    series = bool(find_states(source, options))
    stored = {}
    for path in files_with(source, (".mat",)) if photographs_in(source) else ():
        try:
            matrices = _matrices_in(path)
        except CaptureError:
            if not series:
                raise
            continue
        if matrices is not None:
            stored[path] = matrices
    path = expect_one(list(stored), source, *SEVERAL)
    return (path, stored[path]) if path else None


def find_turn(source: Path, options: ConvertOptions) -> list[Path] | None:
    """Find photographs that the user says to show an object once round."""
    return (photographs_in(source) or None) if options.turntable or options.height_mm else None


def read_turn(source: Path, photographs: list[Path], options: ConvertOptions) -> RoundLayout:
    """Read photographs once round in the natural order of their names, without cameras; repeated ones are left out."""
    notes, first, kept = [], {}, []
    for path in photographs:
        same = first.setdefault(sha256_of(path), path)
        if same is path:
            kept.append(path)
        else:
            what = "the photograph repeats another and was left out"
            notes.append(warning("photograph-repeats", path.name, what, found=f"it is the same file as {same.name}"))
    expect_rows(len(kept), "views", str(source), "photographs")
    if len(kept) < FEWEST_VIEWS:
        what = "too few photographs to estimate cameras from"
        remedy = "Photograph the object in 24 or 36 equal steps, or give camera matrices"
        expected = f"{FEWEST_VIEWS} different ones or more, once round"
        refuse("photographs-count", str(source), what, expected=expected, found=f"{len(kept)}", remedy=remedy)
    none = ("",) * len(kept)
    views = _view_names(kept)
    return RoundLayout(TURN, tuple(kept), views, none, None, True, None, tuple(notes))


def find_states(source: Path, options: ConvertOptions) -> list[Path] | None:
    """Find photographs that are all named G_A, the angles of generator and analyser in degrees.

    Angles that are turned are turned by LEAST_TURN at least: rows and columns of tiles, and running numbers, are none.
    """
    photographs = photographs_in(source)
    matches = [match for match in (STATES.fullmatch(p.stem) for p in photographs) if match]
    if len(photographs) < FEWEST_ANGLES or len(matches) < len(photographs):
        return None
    angles = np.array([match.groups() for match in matches], float)
    turns = [float(np.ptp(column)) for column in angles.T]
    turned = [turn for turn in turns if turn > 0]
    sound = bool(turned) and min(turned) >= LEAST_TURN and angles.max() <= 360
    return photographs if sound else None


def _matrices_in(path: Path) -> np.ndarray | None:
    """Read projection matrices (views, 3, 4) float64 of a MATLAB file's variable P: a cell array or one array.

    None where the file has no such variable. CaptureError (cameras-unreadable) where it is no MATLAB file of level 5.
    """
    with reading_cameras(path.name, "MATLAB", "Save it with -v7 in MATLAB, or write cameras.csv by hand"):
        stored = read_matlab(path, ("P",)).get("P")
    if stored is None:
        return None
    if stored.dtype == object:
        cells = list(stored.ravel())
    elif stored.ndim == 3 and stored.shape[:2] == (3, 4):
        cells = list(np.moveaxis(stored, 2, 0))
    else:
        return None
    problems = []
    for i, cell in enumerate(cells):
        if np.shape(cell) != (3, 4) or np.asarray(cell).dtype.kind not in "fiu":
            what = f"expected a matrix of 3 x 4 numbers, found {' x '.join(map(str, np.shape(cell)))}"
            problems.append(error("camera-values", f"{path.name} P{{{i + 1}}}", what))
    raise_errors(problems)
    expect_rows(len(cells), "views", path.name, "cameras")
    return np.array(cells, np.float64).reshape(-1, 3, 4)


def read_numbered_matrices(source: Path, stored: tuple[Path, np.ndarray], options: ConvertOptions) -> RoundLayout:
    """Give each photograph, in natural order, a matrix; a last one that repeats the first is omitted."""
    (path, matrices), photographs = stored, photographs_in(source)
    notes = []
    repeated = len(photographs) > 2 and sha256_of(photographs[0]) == sha256_of(photographs[-1])
    if len(photographs) == len(matrices) + 1 or (repeated and len(photographs) == len(matrices)):
        what = "the last photograph closes the turn and was left out"
        found = "it repeats the first" if repeated else f"{len(matrices)} matrices for {len(photographs)} photographs"
        remedy = "" if repeated else "Check that the first matrix belongs to the first photograph"
        notes.append(warning("photograph-repeats", photographs[-1].name, what, found=found, remedy=remedy))
        photographs = photographs[:-1]
        matrices = matrices[: len(photographs)]
    if len(photographs) != len(matrices):
        what = f"expected {len(matrices)} photographs, one a matrix of {path.name}, found {len(photographs)}"
        refuse("photographs-count", str(source), what)
    what = "matrices have no file names: given to the photographs in the natural order of their names"
    found = f"{photographs[0].name} ... {photographs[-1].name}"
    notes.append(warning("cameras-in-order", path.name, what, found=found))
    return _turntable("turntable with matrices", photographs, matrices, path.name, notes)


def _is_camera_list(path: Path) -> bool:
    """Check whether a file is a count, then as many lines of a picture's name and 21 numbers."""
    try:
        lines = _camera_lines(path)
    except CaptureError:
        return False
    if len(lines) < 2 or len(lines[0]) != 1 or not re.fullmatch(r"[0-9]{1,9}", lines[0][0]):
        return False
    return Path(lines[1][0]).suffix.lower() in IMAGE_SUFFIXES and len(lines[1]) > 12


def _camera_lines(path: Path) -> list[list[str]]:
    """Read words of the lines that are not empty, up to the bound of views."""
    with reading(path.name, "cameras"):
        text = read_text(path, "table_bytes", errors="replace")
    kept = (line.split() for line in io.StringIO(text, newline=None) if line.strip())
    return list(islice(kept, bound("views") + 2))


def read_middlebury(source: Path, path: Path, options: ConvertOptions) -> RoundLayout:
    """Read lines `name k11 ... k33 r11 ... r33 t1 t2 t3`: the camera is K [R t]."""
    lines = _camera_lines(path)
    expect_rows(len(lines) - 1, "views", path.name, "cameras")
    problems, photographs, matrices = [], [], []
    present = {p.name: p for p in source.iterdir() if p.is_file()}
    for number, cells in enumerate(lines[1:], start=2):
        where = f"{path.name} line {number}"
        values = np.array([number_of(cell) for cell in cells[1:]])
        if len(values) != 21 or np.isnan(values).any():
            found = f"{len(values)} values" if len(values) != 21 else "a value that is no number"
            problems.append(error("camera-values", where, f"expected a name and 21 numbers, found {found}"))
            continue
        if cells[0] not in present:
            problems.append(error("photograph-missing", where, f"no photograph '{cells[0]}'"))
            continue
        intrinsics, rotation, translation = values[:9].reshape(3, 3), values[9:18].reshape(3, 3), values[18:]
        photographs.append(present[cells[0]])
        with np.errstate(over="ignore", invalid="ignore"):  # told where the matrix is looked at
            matrices.append(intrinsics @ np.column_stack([rotation, translation]))
    if int(lines[0][0]) != len(lines) - 1:
        what = f"expected {lines[0][0]} cameras as its first line says, found {len(lines) - 1}"
        problems.append(error("cameras-count", path.name, what))
    raise_errors(problems)
    extra = [p.name for p in photographs_in(source) if p not in photographs]
    notes = left_out(extra, str(source), "pictures that the cameras do not name")
    return _turntable("turntable with a list of cameras", photographs, np.array(matrices), path.name, notes)


def place_registered(source: Path, program: str, file: str, found: Registration, pictures: PictureIndex) -> RoundLayout:
    """Pair photographs with the cameras of another program, in the natural order of their names."""
    placed = zip(pictures.paths([view.name for view in found.views], file), found.views, strict=True)
    ordered = sorted(placed, key=lambda each: natural_parts(str(each[0])))
    photographs, views = [path for path, _ in ordered], [view for _, view in ordered]
    if len(set(photographs)) != len(views):
        twice = next(path.name for path in photographs if photographs.count(path) > 1)
        refuse("photograph-repeats", file, f"two cameras of {program} of one photograph", found=twice)
    problems = []
    for view, path in zip(views, photographs, strict=True):
        problems += source_problems(path, source)
        header = read_header(path)
        if (header.rows, header.columns) != (view.rows, view.columns):
            what = f"not the photograph that {program} was given, of {view.columns} x {view.rows} pixels"
            problems.append(error("camera-values", path.name, what, found=f"{header.columns} x {header.rows}"))
    raise_errors(problems)
    folders = dict.fromkeys(path.parent for path in photographs)
    extra = [path.name for folder in folders for path in photographs_in(folder) if path not in photographs]
    notes = [*found.notes, *left_out(extra, file, f"pictures without a camera of {program}")]
    matrices = np.array([view.matrix for view in views])
    cameras = [Camera.from_matrix(v.name, v.matrix, rows=v.rows, columns=v.columns) for v in views]
    notes += aim_problems(np.array([np.column_stack([c.rotation, c.translation]) for c in cameras]), file)
    distortions = np.array([view.lens.distortion for view in views])
    return _turntable(f"turntable with cameras of {program}", photographs, matrices, file, notes, distortions)


def _turntable(
    name: str,
    photographs: list[Path],
    matrices: np.ndarray,
    file: str,
    notes: list[Problem],
    distortions: np.ndarray | None = None,
) -> RoundLayout:
    """Make a layout with its cameras checked, in the order of the turn; find whether they go once round."""
    raise_errors(
        [p for path, m in zip(photographs, matrices, strict=True) for p in camera_problems(path.stem, m, file)]
    )
    centres = np.array([camera_centre(m) for m in matrices])
    order = order_round(centres)
    photographs, matrices = [photographs[i] for i in order], matrices[order]
    turn = turn_of(centres[order])
    return RoundLayout(
        name,
        tuple(photographs),
        _view_names(photographs),
        ("",) * len(photographs),
        matrices,
        turn is not None and turn.full,
        None,
        tuple(notes),
        distortions[order] if distortions is not None and distortions.any() else None,
    )


def _view_names(photographs: list[Path]) -> tuple[str, ...]:
    """Name views by their files, or by number where two files have one name."""
    stems = tuple(path.stem for path in photographs)
    return stems if len(set(stems)) == len(stems) else tuple(f"{i + 1:03d}" for i in range(len(stems)))


def read_series(source: Path, photographs: list[Path], options: ConvertOptions) -> RoundLayout:
    """Read one view in many states; a MATLAB file beside the photographs is the instrument's calibration."""
    pairs = [require(STATES.fullmatch(p.stem)).groups() for p in photographs]
    states = [parse_state(f"{generator}/{analyser}").name for generator, analyser in pairs]
    if len(set(states)) != len(states):
        found = next(state for state in states if states.count(state) > 1)
        refuse("photograph-repeats", str(source), "two photographs of one state", found=found)
    order = sorted(range(len(states)), key=lambda i: parse_state(states[i]).angles_deg)
    notes = state_warnings(photographs, states, str(source))
    calibrations = sorted(files_with(source, (".mat",)), key=natural_key)
    generators, analysers = ({angles[k] for angles in (parse_state(s).angles_deg for s in states)} for k in (0, 1))
    if len(states) != len(generators) * len(analysers):
        what = (
            f"{len(states)} states of {len(generators)} generator and {len(analysers)} analyser angles: not all pairs"
        )
        notes.append(warning("states-incomplete", str(source), what))
    if len(calibrations) > 1:
        what = "several calibration files, of which none was taken along for turntable.calibration"
        notes.append(warning("calibration-several", str(source), what, found=name_some(p.name for p in calibrations)))
    calibration = calibrations[0] if len(calibrations) == 1 else None
    chosen, ordered = tuple(photographs[i] for i in order), tuple(states[i] for i in order)
    views = ("",) * len(states)
    return RoundLayout("polarisation series", chosen, views, ordered, None, False, calibration, tuple(notes))
