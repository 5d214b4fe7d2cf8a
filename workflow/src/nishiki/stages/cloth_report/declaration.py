"""Declaration of the stage `cloth_report`: settings, inputs, limits of its result, cost."""

from typing import ClassVar

from pydantic import Field

from nishiki.artifacts.closed import Guarded
from nishiki.stages.base import Cost, Stage


class ClothReportSettings(Guarded):
    """One HTML file on a cloth that opens offline."""

    STAGE: ClassVar[str] = "cloth_report"
    VERSION: ClassVar[int] = 1

    picture_columns: int = Field(720, ge=128, le=4096, description="width of the pictures inside the page")
    video_mb: float = Field(2.5, ge=0, le=64, description="largest video that the page carries; larger ones are named")
    region: str = Field("", description="region whose lobes and curves are drawn; empty: the first")
    title: str = Field("", description="heading; empty: title of the capture, or name of the scene")
    left_out: dict[str, str] = Field({}, description="what the plan leaves out, and why; filled in by the plan")


STAGE = Stage(
    settings=ClothReportSettings,
    does="one page that tells everything",
    formerly="fabric_report",
    geometry="goniometer",
    product="report",
    requires=("ingest", "goniometer_samples"),
    wants=lambda settings: ("weave",),
    uses=("cloth_brdf", "cloth_render", "cloth_evaluate"),
    libraries=("numpy", "scipy", "jinja2", "numba", "opencv-contrib-python-headless"),
    deliverables=("*.html",),
    threads=1,
    cost=lambda facts: Cost(mib=260, seconds=5.5),
)
