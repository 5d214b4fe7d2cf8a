"""Settings of texels."""

from typing import ClassVar

from pydantic import Field

from nishiki.artifacts.closed import Guarded


class TexelsSettings(Guarded):
    """How the surface is cut into charts and tiles, how densely it is sampled, and what counts as visible."""

    STAGE: ClassVar[str] = "texels"
    VERSION: ClassVar[int] = 1

    texels_per_pixel: float = Field(
        1.0, gt=0, le=8, description="linear: texels for one pixel of the views that see a place best"
    )
    density_percentile: float = Field(
        90.0, ge=0, le=100, description="over the views, of a triangle's area in pixels: which of them see it best"
    )
    tile: int = Field(64, ge=4, le=1024, description="texels along a tile's side; a tile is the unit of random access")
    normal_range: float = Field(
        0.02, ge=0, le=1, description="range over which normals are averaged to choose charts, of the object's extent"
    )
    smallest_chart: float = Field(0.01, ge=0, le=1, description="smaller charts are merged, of the surface's area")
    steepest_deg: float = Field(80.0, gt=0, lt=90, description="largest angle between a triangle and its chart")
    depth_tolerance: float = Field(
        1.0, gt=0, description="visible where the depth agrees within so many pixels of the tangent plane"
    )
    grazing_deg: float = Field(80.0, gt=0, le=90, description="texels seen at more than this from their normal are not")
    hold_out: tuple[str, ...] = Field((), description="views that take no part; filled in by the plan")
