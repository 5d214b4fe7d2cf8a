"""Declaration of the stage `cloth_render`: settings, inputs, limits of its result, cost."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from nishiki.artifacts.closed import Closed, Guarded
from nishiki.stages.base import Cost, Stage, digest_of, no_film

COLOUR = r"^#[0-9a-fA-F]{6}$"
Colour = Annotated[str, Field(pattern=COLOUR)]
Name = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]*$")]


class MeshSettings(Closed):
    """A surface from a file in place of the shipped cloth."""

    file: str = Field(description="PLY or OBJ; y is up")
    sha256: str = Field("", description="digest that the file must have; empty: any")
    weft: Literal["texture", "x", "y", "z"] = Field(
        "texture", description="direction of the weft: along u of the file's texture coordinates, or an axis laid on"
    )
    turned_deg: float = Field(0, ge=-360, le=360, description="of the cloth on the surface, from weft to warp")
    smooth: bool = Field(True, description="vertex normals averaged over their triangles")


class ViewSettings(Closed):
    """A camera that holds the whole surface in its picture."""

    elevation_deg: float = Field(21, ge=-10, le=89)
    azimuth_deg: float = Field(12, ge=-360, le=360, description="from the front, to the right")
    distance: float = Field(2.2, ge=0.8, le=100, description="in extents of the surface")
    rows: int = Field(640, ge=16, le=8192)
    columns: int = Field(640, ge=16, le=8192)


class LampSettings(Closed):
    """A distant lamp."""

    elevation_deg: float = Field(35, ge=-10, le=90)
    azimuth_deg: float = Field(-45, ge=-360, le=360, description="from the camera, to the right")
    intensity: float = Field(1.0, ge=0, le=1000)
    colour: str = Field("#ffffff", pattern=COLOUR, description="sRGB colour of white paper under it")
    radius_deg: float = Field(1.5, ge=0, le=45, description="half of the angle that it fills: soft edges of shadows")


class FilmSettings(Closed):
    """A video."""

    moves: Literal["turn", "light"] = Field("turn", description="the cloth turns, or the lamps go round it")
    frames: int = Field(96, ge=2, le=2000)
    frames_per_second: int = Field(24, ge=1, le=120)
    columns: int = Field(480, ge=16, le=4096)
    supersampling: int = Field(2, ge=1, le=8)


LAMPS = {
    "left": LampSettings(elevation_deg=38, azimuth_deg=-50, intensity=1.15, colour="#fff3e2", radius_deg=1.5),
    "right": LampSettings(elevation_deg=24, azimuth_deg=68, intensity=0.75, colour="#e8f0ff", radius_deg=3),
}
DYES = {"red": "#b01e3c", "indigo": "#2b4a7f", "gold": "#c9992f"}


class ClothRenderSettings(Guarded):
    """Pictures of the cloth: draped, from two lights, in three dyes, and on cylinders."""

    STAGE: ClassVar[str] = "cloth_render"
    VERSION: ClassVar[int] = 2

    region: str = Field("", description="region of the capture whose cloth is shown; empty: the first")
    model: str = Field("", description="model of the cloth_brdf stage; empty: its default")
    mesh: MeshSettings | None = Field(None, description="a surface from a file instead; null: the draped cloth")
    view: ViewSettings = Field(ViewSettings(), description="camera of the draped pictures")
    lights: dict[Name, LampSettings] = Field(LAMPS, description="lamps by name; a picture under each, and under all")
    around: float = Field(0.16, ge=0, le=100, description="radiance of the room above, a third of it below; white 1")
    dyes: dict[Name, Colour] = Field(
        DYES, description="dyes by name, sRGB colour of the dye under a gloss that takes no light; a picture in each"
    )
    as_measured: bool = Field(True, description="also pictures in the cloth's own colour")
    swatches: bool = Field(True, description="also three cylinders, warp upright, oblique and around")
    paper: float = Field(
        0.14, ge=0, le=1, description="reflectance of the paper it stands on; 0: none, and alpha in EXR"
    )
    shadows: bool = Field(True, description="cast shadows")
    supersampling: int = Field(3, ge=1, le=16, description="samples along each side of a pixel")
    exposure: float | Literal["auto"] = Field(
        "auto",
        description="factor of the PNG pictures; auto: a white sheet facing the brightest lamp is white; not in EXR",
    )
    tone: Literal["soft", "linear"] = Field("soft", description="of the PNG: highlights bent softly, or clipped")
    film: FilmSettings | None = Field(None, description="a video; null: none")


def with_digest_of_mesh(mesh: MeshSettings | None, stage: str) -> dict:
    """What the plan fills in for a stage: the digest of the file, where the settings state none."""
    if mesh is None or mesh.sha256:
        return {"mesh": mesh}
    return {"mesh": mesh.model_copy(update={"sha256": digest_of(mesh.file, f"{stage}.mesh.file")})}


STAGE = Stage(
    settings=ClothRenderSettings,
    does="the cloth on a draped mesh, in any dye",
    formerly="fabric_render",
    geometry="goniometer",
    product="render",
    requires=("cloth_brdf",),
    needs_colour=True,
    filled=lambda block, settings: with_digest_of_mesh(block.mesh, "cloth_render"),
    libraries=("numpy", "scipy", "numba", "trimesh", "OpenEXR", "opencv-contrib-python-headless", "av"),
    idle={
        "av": no_film("cloth_render", "film"),
        "trimesh": lambda facts, settings: None if settings["cloth_render"].mesh else "no mesh file is draped",
    },
    deliverables=("*.png", "*.exr", "*.mp4"),
    cost=lambda facts: Cost(mib=900, seconds=90),
)
