"""Declaration of the stage `report`: settings, inputs, limits of its result, cost."""

from typing import ClassVar

from nishiki.report.settings import PageSettings
from nishiki.stages.base import Cost, Stage


class ReportSettings(PageSettings):
    """One HTML file that opens offline."""

    STAGE: ClassVar[str] = "report"
    VERSION: ClassVar[int] = 1


STAGE = Stage(
    settings=ReportSettings,
    does="HTML report of the scene",
    requires=("ingest", "normals"),
    uses=("separate", "height", "spectra", "brdf", "render", "evaluate", "viewer", "export"),
    libraries=("numpy", "jinja2", "zarr", "opencv-contrib-python-headless"),
    deliverables=("*.html", "thumbnail.jpg"),
    threads=1,
    cost=lambda facts: Cost(mib=230, bytes_per_pixel=16, seconds=2, us_per_pixel=8),
)
