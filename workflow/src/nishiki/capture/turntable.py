"""Describe, check and read a turntable capture, as one frozen value.

One view under several polariser states is a turntable that does not turn.
"""

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from nishiki.artifacts.declaration import Closed
from nishiki.capture import tables
from nishiki.capture.frames import TABLE, BaseCapture, Frame, exposure_problems, inside, lamp_problems, state_problems
from nishiki.capture.lights import Lights, read_lights
from nishiki.capture.schema import Positive, Session
from nishiki.errors import require
from nishiki.formats.files import bound
from nishiki.formats.files import remedy as bound_remedy
from nishiki.formats.mesh_heading import expect_mesh
from nishiki.formats.problems import MOST_LISTED, Problem, error, warning
from nishiki.geometry.turn import FEWEST_VIEWS, turn_of

UNITS_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "arbitrary": None}
MARKERS = {"4X4": (50, 100, 250, 1000), "5X5": (50, 100, 250, 1000), "6X6": (50, 100, 250, 1000)}
MARKERS |= {"7X7": (50, 100, 250, 1000)}
DICTIONARIES = {f"DICT_{kind}_{count}": count for kind, counts in MARKERS.items() for count in counts}
DICTIONARIES |= {"DICT_ARUCO_ORIGINAL": 1024, "DICT_APRILTAG_16h5": 30, "DICT_APRILTAG_25h9": 35}
DICTIONARIES |= {"DICT_APRILTAG_36h10": 2320, "DICT_APRILTAG_36h11": 587}

MESH_AXES = re.compile("-?[xyz],-?[xyz],-?[xyz]")
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
    def _check_name(cls, name: str) -> str:
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
    """Lamp positions: beside the camera, or given in the camera's frame, in which they stand still."""

    kind: Literal["camera", "direction", "position_mm"] = "direction"
    file: str | None = None

    @model_validator(mode="after")
    def _expect_file(self) -> "TurntableLights":
        if self.kind == "camera" and self.file:
            raise ValueError("lights of kind camera have no file: the lamp stands beside the camera")
        if self.kind != "camera" and not self.file:
            raise ValueError(f"lights of kind {self.kind} need their file")
        return self


class Turntable(Closed):
    """The block `turntable`: what is known of the object's shape and of the cameras round it.

    turn: reverse where the object turned against the order of the cameras; camera_of: the row of `cameras` for each
    view whose camera has another name; height: of the object along the axis, in the unit, which gives cameras that are
    estimated from the photographs their scale.
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
    height: Positive | None = None
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
        """Placement of the mesh in the world of the cameras: scale, source axis of each new axis, and its sign."""
        x, y, z = (("xyz".index(name[-1]), 1 - 2 * (name[0] == "-")) for name in self.mesh_axes.split(","))
        return self.mesh_scale, (x[0], y[0], z[0]), (x[1], y[1], z[1])

    @property
    def files(self) -> tuple[tuple[str, str], ...]:
        """Every file in the block: (key, file)."""
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
        if len(problems) >= MOST_LISTED:
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
    turn = turn_of(np.array([tables.camera_centre(matrices[view]) for view in views]))
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


def estimates_cameras(block: Turntable, views: tuple[str, ...]) -> bool:
    """Return whether views without cameras go once round and their scale is stated, or stated to be arbitrary."""
    return block.full_turn and len(views) >= FEWEST_VIEWS and (block.height is not None or block.unit == "arbitrary")


def _board_problems(frames: tuple[Frame, ...], views: tuple[str, ...], settings: TurntableFile) -> list[Problem]:
    """List contradictions of boards and their description, and views without a camera, which then need boards."""
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
        if estimates_cameras(block, views):
            what = "cameras are estimated from the photographs, which must go once round"
            found = "height stated" if block.height else "no height, so that the scale is arbitrary"
            return [*problems, warning("cameras-estimated", "capture.yaml", what, found=found)]
        what = "camera positions are unknown: only separation by polarisers is possible"
        remedy = (
            "Give turntable.cameras, correspondences, or pictures of a board in each view; or let them be estimated "
            f"from {FEWEST_VIEWS} views or more, once round: full_turn: true with height, or with unit: arbitrary"
        )
        return [*problems, warning("cameras-none", "capture.yaml", what, remedy=remedy)]
    what = "has no picture of the board, nor a camera"
    return problems + [
        error("view-without-camera", TABLE, f"view '{view}' {what}") for view in views if view not in posed
    ]


@dataclass(frozen=True)
class TurntableCapture(BaseCapture):
    """An object photographed from many sides.

    views, light_names, states: of the sample frames in the order in which they first appear, ('',) where the column is
    empty, but 'off' before 'on'; lights: the lamps of the lights file, or None; matrices: (3, 4) float64 by view, or
    None; distortions: k1, k2, p1, p2, k3 by view, empty where cameras.csv has none; points: (n, 5) float64 column, row,
    x, y, z by view, or None; scans, mesh, calibration: files; warnings: what was tolerated.
    """

    settings: TurntableFile
    views: tuple[str, ...]
    light_names: tuple[str, ...]
    states: tuple[str, ...]
    lights: Lights | None
    matrices: dict[str, np.ndarray] | None
    distortions: dict[str, tuple[float, ...]]
    points: dict[str, np.ndarray] | None
    intrinsics: tables.Intrinsics | None
    mesh: Path | None
    scans: tuple[Path, ...]
    calibration: Path | None
    warnings: tuple[Problem, ...]

    @property
    def observed(self) -> tuple[Frame, ...]:
        """Frames of the object, ordered by light, then view, then polariser state: how observations are numbered."""
        by_state = {(f.light, f.view, f.polariser): f for f in self.frames_of("sample")}
        orders = [{name: i for i, name in enumerate(n)} for n in (self.light_names, self.views, self.states)]
        known = (key for key in by_state if all(name in order for name, order in zip(key, orders, strict=True)))
        return tuple(
            by_state[key] for key in sorted(known, key=lambda k: [o[n] for n, o in zip(k, orders, strict=True)])
        )

    def distortion_of(self, view: str) -> tuple[float, ...]:
        """Return Brown's k1, k2, p1, p2, k3 of a view's lens: from its camera, else from the intrinsics, else zeros."""
        shared = self.intrinsics.distortion if self.intrinsics else (0.0,) * 5
        return self.distortions.get(view, shared)

    def silhouette_of(self, view: str) -> Frame | None:
        """Find the frame whose row names the silhouette of this view."""
        return next((f for f in self.frames if f.view == view and f.silhouette_path), None)


def examine_turntable(
    read: BaseCapture, complete: bool, attempt: Callable
) -> tuple[TurntableCapture | None, list[Problem]]:
    """Read the capture (None where its tables cannot be read) and list how its tables contradict each other.

    complete: whether frames.csv could be read; attempt: runs a reader, collecting the problems that it raises.
    """
    settings, payload, block = read.settings, read.payload, read.settings.turntable
    places = {(key, file): attempt(lambda f=file, k=key: inside(payload, f, f"capture.yaml {k}"))
              for key, file in block.files}  # fmt: skip

    def resolve(key: str) -> Path | None:
        return places.get((f"turntable.{key}", getattr(block, key)))

    def from_file(key: str, reader: Callable):
        return attempt(lambda: reader(resolve(key), getattr(block, key))) if resolve(key) else None

    for (key, file), path in places.items():
        if path is not None and key in ("turntable.mesh", "turntable.scans"):
            scan = key == "turntable.scans"
            attempt(lambda p=path, f=file, k=key, s=scan: expect_mesh(p, f, f"capture.yaml {k}", scan=s))
    file, kind = (settings.lights.file, settings.lights.kind) if settings.lights else (None, "direction")
    listed = attempt(lambda: inside(payload, file, "capture.yaml lights.file")) if file else None
    lights = attempt(lambda: read_lights(listed, kind=kind, frontal=False)) if listed else None
    table, intrinsics = from_file("cameras", tables.read_cameras), from_file("intrinsics", tables.read_intrinsics)
    if not complete:
        return None, []
    frames = _name_lamps(read.frames, lights)
    samples = [f for f in frames if f.role == "sample"]
    views = tuple(dict.fromkeys(f.view for f in samples))
    points = from_file("correspondences", lambda path, name: tables.read_points(path, name, views))
    problems = turntable_problems(frames, views, lights, table.matrices if table else None, settings)
    if table is not None and (block.turn == "reverse" or block.camera_of):
        table = attempt(
            lambda: tables.arrange_cameras(table, views, reverse=block.turn == "reverse", camera_of=block.camera_of)
        )
    states = tuple(dict.fromkeys(f.polariser for f in samples))
    if set(states) == {"off", "on"}:
        states = ("off", "on")  # the first state is the brighter one
    capture = TurntableCapture(
        **vars(read) | {"frames": frames},
        views=views,
        light_names=tuple(dict.fromkeys(f.light for f in samples)),
        states=states,
        lights=lights,
        matrices=table.matrices if table else None,
        distortions=table.distortions if table else {},
        points=points,
        intrinsics=intrinsics,
        mesh=resolve("mesh"),
        scans=tuple(path for (key, _), path in places.items() if key == "turntable.scans" and path),
        calibration=resolve("calibration"),
        warnings=tuple(p for p in (*problems, *(lights.warnings if lights else ())) if p.severity == "warning"),
    )
    return capture, problems + list(lights.warnings if lights else ())


def _name_lamps(frames: tuple[Frame, ...], lights: Lights | None) -> tuple[Frame, ...]:
    """Rename the frames' lamps as in the lights file; a single lamp needs no name."""
    if lights is None:
        return frames
    alone = lights.names[0] if len(lights.names) == 1 else ""

    def lamp_name(frame: Frame) -> str:
        place = lights.find(frame.light) if frame.light else None
        return lights.names[place] if place is not None else frame.light or alone

    return tuple(replace(f, light=lamp_name(f)) if f.role in ("sample", "white") else f for f in frames)
