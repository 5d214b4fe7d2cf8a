"""Settings of fabric_evaluate."""

from typing import ClassVar

from pydantic import Field

from nishiki.artifacts.closed import Guarded


class FabricEvaluateSettings(Guarded):
    """The cloth's models against measurements that their fits did not see."""

    STAGE: ClassVar[str] = "fabric_evaluate"
    VERSION: ClassVar[int] = 1

    curves: int = Field(
        12, ge=0, le=200, description="incidences of each region whose plane is drawn, measured beside predicted"
    )
    regions: tuple[str, ...] = Field((), description="regions to judge; none named: all")
