"""Declaration of the stage `evaluate`: settings, inputs, limits of its result, cost."""

from typing import ClassVar

from pydantic import Field

from nishiki.artifacts.closed import Closed, Guarded
from nishiki.stages.base import Cost, SceneFacts, Stage


class EvaluateSettings(Guarded):
    """Comparison with truth where there is one, otherwise with lights that the fit never saw."""

    STAGE: ClassVar[str] = "evaluate"
    VERSION: ClassVar[int] = 1

    cast_shadows: bool = Field(True, description="predict cast shadows from the integrated height")
    lamp_diameter_deg: float = Field(
        1.0, ge=0, le=20, description="size of the lamps seen from the object, for the edges of cast shadows"
    )
    hold_out: tuple[str, ...] = Field((), description="lights to predict; filled in by the plan")
    truth_sha256: str = Field("", description="digest of the truth; filled in by the plan")


def _nothing_to_compare(facts: SceneFacts, settings: Closed) -> str | None:
    if facts.truth_sha256 or facts.check_lights or settings.hold_out:
        return None
    return "there is no truth, the capture has no check lights and no light is held out (set hold_out)"


def _evaluate_cost(facts: SceneFacts) -> Cost:
    if facts.truth_sha256:
        return Cost(mib=390, bytes_per_pixel=160, seconds=2.8, us_per_pixel=16)
    return Cost(mib=225, bytes_per_pixel=195, seconds=2.4, us_per_pixel=16)


STAGE = Stage(
    settings=EvaluateSettings,
    does="errors against truth, or on lights that the fit never saw",
    requires=("ingest", "normals"),
    wants=lambda settings: ("height",) * settings.cast_shadows + ("spectra", "brdf"),
    lacks=_nothing_to_compare,
    needs_colour=True,
    looks_at=lambda facts, settings, asked: ("check",),
    libraries=("numpy", "scipy", "numba", "zarr"),
    cost=_evaluate_cost,
)
