"""Declaration of the stage `render`: settings, inputs, limits of its result, cost."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field, PositiveFloat

from nishiki.artifacts.closed import Closed, Guarded
from nishiki.stages.base import Cost, Stage, digest_of, no_film


class LightSettings(Closed):
    """One lamp, from a direction."""

    elevation_deg: float = Field(45, gt=0, le=90, description="above the plane of the object")
    azimuth_deg: float = Field(90, ge=-360, le=360, description="from x (right) towards y (up)")
    illuminant: str = Field("D65", description="A, D50, D65, E, F2, F7, F11, LED-B1, -B3, -B5, or a CSV: nm, power")
    intensity: float = Field(1.0, ge=0, description="1: a white board facing the lamp has luminance 1")


class ViewSettings(Closed):
    """From where the picture is seen."""

    kind: Literal["frontal", "pinhole"] = Field("frontal", description="frontal: orthographic, one pixel a pixel")
    elevation_deg: float = Field(90, gt=0, le=90, description="pinhole: of the eye above the plane")
    azimuth_deg: float = Field(-90, ge=-360, le=360, description="pinhole: of the eye, from x towards y")
    distance: float = Field(3, gt=0, description="pinhole: in lengths of the object's longer side")
    rows: int | None = Field(None, ge=16, le=16384, description="pinhole: of the picture; null: as the object needs")
    columns: int | None = Field(None, ge=16, le=16384, description="pinhole: of the picture; null: as the object needs")


class PictureSettings(Closed):
    """One picture."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9_-]*$", description="file name without ending")
    lights: tuple[LightSettings, ...] = (LightSettings(),)
    view: ViewSettings = ViewSettings()
    ambient: float = Field(0.05, ge=0, description="uniform light from everywhere, relative to the lamps")
    exposure: Literal["auto"] | PositiveFloat = Field(
        "auto", description="of the PNG; 1: a white facing the lamp is white; auto: as an adapted eye, by the picture"
    )


class SequenceSettings(Closed):
    """A moving light or a moving view, as video."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9_-]*$", description="file name without ending")
    moves: Literal["light", "view"] = Field("light", description="what goes round")
    elevation_deg: float = Field(35, gt=0, le=90, description="of what goes round")
    frames: int = Field(48, ge=2, le=3600, description="frames of one turn")
    frames_per_second: int = Field(24, ge=1, le=120)
    illuminant: str = Field("D65", description="as for a light")
    columns: int = Field(640, ge=16, le=4096, description="width of the video")


class RenderSettings(Guarded):
    """Pictures and sequences to make."""

    STAGE: ClassVar[str] = "render"
    VERSION: ClassVar[int] = 2

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
    export_normals: bool = Field(True, description="also write the normals as 16-bit PNG (y up) and EXR")
    curves_sha256: dict[str, str] = Field({}, description="digests of the illuminant tables; filled in by the plan")
    supersampling: int = Field(2, ge=1, le=8, description="pinhole: rays along each side of a pixel")


def illuminants(settings: RenderSettings) -> set[str]:
    """Every illuminant that the pictures and sequences name."""
    names = {light.illuminant for picture in settings.pictures for light in picture.lights}
    return names | {sequence.illuminant for sequence in settings.sequences}


STAGE = Stage(
    settings=RenderSettings,
    does="pictures under any light and view",
    requires=("normals",),
    wants=lambda settings: ("height",) * settings.cast_shadows + ("spectra", "brdf"),
    needs_colour=True,
    filled=lambda block, settings: {
        "curves_sha256": {
            table: digest_of(table, "illuminant")
            for table in sorted(table for table in illuminants(block) if table.lower().endswith(".csv"))
        }
    },
    libraries=("numpy", "scipy", "numba", "zarr", "OpenEXR", "opencv-contrib-python-headless", "av"),
    idle={"av": no_film("render", "sequences")},
    deliverables=("*.png", "*.exr", "*.mp4", "*.webp"),
    cost=lambda facts: Cost(mib=380, bytes_per_pixel=160, seconds=4, us_per_pixel=30),
)
