"""Declaration of the stage `object_report`: settings, inputs, limits of its result, cost."""

from typing import ClassVar

from nishiki.report.settings import PageSettings
from nishiki.stages.base import Cost, Stage


class ObjectReportSettings(PageSettings):
    """One HTML file on a turntable scene that opens offline."""

    STAGE: ClassVar[str] = "object_report"
    VERSION: ClassVar[int] = 1


STAGE = Stage(
    settings=ObjectReportSettings,
    does="HTML report of the scene",
    geometry="turntable",
    product="report",
    requires=("ingest",),
    wants=lambda settings: ("polarise",),
    uses=(
        "cameras",
        "mesh",
        "texels",
        "object_brdf",
        "residual",
        "object_render",
        "object_evaluate",
        "object_export",
        "object_viewer",
    ),
    libraries=("numpy", "jinja2", "zarr", "opencv-contrib-python-headless"),
    deliverables=("*.html", "thumbnail.jpg"),
    threads=1,
    cost=lambda facts: Cost(mib=230, bytes_per_sample=1, seconds=1.8, us_per_sample=0.2),
)
