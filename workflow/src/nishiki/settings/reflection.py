"""Settings of reflection."""

from typing import ClassVar, Literal

from pydantic import Field

from nishiki.artifacts.closed import Guarded


class ReflectionSettings(Guarded):
    """Lambert and the simplified Torrance-Sparrow model at every texel of an object."""

    STAGE: ClassVar[str] = "reflection"
    VERSION: ClassVar[int] = 2

    width: Literal["smooth", "texel", "object"] = Field(
        "smooth",
        description="sigma and K_s: drawn towards the neighbours' as far as the data allow; each texel's own, filled "
        "where no highlight was observed (the paper's); one sigma for the object",
    )
    method: Literal["projection", "levenberg_marquardt"] = Field(
        "projection", description="fit of a texel's lobe; levenberg_marquardt: the paper's, slow"
    )
    lighting: Literal["auto", "camera", "fitted"] = Field(
        "auto",
        description="auto: the capture's lamps, fitted where it states none; camera: a lamp at the camera; fitted: an "
        "irradiance over the normal whatever the capture states",
    )
    components: Literal["auto", "apart", "total"] = Field(
        "auto",
        description="where polarisation separated them: auto: sigma from the specular part, strengths from the total; "
        "apart: K_d from the diffuse, K_s from the specular part (the paper's); total: not used",
    )
    specular: Literal["auto", "keep", "drop"] = Field(
        "auto", description="auto: Lambert alone where a sample of texels shows no gloss (docs/economy.md)"
    )
    falloff: Literal["auto", "none", "inverse_square"] = Field(
        "auto", description="of a lamp at a place, over the depth of the object; auto: whichever fits better"
    )
    hold_out: tuple[str, ...] = Field((), description="views left out of the fit; filled in by the plan")
