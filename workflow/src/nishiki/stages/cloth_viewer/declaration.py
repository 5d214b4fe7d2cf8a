"""Declaration of the stage `cloth_viewer`: settings, inputs, limits of its result, cost."""

from typing import ClassVar

from pydantic import Field

from nishiki.artifacts.closed import Guarded
from nishiki.stages.base import Cost, Stage
from nishiki.stages.cloth_render.declaration import DYES, Colour, MeshSettings, Name, with_digest_of_mesh


class ClothViewerSettings(Guarded):
    """A page on which cloth, lamps and eye move, offline."""

    STAGE: ClassVar[str] = "cloth_viewer"
    VERSION: ClassVar[int] = 1

    dyes: dict[Name, Colour] = Field(DYES, description="dyes to choose from, sRGB colour; others are mixed on the page")
    mesh: MeshSettings | None = Field(
        None, description="a surface from a file beside the others; that of `cloth_render`, filled in by the plan"
    )
    inline_mb: float = Field(6, ge=0, le=100, description="up to this size the page is one file")


STAGE = Stage(
    settings=ClothViewerSettings,
    does="interactive page: the cloth draped, flat and on cylinders",
    geometry="goniometer",
    product="viewer",
    requires=("ingest", "cloth_brdf"),
    needs_colour=True,
    filled=lambda block, settings: (
        with_digest_of_mesh(block.mesh, "cloth_viewer")
        if block.mesh
        else with_digest_of_mesh(settings.cloth_render.mesh, "cloth_render")
    ),
    libraries=("numpy", "scipy", "numba", "trimesh", "jinja2"),
    idle={"trimesh": lambda facts, settings: None if settings["cloth_viewer"].mesh else "no mesh file is shown"},
    cost=lambda facts: Cost(mib=340, seconds=40),
)
