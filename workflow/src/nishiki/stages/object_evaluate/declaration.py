"""Declaration of the stage `object_evaluate`: settings, inputs, limits of its result, cost."""

from typing import ClassVar, Literal

from pydantic import Field

from nishiki.artifacts.closed import Guarded
from nishiki.stages.base import Cost, Stage, photographs_or_states


class ObjectEvaluateSettings(Guarded):
    """The decoded object against its photographs, and what it costs."""

    STAGE: ClassVar[str] = "object_evaluate"
    VERSION: ClassVar[int] = 2

    pictures: int = Field(3, ge=0, le=64, description="captured views shown beside their photographs, evenly spread")
    columns: int = Field(480, ge=64, le=4096, description="largest width of those pictures")
    left_out: Literal["best", "interpolated", "slot"] = Field(
        "best",
        description="prediction of left-out views: from the neighbours' residual, from what the decoder filled into "
        "their own slot, or whichever predicts them better on average",
    )
    interpolation: Literal["linear", "cubic", "nearest"] = Field(
        "cubic", description="of the residual between captured views, from four or two of them; linear: as the paper"
    )
    rim_px: int = Field(2, ge=0, le=8, description="pixels by which values are carried on beyond the surface's edge")
    similarity: bool = Field(True, description="also structural similarity")
    hold_out: tuple[str, ...] = Field((), description="views left out of the fit; filled in by the plan")
    truth_sha256: str = Field("", description="digest of the truth; filled in by the plan")


STAGE = Stage(
    settings=ObjectEvaluateSettings,
    does="errors of rendered views against photographs, truth and views left out",
    geometry="turntable",
    product="evaluate",
    requires=("ingest", "mesh", "cameras", "texels", "object_brdf", "residual"),
    wants=lambda settings: ("polarise",),
    needs_colour=True,
    looks_at=photographs_or_states,
    libraries=("numpy", "scipy", "numba", "zarr", "pywavelets", "opencv-contrib-python-headless", "dracopy"),
    cost=lambda facts: Cost(mib=380, bytes_per_sample=90, seconds=5, us_per_sample=3),
)
