"""Describe, check and read a goniometer capture, as one frozen value."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from nishiki.artifacts.declaration import Closed
from nishiki.capture.frames import ANGLE_COLUMNS, TABLE, BaseCapture, Frame, exposure_problems, inside
from nishiki.capture.goniometer_tables import ReflectanceTable, in_radians, radians_problem, read_table
from nishiki.capture.lights import SAME_DEG
from nishiki.capture.options import Azimuths, Values
from nishiki.capture.schema import Positive, Session
from nishiki.formats.files import is_label
from nishiki.formats.problems import Problem, error, warning
from nishiki.goniometry.directions import unit
from nishiki.goniometry.table import NORMAL_DEG

Reflectance = Annotated[float, Field(gt=0, le=1.1)]
Label = Annotated[int, Field(ge=1, le=65535)]


class Goniometer(Closed):
    """The block `goniometer`: how a reflectance is read from the photographs, and what is known of the cloth.

    table: reflectances instead of photographs. values: what its columns hold: the BRDF in 1/sr, pi times as much, that
    in per cent, or the BRDF times the cosine of the view or of the light. azimuths: what phi_r is counted from: the
    cloth's weft, as phi_i; the lamp's side; or the side opposite to it, where a mirror would send the light.
    white_reflectance: of the board, a number or one a channel. crop_px: side of the central window that is kept of
    every photograph. regions: label picture of the cloth as seen along its normal, region_names: label of each name;
    upright: what points up in an oblique photograph, the cloth's warp or the plane through normal and camera;
    threads_per_cm: counted on the cloth, of warp and weft.
    """

    table: str | None = None
    values: Values = "brdf"
    azimuths: Azimuths = "cloth"
    white_reflectance: Reflectance | tuple[Reflectance, ...] = 1.0
    crop_px: Annotated[int, Field(strict=True, ge=1, le=4096)] = 64
    regions: str | None = None
    region_names: dict[str, Label] = Field(default_factory=dict)
    regions_pitch_mm: Positive | None = None
    pixel_pitch_mm: Positive | None = None
    upright: Literal["cloth", "arm"] = "cloth"
    symmetry: Literal["unknown", "quarter", "half", "none"] = "unknown"
    weave: Literal["plain", "twill", "satin", "unknown"] = "unknown"
    threads_per_cm: tuple[Positive, Positive] | None = None

    @field_validator("region_names")
    @classmethod
    def _distinct(cls, names: dict[str, int]) -> dict[str, int]:
        if len(set(names.values())) != len(names) or any(not n.strip() for n in names):
            raise ValueError("each name has a label of its own and is not empty")
        wrong = [name for name in names if not is_label(name)]
        if wrong:
            raise ValueError(f"{wrong[0][:60]!r} cannot be part of a file name: at most 100 characters, no slashes")
        return names

    @model_validator(mode="after")
    def _agree(self) -> "Goniometer":
        if self.table and self.regions:
            raise ValueError("a table of reflectances has no regions: they are places in photographs")
        if not self.table and (self.values, self.azimuths) != ("brdf", "cloth"):
            raise ValueError("values and azimuths belong to a table of reflectances; frames.csv has photographs")
        if self.region_names and not self.regions:
            raise ValueError("region_names need regions, the label picture that they name")
        if (self.regions_pitch_mm is None) != (self.pixel_pitch_mm is None) and self.regions:
            raise ValueError("give both regions_pitch_mm and pixel_pitch_mm, or neither where the scales are the same")
        return self

    @property
    def files(self) -> tuple[tuple[str, str], ...]:
        """Every file in the block: (key, file)."""
        return tuple((f"goniometer.{key}", getattr(self, key)) for key in ("table", "regions") if getattr(self, key))


class GoniometerFile(Session):
    """capture.yaml of a cloth on a gonioreflectometer."""

    geometry: Literal["goniometer"]
    goniometer: Goniometer = Goniometer()

    @property
    def region_of_interest(self) -> None:
        """The window is `goniometer.crop_px`, not a region of the picture."""
        return None

    @model_validator(mode="before")
    @classmethod
    def _one_board(cls, parsed: Any) -> Any:
        if isinstance(parsed, dict) and "white" in parsed:
            raise ValueError("goniometer.white_reflectance instead of the block white: angles are those of frames.csv")
        return parsed

    @model_validator(mode="after")
    def _one_a_channel(self) -> "GoniometerFile":
        given, count = self.goniometer.white_reflectance, len(self.camera.channels)
        if isinstance(given, tuple) and len(given) != count and self.goniometer.table is None:
            raise ValueError(f"goniometer.white_reflectance has {len(given)} values for {count} camera.channels")
        return self

    @property
    def white_reflectance(self) -> tuple[float, ...]:
        """Reflectance of the white board, one per camera channel."""
        given = self.goniometer.white_reflectance
        return given if isinstance(given, tuple) else (given,) * len(self.camera.channels)


STEEPEST_WHITE_DEG = 85.0
FEWEST_NORMAL = 12  # views along the normal


def goniometer_problems(frames: tuple[Frame, ...]) -> list[Problem]:
    """List everything wrong with how the table's frames fit together."""
    samples, whites = ([f for f in frames if f.role == role] for role in ("sample", "white"))
    problems = [p for frame in frames for p in _angle_problems(frame)]
    if not samples:
        problems.append(error("samples-none", TABLE, "no photograph of the cloth, of role sample"))
    if not whites:
        what = "no white frame: a reflectance is the cloth's light over that of a white board"
        remedy = "Photograph a diffuse white board in the cloth's place, at least once"
        problems.append(error("white-missing", TABLE, what, remedy=remedy))
    problems += exposure_problems(frames)
    angles = [f.angles_deg for f in samples if None not in f.angles_deg]
    if angles and in_radians(np.array(angles, np.float64)):
        problems.append(radians_problem(TABLE))
    if not any(p.severity == "error" for p in problems):
        problems += _spread_problems(samples, whites)
    return problems


def _angle_problems(frame: Frame) -> list[Problem]:
    """List angles that a frame of this role needs or cannot have."""
    where, (theta_i, phi_i, theta_r, phi_r) = f"{TABLE} row {frame.row}", frame.angles_deg
    if frame.role == "dark":
        return []
    if frame.role == "sample" and None in frame.angles_deg:
        what = f"a sample frame needs its four angles, {', '.join(ANGLE_COLUMNS)}; phi is 0 where theta is 0"
        return [error("angle-missing", where, what)]
    if theta_i is None or phi_i is None:
        what = "a white frame needs theta_i_deg and phi_i_deg, the direction of its light"
        return [error("angle-missing", where, what)]
    if (theta_r is None) != (phi_r is None):
        what = "half a direction of view: give both theta_r_deg and phi_r_deg, or neither"
        return [error("angle-missing", where, what)]
    if frame.role == "white" and theta_i > STEEPEST_WHITE_DEG:
        what = f"the light grazes the board: theta_i_deg {theta_i:g} is above {STEEPEST_WHITE_DEG:g}"
        remedy = "Photograph it at a smaller one: the cosine of the angles brings it to the others"
        return [error("white-grazing", where, what, remedy=remedy)]
    return []


def _spread_problems(samples: list[Frame], whites: list[Frame]) -> list[Problem]:
    """List what the later stages will lack, although the capture can be read."""
    problems = []
    normal = [f for f in samples if f.angles_deg[0] < NORMAL_DEG]
    if len(normal) < FEWEST_NORMAL:
        expected, found = f"{FEWEST_NORMAL} views or more with theta_i below {NORMAL_DEG:g} degree", f"{len(normal)}"
        what = "few views of the cloth lit along its normal; the weave and the BRDF are found from them"
        problems.append(warning("normal-few", TABLE, what, expected=expected, found=found))
    lights = sorted({f.angles_deg[:2] for f in samples})
    apart_deg = nearest(lights, sorted({w.angles_deg[:2] for w in whites}))
    alone = {light for light, angle in zip(lights, apart_deg, strict=True) if angle >= SAME_DEG}
    apart = [f for f in samples if f.angles_deg[:2] in alone]
    if apart:
        what = "no white frame under the same light: another board's light is used, by the cosine of the angles"
        found = f"{len(apart)} of {len(samples)} sample frames, the first in row {apart[0].row}"
        remedy = "Photograph the board once for every direction of light where the lamp's distance or strength changes"
        problems.append(warning("white-cosine", TABLE, what, found=found, remedy=remedy))
    return problems


def nearest(directions: list[tuple[float, float]], others: list[tuple[float, float]]) -> np.ndarray:
    """Compute the angle in degrees from each direction (theta, phi in degrees) to the nearest other; inf for none."""
    from scipy.spatial import cKDTree

    if not others:
        return np.full(len(directions), np.inf)
    towards, known = (unit(*np.radians(each).T) for each in (directions, others))
    chords, _ = cKDTree(known).query(towards)
    return np.degrees(2 * np.arcsin(np.minimum(chords / 2, 1.0)))  # from the chord: exact for small angles


@dataclass(frozen=True)
class GoniometerCapture(BaseCapture):
    """A cloth on a goniometer.

    frames: none where there is a table; table: the reflectances given instead, or None; regions: label picture of the
    cloth, or None; warnings: what was tolerated.
    """

    settings: GoniometerFile
    table: ReflectanceTable | None
    regions: Path | None
    warnings: tuple[Problem, ...]

    @property
    def observed(self) -> tuple[Frame, ...]:
        """Frames of the cloth, in the order of the table."""
        return self.frames_of("sample")

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels: of the camera, or of the table's columns."""
        return self.settings.camera.channels if self.table is None else self.table.channels

    @property
    def angles_deg(self) -> list[tuple[float, ...]]:
        """theta_i, phi_i, theta_r, phi_r of every measurement of the cloth."""
        if self.table is None:
            return [f.angles_deg for f in self.observed]
        rows = zip(self.table.incident_deg.tolist(), self.table.outgoing_deg.tolist(), strict=True)
        return [(*incident, *outgoing) for incident, outgoing in rows]


def examine_goniometer(
    read: BaseCapture, complete: bool, attempt: Callable
) -> tuple[GoniometerCapture | None, list[Problem]]:
    """Read the capture (None where its tables cannot be read) and list how its tables contradict each other.

    complete: whether frames.csv could be read; attempt: runs a reader, collecting the problems that it raises.
    """
    payload, block = read.payload, read.settings.goniometer
    named = {key: attempt(lambda f=file, k=key: inside(payload, f, f"capture.yaml {k}")) for key, file in block.files}
    path, table = named.get("goniometer.table"), None
    if block.table is not None:
        held = {"values": block.values, "azimuths": block.azimuths}
        table = attempt(lambda: read_table(path, block.table, **held)) if path else None
        if table is None:
            return None, []
        problems = list(table.warnings)
        if (payload / "frames.csv").exists():
            what = "photographs beside goniometer.table: a capture has either"
            problems.append(error("frames-unexpected", "frames.csv", what))
    elif not complete:
        return None, []
    else:
        problems = goniometer_problems(read.frames)
    doubts = tuple(p for p in problems if p.severity == "warning")
    return GoniometerCapture(
        **vars(read), table=table, regions=named.get("goniometer.regions"), warnings=doubts
    ), problems
