"""How many of the measurements a stage uses: all, a number, or as many as the data ask for."""

from typing import Annotated, Literal

from pydantic import Field

Lights = Literal["all", "auto"] | Annotated[int, Field(ge=4, le=4096)]
Measurements = Literal["all", "auto"] | Annotated[int, Field(ge=8, le=100_000)]
Bases = Literal["auto"] | Annotated[int, Field(ge=1, le=16)]
