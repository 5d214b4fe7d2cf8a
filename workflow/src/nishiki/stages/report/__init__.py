"""Declare the stages of paintings, objects and cloths for pages on a scene."""

from pydantic import Field

from nishiki.artifacts.declaration import Guarded
from nishiki.stages.base import OPENCV, Cost, Stage


class PageSettings(Guarded):
    """One HTML file that opens offline."""

    picture_columns: int = Field(720, ge=128, le=4096, description="width of the pictures inside the page")
    video_mb: float = Field(2.5, ge=0, le=64, description="largest video that the page carries; larger ones are named")
    title: str = Field("", description="heading; empty: title of the capture, or name of the scene")
    left_out: dict[str, str] = Field({}, description="what the plan leaves out, and why; filled in by the plan")


class ReportSettings(PageSettings, stage="report", version=2):
    """One HTML file that opens offline."""


PAINTING = Stage(
    settings=ReportSettings,
    does="HTML report of the scene",
    of_mosaics=True,
    requires=("ingest", "normals"),
    uses=("separate", "height", "spectra", "brdf", "render", "evaluate", "viewer", "export"),
    libraries=("numpy", "jinja2", "zarr", OPENCV),
    deliverables=("*.html", "thumbnail.jpg"),
    threads=1,
    cost=lambda facts: Cost(mib=230, bytes_per_pixel=6, seconds=2, us_per_pixel=2),
)


class ObjectReportSettings(PageSettings, stage="object_report", version=2):
    """One HTML file on a turntable scene that opens offline."""


OBJECT = Stage(
    settings=ObjectReportSettings,
    does="HTML report of the scene",
    geometry="turntable",
    product="report",
    requires=("ingest",),
    optional_inputs=lambda settings: ("polarise",),
    needs_colour=False,
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
    libraries=("numpy", "jinja2", "zarr", OPENCV),
    deliverables=("*.html", "thumbnail.jpg"),
    threads=1,
    cost=lambda facts: Cost(mib=230, bytes_per_sample=1, seconds=1.8, us_per_sample=0.2),
)


class ClothReportSettings(PageSettings, stage="cloth_report", version=2):
    """One HTML file on a cloth that opens offline."""

    region: str = Field("", description="region whose lobes and curves are drawn; empty: the first")


CLOTH = Stage(
    settings=ClothReportSettings,
    does="HTML report of the scene",
    geometry="goniometer",
    product="report",
    requires=("ingest", "goniometer_samples"),
    optional_inputs=lambda settings: ("weave",),
    uses=("cloth_brdf", "cloth_render", "cloth_evaluate", "cloth_export", "cloth_viewer"),
    libraries=("numpy", "scipy", "jinja2", "numba", OPENCV),
    deliverables=("*.html", "thumbnail.jpg"),
    threads=1,
    cost=lambda facts: Cost(mib=260, seconds=5.5),
)
