"""The closed schema of capture.yaml: every key that may appear, with its unit, range and meaning."""

from pathlib import Path
from typing import Literal

from pydantic import model_validator

from nishiki.artifacts.closed import Closed
from nishiki.capture.goniometer import GoniometerFile
from nishiki.capture.schema_base import Count, Positive, Session, read_mapping, validate
from nishiki.capture.turntable_rules import TurntableFile

LOST_BY_FIT = (
    "cast shadows and highlights are as smooth as that fit made them, what it left over is gone, its coefficients have "
    "8 bits, and neither the scale of brightness nor the strengths and distances of the lamps are known"
)
"""What a capture lacks whose pictures were rendered from a relightable image."""


class LightsFile(Closed):
    """Where the lamps were."""

    file: str
    kind: Literal["direction", "position_mm"] = "direction"
    intensities: str | None = None
    axes_confirmed: bool = False  # by the user, so that undecided axes are not warned about


class CaptureFile(Session):
    """capture.yaml of a plane."""

    lights: LightsFile
    geometry: Literal["plane", "turntable", "goniometer"] = "plane"
    pixel_pitch_mm: Positive | None = None
    region_of_interest: tuple[Count, Count, Count, Count] | None = None
    mask: str | None = None
    regions: str | None = None
    rendered_from: str | None = None

    @model_validator(mode="after")
    def _pitch_for_positions(self) -> "CaptureFile":
        if self.lights.kind == "position_mm" and self.pixel_pitch_mm is None:
            raise ValueError("lights of kind position_mm need pixel_pitch_mm (millimetres a pixel on the object)")
        return self


def read_capture_file(path: Path) -> CaptureFile | TurntableFile | GoniometerFile:
    """Parse capture.yaml by its geometry; a CaptureError lists every mistake in it.

    Kinds: yaml-missing, yaml-invalid, unknown-key, missing-key, wrong-value.
    """
    return check_settings(read_mapping(path), path.name)


def check_settings(parsed: dict, file: str) -> CaptureFile | TurntableFile | GoniometerFile:
    """Parse the keys and values of a capture.yaml by its geometry. CaptureError: those of `validate`."""
    geometry = parsed.get("geometry")
    if geometry == "turntable":
        return validate(TurntableFile, parsed, file)
    if geometry == "goniometer":
        return validate(GoniometerFile, parsed, file)
    return validate(CaptureFile, parsed, file)
