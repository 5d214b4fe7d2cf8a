"""Declaration of the stage `brdf`: settings, inputs, limits of its result, cost."""

from typing import ClassVar, Literal

from pydantic import Field

from nishiki.artifacts.closed import Guarded
from nishiki.artifacts.limits import Limit, extreme
from nishiki.stages.base import Cost, Stage

LIMITS = (
    Limit("samples", "samples of the gloss, least region", extreme("samples", min)),
    Limit("residual", "rms residual of the gloss, worst region", extreme("residual")),
)


class BrdfSettings(Guarded):
    """Torrance-Sparrow parameters of a scene or of each region."""

    STAGE: ClassVar[str] = "brdf"
    VERSION: ClassVar[int] = 3
    LIMITS: ClassVar[tuple[Limit, ...]] = LIMITS

    method: Literal["robust", "paper"] = Field("robust", description="paper: brightest light, Levenberg-Marquardt")
    smoothing_px: float = Field(
        0.4, ge=0, le=16, description="paper: Gaussian that smooths the normals, standard deviation"
    )
    refractive_index: float = Field(
        1.45, gt=1, le=3, description="of the varnish or binder (Tominaga and Tanaka: 1.45)"
    )
    max_slope_deg: float = Field(50, gt=0, le=90, description="steeper pixels are left out of the fit")
    lobes: Literal["ladder", 1, 2] = Field(
        "ladder",
        description="specular lobes; ladder: the 11 widths of the joint fit of normals; paper: always 1",
    )
    specular: Literal["auto", "keep", "drop"] = Field(
        "auto", description="auto: left out where a sample shows no gloss (docs/economy.md); method paper: always kept"
    )
    hold_out: tuple[str, ...] = Field((), description="lights left out of the fit; filled in by the plan")


STAGE = Stage(
    settings=BrdfSettings,
    does="Torrance-Sparrow parameters",
    requires=("ingest", "normals"),
    needs_colour=True,
    libraries=("numpy", "scipy", "numba", "zarr"),
    cost=lambda facts: Cost(mib=260, tiles=0.9, seconds=2.2, us_per_pixel=6, us_per_sample=0.02),
)
