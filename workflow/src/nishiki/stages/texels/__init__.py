"""Declare the stage `texels`: settings, inputs, limits of its result, cost."""

from pydantic import Field

from nishiki.artifacts.declaration import Guarded, Limit, Output, at
from nishiki.stages.base import ARRAYS, OPENCV, Cost, Stage, photographs_or_states

LIMITS = (
    Limit(
        "object_pixels",
        "pixels of all views that show the mesh",
        at("object_pixels"),
        least=1,
        remedy="mesh and cameras must be of one world; look at the mesh stage's preview",
        why="no pixel: nothing to fit",
    ),
    Limit(
        "visible_share",
        "share of the texels that a view shows, mean over the views",
        at("visible_share"),
        least=0.05,
        doubt=0.15,
        remedy="check mesh and cameras",
        why="captures gave 0.32 to 0.38; a mesh that stood wrong gave 0.003",
    ),
    Limit(
        "uncovered_share",
        "share of the silhouettes that the mesh does not cover",
        at("silhouette_uncovered_share"),
        most=0.1,
        doubt=0.04,
        remedy="look at surface and silhouettes: dark shadows or parts of few pixels may cut it; check the cameras",
        why="captures gave 0.0015 to 0.013; scans that were registered wrongly gave 0.74",
    ),
    Limit("degenerate_triangles", "triangles without area that get no texels", at("degenerate_triangles")),
)


class TexelsSettings(Guarded, stage="texels", version=5, limits=LIMITS):
    """Charts and tiles of the surface, density of its samples, and limits of visibility."""

    texels_per_pixel: float = Field(
        1.0, gt=0, le=8, description="linear: texels for one pixel of the views that see a place best"
    )
    tile: int = Field(64, ge=4, le=1024, description="texels along a tile's side; a tile is the unit of random access")
    hold_out: tuple[str, ...] = Field((), description="views that take no part; filled in by the plan")


OUTPUTS = (
    Output("positions", "float32", "of the capture", "place of each texel, 0 outside the surface", "tile row column 3"),
    Output("normals", "float32", "unit vector", "of the surface, 0 outside it", "tile row column 3"),
    Output(
        "visible", "uint8", "", "1: seen, 2, 4, ..: saturated channels; 1 alone: valid",
        "observation tile row column",
    ),
    Output(
        "values/COMPONENT", "float32", "linear", "light of the texel, 0 where not seen",
        "observation tile row column channel",
    ),
    Output("pixels/row", "uint16", "pixels", "row in the photograph of each object pixel, by view and tile", "pixel"),
    Output("pixels/column", "uint16", "pixels", "column in the photograph", "pixel"),
    Output("pixels/s", "float32", "texels", "row within the tile", "pixel"),
    Output("pixels/t", "float32", "texels", "column within the tile", "pixel"),
    Output("pixels/valid", "uint8", "", "1: usable, in all channels", "light pixel"),
    Output("pixels/values/COMPONENT", "float32", "linear", "light of the pixel", "light pixel channel"),
    Output("pixels/offsets", "int64", "pixels", "first pixel of each tile, and the end of the last", "view bound"),
)  # fmt: skip


STAGE = Stage(
    settings=TexelsSettings,
    does="what every view shows of every patch of the surface",
    outputs=OUTPUTS,
    store="texels.zarr",
    geometry="turntable",
    requires=("ingest", "cameras", "mesh"),
    optional_inputs=lambda settings: ("polarise",),
    capture_parts=photographs_or_states,
    libraries=(*ARRAYS, OPENCV),
    # with polarisers all light, diffuse and specular part
    cost=lambda facts: Cost(mib=320, bytes_per_sample=16, seconds=4.5, us_per_sample=5 if len(facts.states) > 1 else 2),
)
