"""Declaration of the stage `cloth_report`: settings, inputs, limits of its result, cost."""

from typing import ClassVar

from pydantic import Field

from nishiki.report.settings import PageSettings
from nishiki.stages.base import Cost, Stage


class ClothReportSettings(PageSettings):
    """One HTML file on a cloth that opens offline."""

    STAGE: ClassVar[str] = "cloth_report"
    VERSION: ClassVar[int] = 1

    region: str = Field("", description="region whose lobes and curves are drawn; empty: the first")


STAGE = Stage(
    settings=ClothReportSettings,
    does="HTML report of the scene",
    formerly="fabric_report",
    geometry="goniometer",
    product="report",
    requires=("ingest", "goniometer_samples"),
    wants=lambda settings: ("weave",),
    uses=("cloth_brdf", "cloth_render", "cloth_evaluate", "cloth_export", "cloth_viewer"),
    libraries=("numpy", "scipy", "jinja2", "numba", "opencv-contrib-python-headless"),
    deliverables=("*.html", "thumbnail.jpg"),
    threads=1,
    cost=lambda facts: Cost(mib=260, seconds=5.5),
)
