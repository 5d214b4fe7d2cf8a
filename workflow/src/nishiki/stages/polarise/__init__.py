"""Declare the stage `polarise`: settings, inputs, limits of its result, cost."""

from typing import Literal

from pydantic import Field

from nishiki.artifacts.declaration import Guarded, Limit, Output, at, extreme
from nishiki.stages.base import ARRAYS, OPENCV, Cost, Stage, no_method

EXCHANGED = "exchange the states off and on (or parallel and crossed angles) in the column polariser of frames.csv, "
EXCHANGED += "for white boards too where they were exchanged with them; else check polarise.beta, the exposure of the "
EXCHANGED += "states, and that nothing moved between them"
LIMITS = (
    Limit(
        "condition",
        "condition of the least squares over the polariser states",
        at("condition"),
        most=1e3,
        doubt=100,
        remedy="photograph states that are spread more evenly",
        why="simulated and measured series gave 1 to 35; 1000 turns noise of 0.1 % into the whole signal",
    ),
    Limit(
        "valid_share",
        "share of the object's pixels with both components",
        at("valid"),
        least=0.5,
        doubt=0.95,
        remedy="expose differently, or give polarise.beta where the board does not fill the picture",
        why="captures gave 0.9998 and more; with half of the object missing the maps are mostly interpolation",
    ),
    Limit(
        "specular_share",
        "mean specular light of the object over all of its light",
        at("specular_share"),
        least=-0.01,
        doubt=-0.002,
        remedy=EXCHANGED,
        why="light cannot be negative; a lamp that varies by 1 % between the states of a matt object gives -0.01; "
        "the jar of the demo gave 0.16, its exchanged states -0.18",
    ),
    Limit(
        "beta",
        "share of diffuse light that the crossed polarisers let through, largest channel",
        # boards behind analysers give a transmission
        lambda diagnostics: (
            extreme("boards.*.channel")(diagnostics) if diagnostics.get("method") == "circular" else None
        ),
        most=1.0,
        doubt=0.7,
        remedy=EXCHANGED,
        why="captures gave 0.37 to 0.41, ideal polarisers give 0.5; above 1 the crossed board is the brighter one",
    ),
    Limit(
        "negative_share",
        "share of the object's specular values further below 0 than noise reaches",
        at("doubtful"),
        most=0.2,
        doubt=0.05,
        remedy=EXCHANGED,
        why="captures gave 0.017 and less over the object; exchanged states gave 0.42",
    ),
    Limit(
        "unexplained",
        "share of the variation between the states that their angles do not explain, worst view",
        extreme("by_view.*.unexplained"),
        most=0.4,
        doubt=0.1,
        remedy="check the angles in the column polariser of frames.csv against the photographs, and the calibration",
        why="64 measured states gave 0.0008; all one place on 0.41, mixed 0.74",
    ),
    Limit(
        "exchanged",
        "states whose photographs another order explains better beyond doubt, worst view",
        extreme("by_view.*.exchanged"),
        most=0,
        remedy="exchange the states that check names in the column polariser of frames.csv",
        why="308 choices of 30 and more of 64 measured states gave 0; of pairs exchanged among them 95 % give 2",
    ),
    Limit("low_beta_pixels", "pixels whose beta is below polarise.beta_least", extreme("low_beta")),
)


class PolariseSettings(Guarded, stage="polarise", version=2, limits=LIMITS):
    """Diffuse and specular components of every view, from its polariser states."""

    method: Literal["auto", "pairs", "mueller", "none"] = Field(
        "auto",
        description="generator/analyser states by parallel and crossed pairs or the Mueller matrix; none: all diffuse",
    )
    beta: tuple[float, ...] | None = Field(
        None, description="circular: what the polarisers let through, one a channel; none: from the white boards"
    )
    beta_least: float = Field(0.02, gt=0, lt=1, description="circular: below this beta a pixel is flagged, not divided")
    local: bool = Field(True, description="beta and transmission by place; off: one value a channel")
    phase: Literal["pixel", "common"] = Field(
        "pixel", description="three or more analyser angles: amplitude at each pixel's own angle, or at one for a view"
    )
    smoothing: bool = Field(
        True, description="smooth the specular part where its measured noise allows, and correct the diffuse part by it"
    )
    wavelength_nm: float | None = Field(
        None, gt=0, description="of the light; needed where the calibration gives a retarder's dispersion"
    )
    pictures: int = Field(8, ge=0, description="views shown as pictures: whole, diffuse, specular")


OUTPUTS = (  # (light x views + view, row, column, channel)
    Output("diffuse", "float32", "as the diagnostics say", "light from inside the body"),
    Output("specular", "float32", "as the diagnostics say", "light reflected at the surface; negative by noise"),
    Output("valid", "uint8", "", "1: usable, in all channels"),
)


STAGE = Stage(
    settings=PolariseSettings,
    does="diffuse and specular parts, by the state of the polarisers",
    outputs=OUTPUTS,
    store="components.zarr",
    geometry="turntable",
    product="separate",
    requires=("ingest",),
    missing_inputs=lambda facts, settings: (
        no_method(facts, settings) if len(facts.states) > 1 else "the photographs show one polariser state only"
    ),
    capture_parts=lambda facts, settings, asked: ("photographs", "states", "white_states"),
    libraries=(*ARRAYS, OPENCV),
    deliverables=("*.png", "*.exr"),
    cost=lambda facts: Cost(mib=300, bytes_per_pixel=400, seconds=2.5, us_per_pixel=16, us_per_sample=3.2),
)
