"""Declare the stages of paintings, objects and cloths for pictures and films."""

from typing import Annotated, Literal

from pydantic import Field, PositiveFloat

from nishiki.artifacts.declaration import Closed, Guarded
from nishiki.stages.base import ARRAYS, OPENCV, Cost, Stage, digest_of, no_film

NAME = r"^[a-z0-9][a-z0-9_-]*$"
Name = Annotated[str, Field(pattern=NAME)]


class LightSettings(Closed):
    """One lamp, from a direction."""

    elevation_deg: float = Field(45, gt=0, le=90, description="above the plane of the object")
    azimuth_deg: float = Field(90, ge=-360, le=360, description="from x (right) towards y (up)")
    illuminant: str = Field("D65", description="A, D50, D65, E, F2, F7, F11, LED-B1, -B3, -B5, or a CSV: nm, power")
    intensity: float = Field(1.0, ge=0, description="1: a white board facing the lamp has luminance 1")


class ViewSettings(Closed):
    """Viewpoint of the picture."""

    kind: Literal["frontal", "pinhole"] = Field("frontal", description="frontal: orthographic, the pixels of the maps")
    elevation_deg: float = Field(90, gt=0, le=90, description="pinhole: of the eye above the plane")
    azimuth_deg: float = Field(-90, ge=-360, le=360, description="pinhole: of the eye, from x towards y")
    distance: float = Field(3, gt=0, description="pinhole: in lengths of the object's longer side")
    rows: int | None = Field(None, ge=16, le=16384, description="pinhole: of the picture; null: as the object needs")
    columns: int | None = Field(None, ge=16, le=16384, description="pinhole: of the picture; null: as the object needs")


class PictureSettings(Closed):
    """One picture."""

    name: str = Field(pattern=NAME, description="file name without ending")
    lights: tuple[LightSettings, ...] = (LightSettings(),)
    view: ViewSettings = ViewSettings()
    ambient: float = Field(0.05, ge=0, description="uniform light from everywhere, relative to the lamps")
    exposure: Literal["auto"] | PositiveFloat = Field(
        "auto", description="of the PNG; 1: a white facing the lamp is white; auto: as an adapted eye, by the picture"
    )


class SequenceSettings(Closed):
    """A moving light or a moving view, as video."""

    name: str = Field(pattern=NAME, description="file name without ending")
    moves: Literal["light", "view"] = Field("light", description="what goes round")
    elevation_deg: float = Field(35, gt=0, le=90, description="of what goes round")
    frames: int = Field(48, ge=2, le=3600, description="frames of one turn")
    frames_per_second: int = Field(24, ge=1, le=120)
    illuminant: str = Field("D65", description="as for a light")
    columns: int = Field(640, ge=16, le=4096, description="width of the video")


MOST_MEGAPIXELS = 24.0
"""Largest size of photographs from usual cameras; their pictures take 4 GiB."""


class RenderSettings(Guarded, stage="render", version=3):
    """Pictures and sequences to make."""

    pictures: Annotated[tuple[PictureSettings, ...], Field(description="pictures to make")] = (
        PictureSettings(name="daylight"),
        PictureSettings(name="raking", lights=(LightSettings(elevation_deg=15, azimuth_deg=180),), ambient=0.0),
        PictureSettings(name="lamplight", lights=(LightSettings(illuminant="A"),)),
        PictureSettings(
            name="oblique",
            lights=(LightSettings(elevation_deg=50, azimuth_deg=160),),
            view=ViewSettings(kind="pinhole", elevation_deg=45, azimuth_deg=-90),
        ),
    )
    sequences: tuple[SequenceSettings, ...] = Field(
        (SequenceSettings(name="moving-light"),), description="videos to make"
    )
    cast_shadows: bool = Field(True, description="shadows thrown by the integrated height")
    most_megapixels: float = Field(
        MOST_MEGAPIXELS,
        gt=0,
        description="of the maps that pictures are made from; larger ones are averaged over squares of pixels, to at "
        "most half as many",
    )
    export_normals: bool = Field(True, description="also write the normals as 16-bit PNG (y up) and EXR")
    curves_sha256: dict[str, str] = Field({}, description="digests of the illuminant tables; filled in by the plan")
    supersampling: int = Field(2, ge=1, le=8, description="pinhole: rays along each side of a pixel")


def illuminants(settings: RenderSettings) -> set[str]:
    """Return every illuminant that the pictures and sequences name."""
    names = {light.illuminant for picture in settings.pictures for light in picture.lights}
    return names | {sequence.illuminant for sequence in settings.sequences}


def _picture_megapixels(megapixels: float) -> float:
    """Return the largest size in megapixels for pictures of a painting."""
    return megapixels if megapixels <= MOST_MEGAPIXELS else MOST_MEGAPIXELS / 2


PAINTING = Stage(
    settings=RenderSettings,
    does="pictures under any light and view",
    of_mosaics=True,
    requires=("normals",),
    optional_inputs=lambda settings: ("height",) * settings.cast_shadows + ("spectra", "brdf"),
    filled=lambda block, settings: {
        "curves_sha256": {
            table: digest_of(table, "illuminant")
            for table in sorted(table for table in illuminants(block) if table.lower().endswith(".csv"))
        }
    },
    libraries=(*ARRAYS, OPENCV, "av"),
    unused_packages={"av": no_film("render", "sequences")},
    deliverables=("*.png", "*.exr", "*.mp4", "*.webp"),
    cost=lambda facts: Cost(
        mib=400 + 160 * _picture_megapixels(facts.pixels / 1e6),
        bytes_per_pixel=0.5,
        seconds=4 + 30 * _picture_megapixels(facts.pixels / 1e6),
        us_per_pixel=2,
    ),
)


class ObjectFilmSettings(Closed):
    """The turntable video."""

    frames_per_step: int = Field(3, ge=1, le=60, description="frames from one captured view to the next")
    frames_per_second: int = Field(24, ge=1, le=120)
    columns: int = Field(640, ge=16, le=4096, description="width of the frames; never more than that of the capture")
    supersampling: int = Field(2, ge=1, le=4, description="samples along each side of a pixel")


class ObjectLampSettings(Closed):
    """Lamp chosen by the user, fixed to the camera."""

    azimuth_deg: float = Field(90, ge=-360, le=360, description="from the right of the picture, upwards")
    elevation_deg: float = Field(45, ge=-90, le=90, description="above the picture's plane, towards the camera")
    intensity: float = Field(1.0, ge=0, le=1000, description="of a white diffuser that faces the lamp")
    radius_deg: float = Field(0.75, ge=0, le=45, description="half of the angle that it fills: soft edges of shadows")
    distance: float | None = Field(
        None, ge=0.6, le=1000, description="from the object's middle in its diameters, with fall-off; null: very far"
    )


class ObjectRenderSettings(Guarded, stage="object_render", version=6):
    """Pictures of the decoded object, and a video of it turning."""

    views: tuple[str, ...] | int = Field(
        4, description="names of the captured views to write, or how many, evenly spread; 0: none"
    )
    between: int = Field(2, ge=0, le=360, description="pictures half-way between captured views, evenly spread")
    lights: dict[str, float] = Field(
        {}, description="weight L_j / L of each captured light, by name; none named: the first light alone"
    )
    lamps: dict[Name, ObjectLampSettings] = Field(
        {}, description="lamps of one's own in place of the captured ones; pictures then show the model alone"
    )
    around: float = Field(0.05, ge=0, le=100, description="even light from all around, where `lamps` light; white 1")
    shadows: bool = Field(True, description="cast shadows of `lamps`")
    shadow_rays: int = Field(32, ge=1, le=1024, description="to points of each lamp's disc, from every texel")
    film: ObjectFilmSettings | None = Field(ObjectFilmSettings(), description="null: no video")
    level: int = Field(
        0,
        ge=0,
        le=6,
        description="0: everything; 1, 2, ..: previews from the coarse part of texels, else the model alone",
    )
    background: float = Field(
        0.0, ge=0, le=1, description="of PNG and video, sRGB-coded grey; EXR has an alpha channel"
    )
    export_normals: bool = Field(False, description="also write normals and depth of the captured views")
    hold_out: tuple[str, ...] = Field((), description="views left out of the fit; filled in by the plan")


OBJECT = Stage(
    settings=ObjectRenderSettings,
    does="captured and in-between views, and a turn as video",
    geometry="turntable",
    product="render",
    requires=("ingest", "mesh", "cameras", "texels", "object_brdf", "residual"),
    libraries=(*ARRAYS, "pywavelets", OPENCV, "av"),
    unused_packages={"av": no_film("object_render", "film")},
    deliverables=("*.png", "*.exr", "*.mp4", "*.webp"),
    cost=lambda facts: Cost(mib=320, bytes_per_sample=55, seconds=2, us_per_sample=7.8),
)


COLOUR = r"^#[0-9a-fA-F]{6}$"
Colour = Annotated[str, Field(pattern=COLOUR)]


class SurfaceFile(Closed):
    """A surface from a file in place of the shipped cloth."""

    file: str = Field(description="PLY or OBJ; y is up")
    sha256: str = Field("", description="digest that the file must have; empty: any")
    weft: Literal["texture", "x", "y", "z"] = Field(
        "texture", description="direction of the weft: along u of the file's texture coordinates, or an axis laid on"
    )
    turned_deg: float = Field(0, ge=-360, le=360, description="of the cloth on the surface, from weft to warp")
    smooth: bool = Field(True, description="vertex normals averaged over their triangles")


class ClothViewSettings(Closed):
    """Camera that frames the whole surface."""

    elevation_deg: float = Field(21, ge=-10, le=89)
    azimuth_deg: float = Field(12, ge=-360, le=360, description="from the front, to the right")
    distance: float = Field(2.2, ge=0.8, le=100, description="in extents of the surface")
    rows: int = Field(640, ge=16, le=8192)
    columns: int = Field(640, ge=16, le=8192)


class ClothLampSettings(Closed):
    """A distant lamp."""

    elevation_deg: float = Field(35, ge=-10, le=90)
    azimuth_deg: float = Field(-45, ge=-360, le=360, description="from the camera, to the right")
    intensity: float = Field(1.0, ge=0, le=1000)
    colour: str = Field("#ffffff", pattern=COLOUR, description="sRGB colour of white paper under it")
    radius_deg: float = Field(1.5, ge=0, le=45, description="half of the angle that it fills: soft edges of shadows")


class ClothFilmSettings(Closed):
    """A video."""

    moves: Literal["turn", "light"] = Field("turn", description="the cloth turns, or the lamps go round it")
    frames: int = Field(96, ge=2, le=2000)
    frames_per_second: int = Field(24, ge=1, le=120)
    columns: int = Field(480, ge=16, le=4096)
    supersampling: int = Field(2, ge=1, le=8)


LAMPS = {
    "left": ClothLampSettings(elevation_deg=38, azimuth_deg=-50, intensity=1.15, colour="#fff3e2", radius_deg=1.5),
    "right": ClothLampSettings(elevation_deg=24, azimuth_deg=68, intensity=0.75, colour="#e8f0ff", radius_deg=3),
}
DYES = {"red": "#b01e3c", "indigo": "#2b4a7f", "gold": "#c9992f"}


class ClothRenderSettings(Guarded, stage="cloth_render", version=2):
    """Pictures of the cloth: draped, from two lights, in three dyes, and on cylinders."""

    region: str = Field("", description="region of the capture whose cloth is shown; empty: the first")
    model: str = Field("", description="model of the cloth_brdf stage; empty: its default")
    mesh: SurfaceFile | None = Field(None, description="a surface from a file instead; null: the draped cloth")
    view: ClothViewSettings = Field(ClothViewSettings(), description="camera of the draped pictures")
    lights: dict[Name, ClothLampSettings] = Field(
        LAMPS, description="lamps by name; a picture under each, and under all"
    )
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
    film: ClothFilmSettings | None = Field(None, description="a video; null: none")


def with_digest_of_mesh(mesh: SurfaceFile | None, stage: str) -> dict:
    """Return the settings filled in by the plan: the digest of the file, where the settings state none."""
    if mesh is None or mesh.sha256:
        return {"mesh": mesh}
    return {"mesh": mesh.model_copy(update={"sha256": digest_of(mesh.file, f"{stage}.mesh.file")})}


CLOTH = Stage(
    settings=ClothRenderSettings,
    does="the cloth on a draped mesh, in any dye",
    geometry="goniometer",
    product="render",
    requires=("cloth_brdf",),
    filled=lambda block, settings: with_digest_of_mesh(block.mesh, "cloth_render"),
    libraries=("numpy", "scipy", "numba", "trimesh", OPENCV, "av"),
    unused_packages={
        "av": no_film("cloth_render", "film"),
        "trimesh": lambda facts, settings: None if settings["cloth_render"].mesh else "no mesh file is draped",
    },
    deliverables=("*.png", "*.exr", "*.mp4"),
    cost=lambda facts: Cost(mib=900, seconds=90),
)
