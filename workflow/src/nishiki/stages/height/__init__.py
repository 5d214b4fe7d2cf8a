"""Declare the stage `height`: settings, inputs, limits of its result, cost."""

from typing import Literal

from pydantic import Field

from nishiki.artifacts.declaration import Guarded, Limit, Output, at
from nishiki.stages.base import ARRAYS, Cost, Stage

LIMITS = (
    Limit(
        "convergence",
        "relative residual of the linear system of the height",
        at("residual"),
        most=1e-3,
        doubt=1e-4,
        remedy="check the normals' maps: parts that hardly hang together are slow to solve",
        why="captures gave 1e-5 and less; a hundredth bends a surface by its own relief, a thousandth by a tenth of it",
    ),
    Limit(
        "bow",
        "depth of the bowl in the relief over its longer side",
        at("bow"),
        most=0.02,
        remedy="if the object is flat overall, slow errors of the normals bend it: set height.flatten: true",
        why="panels seldom warp by 2 cm a metre; flat ones under near lamps taken as distant gave 0.025 to 0.24",
        warns=True,
    ),
    Limit("integrability", "rms curl of the gradients", at("integrability_rms")),
    Limit("parts", "separate parts of the object, each with its own zero", at("parts")),
)


class HeightSettings(Guarded, stage="height", version=6, limits=LIMITS):
    """Integration of the normals."""

    method: Literal["auto", "dct", "weighted"] = Field(
        "auto", description="dct: equal weights, full rectangle; weighted: with mask and weights; auto: as needed"
    )
    flatten: bool = Field(
        False, description="the object is flat overall: take the smooth part of the normals off before the integration"
    )


OUTPUTS = (
    Output("height", "float32", "", "mean 0 over each connected part; mm, or pixels without a scale"),
    Output(
        "expected_error",
        "float32",
        "radians",
        "rms angle by which the normal is likely to be off; pi / 2 without an estimate",
    ),
    Output("normals", "float32", "unit vector", "flattened, where flatten is set; 0 without an estimate"),
)


STAGE = Stage(
    settings=HeightSettings,
    does="height by integration of the normals",
    outputs=OUTPUTS,
    of_mosaics=True,
    requires=("normals",),
    libraries=ARRAYS,
    threads=1,
    cost=lambda facts: Cost(
        mib=120 + 60 * min(facts.pixels / 1e6, 4), bytes_per_pixel=0.4, seconds=1.4, us_per_pixel=12
    ),
)
