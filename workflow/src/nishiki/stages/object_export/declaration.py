"""Declaration of the stage `object_export`: settings, inputs, limits of its result, cost."""

from collections.abc import Mapping
from typing import Any, ClassVar, Literal, get_args

from pydantic import Field

from nishiki.artifacts.closed import Guarded
from nishiki.artifacts.limits import Figure, Limit, at
from nishiki.stages.base import Cost, Stage, no_format, photographs_or_states
from nishiki.stages.export.declaration import IiifSettings

Format = Literal["gltf", "usd", "materialx", "mitsuba", "iiif", "kintsugi"]


def _of_look(name: str) -> Figure:
    """A figure that every format states, because all have the same textures."""

    def figure(diagnostics: Mapping[str, Any]) -> float | None:
        found = (at(f"losses.{each}.{name}")(diagnostics) for each in get_args(Format))
        return next((value for value in found if value is not None), None)

    return figure


LIMITS = (
    Limit("clipped", "share of the texels whose colour is brighter than white", _of_look("clipped")),
    Limit("placed", "share of the triangles that have a place in the textures", _of_look("placed"), least=0.9,
          doubt=0.99, remedy="check the mesh and the charts of the stage texels", why="objects gave 1; without texels "
          "there is no colour"),
)  # fmt: skip


class ObjectExportSettings(Guarded):
    """Files of an object for other programs."""

    STAGE: ClassVar[str] = "object_export"
    VERSION: ClassVar[int] = 2
    LIMITS: ClassVar[tuple[Limit, ...]] = LIMITS

    formats: tuple[Format, ...] = Field(("gltf",), min_length=1, description="what to write; docs/stages/export.md")
    views: int = Field(6, ge=1, le=360, description="captured views, evenly spread, on which the loss is measured")
    iiif: IiifSettings = Field(IiifSettings(), description="tiles and manifest")
    hold_out: tuple[str, ...] = Field((), description="views left out of the fit; filled in by the plan")


STAGE = Stage(
    settings=ObjectExportSettings,
    does="files for other programs",
    geometry="turntable",
    product="export",
    requires=("ingest", "mesh", "cameras", "texels", "object_brdf", "residual"),
    uses=("polarise",),
    needs_colour=True,
    looks_at=photographs_or_states,
    libraries=(
        "numpy",
        "scipy",
        "numba",
        "zarr",
        "pywavelets",
        "opencv-contrib-python-headless",
        "usd-core",
        "materialx",
    ),
    idle={"usd-core": no_format("object_export", "usd"), "materialx": no_format("object_export", "materialx")},
    deliverables=("exports",),
    threads=1,
    cost=lambda facts: Cost(mib=560, bytes_per_sample=20, seconds=5, us_per_sample=2),
)
