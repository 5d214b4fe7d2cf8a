"""Declaration of the stage `cloth_export`: settings, inputs, limits of its result, cost."""

from typing import ClassVar, Literal

from pydantic import Field

from nishiki.artifacts.closed import Guarded
from nishiki.artifacts.limits import Limit, at
from nishiki.stages.base import Cost, Stage

Format = Literal["gltf", "mitsuba", "bsdf"]
LIMITS = (
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


class ClothExportSettings(Guarded):
    """Files of a draped cloth for other programs."""

    STAGE: ClassVar[str] = "cloth_export"
    VERSION: ClassVar[int] = 2
    LIMITS: ClassVar[tuple[Limit, ...]] = LIMITS

    formats: tuple[Format, ...] = Field(("gltf",), min_length=1, description="what to write; docs/stages/export.md")


STAGE = Stage(
    settings=ClothExportSettings,
    does="files for other programs",
    geometry="goniometer",
    product="export",
    requires=("cloth_brdf", "cloth_render"),
    needs_colour=True,
    libraries=("numpy", "scipy", "numba", "trimesh"),
    idle={"trimesh": lambda facts, settings: None if settings["cloth_render"].mesh else "no mesh file is draped"},
    deliverables=("exports",),
    cost=lambda facts: Cost(mib=500, seconds=40),
)
