"""Declare the stages of paintings, objects and cloths for exports to other programs."""

from typing import Literal

from pydantic import Field

from nishiki.artifacts.declaration import Closed, Guarded, Limit, at, extreme
from nishiki.stages.base import ARRAYS, OPENCV, Cost, Stage, no_format, photographs_or_states

Format = Literal[
    "normals", "height", "albedo", "relight", "spectral", "gltf", "mitsuba", "merl", "iiif", "usd", "materialx"
]
Kind = Literal["ptm", "hsh", "rbf", "bilinear"]
PAINTING_LIMITS = (
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


class ExportSettings(Guarded, stage="export", version=8, limits=PAINTING_LIMITS):
    """Files of the results for other programs."""

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
    "relight": ("spectra",),
    "bilinear": ("brdf",),
    "spectral": ("spectra",),
    "gltf": ("height", "spectra", "brdf"),
    "mitsuba": ("height", "spectra", "brdf"),
    "merl": ("spectra", "brdf"),
    "iiif": ("height", "spectra"),
    "usd": ("height", "spectra", "brdf"),
    "materialx": ("height", "spectra", "brdf"),
}
"""Stages read by a format, or a kind of relightable image, where the capture can feed them."""


PAINTING = Stage(
    settings=ExportSettings,
    does="files for other programs",
    of_mosaics=True,
    requires=("ingest", "normals"),
    optional_inputs=lambda settings: tuple(
        dict.fromkeys(
            name
            for each in (*settings.formats, *(settings.relight.kinds if "relight" in settings.formats else ()))
            for name in NEEDS.get(each, ())
        )
    ),
    capture_parts=lambda facts, settings, asked: ("check",),
    libraries=(*ARRAYS, OPENCV, "usd-core", "materialx"),
    unused_packages={"usd-core": no_format("export", "usd"), "materialx": no_format("export", "materialx")},
    deliverables=("exports",),
    cost=lambda facts: Cost(mib=620, bytes_per_pixel=40, seconds=5, us_per_pixel=20, us_per_sample=0.5),
)


ObjectFormat = Literal["gltf", "usd", "materialx", "mitsuba", "iiif", "kintsugi"]


OBJECT_LIMITS = (  # of textures that all formats have in common
    Limit("clipped", "share of the texels whose colour is brighter than white", extreme("losses.*.clipped")),
    Limit("placed", "share of the triangles that have a place in the textures", extreme("losses.*.placed"), least=0.9,
          doubt=0.99, remedy="check the mesh and the charts of the stage texels", why="objects gave 1; without texels "
          "there is no colour"),
)  # fmt: skip


class ObjectExportSettings(Guarded, stage="object_export", version=4, limits=OBJECT_LIMITS):
    """Files of an object for other programs."""

    formats: tuple[ObjectFormat, ...] = Field(
        ("gltf",), min_length=1, description="what to write; docs/stages/export.md"
    )
    views: int = Field(6, ge=1, le=360, description="captured views, evenly spread, on which the loss is measured")
    iiif: IiifSettings = Field(IiifSettings(), description="tiles and manifest")
    hold_out: tuple[str, ...] = Field((), description="views left out of the fit; filled in by the plan")


OBJECT = Stage(
    settings=ObjectExportSettings,
    does="files for other programs",
    geometry="turntable",
    product="export",
    requires=("ingest", "mesh", "cameras", "texels", "object_brdf", "residual"),
    uses=("polarise",),
    capture_parts=photographs_or_states,
    libraries=(*ARRAYS, "pywavelets", OPENCV, "usd-core", "materialx"),
    unused_packages={
        "usd-core": no_format("object_export", "usd"),
        "materialx": no_format("object_export", "materialx"),
    },
    deliverables=("exports",),
    threads=1,
    cost=lambda facts: Cost(mib=560, bytes_per_sample=20, seconds=5, us_per_sample=2),
)


ClothFormat = Literal["gltf", "mitsuba", "bsdf"]
CLOTH_LIMITS = (
    Limit(
        "material",
        "mean CIEDE2000 between the cloth with the material of glTF and with the fitted model",
        at("losses.gltf.against_model.delta_e.mean"),
        most=5,
        warns=True,
        remedy="show another model of the cloth (cloth_render.model)",
        why="models of satins gave 0.4 to 2; laws that grow without bound towards the horizon gave 9 and 12",
    ),
)


class ClothExportSettings(Guarded, stage="cloth_export", version=2, limits=CLOTH_LIMITS):
    """Files of a draped cloth for other programs."""

    formats: tuple[ClothFormat, ...] = Field(
        ("gltf",), min_length=1, description="what to write; docs/stages/export.md"
    )


CLOTH = Stage(
    settings=ClothExportSettings,
    does="files for other programs",
    geometry="goniometer",
    product="export",
    requires=("cloth_brdf", "cloth_render"),
    libraries=("numpy", "scipy", "numba", "trimesh"),
    unused_packages={
        "trimesh": lambda facts, settings: None if settings["cloth_render"].mesh else "no mesh file is draped"
    },
    deliverables=("exports",),
    cost=lambda facts: Cost(mib=500, seconds=40),
)
