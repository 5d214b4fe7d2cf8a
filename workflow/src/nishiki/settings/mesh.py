"""Settings of mesh."""

from typing import ClassVar, Literal

from pydantic import Field

from nishiki.artifacts.closed import Guarded


class MeshSettings(Guarded):
    """Where the object's surface comes from, and how many triangles it gets."""

    STAGE: ClassVar[str] = "mesh"
    VERSION: ClassVar[int] = 2

    source: Literal["auto", "file", "scans", "silhouettes"] = Field(
        "auto", description="of the surface; auto: the first of these that the capture has"
    )
    background: Literal["capture", "auto", "dark", "bright", "blue", "green"] = Field(
        "capture", description="silhouettes: what is behind the object; capture: as the capture says"
    )
    cells: int = Field(256, ge=16, le=768, description="silhouettes: grid cells along the object's longest side")
    misses: int = Field(
        0, ge=0, le=4, description="silhouettes: views that may wrongly see background where the object is"
    )
    consistency: bool = Field(
        True, description="silhouettes: segment once more with what the other views say (not for given masks)"
    )
    smooth: float = Field(
        0.5, ge=0, le=10, description="silhouettes: pixels by which smoothing may move the hull's surface; 0: none"
    )
    merge_cells: int = Field(256, ge=16, le=1024, description="scans: detail of the merged surface, cells along a side")
    overlap: float = Field(0.5, gt=0, le=1, description="scans: part of a scan that the nearest other scans share")
    smallest_part: float = Field(
        0.05, ge=0, le=1, description="parts smaller than this are left out, of the largest part's diagonal"
    )
    deviation_px: float = Field(
        0.5,
        ge=0,
        description="as few triangles as keep 99 % of the surface within so many pixels; 0: all triangles",
    )
    most_triangles: int | None = Field(None, ge=16, description="no more triangles than this, whatever the deviation")
    grid_px: float = Field(
        0.05, ge=0, le=1, description="vertices are put on a grid that moves them no further; 0: none"
    )
    hold_out: tuple[str, ...] = Field((), description="views that take no part in carving; filled in by the plan")
