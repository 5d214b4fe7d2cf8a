"""Declare the stage `cameras`: settings, inputs, limits of its result, cost."""

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import Field

from nishiki.artifacts.declaration import Guarded, Limit, at
from nishiki.stages.base import OPENCV, POSES, Cost, Stage, poses_of


def _pose_outliers(diagnostics: Mapping[str, Any]) -> float | None:
    kept, lost = diagnostics.get("points") or {}, diagnostics.get("outliers") or {}
    shares = [lost[view] / (lost[view] + kept[view]) for view in lost if lost[view] + kept.get(view, 0)]
    return max(shares) if shares else None


def _uneven_steps(diagnostics: Mapping[str, Any]) -> float | None:
    estimate = diagnostics.get("estimate") or {}
    return float(len(estimate["uneven_steps_deg"])) if "uneven_steps_deg" in estimate else None


LIMITS = (
    Limit(
        "reprojection",
        "reprojection error of the worst view, px",
        at("reprojection_worst_px"),
        most=10,
        doubt=4,
        remedy="check the correspondences and the board of that view, and that cameras and points are of one world",
        why="boards gave 0.05, points with noise of 1 pixel gave 1; at 10 pixels texels are smeared over others",
    ),
    Limit(
        "calibration",
        "rms error of the lens calibration, px",
        at("calibration.rms_px"),
        most=2,
        doubt=1,
        remedy="photograph the board again, flat, sharp and without gloss; or cameras.distortion with more terms",
        why="boards gave 0.05 to 0.3; at 2 pixels the board or the lens is not the one that is described",
    ),
    Limit(
        "outlier_share",
        "share of the points that no pose explains, worst view",
        _pose_outliers,
        most=0.4,
        doubt=0.34,
        remedy="pick the points of that view again",
        why="a third wrong was mended in simulated views; with half of the points wrong another half could be as right",
    ),
    Limit(
        "uneven_steps",
        "number of steps between neighbouring views that are unlike the others",
        _uneven_steps,
        most=0,
        warns=True,
        remedy="compare the photographs on both sides of the steps that the report names: a missing, repeated or "
        "exchanged photograph, or a table that slipped",
        why="turns by equal steps gave 0; one missing, repeated or slipped view gave 1 or 2",
    ),
)


class CamerasSettings(Guarded, stage="cameras", version=1, limits=LIMITS):
    """Pose and lens of each view's camera."""

    source: Literal["auto", "matrices", "boards", "correspondences", "photographs"] = Field(
        "auto",
        description="what gives the poses; auto: the first of these that the capture has; photographs: estimated from "
        "outlines and features of views once round",
    )
    distortion: Literal["none", "radial", "tangential", "full"] = Field(
        "tangential", description="terms fitted in a calibration: radial k1, k2; tangential: p1, p2 too; full: k3 too"
    )
    outlier_px: float | None = Field(
        None, gt=0, description="correspondences further off are left out, pixels; none: 0.005 of the longer side"
    )
    turntable: Literal["auto", "on", "off"] = Field(
        "auto", description="one axis for all views (boards, correspondences); auto: where left-out points gain by it"
    )
    steps: Literal["free", "equal"] = Field(
        "free",
        description="turntable: one angle a view, or one step for all; photographs: one step "
        "unless free ones predict left-out views better",
    )


PARTS = {"": ("calibration",), "matrices": (), "photographs": ("photographs", "silhouettes")}
PARTS |= dict.fromkeys(("boards", "correspondences"), ("calibration",))
"""Parts of the capture from which poses of each source are computed."""

STAGE = Stage(
    settings=CamerasSettings,
    does="where each view was taken from",
    geometry="turntable",
    requires=("ingest",),
    needs_colour=False,
    missing_inputs=lambda facts, settings: (
        None
        if facts.has_poses
        else "the capture has no camera matrices, board pictures or correspondences, and no stated full turn and height"
    ),
    capture_parts=lambda facts, settings, asked: PARTS[poses_of(facts, settings)],
    libraries=("numpy", "scipy", "zarr", OPENCV),
    threads=1,
    cost=lambda facts: (
        Cost(
            mib=300 + facts.pixels * (len(facts.views) + 60) / 2**20,
            seconds=0.5 * len(facts.views) + 2e-6 * facts.pixels * len(facts.views),
        )
        if POSES[-1] in facts.given and len({*POSES} & {*facts.given}) == 1
        else Cost(mib=200, seconds=1.5)
    ),
)
