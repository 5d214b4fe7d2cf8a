"""Settings of reflectance."""

from typing import ClassVar, Literal

from pydantic import Field

from nishiki.artifacts.closed import Guarded


class ReflectanceSettings(Guarded):
    """Goniometer photographs to reflectances of the cloth, completed at normal incidence."""

    STAGE: ClassVar[str] = "reflectance"
    VERSION: ClassVar[int] = 1

    window_px: int = Field(16, ge=1, le=4096, description="side of the central window that is averaged, pixels")
    saturated_share: float = Field(
        0.0, ge=0, le=0.5, description="share of the window's pixels that may be saturated before it is not used"
    )
    normal_deg: float = Field(1.0, gt=0, le=15, description="light within this angle of the normal counts as along it")
    grid_deg: float = Field(3.0, ge=1, le=10, description="step of the hemisphere's grid, degrees")
    interpolation: Literal["spline", "thin_plate", "linear", "none"] = Field(
        "spline",
        description="between the views at normal incidence, of the logarithm: smoothing spline of r^3 or r^2 log r, or "
        "linear on triangles; none: no hemisphere, for captures without normal incidence",
    )
    symmetry: Literal["auto", "quarter", "half", "none"] = Field(
        "auto", description="of the weave: two mirror planes, half a turn, none; auto: as the capture says"
    )
