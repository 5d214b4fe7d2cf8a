"""Declaration of the stage `viewer`: settings, inputs, limits of its result, cost."""

from typing import ClassVar

from pydantic import Field

from nishiki.artifacts.closed import Guarded
from nishiki.stages.base import Cost, Stage


class ViewerSettings(Guarded):
    """A page on which the lamp moves, offline."""

    STAGE: ClassVar[str] = "viewer"
    VERSION: ClassVar[int] = 1

    quality: int = Field(92, ge=50, le=100, description="of the tiles (JPEG); docs/stages/viewer.md has the errors")
    inline_mb: float = Field(6, ge=0, le=100, description="up to this size the page is one file")


STAGE = Stage(
    settings=ViewerSettings,
    does="interactive page: moving lamps, spectra, layers",
    requires=("ingest", "normals"),
    wants=lambda settings: ("height", "spectra", "brdf"),
    uses=("evaluate",),
    needs_colour=True,
    libraries=("numpy", "numba", "jinja2", "zarr", "opencv-contrib-python-headless"),
    threads=1,
    cost=lambda facts: Cost(mib=400, bytes_per_pixel=16, seconds=3, us_per_pixel=6),
)
