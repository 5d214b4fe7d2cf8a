"""Declare the stage `separate`: settings, inputs, limits of its result, cost."""

from typing import Literal

from pydantic import Field

from nishiki.artifacts.declaration import Guarded, Limit, Output, at, share
from nishiki.stages.base import Cost, Lights, Stage, no_method

LIMITS = (
    Limit(
        "valid_share",
        "share of the samples that are neither saturated, dark nor outside the mask",
        at("valid_fraction"),
        least=1e-4,
        remedy="expose differently, or check the mask and the black level of the capture",
        why="a small object in a large picture may be one in a thousand; less means photographs that show nothing",
    ),
    Limit(
        "usable_share",
        "share of the valid samples that were taken as diffuse",
        share("usable_fraction", "valid_fraction"),
        least=0.1,
        doubt=0.25,
        remedy="set separate.method to none or trimmed, or change separate.w1 and w2",
        why="captures gave 0.40 to 0.88; with a tenth most pixels keep fewer than three lights",
    ),
    Limit("highlight_share", "share of the samples taken as highlight", at("highlight_fraction")),
    Limit("shadow_share", "share of the samples taken as shadow", at("shadow_fraction")),
)


class SeparateSettings(Guarded, stage="separate", version=1, limits=LIMITS):
    """Selection of lights with diffuse reflection at a pixel: neither highlight nor shadow."""

    method: Literal["refit", "threshold", "trimmed", "none"] = Field(
        "refit",
        description="refit: by residuals of a robust fit; threshold: w1, w2 (Tominaga and Tanaka 2004, section 3.2); "
        "trimmed: by rank",
    )
    w1: float = Field(1.2, gt=0, description="threshold: highlight above w1 times the mean over lights")
    w2: float = Field(0.1, ge=0, description="threshold: shadow below w2 times the mean over lights")
    keep: tuple[float, float] = Field((0.3, 0.7), description="trimmed: ranks kept, as fractions from dark to bright")
    lights: Lights = Field("auto", description="lights of the fit; filled in by the plan from normals.lights")
    hold_out: tuple[str, ...] = Field((), description="lights left out of the fit; filled in by the plan")


OUTPUTS = (
    Output("usable", "uint8", "", "bit j of byte i: light 8 i + j shows diffuse reflection"),
    Output("highlights", "uint16", "lights", "brighter than the fit"),
    Output("shadows", "uint16", "lights", "darker than the fit"),
)


STAGE = Stage(
    settings=SeparateSettings,
    does="lights that show only diffuse reflection",
    outputs=OUTPUTS,
    requires=("ingest",),
    missing_inputs=no_method,
    filled=lambda block, settings: {"lights": settings.normals.lights},
    cost=lambda facts: Cost(mib=300, tiles=2.0, seconds=2.5, us_per_pixel=2, us_per_sample=0.12),
    scatter=True,
)
