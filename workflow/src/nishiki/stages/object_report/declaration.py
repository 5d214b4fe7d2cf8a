"""Declaration of the stage `object_report`: settings, inputs, limits of its result, cost."""

from typing import ClassVar

from pydantic import Field

from nishiki.artifacts.closed import Guarded
from nishiki.stages.base import Cost, Stage


class ObjectReportSettings(Guarded):
    """One HTML file on a turntable scene that opens offline."""

    STAGE: ClassVar[str] = "object_report"
    VERSION: ClassVar[int] = 1

    picture_columns: int = Field(720, ge=128, le=4096, description="width of the pictures inside the page")
    video_mb: float = Field(2.5, ge=0, le=64, description="largest video that the page carries; larger ones are named")
    title: str = Field("", description="heading; empty: title of the capture")
    left_out: dict[str, str] = Field({}, description="what the plan leaves out, and why; filled in by the plan")


STAGE = Stage(
    settings=ObjectReportSettings,
    does="one page that tells everything",
    geometry="turntable",
    product="report",
    requires=("ingest",),
    wants=lambda settings: ("polarise",),
    uses=("cameras", "mesh", "texels", "object_brdf", "residual", "object_render", "object_evaluate"),
    libraries=("numpy", "jinja2", "zarr", "opencv-contrib-python-headless"),
    deliverables=("*.html",),
    threads=1,
    cost=lambda facts: Cost(mib=230, bytes_per_sample=1, seconds=1.8, us_per_sample=0.2),
)
