"""Declare the stage `ingest`: settings, inputs, limits of its result, cost."""

from typing import Literal

from pydantic import Field

from nishiki.artifacts.declaration import Closed, Guarded, Limit, at
from nishiki.formats.picture_files import RAW_SUFFIXES
from nishiki.stages.base import ARRAYS, OPENCV, Cost, Stage, only_files

LIMITS = (
    Limit(
        "object_pixels",
        "pixels inside the mask",
        at("mask_pixels"),
        least=1,
        remedy="give a mask or a region of interest that shows the object",
        why="an empty mask leaves nothing to compute",
    ),
    Limit("defect_pixels", "hot or dead pixels", at("defects")),
)


class Correct(Closed):
    """Corrections based on comparing photographs with each other; never: measured, and warned of."""

    registration: Literal["auto", "never"] = Field(
        "auto", description="auto: photographs are moved back where the camera moved; never: they stay"
    )
    ambient: Literal["auto", "never"] = Field(
        "auto", description="auto: light of the room that no frame of role ambient shows is estimated and subtracted"
    )
    gains: Literal["auto", "never"] = Field(
        "auto", description="auto: strengths of the lamps from the photographs, where no board or table has them"
    )
    leave_out: Literal["auto", "never"] = Field(
        "auto", description="auto: without photographs of failed lamps, repeated or odd ones, or with more room light"
    )


class IngestSettings(Guarded, stage="ingest", version=8, limits=LIMITS):
    """Photographs to linear, white-normalised observations."""

    channels: str = Field(
        "auto",
        min_length=1,
        max_length=100,
        description="auto: all where a stage of the plan uses colour, as normals do; all; luminance; green; or the "
        "name of one channel of the capture",
    )
    white_block: int = Field(
        16,
        ge=1,
        le=256,
        description="white board averaged over blocks of this many pixels; 1: per pixel (Tominaga and Tanaka 2004, "
        "eq. 3)",
    )
    correct: Correct = Field(
        Correct(), description="plane: what is put right where the photographs do not agree with each other"
    )
    tile_mib: int = Field(128, ge=8, le=4096, description="memory for one tile of all lights as float32, MiB")
    compression: Literal["none", "zstd"] = Field("none", description="zstd: a third of the bytes, twice the time")
    without: tuple[str, ...] = Field(
        (), description="parts of the capture that no stage of the plan looks at, not opened; filled in by the plan"
    )


DECODING_US = {"plane": 0.65, "turntable": 2.0, "goniometer": 0.42}
"""Of a sample; a flat object has a white and a dark photograph to most of its lights."""

STAGE = Stage(
    settings=IngestSettings,
    does="photographs to linear, white-normalised observations",
    geometry=None,
    needs_colour=False,
    libraries=(*ARRAYS, OPENCV, "OpenEXR", "rawpy"),
    unused_packages={
        "rawpy": only_files(RAW_SUFFIXES, "camera raw"),
        "OpenEXR": only_files(frozenset({".exr"}), "an EXR file"),
        OPENCV: lambda facts, settings: (
            None if set(facts.suffixes) - RAW_SUFFIXES - {".exr"} else "no PNG, JPEG or TIFF is read"
        ),
    },
    cost=lambda facts: Cost(  # JPEG is quick
        mib=400,
        seconds=2.2,
        us_per_sample=0.05 if set(facts.suffixes) & {".jpg", ".jpeg"} else DECODING_US[facts.geometry],
    ),
)
