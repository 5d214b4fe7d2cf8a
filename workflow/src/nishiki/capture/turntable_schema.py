"""The closed schema of capture.yaml for objects seen from many sides, and of the files that it names."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from nishiki.artifacts.closed import Closed
from nishiki.capture.schema_base import Positive, Session, read_mapping, validate

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
    def _possible(self) -> Board:
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
    def _file_where_needed(self) -> TurntableLights:
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
    def mesh_placement(self) -> tuple[float, tuple[int, ...], tuple[int, ...]]:
        """What brings the mesh into the world of the cameras: scale, the axis that each new one is, and its sign."""
        names = self.mesh_axes.split(",")
        order, signs = (
            tuple(f(name) for name in names) for f in (lambda n: "xyz".index(n[-1]), lambda n: 1 - 2 * (n[0] == "-"))
        )
        return self.mesh_scale, order, signs

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
    def _positions_need_a_unit(self) -> TurntableFile:
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
