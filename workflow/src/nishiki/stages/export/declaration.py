"""Declaration of the stage `export`: settings, inputs, limits of its result, cost."""

from typing import ClassVar, Literal

from pydantic import Field

from nishiki.artifacts.closed import Closed, Guarded
from nishiki.artifacts.limits import Limit, at
from nishiki.stages.base import Cost, Stage, no_format

Format = Literal[
    "normals", "height", "albedo", "relight", "spectral", "gltf", "mitsuba", "merl", "iiif", "usd", "materialx"
]
Kind = Literal["ptm", "hsh", "rbf", "bilinear"]
LIMITS = (
    Limit("quantised", "largest angle by which 16 bits move a normal, degrees", at("losses.normals.largest_deg")),
    Limit(
        "clipped",
        "share of the samples of the albedo that its colour space cannot hold",
        at("losses.albedo.clipped"),
        most=0.2,
        doubt=0.02,
        remedy="check the white board and the spectra, or leave albedo out of export.formats",
        why="surfaces gave 0; where a fifth is outside, the picture shows another surface",
    ),
)


class RelightSettings(Closed):
    """Relightable images."""

    kinds: tuple[Kind, ...] = Field(
        ("ptm", "hsh", "rbf", "bilinear"),
        min_length=1,
        description="ptm: 18 planes; hsh: 27; rbf, bilinear: as many as `planes`",
    )
    planes: int = Field(18, ge=3, le=60, multiple_of=3, description="of rbf and bilinear; three planes a picture")
    jpeg_quality: int = Field(97, ge=50, le=100, description="of the planes")
    single_file: bool = Field(False, description="write painting.ptm beside the planes of ptm, one large file")


class GltfSettings(Closed):
    """Binary glTF, USD and MaterialX."""

    texture_px: int = Field(4096, ge=16, le=16384, description="most texels along a side")


class IiifSettings(Closed):
    """Tiles and manifest for viewers of libraries and museums."""

    address: str = Field(
        "http://localhost:8000",
        pattern=r"^https?://\S+$",
        description="where the folder `iiif` will be found on the web; its files must state it",
    )


class ExportSettings(Guarded):
    """Files of the results for other programs."""

    STAGE: ClassVar[str] = "export"
    VERSION: ClassVar[int] = 8
    LIMITS: ClassVar[tuple[Limit, ...]] = LIMITS

    formats: tuple[Format, ...] = Field(
        ("normals", "height", "albedo"), min_length=1, description="what to write; docs/stages/export.md"
    )
    normals_y: Literal["up", "down"] = Field(
        "up", description="green of the 16-bit normals: up as in OpenGL and glTF, down as in DirectX"
    )
    mesh_vertices: int = Field(
        2_000_000, ge=100, le=100_000_000, description="most vertices of a mesh; more pixels are averaged in squares"
    )
    relight: RelightSettings = Field(RelightSettings(), description="relightable images")
    gltf: GltfSettings = Field(GltfSettings(), description="textures of glTF, USD and MaterialX")
    iiif: IiifSettings = Field(IiifSettings(), description="tiles and manifest for viewers of museums")
    hold_out: tuple[str, ...] = Field((), description="lights that no fit saw; filled in by the plan")


NEEDS: dict[str, tuple[str, ...]] = {
    "height": ("height", "spectra"),
    "albedo": ("spectra",),
    "relight": ("spectra", "brdf"),
    "spectral": ("spectra",),
    "gltf": ("height", "spectra", "brdf"),
    "mitsuba": ("height", "spectra", "brdf"),
    "merl": ("spectra", "brdf"),
    "iiif": ("height", "spectra"),
    "usd": ("height", "spectra", "brdf"),
    "materialx": ("height", "spectra", "brdf"),
}
"""Stages that a format reads where the capture can feed them."""

STAGE = Stage(
    settings=ExportSettings,
    does="files for other programs",
    requires=("ingest", "normals"),
    wants=lambda settings: tuple(dict.fromkeys(name for each in settings.formats for name in NEEDS.get(each, ()))),
    needs_colour=True,
    looks_at=lambda facts, settings, asked: ("check",),
    libraries=("numpy", "scipy", "numba", "zarr", "OpenEXR", "opencv-contrib-python-headless", "usd-core", "materialx"),
    idle={"usd-core": no_format("export", "usd"), "materialx": no_format("export", "materialx")},
    deliverables=("exports",),
    cost=lambda facts: Cost(mib=620, bytes_per_pixel=40, seconds=5, us_per_pixel=20, us_per_sample=0.5),
)
