"""Declaration of the stage `object_render`: settings, inputs, limits of its result, cost."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from nishiki.artifacts.closed import Closed, Guarded
from nishiki.stages.base import Cost, Stage, no_film


class FilmSettings(Closed):
    """The turntable video."""

    frames_per_step: int = Field(3, ge=1, le=60, description="frames from one captured view to the next")
    frames_per_second: int = Field(24, ge=1, le=120)
    columns: int = Field(640, ge=16, le=4096, description="width of the frames; never more than that of the capture")
    supersampling: int = Field(2, ge=1, le=4, description="samples along each side of a pixel")


class LampSettings(Closed):
    """A lamp of one's own, fixed to the camera."""

    azimuth_deg: float = Field(90, ge=-360, le=360, description="from the right of the picture, upwards")
    elevation_deg: float = Field(45, ge=-90, le=90, description="above the picture's plane, towards the camera")
    intensity: float = Field(1.0, ge=0, le=1000, description="of a white diffuser that faces the lamp")
    radius_deg: float = Field(0.75, ge=0, le=45, description="half of the angle that it fills: soft edges of shadows")
    distance: float | None = Field(
        None, ge=0.6, le=1000, description="from the object's middle in its diameters, with fall-off; null: very far"
    )


Name = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]*$")]


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
    lamps: dict[Name, LampSettings] = Field(
        {}, description="lamps of one's own in place of the captured ones; pictures then show the model alone"
    )
    around: float = Field(0.05, ge=0, le=100, description="even light from all around, where `lamps` light; white 1")
    shadows: bool = Field(True, description="cast shadows of `lamps`")
    shadow_rays: int = Field(32, ge=1, le=1024, description="to points of each lamp's disc, from every texel")
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
