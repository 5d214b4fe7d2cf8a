"""The description of a turntable, and whether its tables belong together: frames, views, lamps, states, cameras."""

import re
from collections import Counter
from itertools import product
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from nishiki.artifacts.closed import Closed
from nishiki.capture.frames import Frame, exposure_problems, lamp_problems
from nishiki.capture.lights import Lights
from nishiki.capture.polariser import state_problems
from nishiki.capture.schema_base import Positive, Session, read_mapping, validate
from nishiki.capture.tables import camera_centre
from nishiki.errors import require
from nishiki.formats.files import bound
from nishiki.formats.files import remedy as bound_remedy
from nishiki.formats.problems import Problem, error, warning
from nishiki.geometry.turn import turn_of

UNITS_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "arbitrary": None}
MARKERS = {"4X4": (50, 100, 250, 1000), "5X5": (50, 100, 250, 1000), "6X6": (50, 100, 250, 1000)}
MARKERS |= {"7X7": (50, 100, 250, 1000)}
DICTIONARIES = {f"DICT_{kind}_{count}": count for kind, counts in MARKERS.items() for count in counts}
DICTIONARIES |= {"DICT_ARUCO_ORIGINAL": 1024, "DICT_APRILTAG_16h5": 30, "DICT_APRILTAG_25h9": 35}
DICTIONARIES |= {"DICT_APRILTAG_36h10": 2320, "DICT_APRILTAG_36h11": 587}

MESH_AXES = re.compile("-?[xyz],-?[xyz],-?[xyz]")
Finite = Annotated[float, Field(allow_inf_nan=False)]
Squares = Annotated[int, Field(strict=True, ge=3, le=200)]


class Board(Closed):
    """A ChArUco calibration board: a chessboard with a marker in each white square."""

    squares_x: Squares
    squares_y: Squares
    square_mm: Positive
    marker_mm: Positive
    dictionary: str = "DICT_4X4_50"

    @field_validator("dictionary")
    @classmethod
    def _known(cls, name: str) -> str:
        if name not in DICTIONARIES:
            raise ValueError(f"one of {', '.join(DICTIONARIES)}")
        return name

    @model_validator(mode="after")
    def _possible(self) -> "Board":
        if self.marker_mm >= self.square_mm:
            raise ValueError("marker_mm must be smaller than square_mm: a marker lies inside its square")
        needed = self.squares_x * self.squares_y // 2
        if needed > DICTIONARIES[self.dictionary]:
            raise ValueError(
                f"{self.squares_x} x {self.squares_y} squares need {needed} markers, {self.dictionary} has "
                f"{DICTIONARIES[self.dictionary]}"
            )
        return self


class TurntableLights(Closed):
    """Where the lamps were: beside the camera, or given in the camera's frame, in which they stand still."""

    kind: Literal["camera", "direction", "position_mm"] = "direction"
    file: str | None = None

    @model_validator(mode="after")
    def _file_where_needed(self) -> "TurntableLights":
        if self.kind == "camera" and self.file:
            raise ValueError("lights of kind camera have no file: the lamp stands beside the camera")
        if self.kind != "camera" and not self.file:
            raise ValueError(f"lights of kind {self.kind} need their file")
        return self


class Turntable(Closed):
    """The block `turntable`: what is known of the object's shape and of the cameras round it.

    turn: reverse where the object turned against the order of the cameras; camera_of: the row of `cameras` for each
    view whose camera has another name.
    """

    full_turn: bool = False
    unit: Literal["mm", "cm", "m", "arbitrary"] = "mm"
    cameras: str | None = None
    turn: Literal["forward", "reverse"] = "forward"
    camera_of: dict[str, str] = Field(default_factory=dict)
    mesh: str | None = None
    mesh_scale: Positive = 1.0
    mesh_axes: str = "x,y,z"
    scans: tuple[str, ...] = ()
    correspondences: str | None = None
    board: Board | None = None
    intrinsics: str | None = None
    background: Literal["auto", "dark", "bright", "blue", "green"] = "auto"
    calibration: str | None = None

    @field_validator("mesh_axes")
    @classmethod
    def _turn(cls, axes: str) -> str:
        if not MESH_AXES.fullmatch(axes) or len({name.strip("-") for name in axes.split(",")}) != 3:
            raise ValueError("three signed axes, each once, such as x,-z,y")
        return axes

    @property
    def mesh_placement(self) -> tuple[float, tuple[int, int, int], tuple[int, int, int]]:
        """What brings the mesh into the world of the cameras: scale, the axis that each new one is, and its sign."""
        x, y, z = (("xyz".index(name[-1]), 1 - 2 * (name[0] == "-")) for name in self.mesh_axes.split(","))
        return self.mesh_scale, (x[0], y[0], z[0]), (x[1], y[1], z[1])

    @property
    def files(self) -> tuple[tuple[str, str], ...]:
        """Every file that the block names: (key, file)."""
        single = ("cameras", "mesh", "correspondences", "intrinsics", "calibration")
        named = [(f"turntable.{key}", getattr(self, key)) for key in single if getattr(self, key)]
        return (*named, *(("turntable.scans", scan) for scan in self.scans))


class TurntableFile(Session):
    """capture.yaml of a turntable, or of a series of polariser states."""

    geometry: Literal["turntable"]
    lights: TurntableLights | None = None
    turntable: Turntable = Turntable()

    @property
    def region_of_interest(self) -> None:
        """Photographs are used whole: camera matrices count from their corner."""
        return None

    @model_validator(mode="after")
    def _positions_need_a_unit(self) -> "TurntableFile":
        if self.lights and self.lights.kind == "position_mm" and self.turntable.unit == "arbitrary":
            raise ValueError("lights of kind position_mm need turntable.unit to be mm, cm or m")
        return self


class Intrinsics(Closed):
    """intrinsics.yaml: focal lengths and principal point in pixels, Brown's distortion k1, k2, p1, p2, k3."""

    fx: Positive
    fy: Positive
    cx: Finite
    cy: Finite
    skew: Finite = 0.0
    distortion: tuple[Finite, Finite, Finite, Finite, Finite] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def as_dict(self) -> dict:
        """matrix (3 rows of 3) and distortion as plain lists."""
        matrix = [[self.fx, self.skew, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]
        return {"matrix": matrix, "distortion": list(self.distortion)}


def read_intrinsics(path: Path, name: str) -> Intrinsics:
    """Parse intrinsics.yaml. CaptureError: yaml-missing, yaml-invalid, unknown-key, missing-key, wrong-value."""
    return validate(Intrinsics, read_mapping(path), name)


TABLE = "frames.csv"
MOST_PROBLEMS = 100  # photographs that are missing from the grid of views, lights and states


def turntable_problems(
    frames: tuple[Frame, ...],
    views: tuple[str, ...],
    lights: Lights | None,
    matrices: dict[str, np.ndarray] | None,
    settings: TurntableFile,
) -> list[Problem]:
    """Everything wrong with how the tables fit together."""
    samples = [f for f in frames if f.role == "sample"]
    if not samples:
        remedy = "Photographs of the object have the role sample"
        return [error("samples-none", TABLE, "no photograph of the object", remedy=remedy)]
    if len(views) > bound("views"):
        expected, found = f"at most {bound('views')}", f"{len(views)}"
        return [error("views-many", TABLE, "views", expected=expected, found=found, remedy=bound_remedy("views"))]
    return [
        *_view_problems(frames, views),
        *_light_problems(frames, lights, settings),
        *_grid_problems(samples, views),
        *_white_problems(frames),
        *_silhouette_problems(samples, views),
        *_camera_problems(views, matrices, settings),
        *_board_problems(frames, views, settings),
        *_pose_problems(frames, views, settings),
        *exposure_problems(frames),
    ]


def _row(frame: Frame) -> str:
    return f"{TABLE} row {frame.row}"


def _view_problems(frames: tuple[Frame, ...], views: tuple[str, ...]) -> list[Problem]:
    problems = []
    several = len(views) > 1
    for frame in frames:
        if frame.role == "sample" and several and not frame.view:
            remedy = "Give every sample frame the name of its view, in the order of the turn"
            problems.append(error("view-empty", _row(frame), "a sample frame needs its view", remedy=remedy))
        if frame.role == "board" and frame.view and frame.view not in views:
            what = f"no sample frame shows view '{frame.view}'"
            remedy = "Name the view as its sample frame does, or leave it empty for a picture of the board alone"
            problems.append(error("view-unknown", _row(frame), what, remedy=remedy))
        if frame.role in ("dark", "white") and frame.view:
            what, remedy = f"a {frame.role} frame has no view", "Leave the column empty: it serves all views"
            problems.append(error("view-unexpected", _row(frame), what, found=repr(frame.view), remedy=remedy))
        if frame.role in ("dark", "board") and frame.polariser:
            what = f"a {frame.role} frame has no polariser state"
            problems.append(error("polariser-unexpected", _row(frame), what, found=repr(frame.polariser)))
    return problems


def _light_problems(frames: tuple[Frame, ...], lights: Lights | None, settings: TurntableFile) -> list[Problem]:
    """Lamps named in the frames against those of the lights file; without a file, all named or none."""
    lit = [f for f in frames if f.role in ("sample", "white")]
    problems = []
    if settings.lights is None or settings.lights.file is None:
        names = {f.light for f in lit}
        if "" in names and len(names) > 1:
            frame = next(f for f in lit if not f.light)
            remedy = "Name the lamp of every sample and white frame, or of none"
            problems.append(error("light-empty", _row(frame), f"a {frame.role} frame needs its light", remedy=remedy))
        return problems
    if lights is None:
        return problems  # its own mistakes are reported already
    problems = [
        error("light-empty", _row(f), f"a {f.role} frame needs its light", remedy="Name it as in the lights")
        for f in lit
        if not f.light
    ]
    return problems + lamp_problems(lit, lights, settings.lights.file)


def _grid_problems(samples: list[Frame], views: tuple[str, ...]) -> list[Problem]:
    """Every view under every lamp in every polariser state, once."""
    states = tuple(dict.fromkeys(f.polariser for f in samples))
    lights = tuple(dict.fromkeys(f.light for f in samples))
    problems = state_problems(states, TABLE)
    counts = Counter((f.light, f.view, f.polariser) for f in samples)
    last = {(f.light, f.view, f.polariser): f for f in samples}
    for key, count in counts.items():
        if count > 1:
            found = f"{count} frames of {_frame_name(*key)}"
            remedy = "Keep one frame of each view, light and polariser state"
            problems.append(error("frame-repeated", _row(last[key]), "one frame each", found=found, remedy=remedy))
    if any(p.kind == "polariser-mixed" for p in problems):
        return problems
    for light, view in product(lights, views):
        if len(problems) > MOST_PROBLEMS:
            break
        lacking = [state for state in states if (light, view, state) not in counts]
        if len(lacking) == len(states):
            what = f"view '{view}' has no frame under light '{light}'"
            remedy = "Photograph every view under every light"
            problems.append(error("light-missing", TABLE, what, remedy=remedy))
        elif lacking:
            found = ", ".join(repr(state) for state in lacking[:4])
            what, remedy = f"{_frame_name(light, view, None)} lacks a polariser state", "Photograph it in every state"
            expected = f"{len(states)} states"
            problems.append(
                error("polariser-missing", TABLE, what, expected=expected, found=f"no {found}", remedy=remedy)
            )
    return problems


def _frame_name(light: str, view: str, state: str | None) -> str:
    parts = [f"view '{view}'"] + ([f"light '{light}'"] if light else []) + ([f"polariser '{state}'"] if state else [])
    return ", ".join(parts)


def _white_problems(frames: tuple[Frame, ...]) -> list[Problem]:
    """White boards: in states that the sample has, or without one; the normalising ones under every lamp."""
    whites = [f for f in frames if f.role == "white"]
    samples = [f for f in frames if f.role == "sample"]
    states, lights = {f.polariser for f in samples}, tuple(dict.fromkeys(f.light for f in samples))
    problems = []
    for frame in whites:
        if frame.polariser and frame.polariser not in states:
            what, remedy = f"no sample frame has the polariser state '{frame.polariser}'", "Correct or remove the row"
            problems.append(error("white-state", _row(frame), what, remedy=remedy))
    plain = Counter(f.light for f in whites if not f.polariser)
    for light in lights if plain else ():
        count = plain[light]
        if count == 0:
            what = f"light '{light}' has no white frame"
            remedy = "Photograph the board under every light, or list no white frames at all"
            problems.append(error("white-missing", TABLE, what, remedy=remedy))
        if count > 1:
            found = f"{count} under light '{light}'"
            problems.append(error("light-repeated", TABLE, "one white frame a light", found=found))
    kept = {f.polariser for f in whites if f.polariser}
    if kept and kept != states:
        lacking = ", ".join(repr(state) for state in sorted(states - kept)[:4])
        what, remedy = "white boards lack a polariser state", "Photograph the board in every state"
        problems.append(error("white-missing", TABLE, what, found=f"no {lacking}", remedy=remedy))
    return problems


def _silhouette_problems(samples: list[Frame], views: tuple[str, ...]) -> list[Problem]:
    problems = []
    given: dict[str, set[str]] = {view: set() for view in views}
    for frame in samples:
        if frame.silhouette:
            given[frame.view].add(frame.silhouette)
    for view, files in given.items():
        if len(files) > 1:
            found = ", ".join(sorted(files)[:3])
            remedy = "Name the same file in all rows of the view, or in one of them"
            what = f"view '{view}' has several silhouettes"
            problems.append(error("silhouette-several", TABLE, what, found=found, remedy=remedy))
    without = [view for view, files in given.items() if not files]
    if without and len(without) < len(views):
        found = f"{len(without)} of {len(views)} views without, the first '{without[0]}'"
        remedy = "They are found from the pictures for the others; give all, or none"
        problems.append(warning("silhouette-partial", TABLE, "silhouettes of some views", found=found, remedy=remedy))
    return problems


def _camera_problems(
    views: tuple[str, ...], matrices: dict[str, np.ndarray] | None, settings: TurntableFile
) -> list[Problem]:
    if matrices is None:
        return []
    file, problems = require(settings.turntable.cameras), []
    for view in [view for view in views if view not in matrices]:
        remedy = "Add its row to the cameras, or remove its photographs"
        problems.append(error("view-without-camera", file, f"view '{view}' has no camera", remedy=remedy))
    for view in [view for view in matrices if view not in views]:
        remedy = f"Add its photograph to {TABLE}, or remove the camera"
        problems.append(error("camera-without-view", file, f"view '{view}' has no photograph", remedy=remedy))
    if problems or len(views) < 3:
        return problems
    turn = turn_of(np.array([camera_centre(matrices[view]) for view in views]))
    full = turn is not None and turn.full
    if settings.turntable.full_turn and not full:
        found = (
            f"steps of {min(turn.steps_deg):.1f} to {max(turn.steps_deg):.1f} degrees" if turn else "a straight line"
        )
        what, expected = "full_turn is true but the cameras do not go once round at about equal steps", "equal steps"
        remedy = f"List the views in the order of the turn in {TABLE}, or set full_turn: false"
        problems.append(warning("turn-uneven", "capture.yaml turntable.full_turn", what,
                                expected=expected, found=found, remedy=remedy))  # fmt: skip
    if full and not settings.turntable.full_turn:
        remedy = "Set full_turn: true: the residual is then coded as periodic over the views"
        what = "the cameras go once round, but full_turn is false"
        problems.append(warning("turn-full", "capture.yaml turntable.full_turn", what, remedy=remedy))
    return problems


def _board_problems(frames: tuple[Frame, ...], views: tuple[str, ...], settings: TurntableFile) -> list[Problem]:
    boards = [f for f in frames if f.role == "board"]
    problems = []
    if boards and settings.turntable.board is None:
        what = "frames of a calibration board, but no description of it"
        expected = "turntable.board with squares_x, squares_y, square_mm, marker_mm, dictionary"
        problems.append(
            error("board-undescribed", "capture.yaml", what, expected=expected, found=f"{len(boards)} frames")
        )
    if settings.turntable.board is not None and not boards:
        what, remedy = "a calibration board is described, but no frame shows it", "List its pictures with role board"
        problems.append(error("board-without-frame", "capture.yaml turntable.board", what, remedy=remedy))
    for view, count in Counter(f.view for f in boards if f.view).items():
        if count > 1:
            found = f"{count} for view '{view}'"
            problems.append(error("board-repeated", TABLE, "one picture of the board a view", found=found))
    return problems


def _pose_problems(frames: tuple[Frame, ...], views: tuple[str, ...], settings: TurntableFile) -> list[Problem]:
    """Where neither matrices nor correspondences tell where a view was taken from, boards must, for all or none."""
    block = settings.turntable
    if block.cameras or block.correspondences or len(views) < 2:
        return []
    posed = {f.view for f in frames if f.role == "board" and f.view}
    if not posed:
        what = "camera positions are unknown: only separation by polarisers is possible"
        remedy = "Give turntable.cameras, correspondences, or pictures of a board in each view"
        return [warning("cameras-none", "capture.yaml", what, remedy=remedy)]
    return [
        error("view-without-camera", TABLE, f"view '{view}' has no picture of the board, nor a camera")
        for view in views
        if view not in posed
    ]
