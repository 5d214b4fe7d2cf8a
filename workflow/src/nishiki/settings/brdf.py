"""Settings of brdf."""

from typing import ClassVar, Literal

from pydantic import Field

from nishiki.artifacts.closed import Guarded


class BrdfSettings(Guarded):
    """Torrance-Sparrow parameters of a scene or of each region."""

    STAGE: ClassVar[str] = "brdf"
    VERSION: ClassVar[int] = 3

    method: Literal["robust", "paper"] = Field("robust", description="paper: brightest light, Levenberg-Marquardt")
    smoothing_px: float = Field(
        0.4, ge=0, le=16, description="paper: Gaussian that smooths the normals, standard deviation"
    )
    refractive_index: float = Field(1.45, gt=1, le=3, description="of the varnish or binder (P: 1.45)")
    max_slope_deg: float = Field(50, gt=0, le=90, description="steeper pixels are left out of the fit")
    lobes: Literal["ladder", 1, 2] = Field(
        "ladder",
        description="specular lobes; ladder: the 11 widths of the joint fit of normals; paper: always 1",
    )
    specular: Literal["auto", "keep", "drop"] = Field(
        "auto", description="auto: left out where a sample shows no gloss (docs/economy.md); method paper: always kept"
    )
    hold_out: tuple[str, ...] = Field((), description="lights left out of the fit; filled in by the plan")
