"""Declaration of the stage `report`: settings, inputs, limits of its result, cost."""

from typing import ClassVar

from pydantic import Field

from nishiki.artifacts.closed import Guarded
from nishiki.stages.base import Cost, Stage


class ReportSettings(Guarded):
    """One HTML file that opens offline."""

    STAGE: ClassVar[str] = "report"
    VERSION: ClassVar[int] = 1

    picture_columns: int = Field(720, ge=128, le=4096, description="width of the pictures inside the page")
    title: str = Field("", description="heading; empty: title of the capture")
    left_out: dict[str, str] = Field({}, description="what the plan leaves out, and why; filled in by the plan")


STAGE = Stage(
    settings=ReportSettings,
    does="one page that tells everything",
    requires=("ingest", "normals"),
    uses=("separate", "height", "spectra", "brdf", "render", "evaluate"),
    libraries=("numpy", "jinja2", "zarr", "opencv-contrib-python-headless"),
    deliverables=("*.html",),
    threads=1,
    cost=lambda facts: Cost(mib=230, bytes_per_pixel=16, seconds=2, us_per_pixel=8),
)
