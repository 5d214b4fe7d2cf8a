"""Settings of height."""

from typing import ClassVar, Literal

from pydantic import Field

from nishiki.artifacts.closed import Guarded


class HeightSettings(Guarded):
    """Integration of the normals."""

    STAGE: ClassVar[str] = "height"
    VERSION: ClassVar[int] = 2

    method: Literal["auto", "dct", "weighted"] = Field(
        "auto", description="dct: Poisson on the full rectangle; weighted: with mask and weights; auto: as needed"
    )
