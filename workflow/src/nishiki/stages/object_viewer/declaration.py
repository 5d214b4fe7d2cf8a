"""Declaration of the stage `object_viewer`: settings, inputs, limits of its result, cost."""

from typing import ClassVar

from pydantic import Field

from nishiki.artifacts.closed import Guarded
from nishiki.stages.base import Cost, Stage


class ObjectViewerSettings(Guarded):
    """A page on which the object turns, offline."""

    STAGE: ClassVar[str] = "object_viewer"
    VERSION: ClassVar[int] = 1

    inline_mb: float = Field(6, ge=0, le=100, description="up to this size the page is one file")
    hold_out: tuple[str, ...] = Field((), description="views left out of the fit; filled in by the plan")


STAGE = Stage(
    settings=ObjectViewerSettings,
    does="interactive page: the decoded object from any view",
    geometry="turntable",
    product="viewer",
    requires=("ingest", "mesh", "cameras", "texels", "object_brdf", "residual"),
    needs_colour=True,
    libraries=("numpy", "scipy", "numba", "zarr", "pywavelets", "jinja2", "opencv-contrib-python-headless"),
    threads=1,
    cost=lambda facts: Cost(mib=270, seconds=4),
)
