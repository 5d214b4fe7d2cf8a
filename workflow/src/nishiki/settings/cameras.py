"""Settings of cameras."""

from typing import ClassVar, Literal

from pydantic import Field

from nishiki.artifacts.closed import Guarded


class CamerasSettings(Guarded):
    """Where each view's camera stood, and its lens."""

    STAGE: ClassVar[str] = "cameras"
    VERSION: ClassVar[int] = 1

    source: Literal["auto", "matrices", "boards", "correspondences"] = Field(
        "auto", description="what gives the poses; auto: the first of these that the capture has"
    )
    distortion: Literal["none", "radial", "tangential", "full"] = Field(
        "tangential",
        description="terms fitted in a calibration: radial k1, k2; tangential: p1, p2 too; full: k3 too",
    )
    outlier_factor: float = Field(
        3.0, gt=1, description="calibration pictures with more than this times the median error are left out"
    )
    outlier_px: float | None = Field(
        None, gt=0, description="correspondences further off are left out, pixels; none: 0.005 of the longer side"
    )
    turntable: Literal["auto", "on", "off"] = Field(
        "auto", description="one axis for all views (boards, correspondences); auto: where left-out points gain by it"
    )
    steps: Literal["free", "equal"] = Field("free", description="turntable: one angle a view, or one step for all")
