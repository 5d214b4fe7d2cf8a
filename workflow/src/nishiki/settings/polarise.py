"""Settings of polarise."""

from typing import ClassVar, Literal

from pydantic import Field

from nishiki.artifacts.closed import Guarded


class PolariseSettings(Guarded):
    """Diffuse and specular components of every view, from its polariser states."""

    STAGE: ClassVar[str] = "polarise"
    VERSION: ClassVar[int] = 1

    method: Literal["auto", "pairs", "mueller", "none"] = Field(
        "auto",
        description="generator/analyser states by parallel and crossed pairs or the Mueller matrix; none: all diffuse",
    )
    beta: tuple[float, ...] | None = Field(
        None, description="circular: what the polarisers let through, one a channel; none: from the white boards"
    )
    beta_least: float = Field(0.02, gt=0, lt=1, description="circular: below this beta a pixel is flagged, not divided")
    block_px: int = Field(16, ge=1, description="board images are averaged over blocks of this many pixels")
    local: bool = Field(True, description="beta and transmission by place; off: one value a channel")
    phase: Literal["pixel", "common"] = Field(
        "pixel", description="three or more analyser angles: amplitude at each pixel's own angle, or at one for a view"
    )
    wavelength_nm: float | None = Field(
        None, gt=0, description="of the light; needed where the calibration gives a retarder's dispersion"
    )
    pictures: int = Field(8, ge=0, description="views shown as pictures: whole, diffuse, specular")
