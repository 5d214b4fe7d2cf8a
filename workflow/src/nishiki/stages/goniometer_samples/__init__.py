"""Declare the stage `goniometer_samples`: settings, inputs, limits of its result, cost."""

from typing import Literal

from pydantic import Field

from nishiki.artifacts.declaration import Guarded, Limit, Output, at, extreme, share
from nishiki.stages.base import ARRAYS, OPENCV, Cost, Stage

LIMITS = (
    Limit(
        "unusable_share",
        "share of the measurements that cannot be used, worst region",
        lambda diagnostics: share("worst", "directions")({**diagnostics, "worst": extreme("unusable")(diagnostics)}),
        most=0.5,
        doubt=0.1,
        remedy="expose differently, or check the window of the photographs",
        why="captures gave 0; with half of the measurements lost most incidences have gaps",
    ),
    Limit(
        "noise",
        "relative noise of a reflectance",
        at("noise_relative"),
        most=0.2,
        doubt=0.05,
        remedy="a larger window, longer exposures, or more photographs",
        why="captures gave 0.001 to 0.01",
    ),
    Limit(
        "symmetry",
        "relative departure from the symmetry that was assumed",
        extreme("symmetry_departure"),
        most=0.5,
        doubt=0.25,
        remedy="set goniometer_samples.symmetry, and check the directions of warp and camera",
        why="captures gave 0.0006 to 0.14; at 1 the quarters do not show the same cloth",
    ),
    Limit(
        "interpolation",
        "relative error at left-out views of normal incidence",
        extreme("left_out_error"),
        most=0.3,
        doubt=0.15,
        remedy="more views at normal incidence",
        why="captures gave 0.0009 to 0.089; at 1 the table of the hemisphere holds nothing",
    ),
    Limit(
        "extrapolated",
        "share of the hemisphere beyond the outermost views at normal incidence",
        at("basic_extrapolated"),
        most=0.5,
        doubt=0.35,
        remedy="views up to 75 degrees and more; check that the angles are degrees",
        why="captures gave 0.03 to 0.26; at 0.5 the steepest view is at 60 degrees",
    ),
    Limit(
        "energy",
        "share of the light that is sent back, in the brightest channel",
        # along the normal where nothing else is known
        lambda diagnostics: extreme("albedo")(diagnostics) or extreme("albedo_normal")(diagnostics),
        most=1.1,
        remedy="check white_reflectance and the exposures; of a table, what its columns hold (goniometer.values)",
        why="captures gave 0.04 to 0.6; a surface sends back no more light than it gets",
    ),
    Limit(
        "reciprocity",
        "disagreement of measurements with light and view exchanged, relative",
        extreme("reciprocity"),
        most=0.3,
        remedy="check from where phi_r_deg is counted (from the weft, as phi_i_deg), and the boards of oblique light",
        why="captures gave 0.02 to 0.13; azimuths counted from the mirror direction or a missing cosine 0.35 and more",
    ),
    Limit("saturated_measurements", "measurements with saturated pixels", at("saturated")),
)


class GoniometerSamplesSettings(Guarded, stage="goniometer_samples", version=2, limits=LIMITS):
    """Goniometer photographs to reflectances of the cloth, completed at normal incidence."""

    window_px: int = Field(16, ge=1, le=4096, description="side of the central window that is averaged, pixels")
    normal_deg: float = Field(1.0, gt=0, le=15, description="light within this angle of the normal counts as along it")
    grid_deg: float = Field(3.0, ge=1, le=10, description="step of the hemisphere's grid, degrees")
    interpolation: Literal["spline", "none"] = Field(
        "spline",
        description="between the views at normal incidence, of the logarithm: smoothing spline of r^3; none: no "
        "hemisphere, for captures without normal incidence",
    )
    symmetry: Literal["auto", "quarter", "half", "none"] = Field(
        "auto",
        description="of the weave: two mirror planes, half a turn, none; auto: as the capture says, and where it does "
        "not, the one that predicts each view at normal incidence best from the others",
    )


OUTPUTS = (
    Output("incident", "float64", "unit vector", "to the light; x weft, y warp, z normal", "pair 3"),
    Output("outgoing", "float64", "unit vector", "to the camera", "pair 3"),
    Output("values", "float64", "1/sr", "reflectance, 0 where not valid", "pair region channel"),
    Output("noise", "float64", "1/sr", "standard deviation of the mean, 0 where unknown", "pair region channel"),
    Output("valid", "bool", "", "usable", "pair region"),
    Output("basic_theta", "float64", "radians", "polar angles of the views under light along the normal", "theta"),
    Output("basic_phi", "float64", "radians", "their azimuths", "phi"),
    Output("basic_values", "float64", "1/sr", "reflectance over the hemisphere", "region theta phi channel"),
    Output("basic_measured", "bool", "", "a view or its mirror image lies in the cell", "theta phi"),
    Output("basic_extrapolated", "bool", "", "beyond the outermost view of its azimuth", "theta phi"),
)


STAGE = Stage(
    settings=GoniometerSamplesSettings,
    does="photographs by direction to reflectance, over the whole hemisphere",
    outputs=OUTPUTS,
    store="reflectance.npz",
    geometry="goniometer",
    requires=("ingest",),
    # Asked for by name the reflectances themselves are wanted, all of them. A light within normal_deg counts as along
    # the normal, where ingest would take it for oblique.
    capture_parts=lambda facts, settings, asked: (
        ("oblique",) if "goniometer_samples" in asked or settings["goniometer_samples"].normal_deg > 1 else ()
    ),
    libraries=(*ARRAYS, OPENCV),
    deliverables=("*.png", "*.csv"),
    threads=1,
    cost=lambda facts: Cost(mib=220, bytes_per_sample=2, seconds=1.8, us_per_sample=0.28),
)
