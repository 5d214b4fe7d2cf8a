"""Settings of evaluate."""

from typing import ClassVar

from pydantic import Field

from nishiki.artifacts.closed import Guarded


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
