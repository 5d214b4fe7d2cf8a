"""Declaration of the stage `object_render`: settings, inputs, limits of its result, cost."""

from typing import ClassVar, Literal

from pydantic import Field

from nishiki.artifacts.closed import Closed, Guarded
from nishiki.stages.base import Cost, Stage, no_film


class FilmSettings(Closed):
    """The turntable video."""

    frames_per_step: int = Field(3, ge=1, le=60, description="frames from one captured view to the next")
    frames_per_second: int = Field(24, ge=1, le=120)
    columns: int = Field(640, ge=16, le=4096, description="width of the frames; never more than that of the capture")
    supersampling: int = Field(2, ge=1, le=4, description="samples along each side of a pixel")


class ObjectRenderSettings(Guarded):
    """Pictures of the decoded object, and a video of it turning."""

    STAGE: ClassVar[str] = "object_render"
    VERSION: ClassVar[int] = 1

    views: tuple[str, ...] | int = Field(
        4, description="names of the captured views to write, or how many, evenly spread; 0: none"
    )
    between: int = Field(2, ge=0, le=360, description="pictures half-way between captured views, evenly spread")
    lights: dict[str, float] = Field(
        {}, description="weight L_j / L of each captured light, by name; none named: the first light alone"
    )
    film: FilmSettings | None = Field(FilmSettings(), description="null: no video")
    interpolation: Literal["linear", "cubic", "nearest"] = Field(
        "cubic", description="of the residual between captured views, from four or two of them; linear: as the paper"
    )
    level: int = Field(0, ge=0, le=6, description="0: everything; 1, 2, ..: previews from the coarse part alone")
    rim_px: int = Field(2, ge=0, le=8, description="pixels by which values are carried on beyond the surface's edge")
    background: float = Field(
        0.0, ge=0, le=1, description="of PNG and video, sRGB-coded grey; EXR has an alpha channel"
    )
    export_normals: bool = Field(False, description="also write normals and depth of the captured views")
    hold_out: tuple[str, ...] = Field((), description="views left out of the fit; filled in by the plan")


STAGE = Stage(
    settings=ObjectRenderSettings,
    does="captured and in-between views, and a turn as video",
    geometry="turntable",
    product="render",
    requires=("ingest", "mesh", "cameras", "texels", "object_brdf", "residual"),
    needs_colour=True,
    libraries=("numpy", "scipy", "numba", "zarr", "pywavelets", "OpenEXR", "opencv-contrib-python-headless", "av"),
    idle={"av": no_film("object_render", "film")},
    deliverables=("*.png", "*.exr", "*.mp4", "*.webp"),
    cost=lambda facts: Cost(mib=270, bytes_per_sample=70, seconds=4, us_per_sample=9.5),
)
