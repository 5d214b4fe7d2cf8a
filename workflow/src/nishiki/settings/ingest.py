"""Settings of ingest."""

from typing import ClassVar, Literal

from pydantic import Field

from nishiki.artifacts.closed import Guarded


class IngestSettings(Guarded):
    """Photographs to linear, white-normalised observations."""

    STAGE: ClassVar[str] = "ingest"
    VERSION: ClassVar[int] = 2

    channels: str = Field(
        "auto",
        min_length=1,
        max_length=100,
        description="auto: all where a stage of the plan uses colour, as normals do; all; luminance; green; or the "
        "name of one channel of the capture",
    )
    white_block: int = Field(
        16, ge=1, le=256, description="white board averaged over blocks of this many pixels; 1: per pixel (P eq. 3)"
    )
    tile_mib: int = Field(128, ge=8, le=4096, description="memory for one tile of all lights as float32, MiB")
    compression: Literal["none", "zstd"] = Field("none", description="zstd: a third of the bytes, twice the time")
    without: tuple[str, ...] = Field(
        (), description="parts of the capture that no stage of the plan looks at, not opened; filled in by the plan"
    )
