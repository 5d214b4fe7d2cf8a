"""Declare the stage `weave`: settings, inputs, limits of its result, cost."""

from typing import Literal

from pydantic import Field

from nishiki.artifacts.declaration import Guarded, Limit, extreme
from nishiki.stages.base import OPENCV, Cost, Stage

LIMITS = (
    Limit(
        "misfit",
        "relative rms error of the cross-section's fit, worst yarn and region",
        extreme("regions.*.rms_rel"),
        most=0.25,
        doubt=0.12,
        remedy="set weave.harness, or take the stage from the products",
        why="cloths gave 0.009 to 0.06; at a quarter the section explains little of what was measured",
    ),
)


class WeaveSettings(Guarded, stage="weave", version=10, limits=LIMITS):
    """Cross-sections of a cloth from its reflectances in the planes of warp and weft."""

    reading: Literal["paper", "shaded"] = Field(
        "shaded",
        description="what the section does with light: paper: masking alone (Takeda and Tanaka, eq. 15); shaded: each "
        "visible piece reflects by its own slope",
    )
    contact_deg: float | None = Field(
        90.0, gt=8.0, le=90.0, description="steepest slope where yarns touch; 90: circles, as the paper; null: fitted"
    )
    refractive_index: float | None = Field(
        1.5, gt=1.2, lt=2.2, description="of the fibres; null: fitted (strongly correlated with k_s)"
    )
    relative_error: float = Field(
        0.02, gt=0.0, le=1.0, description="error of the data and of the model, relative to the value, beside the noise"
    )
    confidence: float = Field(0.95, gt=0.5, lt=1.0, description="of the intervals")
    harness: int | None = Field(
        None, ge=2, le=16, description="yarns of a repeat; null: searched among those of the weave"
    )
    spacing_ratio: float | None = Field(
        None,
        gt=0.1,
        lt=10.0,
        description="spacing of weft yarns over warp yarns; null: from goniometer.threads_per_cm of the capture; "
        "where that is missing too, fitted with the yarns",
    )


STAGE = Stage(
    settings=WeaveSettings,
    does="cross-sections of warp and weft, from how they hide each other",
    geometry="goniometer",
    requires=("goniometer_samples",),
    missing_inputs=lambda facts, settings: (
        None if facts.frontal else "no measurement has its light at the normal of the cloth"
    ),
    libraries=("numpy", "scipy", "numba", OPENCV),
    deliverables=("*.ply", "*.png", "*.svg"),
    cost=lambda facts: Cost(mib=480, seconds=60),
)
