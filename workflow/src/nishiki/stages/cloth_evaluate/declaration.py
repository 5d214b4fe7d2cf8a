"""Declaration of the stage `cloth_evaluate`: settings, inputs, limits of its result, cost."""

from typing import ClassVar

from pydantic import Field

from nishiki.artifacts.closed import Closed, Guarded
from nishiki.stages.base import Cost, SceneFacts, Stage


class ClothEvaluateSettings(Guarded):
    """The cloth's models against measurements that their fits did not see."""

    STAGE: ClassVar[str] = "cloth_evaluate"
    VERSION: ClassVar[int] = 1

    curves: int = Field(
        12, ge=0, le=200, description="incidences of each region whose plane is drawn, measured beside predicted"
    )
    regions: tuple[str, ...] = Field((), description="regions to judge; none named: all")


def _seen_from_one_light_only(facts: SceneFacts, settings: Closed) -> str | None:
    if facts.measurements > facts.frontal or facts.truth_sha256:
        return None
    return "the light stood at the normal of the cloth in every measurement: none is left to compare with"


STAGE = Stage(
    settings=ClothEvaluateSettings,
    does="errors of the predicted against the measured reflectance",
    formerly="fabric_evaluate",
    geometry="goniometer",
    product="evaluate",
    requires=("goniometer_samples", "cloth_brdf"),
    lacks=_seen_from_one_light_only,
    needs_colour=True,
    looks_at=lambda facts, settings, asked: ("oblique",),
    libraries=("numpy", "scipy", "numba"),
    deliverables=("*.csv",),
    threads=1,
    cost=lambda facts: Cost(mib=230, seconds=2, us_per_sample=0.05),
)
