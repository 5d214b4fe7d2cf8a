"""Settings of normals."""

from typing import ClassVar, Literal

from pydantic import Field

from nishiki.artifacts.closed import Guarded
from nishiki.settings.counts import Lights


class NormalsSettings(Guarded):
    """Photometric stereo on the selected lights (P 3.3), and the reflectance of each channel."""

    STAGE: ClassVar[str] = "normals"
    VERSION: ClassVar[int] = 1

    solver: Literal["default", "lobe", "lobes", "least_squares"] = Field(
        "default", description="see docs/stages/normals.md"
    )
    lights: Lights = Field(
        "auto",
        description="lights of the fit (separate follows): all; so many evenly spread ones; auto: as many as normals "
        "need, in captures of some size (docs/economy.md)",
    )
    refine: Literal["auto", "gloss", "none"] = Field(
        "auto", description="fit normals, reflectance and gloss together; auto: where few lights show gloss that counts"
    )
    refractive_index: float = Field(1.45, gt=1, le=3, description="of the varnish or binder, for refine (P: 1.45)")
    reflectance: Literal["least_squares", "mean"] = Field(
        "least_squares", description="of each channel, without refine; mean: of I / cos over the lights (P eq. 6)"
    )
    max_condition: float = Field(1e4, gt=1, description="pixels with a worse conditioned light matrix are flagged")
    hold_out: tuple[str, ...] = Field((), description="lights left out of the fit; filled in by the plan")
