"""Declare the stage `normals`: settings, inputs, limits of its result, cost."""

from typing import Literal

from pydantic import Field

from nishiki.artifacts.declaration import Guarded, Limit, Output, at, share
from nishiki.photometric.flags import FEW_LIGHTS
from nishiki.stages.base import ARRAYS, Cost, Lights, Stage, digest_of

LIMITS = (
    Limit(
        "estimated_share",
        "share of the object's pixels that have a normal",
        share("valid_pixels", "object_pixels"),
        least=0.8,
        doubt=0.95,
        remedy="more lights, other exposures, separate.method none, or normals.max_condition for lights in a plane",
        why="captures gave 0.9997 and more; without a fifth, height and reflectance are guessed over wide areas",
    ),
    Limit(
        "sigma",
        "median expected error of a normal, degrees",
        at("sigma_median_deg"),
        most=30,
        doubt=20,
        remedy="more lights, from other sides; check that the light directions belong to these photographs",
        why="captures gave 0.4 to 13; a random normal is wrong by 57 degrees on average",
    ),
    *(
        Limit(
            f"{name}_share",
            f"share of the object's pixels flagged {words}",
            share(f"flagged_{name}", "object_pixels"),
        )
        for name, words in (
            ("too_few_lights", "too few lights"),
            ("coplanar_lights", "lights in one plane"),
            ("ill_conditioned", "badly conditioned"),
            ("no_redundancy", "no redundancy"),
            ("no_signal", "no signal"),
            ("faces_away", "faces away"),
            ("fallback", "without the joint fit"),
        )
    ),
)


class NormalsSettings(Guarded, stage="normals", version=9, limits=LIMITS):
    """Settings of photometric stereo (Tominaga and Tanaka 2004, section 3.3) and of the reflectance of each channel."""

    solver: Literal["lobe", "least_squares"] = Field(
        "lobe",
        description="least_squares: Lambert's law on the selected samples (Woodham 1980); lobe: from "
        "there, a diffuse fall-off and a gloss lobe, with the samples chosen again by their residuals",
    )
    lights: Lights = Field(
        "auto",
        description="lights of the fit (separate follows): all; so many evenly spread ones; auto: as many as normals "
        "need, in captures of some size (docs/notes/economy.md)",
    )
    refine: Literal["auto", "gloss", "none"] = Field(
        "auto",
        description="fit normals, reflectance and gloss together; auto: where captured lamps are predicted better",
    )
    refractive_index: float = Field(
        1.45, gt=1, le=3, description="of the varnish or binder, for refine (Tominaga and Tanaka: 1.45)"
    )
    reflectance: Literal["least_squares", "mean"] = Field(
        "least_squares",
        description="of each channel, without refine; mean: of I / cos over the lights (Tominaga and Tanaka 2004, "
        "eq. 6)",
    )
    interreflection: Literal["auto", "none"] = Field(
        "auto",
        description="light that the object throws on itself; auto: taken off where captured lamps left out are "
        "predicted better with it, under distant lamps",
    )
    relighting: Literal["auto", "plain", "directional"] = Field(
        "auto",
        description="model that predicts lamps, without refine; auto: the one that predicts captured lamps left out "
        "of the fit in turn",
    )
    given: str = Field(
        "", description="picture of normals from another program, to be used in place of those of the photographs"
    )
    given_sha256: str = Field("", description="digest of that picture; filled in by the plan")
    max_condition: float = Field(1e4, gt=1, description="pixels with a worse conditioned light matrix are flagged")
    hold_out: tuple[str, ...] = Field((), description="lights left out of the fit; filled in by the plan")


OUTPUTS = (
    Output("normals", "float32", "unit vector", "x right, y up, z to the camera"),
    Output(
        "reflectance",
        "float32",
        "relative to white",
        "of each channel, for light shaded as shading says; of a metal its colour",
    ),
    Output(
        "albedo", "float32", "relative to white", "intensity; with a lobe of the diffuse part, mean over the samples"
    ),
    Output(
        "sigma",
        "float32",
        "radians",
        "expected rms angle, by groups of lamps left out; under three lamps by the residual",
    ),
    Output(
        "correction_sigma",
        "float32",
        "radians",
        "the part of sigma that comes from what ingest put right; where it did",
    ),
    Output("lights_used", "uint16", "lights", "samples in the fit"),
    Output("condition", "float32", "", "of the weighted 3 x 3 normal matrix"),
    Output(
        "shading",
        "float32",
        "",
        "a, b, d of the factor max(a + b c + d x^8, 0) of Lambert's c = n.l, x = n.h; also e_x, e_y",
    ),
    Output("shading_normals", "float32", "unit vector", "of the body shading, where it was fitted for relighting"),
    Output("residual", "float32", "relative to white", "rms"),
    Output("flags", "uint8", "bits", "see docs/stages/normals.md"),
    Output("finish", "uint8", "", "row of the diagnostics' finishes, where there are several"),
)


STAGE = Stage(
    settings=NormalsSettings,
    does="normals and diffuse reflectance",
    outputs=OUTPUTS,
    requires=("ingest",),
    optional_inputs=lambda settings: ("separate",),
    filled=lambda block, settings: {"given_sha256": digest_of(block.given, "normals.given")} if block.given else {},
    libraries=ARRAYS,
    cost=lambda facts: (  # with few lights the gloss is fitted together with the normals
        Cost(mib=560, tiles=2.2, bytes_per_pixel=8, seconds=8, us_per_pixel=9, us_per_sample=0.02)
        if len(facts.lights) <= FEW_LIGHTS
        else Cost(mib=400, tiles=2.2, bytes_per_pixel=8, seconds=2.8, us_per_pixel=1, us_per_sample=0.28)
    ),
    scatter=True,
)
