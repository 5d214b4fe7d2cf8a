"""Declare the stage `mesh`: settings, inputs, limits of its result, cost."""

from typing import Literal

from pydantic import Field

from nishiki.artifacts.declaration import Guarded, Limit, at, excess, extreme, share
from nishiki.observations.turntable_coherence import DOUBTFUL, INCOHERENT
from nishiki.stages.base import ARRAYS, OPENCV, Cost, Reason, Stage, surface_of

LIMITS = (
    Limit(
        "contradiction",
        "share of the outlines that misses the hull of the other views, mean over the views",
        at("coherence.contradiction"),
        most=INCOHERENT,
        doubt=DOUBTFUL,
        remedy="check the cameras, whether the camera or the object was moved, and the silhouettes; ./nishiki check "
        "names the mistake where one explains it",
        why="captures gave 0 with given silhouettes and up to 0.039 with silhouettes found in photographs; a turn the "
        "other way gave 0.15 to 0.70, a camera moved by 4 % of the object after half of the views 0.08 to 0.16",
    ),
    Limit(
        "silhouette_overlap",
        "mean intersection over union of the mesh's outline and the outlines as they were given or first found",
        at("fit.iou_mean"),
        least=0.9,
        doubt=0.95,
        remedy="check that mesh and cameras are of one world and unit; mesh.overlap (scans), mesh.background",
        why="captures gave 0.977 and more; cameras in the reverse order gave 0.84 and 0.92, scans that were registered "
        "wrongly 0.26",
    ),
    Limit(
        "registration",
        "residual of the scans' registration over the size of the surface",
        lambda diagnostics: share("worst", "size")(
            {"worst": extreme("scans.residual")(diagnostics), "size": diagnostics.get("area", 0) ** 0.5}
        ),
        most=0.01,
        doubt=0.002,
        remedy="scans that overlap more, or mesh.overlap",
        why="scans gave 5e-5; a hundredth of the object is no registration",
    ),
    Limit(
        "unsure_handles",
        "holes through the body that rest on one view, or on as few as mesh.misses says",
        lambda diagnostics: (  # holes that are closed where some views are forgiven
            None if (more := excess("genus", "silhouettes.overruled.genus")(diagnostics)) is None else max(more, 0.0)
        ),
        most=0,
        warns=True,
        remedy="look at the surface, and at the silhouettes of the views that see through it: a shadow that is as dark "
        "as the background looks like a hole; a brighter background, a second lamp, or more views",
        why="objects whose true number of holes is known gave 0",
    ),
    Limit("open_edges", "edges of one triangle only", at("open_edges")),
    Limit("crowded_edges", "edges of more than two triangles", at("crowded_edges")),
    Limit("degenerate_triangles", "triangles without area that were left out", at("cleaned.degenerate")),
)


class MeshSettings(Guarded, stage="mesh", version=14, limits=LIMITS):
    """Source of the object's surface, and number of its triangles."""

    source: Literal["auto", "file", "scans", "silhouettes"] = Field(
        "auto", description="of the surface; auto: the first of these that the capture has"
    )
    background: Literal["capture", "auto", "dark", "bright", "blue", "green"] = Field(
        "capture", description="silhouettes: what is behind the object; capture: as the capture says"
    )
    cells: int = Field(256, ge=16, le=768, description="silhouettes: grid cells along the object's longest side")
    misses: int | None = Field(
        None,
        ge=0,
        le=4,
        description="silhouettes: views that may wrongly see background where all others see the object; by default "
        "one in 30 (rounded) of silhouettes that are found, none of given ones",
    )
    smooth: float = Field(
        0.5, ge=0, le=10, description="silhouettes: pixels by which smoothing may move the hull's surface; 0: none"
    )
    concavities: bool = Field(
        True,
        description="silhouettes: follow the photographs beyond the outlines: sink large regions that show different "
        "points of the object in different views (hollows), as deep as these agree best, and cut parts that stand in "
        "front of the rest to the edge that two views show",
    )
    overlap: float = Field(0.5, gt=0, le=1, description="scans: part of a scan that the nearest other scans share")
    deviation_px: float = Field(
        0.5, ge=0, description="as few triangles as keep 99 % of the surface within so many pixels; 0: all triangles"
    )
    most_triangles: int | None = Field(None, ge=16, description="no more triangles than this, whatever the deviation")
    hold_out: tuple[str, ...] = Field((), description="views that take no part in carving; filled in by the plan")


def _only_surface(source: tuple[str, ...], reason: str) -> Reason:
    return lambda facts, settings: None if surface_of(facts, settings) in source else reason


STAGE = Stage(
    settings=MeshSettings,
    does="the surface, from a file, range scans or silhouettes",
    geometry="turntable",
    requires=("ingest", "cameras"),
    capture_parts=lambda facts, settings, asked: (
        "silhouettes",
        "photographs",  # the preview shows the surface beside them, whatever it comes from
        *{"file": ("mesh",), "scans": ("scans",), "silhouettes": ()}[surface_of(facts, settings)],
    ),
    libraries=(*ARRAYS, OPENCV, "scikit-image", "trimesh", "pymeshlab"),
    unused_packages={
        "trimesh": _only_surface(("file", "scans"), "the surface comes from silhouettes"),
        "pymeshlab": _only_surface(("scans",), "there are no range scans to merge"),
        "scikit-image": _only_surface(("silhouettes",), "the surface does not come from silhouettes"),
    },
    deliverables=("*.ply",),
    cost=lambda facts: Cost(mib=600, bytes_per_sample=1.7, seconds=14, us_per_sample=3.4),
)
