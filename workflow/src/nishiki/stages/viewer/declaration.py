"""Declaration of the stage `viewer`: settings, inputs, limits of its result, cost."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from nishiki.artifacts.closed import Guarded
from nishiki.stages.base import Cost, Stage


class ViewerSettings(Guarded):
    """A page on which the lamp moves, offline."""

    STAGE: ClassVar[str] = "viewer"
    VERSION: ClassVar[int] = 3

    step: Literal["auto"] | Annotated[float, Field(ge=0.1, le=8)] = Field(
        "auto",
        description="of the codes of colour, in CIELAB; auto: 0.35 up to two megapixels, 0.95 above; others follow",
    )
    inline_mb: float = Field(4, ge=0, le=100, description="up to this size the page is one file")


STAGE = Stage(
    settings=ViewerSettings,
    does="interactive page: moving lamps, spectra, layers",
    requires=("ingest", "normals"),
    wants=lambda settings: ("height", "spectra", "brdf"),
    uses=("evaluate",),
    needs_colour=True,
    libraries=("numpy", "numba", "jinja2", "zarr", "opencv-contrib-python-headless"),
    threads=1,
    cost=lambda facts: Cost(mib=300, bytes_per_pixel=60, seconds=3, us_per_pixel=5, us_per_sample=0.03),
)
