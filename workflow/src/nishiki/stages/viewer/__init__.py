"""Declare the stages of paintings, objects and cloths for interactive pages."""

from typing import Annotated, Literal

from pydantic import Field

from nishiki.artifacts.declaration import Guarded
from nishiki.stages.base import ARRAYS, OPENCV, Cost, Stage
from nishiki.stages.render import DYES, Colour, Name, SurfaceFile, with_digest_of_mesh


class ViewerSettings(Guarded, stage="viewer", version=3):
    """A page on which the lamp moves, offline."""

    step: Literal["auto"] | Annotated[float, Field(ge=0.1, le=8)] = Field(
        "auto",
        description="of the codes of colour, in CIELAB; auto: 0.35 up to two megapixels, 0.95 above; others follow",
    )
    inline_mb: float = Field(4, ge=0, le=100, description="up to this size the page is one file")


PAINTING = Stage(
    settings=ViewerSettings,
    does="interactive page: moving lamps, spectra, layers",
    of_mosaics=True,
    requires=("ingest", "normals"),
    optional_inputs=lambda settings: ("height", "spectra", "brdf"),
    uses=("evaluate",),
    libraries=("numpy", "numba", "jinja2", "zarr", OPENCV),
    threads=1,
    cost=lambda facts: Cost(  # a row of tiles of each level, as wide as the picture
        mib=450 + 0.046 * facts.pixels**0.5, bytes_per_pixel=0.2, seconds=3, us_per_pixel=5, us_per_sample=0.03
    ),
)


class ObjectViewerSettings(Guarded, stage="object_viewer", version=2):
    """A page on which the object turns, offline."""

    inline_mb: float = Field(6, ge=0, le=100, description="up to this size the page is one file")
    hold_out: tuple[str, ...] = Field((), description="views left out of the fit; filled in by the plan")


OBJECT = Stage(
    settings=ObjectViewerSettings,
    does="interactive page: the decoded object from any view",
    geometry="turntable",
    product="viewer",
    requires=("ingest", "mesh", "cameras", "texels", "object_brdf", "residual"),
    libraries=(*ARRAYS, "pywavelets", "jinja2", OPENCV),
    threads=1,
    cost=lambda facts: Cost(mib=270, seconds=4),
)


class ClothViewerSettings(Guarded, stage="cloth_viewer", version=1):
    """A page on which cloth, lamps and eye move, offline."""

    dyes: dict[Name, Colour] = Field(DYES, description="dyes to choose from, sRGB colour; others are mixed on the page")
    mesh: SurfaceFile | None = Field(
        None, description="a surface from a file beside the others; that of `cloth_render`, filled in by the plan"
    )
    inline_mb: float = Field(6, ge=0, le=100, description="up to this size the page is one file")


CLOTH = Stage(
    settings=ClothViewerSettings,
    does="interactive page: the cloth draped, flat and on cylinders",
    geometry="goniometer",
    product="viewer",
    requires=("ingest", "cloth_brdf"),
    filled=lambda block, settings: (
        with_digest_of_mesh(block.mesh, "cloth_viewer")
        if block.mesh
        else with_digest_of_mesh(settings.cloth_render.mesh, "cloth_render")
    ),
    libraries=("numpy", "scipy", "numba", "trimesh", "jinja2"),
    unused_packages={
        "trimesh": lambda facts, settings: None if settings["cloth_viewer"].mesh else "no mesh file is shown"
    },
    cost=lambda facts: Cost(mib=340, seconds=40),
)
