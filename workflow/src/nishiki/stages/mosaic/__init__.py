"""Declare the stage `mosaic`: settings, inputs, limits of its result, cost."""

from pydantic import Field

from nishiki.artifacts.declaration import Guarded, Limit, at, share
from nishiki.stages.base import ARRAYS, OPENCV, Cost, Stage
from nishiki.stages.brdf import PAINTING_OUTPUTS
from nishiki.stages.normals import OUTPUTS as OF_NORMALS

ALIKE = (
    "photograph a white board for every lamp; where ingest moved photographs of some fields only, set "
    "ingest.correct.registration: never"
)
LIMITS = (
    Limit(
        "registration",
        "rms residual of the registration of fields, pixels",
        at("registration_rms_px"),
        most=1.0,
        doubt=0.5,
        remedy="photograph fields with more overlap, or keep the painting flat and the camera at one distance",
        why="simulated fields gave 0.04 to 0.13; beyond a pixel, details are doubled or lost",
    ),
    Limit(
        "seam_colour",
        "mean colour difference of two fields where they overlap, CIEDE2000",
        at("seam_delta_e"),
        most=3.0,
        remedy=ALIKE,
        why="simulated fields gave 0.5 to 0.6; three is seen at a glance",
        warns=True,
    ),
    Limit(
        "seam_angle",
        "mean angle between the normals of two fields where they overlap, degrees",
        at("seam_deg"),
        most=3.0,
        remedy=ALIKE,
        why="simulated fields gave 0.1 to 0.2, a fossil 1, and 11 where each field's lamps were estimated apart",
        warns=True,
    ),
    Limit(
        "estimated_share",
        "share of the painting's pixels that have a normal",
        share("valid_pixels", "object_pixels"),
        least=0.8,
        doubt=0.95,
        remedy="find the field that lacks normals on the page, and give its capture more lights or other exposures",
        why="as of a single field",
    ),
)


class MosaicSettings(Guarded, stage="mosaic", version=3, limits=LIMITS):
    """Fields of a painting to one set of maps."""

    positions_mm: dict[str, tuple[float, float] | None] = Field(
        {}, description="x and y of each field on the stage, null where unknown; filled in by the plan"
    )


OUTPUTS = (*(output for output in OF_NORMALS if output.name != "finish"), *PAINTING_OUTPUTS)

STAGE = Stage(
    settings=MosaicSettings,
    does="fields registered, levelled and joined",
    outputs=OUTPUTS,
    geometry="mosaic",
    stands_for=("ingest", "normals", "brdf"),
    libraries=(*ARRAYS, OPENCV),
    cost=lambda facts: Cost(mib=800 + 12 * len(facts.fields), seconds=3 + 3 * len(facts.fields), us_per_pixel=1.2),
)
