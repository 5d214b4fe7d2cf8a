"""Options of `convert`, which every reader of a folder layout gets, and their checks."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from nishiki.formats.problems import CaptureError, Problem, error, refuse

Values = Literal["brdf", "radiance_factor", "radiance_factor_percent", "brdf_cos_view", "brdf_cos_light"]
Azimuths = Literal["cloth", "lamp", "mirror"]
FLAGS = {
    "lights_file": "lights",
    "lights_kind": "lights-kind",
    "width_mm": "width-mm",
    "lights_order": "lights-order",
    "lights_axes": "lights-axes",
    "checks": "check",
    "region": "roi",
    "camera_of": "camera-of",
}
"""The command's names of fields that have another."""
ANGLES = ("azimuth_elevation", "elevation_azimuth", "azimuth_polar", "polar_azimuth")
LIGHT_KINDS = ("direction", "position_mm", *ANGLES)
"""What the numbers of a lights file can be; angles in degrees or radians by their range, azimuth from x (right) towards
y (up), elevation from the object's plane, polar from its normal."""
NO_PHOTOGRAPHS = "What is converted holds no photographs; leave the option out"


@dataclass(frozen=True)
class ConvertOptions:
    """What a user gives `convert` beside source and target; further options are fields of this class.

    Attributes
    ----------
    lights_file : Path or None
        Lights file, where it is not found by itself; of a relightable image: the lamps to render under.
    lights_kind : str or None
        What the numbers of the lights file are, one of LIGHT_KINDS; None where the file or the photographs
        tell.
    lights_order : str or None
        Which listed lamp each photograph shows, see `lights.reorder`.
    lights_axes : str or None
        Axes of the lamps in terms of those of the lights file, as `x,-y`.
    width_mm : float or None
        Width of the whole photographs on the object, millimetres.
    mask : Path or None
        Picture of the object; for a turntable the folder of the silhouettes.
    white : Path or None
        Folder of the white board's photographs, paired by the part of the names that varies, see `pair_by_name`; for
        a turntable named by their polariser state.
    dark : Path or None
        Folder of dark frames, all of which are averaged.
    ambient : Path or None
        Photograph of the object in the light of the room alone, or a folder of such, all of which are averaged.
    checks : tuple of str
        Lights kept for evaluation.
    encoding : str or None
        Coding of the photographs; None for what is usual.
    title : str or None
        Title of the object; None for the name of the source.
    region : tuple of int or None
        Row, column, rows, columns.
    values : str or None
        What the columns of a table of reflectances hold, see `goniometer_schema.Goniometer`.
    azimuths : str or None
        What phi_r of a table of reflectances is counted from.
    turn : str or None
        "reverse" where the object of a turntable turned against the order of its cameras.
    camera_of : dict of str to str
        Of a turntable: the camera, by the name of another view, of each view that does not have its own.
    link : bool
        Make hard links instead of copies (same disk; then never edit either).
    examine : callable or None
        Function that finds what is wrong with the folder that was made, as `check_capture` does; errors are raised.
    """

    lights_file: Path | None = None
    lights_kind: str | None = None
    lights_order: str | None = None
    lights_axes: str | None = None
    width_mm: float | None = None
    mask: Path | None = None
    white: Path | None = None
    dark: Path | None = None
    ambient: Path | None = None
    checks: tuple[str, ...] = ()
    encoding: Literal["linear", "srgb"] | None = None
    title: str | None = None
    region: tuple[int, int, int, int] | None = None
    values: Values | None = None
    azimuths: Azimuths | None = None
    turn: Literal["reverse"] | None = None
    camera_of: dict[str, str] = field(default_factory=dict)
    link: bool = False
    examine: Callable[[Path], list[Problem]] | None = None

    def __post_init__(self) -> None:
        """Raise CaptureError (option-unusable) for a width that is none, or a kind of lights that is not known."""
        if self.lights_kind not in (None, *LIGHT_KINDS):
            expected = f"one of {', '.join(LIGHT_KINDS)}"
            problem = error("option-unusable", "lights-kind", "no such kind", expected=expected, found=self.lights_kind)
            raise CaptureError(problem)
        if self.width_mm is not None and not 0 < self.width_mm < 1e9:
            refuse("option-unusable", "width-mm", "no width", expected="millimetres", found=f"{self.width_mm:g}")

    def refuse(self, remedy: str, *fields: str) -> None:
        """Raise CaptureError (option-unusable) where one of these fields, which mean nothing to a layout, is given."""
        given = [FLAGS.get(field, field) for field in fields if getattr(self, field)]
        if given:
            refuse("option-unusable", ", ".join(given), "cannot be used here", remedy=remedy)


def folder_problems(**given: Path | None) -> list[Problem]:
    """List folder-missing for each option that must name a folder of photographs and does not."""
    remedy = "Give a folder that holds one picture a light; of a turntable one a view, or one a polariser state"
    return [
        error("folder-missing", f"--{name} {path}", "no such folder", remedy=remedy)
        for name, path in given.items()
        if path is not None and not path.is_dir()
    ]


def file_problems(**given: Path | None) -> list[Problem]:
    """List file-missing for each option that must name a file and does not."""
    return [
        error("file-missing", f"--{name} {path}", "no such file", remedy="Give a file that is there")
        for name, path in given.items()
        if path is not None and not path.is_file()
    ]
