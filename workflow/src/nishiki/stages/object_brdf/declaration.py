"""Declaration of the stage `object_brdf`: settings, inputs, limits of its result, cost."""

from typing import ClassVar, Literal

from pydantic import Field

from nishiki.artifacts.closed import Guarded
from nishiki.artifacts.limits import Limit, at
from nishiki.stages.base import Cost, Stage

LIMITS = (
    Limit(
        "unseen_share",
        "share of the texels that no view shows",
        at("unseen_share"),
        most=0.5,
        doubt=0.2,
        remedy="views from more sides, or a mesh without inner surfaces",
        why="captures gave 0.02 to 0.07; a misplaced mesh gave 0.98",
    ),
    Limit(
        "psnr",
        "PSNR of the model over the samples, dB",
        at("psnr_db"),
        least=12,
        doubt=18,
        remedy="check object_brdf.lighting and the capture's lamp; cameras and mesh",
        why="captures gave 22 to 41; cameras in the reverse order gave 30 in place of 39.5 on an almost round jar",
    ),
    Limit("once_share", "share of the texels that one observation shows", at("once_share")),
    Limit("filled_share", "share of the texels whose gloss is their neighbours'", at("filled_share")),
    Limit("highlight_share", "share of the texels with a highlight of their own", at("highlight_share")),
)


class ObjectBrdfSettings(Guarded):
    """Lambert and the simplified Torrance-Sparrow model at every texel of an object."""

    STAGE: ClassVar[str] = "object_brdf"
    VERSION: ClassVar[int] = 2
    LIMITS: ClassVar[tuple[Limit, ...]] = LIMITS

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


STAGE = Stage(
    settings=ObjectBrdfSettings,
    does="Lambert and Torrance-Sparrow parameters of every texel",
    formerly="reflection",
    geometry="turntable",
    requires=("ingest", "texels"),
    needs_colour=True,
    libraries=("numpy", "scipy", "numba", "zarr"),
    # with polarisers diffuse and specular part
    cost=lambda facts: Cost(
        mib=330, bytes_per_sample=40, seconds=3.5, us_per_sample=6.8 if len(facts.states) > 1 else 3.4
    ),
)
