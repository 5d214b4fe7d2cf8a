"""Declare and check the options of `convert`, which every reader of a folder layout gets."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from nishiki.formats.problems import Problem, error, refuse

Values = Literal["brdf", "radiance_factor", "radiance_factor_percent", "brdf_cos_view", "brdf_cos_light"]
Azimuths = Literal["cloth", "lamp", "mirror"]
ANGLES = ("azimuth_elevation", "elevation_azimuth", "azimuth_polar", "polar_azimuth")
LIGHT_KINDS = ("direction", "position_mm", *ANGLES)
"""Kinds of numbers in a lights file; angles in degrees or radians by their range, azimuth from x (right) towards
y (up), elevation from the object's plane, polar from its normal."""
NO_PHOTOGRAPHS = "What is converted holds no photographs; leave the option out"


def declare(spelling: str, text: str, default: Any = None, **how: Any) -> Any:
    """Declare a field with its option of the command line; how: further settings of `commands.declare.option`."""
    return field(default=default, metadata={"spelling": spelling, "text": text, "how": how})


@dataclass(frozen=True)
class ConvertOptions:
    """Options that a user gives `convert` beside source and target; each field is declared with its help.

    None stands for what is usual, or what the source itself tells. lights_order: see `lights.rearrange`; white: see
    `pairing.pair_by_name`; camera_of: the camera, by the name of another view, of each view that has not its own;
    region: row, column, rows, columns; link: then never edit either; examine: finds what is wrong with the folder that
    was made, as `check_capture` does; errors are raised.
    """

    title: str | None = declare("--title TEXT", "title of the object (default: name of the source)")
    encoding: Literal["linear", "srgb"] | None = declare(
        "--encoding linear|srgb", "encoding of the photographs (default: as their files state)"
    )
    lights_file: Path | None = declare(
        "--lights FILE",
        "lights file, where it is not found by itself; for a relightable image: the lamps to render it under",
    )
    lights_kind: str | None = declare(
        f"--lights-kind {'|'.join(LIGHT_KINDS)}",
        "what the numbers of the lights file are, where it is not clear; elevation is counted from the object's plane, "
        "the polar angle from its normal",
    )
    lights_order: str | None = declare(
        "--lights-order ORDER",
        "which listed lamp each photograph shows: shift:N (the lamp N places on), reverse, or numbers: 2,1,3",
    )
    lights_axes: str | None = declare(
        "--lights-axes X,Y[,Z][,turn:DEG]",
        "axes of the lamps in terms of those listed: x,-y where y was counted downwards, --lights-axes=-x,y; then "
        "2.54z for heights in another unit, or h where sine and cosine of the elevation were exchanged; then turn:30, "
        "by degrees from x towards y",
    )
    width_mm: float | None = declare("--width-mm MM", "width of the whole photographs on the object", type=float)
    mask: Path | None = declare(
        "--mask FILE",
        "picture that is light where the object is, or has its shape as alpha; turntable: a folder of them",
    )
    white: Path | None = declare("--white FOLDER", "photographs of the white board, one per lamp, paired by name")
    dark: Path | None = declare("--dark FOLDER", "dark frames: photographs with the lens closed")
    ambient: Path | None = declare(
        "--ambient FILE", "photograph without lamp, in the light of the room alone, or a folder of such"
    )
    checks: tuple[str, ...] = declare("--check LAMP", "a lamp kept for evaluation (repeatable)", (), multiple=True)
    values: Values | None = declare(
        f"--values {'|'.join(get_args(Values))}", "what a table of reflectances holds (default: brdf, in 1/sr)"
    )
    azimuths: Azimuths | None = declare(
        "--azimuths cloth|lamp|mirror",
        "what the azimuth of the view in a table is counted from (default: cloth, the weft, as that of the light)",
    )
    link: bool = declare("--link", "make hard links instead of copies; both folders on one disk", False)
    fields: bool = declare(
        "--fields", "the folders in this one are overlapping fields of one painting under the same lamps", False
    )
    turntable: bool = declare(
        "--turntable", "photographs of an object, once round: their cameras are estimated where none are given", False
    )
    height_mm: float | None = declare(
        "--height-mm MM", "height of the object on the turntable, which gives estimated cameras their scale", type=float
    )
    turn: Literal["reverse"] | None = declare(
        "--turn reverse", "turntable: the object turned in the direction opposite to the order of the cameras"
    )
    camera_of: dict[str, str] | None = declare(
        "--camera-of VIEW=CAMERA,...", "turntable: the camera of another view, for views whose own is wrong"
    )
    region: tuple[int, int, int, int] | None = declare(
        "--roi ROW COLUMN ROWS COLUMNS",
        "part of the photographs to use: first row and column, number of rows and columns",
        nargs=4,
        type=int,
    )
    examine: Callable[[Path], list[Problem]] | None = None

    def __post_init__(self) -> None:
        """Raise CaptureError (option-unusable) for a length that is none, or a kind of lights that is not known."""
        if self.lights_kind not in (None, *LIGHT_KINDS):
            what = f"expected one of {', '.join(LIGHT_KINDS)}, found {self.lights_kind}"
            refuse("option-unusable", "lights-kind", what)
        for name, length in (("width-mm", self.width_mm), ("height-mm", self.height_mm)):
            if length is not None and not 0 < length < 1e9:
                refuse("option-unusable", name, "no length", expected="millimetres", found=f"{length:g}")

    def refuse(self, remedy: str, *fields: str) -> None:
        """Raise CaptureError (option-unusable) where one of these fields, which a layout does not use, is given."""
        spelling = {each.name: each.metadata["spelling"] for each in dataclasses.fields(self) if each.metadata}
        given = [spelling[name].split()[0].removeprefix("--") for name in fields if getattr(self, name)]
        if given:
            refuse("option-unusable", ", ".join(given), "cannot be used here", remedy=remedy)


def folder_problems(**given: Path | None) -> list[Problem]:
    """List folder-missing for each option that must name a folder of photographs and does not."""
    remedy = "Give a folder that holds one picture a light; of a turntable one a view, or one a polariser state"
    absent = [f"--{name} {path}" for name, path in given.items() if path is not None and not path.is_dir()]
    return [error("folder-missing", place, "no such folder", remedy=remedy) for place in absent]


def file_problems(**given: Path | None) -> list[Problem]:
    """List file-missing for each option that must name a file and does not."""
    absent = [f"--{name} {path}" for name, path in given.items() if path is not None and not path.is_file()]
    return [error("file-missing", place, "no such file") for place in absent]
