"""The closed schema of capture.yaml for cloths measured on a gonioreflectometer."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from nishiki.artifacts.closed import Closed
from nishiki.capture.schema_base import Positive, Session
from nishiki.formats.files import is_label

Reflectance = Annotated[float, Field(gt=0, le=1.1)]
Label = Annotated[int, Field(ge=1, le=65535)]
Values = Literal["brdf", "radiance_factor", "radiance_factor_percent", "brdf_cos_view", "brdf_cos_light"]
Azimuths = Literal["cloth", "lamp", "mirror"]


class Goniometer(Closed):
    """The block `goniometer`: how a reflectance is read from the photographs, and what is known of the cloth.

    table: reflectances instead of photographs. values: what its columns hold: the BRDF in 1/sr, pi times as much, that
    in per cent, or the BRDF times the cosine of the view or of the light. azimuths: what phi_r is counted from: the
    cloth's weft, as phi_i; the lamp's side; or the side opposite to it, where a mirror would send the light.
    white_reflectance: of the board, a number or one a channel. crop_px: side of the central window that is kept of
    every photograph. regions: label picture of the cloth as seen along its normal, region_names: label of each name;
    upright: what points up in an oblique photograph, the cloth's warp or the plane through normal and camera.
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
    symmetry: Literal["quarter", "half", "none"] = "quarter"
    weave: Literal["plain", "twill", "satin", "unknown"] = "unknown"

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
    def _agree(self) -> Goniometer:
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
        """Every file that the block names: (key, file)."""
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
    def _one_a_channel(self) -> GoniometerFile:
        given, count = self.goniometer.white_reflectance, len(self.camera.channels)
        if isinstance(given, tuple) and len(given) != count and self.goniometer.table is None:
            raise ValueError(f"goniometer.white_reflectance has {len(given)} values for {count} camera.channels")
        return self

    @property
    def white_reflectance(self) -> tuple[float, ...]:
        """Of the board, one a channel of the camera."""
        given = self.goniometer.white_reflectance
        return given if isinstance(given, tuple) else (given,) * len(self.camera.channels)
