"""Declaration of the stage `export`: settings, inputs, limits of its result, cost."""

from typing import ClassVar, Literal

from pydantic import Field

from nishiki.artifacts.closed import Guarded
from nishiki.artifacts.limits import Limit, at
from nishiki.stages.base import Cost, Stage

Format = Literal["normals", "height", "albedo"]
LIMITS = (
    Limit("quantised", "largest angle by which 16 bits move a normal, degrees", at("losses.normals.largest_deg")),
    Limit(
        "clipped",
        "share of the samples of the albedo that its colour space cannot hold",
        at("losses.albedo.clipped"),
        most=0.5,
        remedy="check the white board and the spectra, or leave albedo out of export.formats",
        why="surfaces gave 0; where half is outside, the picture shows another surface",
    ),
)


class ExportSettings(Guarded):
    """Files of the results for other programs."""

    STAGE: ClassVar[str] = "export"
    VERSION: ClassVar[int] = 1
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
    hold_out: tuple[str, ...] = Field((), description="lights that no fit saw; filled in by the plan")


NEEDS: dict[str, tuple[str, ...]] = {"height": ("height",), "albedo": ("spectra",)}
"""Stages that a format reads where the capture can feed them."""

STAGE = Stage(
    settings=ExportSettings,
    does="files for other programs",
    requires=("ingest", "normals"),
    wants=lambda settings: tuple(dict.fromkeys(name for each in settings.formats for name in NEEDS.get(each, ()))),
    needs_colour=True,
    looks_at=lambda facts, settings, asked: ("check",),
    libraries=("numpy", "numba", "zarr", "OpenEXR"),
    deliverables=("exports",),
    threads=1,
    cost=lambda facts: Cost(mib=260, bytes_per_pixel=40, seconds=3, us_per_pixel=10),
)
