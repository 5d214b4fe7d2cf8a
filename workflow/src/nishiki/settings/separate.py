"""Settings of separate."""

from typing import ClassVar, Literal

from pydantic import Field

from nishiki.artifacts.closed import Guarded
from nishiki.settings.counts import Lights


class SeparateSettings(Guarded):
    """Which lights show a pixel's diffuse reflection: neither highlight nor shadow."""

    STAGE: ClassVar[str] = "separate"
    VERSION: ClassVar[int] = 1

    method: Literal["refit", "threshold", "trimmed", "none"] = Field(
        "refit",
        description="refit: by residuals of a robust fit; threshold: the paper's w1, w2 (P 3.2); trimmed: by rank",
    )
    w1: float = Field(1.2, gt=0, description="threshold: highlight above w1 times the mean over lights")
    w2: float = Field(0.1, ge=0, description="threshold: shadow below w2 times the mean over lights")
    keep: tuple[float, float] = Field((0.3, 0.7), description="trimmed: ranks kept, as fractions from dark to bright")
    lights: Lights = Field("auto", description="lights of the fit; filled in by the plan from normals.lights")
    hold_out: tuple[str, ...] = Field((), description="lights left out of the fit; filled in by the plan")
