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
    """List everything wrong with how the tables fit together."""
    samples = [f for f in frames if f.role == "sample"]
    if not samples:
        return [error("samples-none", TABLE, "no photograph of the object, of role sample")]
    if len(views) > bound("views"):
        what = f"at most {bound('views')} views are read, found {len(views)}"
        return [error("views-many", TABLE, what, remedy=bound_remedy("views"))]
    return [
        *_cell_problems(frames, views, lights, settings),
        *_grid_problems(samples, views),
        *_white_problems(frames),
        *_silhouette_problems(samples, views),
        *_camera_problems(views, matrices, settings),
        *_board_problems(frames, views, settings),
        *exposure_problems(frames),
    ]


def _cell_problems(
    frames: tuple[Frame, ...], views: tuple[str, ...], lights: Lights | None, settings: TurntableFile
) -> list[Problem]:
    """List cells that a frame of its role needs or cannot have, and lamps that are none of the lights file."""
    lit = [f for f in frames if f.role in ("sample", "white")]
    states, file = (
        {f.polariser for f in frames if f.role == "sample"},
        settings.lights.file if settings.lights else None,
    )
    # Without a file all lamps are named or none is; the mistakes of a file that cannot be read are reported already.
    named = lights is not None if file else any(f.light for f in lit)
    problems = []
    for frame in frames:
        role, view, state, light = frame.role, frame.view, frame.polariser, frame.light
        faults = (
            ("view-empty", role == "sample" and len(views) > 1 and not view, "a sample frame needs its view"),
            ("view-unknown", role == "board" and view not in ("", *views), f"no sample frame shows view '{view}'"),
            ("view-unexpected", role in ("dark", "white") and view, f"a {role} frame serves all views, not '{view}'"),
            ("polariser-unexpected", role in ("dark", "board") and state, f"a {role} frame has no state '{state}'"),
            ("light-empty", named and role in ("sample", "white") and not light, f"a {role} frame needs its light"),
            ("white-state", role == "white" and state not in ("", *states), f"no sample frame has the state '{state}'"),
        )
        problems += [error(kind, f"{TABLE} row {frame.row}", what) for kind, wrong, what in faults if wrong]
    return problems + (lamp_problems(lit, lights, file) if file and lights is not None else [])


def _grid_problems(samples: list[Frame], views: tuple[str, ...]) -> list[Problem]:
    """List what is missing from, or repeated in, the grid of every view under every lamp in every state."""
    states, lights = (tuple(dict.fromkeys(getattr(f, key) for f in samples)) for key in ("polariser", "light"))
    problems = state_problems(states, TABLE)
    last = {(f.light, f.view, f.polariser): f.row for f in samples}
    counts = Counter((f.light, f.view, f.polariser) for f in samples)
    for key, count in counts.items():
        if count > 1:
            what = f"expected one frame of {_frame_name(*key)}, found {count}"
            problems.append(error("frame-repeated", f"{TABLE} row {last[key]}", what))
    if any(p.kind == "polariser-mixed" for p in problems):
        return problems
    for light, view in product(lights, views):
        if len(problems) >= MOST_PROBLEMS:
            break
        lacking = [state for state in states if (light, view, state) not in counts]
        if len(lacking) == len(states):
            problems.append(error("light-missing", TABLE, f"view '{view}' has no frame under light '{light}'"))
        elif lacking:
            what = f"{_frame_name(light, view, '')} has not all {len(states)} polariser states"
            problems.append(error("polariser-missing", TABLE, what, found=f"no {', '.join(map(repr, lacking[:4]))}"))
    return problems


def _frame_name(light: str, view: str, state: str) -> str:
    names = (("view", view), ("light", light), ("polariser", state))
    return ", ".join(f"{what} '{name}'" for what, name in names if name or what == "view")


def _white_problems(frames: tuple[Frame, ...]) -> list[Problem]:
    """List white boards that are missing: those without a state under every lamp, the others in every state."""
    samples, whites = ([f for f in frames if f.role == role] for role in ("sample", "white"))
    plain, problems = Counter(f.light for f in whites if not f.polariser), []
    for light in dict.fromkeys(f.light for f in samples) if plain else ():
        if plain[light] == 0:
            remedy = "Photograph the board under every light, or list no white frames at all"
            problems.append(error("white-missing", TABLE, f"light '{light}' has no white frame", remedy=remedy))
        if plain[light] > 1:
            what = f"expected one white frame under light '{light}', found {plain[light]}"
            problems.append(error("light-repeated", TABLE, what))
    states, kept = {f.polariser for f in samples}, {f.polariser for f in whites if f.polariser}
    if kept and kept != states:
        found = f"no {', '.join(map(repr, sorted(states - kept)[:4]))}"
        problems.append(error("white-missing", TABLE, "white boards lack a polariser state", found=found))
    return problems


def _silhouette_problems(samples: list[Frame], views: tuple[str, ...]) -> list[Problem]:
    problems = []
    given = {view: {f.silhouette for f in samples if f.view == view} - {""} for view in views}
    for view, files in given.items():
        if len(files) > 1:
            found, what = ", ".join(sorted(files)[:3]), f"view '{view}' has several silhouettes"
            problems.append(error("silhouette-several", TABLE, what, found=found))
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
    file, stated = require(settings.turntable.cameras), settings.turntable.full_turn
    problems = [
        error("view-without-camera", file, f"view '{view}' has no camera") for view in views if view not in matrices
    ]
    problems += [
        error("camera-without-view", file, f"view '{view}' has no photograph in {TABLE}")
        for view in matrices
        if view not in views
    ]
    if problems or len(views) < 3:
        return problems
    turn = turn_of(np.array([camera_centre(matrices[view]) for view in views]))
    full, where = turn is not None and turn.full, "capture.yaml turntable.full_turn"
    if stated and not full:
        steps = f"steps of {min(turn.steps_deg):.1f} to {max(turn.steps_deg):.1f} degrees" if turn else "no circle"
        what = "full_turn is true but the cameras do not go once round at about equal steps"
        remedy = f"List the views in the order of the turn in {TABLE}, or set full_turn: false"
        return [warning("turn-uneven", where, what, found=steps, remedy=remedy)]
    if full and not stated:
        remedy = "Set full_turn: true: the residual is then coded as periodic over the views"
        return [warning("turn-full", where, "the cameras go once round, but full_turn is false", remedy=remedy)]
    return []


def _board_problems(frames: tuple[Frame, ...], views: tuple[str, ...], settings: TurntableFile) -> list[Problem]:
    """List how boards and their description disagree, and views without a camera, which boards must then give."""
    boards, block, problems = [f for f in frames if f.role == "board"], settings.turntable, []
    if boards and block.board is None:
        what = f"{len(boards)} frames show a calibration board that turntable.board does not describe"
        problems.append(error("board-undescribed", "capture.yaml", what))
    if block.board is not None and not boards:
        what = f"a calibration board is described, but no frame of role board in {TABLE} shows it"
        problems.append(error("board-without-frame", "capture.yaml turntable.board", what))
    posed = Counter(f.view for f in boards if f.view)
    for view, count in posed.items():
        if count > 1:
            what = f"expected one picture of the board for view '{view}', found {count}"
            problems.append(error("board-repeated", TABLE, what))
    if block.cameras or block.correspondences or len(views) < 2:
        return problems
    if not posed:
        what = "camera positions are unknown: only separation by polarisers is possible"
        remedy = "Give turntable.cameras, correspondences, or pictures of a board in each view"
        return [*problems, warning("cameras-none", "capture.yaml", what, remedy=remedy)]
    what = "has no picture of the board, nor a camera"
    return problems + [
        error("view-without-camera", TABLE, f"view '{view}' {what}") for view in views if view not in posed
    ]
