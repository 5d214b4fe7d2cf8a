"""The section of an object's page on the cameras: their circle seen along its axis, and their errors."""

from typing import Any

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.geometry.cameras_file import load_cameras
from nishiki.report.numbers import figure, percent
from nishiki.report.page import Facts, Figure, Figures, Section
from nishiki.report.svg import GRID, PALETTE, SOFT, Drawing

MOST_MARKED, MOST_NAMED = 40, 12
"""Cameras up to which names are drawn, and about how many names."""


def cameras_section(cameras: Artifact | None, held_out: set[str]) -> Section | None:
    """None where nothing tells where the cameras stood."""
    if cameras is None:
        return None
    diagnostics, views = cameras.diagnostics, load_cameras(cameras.path("cameras.json"))
    circle = diagnostics.get("circle") or {}
    centres = np.array([camera.centre for camera in views])
    drawing = turn_plot(centres, [camera.name for camera in views], held_out, circle.get("axis"), circle.get("centre"))
    caption = "Dots: views; open diamonds: views left out. The object's own frame: the camera goes round."
    return Section("cameras", "Cameras", [
        Figures([Figure("The turn, seen along its axis", caption, svg=drawing)]),
        Facts(facts(diagnostics, circle)),
    ])  # fmt: skip


def facts(diagnostics: dict[str, Any], circle: dict[str, Any]) -> list[tuple[str, str]]:
    """What is known of the cameras: label and text. diagnostics : of the stage; circle : a part of them."""
    errors = [value for value in (diagnostics.get("reprojection_px") or {}).values() if value is not None]
    error = "not known: the matrices were given"
    if errors:
        error = f"{figure(float(np.mean(errors)))} pixels on average, {figure(max(errors))} at worst"
    off_plane = None if circle.get("off_plane") is None else 100 * round(circle["off_plane"], 9)
    steps = circle.get("steps_deg") or []
    return [
        ("From", diagnostics.get("source") or "–"),
        ("Radius", figure(circle.get("radius"), 3, diagnostics.get("unit") or "")),
        ("Off its plane", f"{percent(off_plane)} of the radius at most"),
        ("Steps", f"{figure(min(steps, default=None), 4)}° to {figure(max(steps, default=None), 4)}°"),
        ("Reprojection error", error),
    ]


def turn_plot(centres: np.ndarray, names: list[str], held_out: set[str], axis=None, centre=None) -> str:
    """Cameras (views, 3) seen along the axis of the turn; views held out are open diamonds.

    axis, centre: of the circle; where they are not known, of the plane that fits the cameras best.
    """
    centres = np.asarray(centres, float).reshape(-1, 3)
    middle = np.asarray(centre, float) if centre is not None else centres.mean(axis=0)
    if axis is None:
        axis = np.linalg.svd(centres - middle)[2][2] if len(centres) > 2 else np.array([0.0, 1.0, 0.0])
    right, ahead = _across(np.asarray(axis, float))
    flat = np.stack([(centres - middle) @ right, (middle - centres) @ ahead], axis=1)
    reach = max(float(np.abs(flat).max(initial=0)), 1e-12)
    half = 170
    places = flat * (half - 34) / reach
    drawing = Drawing(2 * half, 2 * half, "places of the cameras seen along the axis of the turn")
    radius = float(np.median(np.linalg.norm(places, axis=1))) if len(places) else 0.0
    drawing.circle(half, half, radius, stroke=GRID)
    drawing.path(f"M{half - 5} {half}h10M{half} {half - 5}v10", stroke=SOFT)
    for (x, y), name in zip(places, names, strict=True):
        if name in held_out:
            drawing.diamond(half + x, half + y, 6, fill="#fff", stroke=PALETTE[1], width=2, tip=f"{name} (left out)")
        else:
            drawing.circle(half + x, half + y, 4, fill=PALETTE[0], tip=name)
    if len(names) <= MOST_MARKED:
        for (x, y), name in list(zip(places, names, strict=True))[:: max(1, len(names) // MOST_NAMED)]:
            out = 1 + 15 / max(float(np.hypot(x, y)), 1e-9)
            drawing.text(half + x * out, half + y * out + 4, name, anchor="middle", size=10)
    return drawing.finish()


def _across(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors across an axis."""
    axis = axis / np.linalg.norm(axis)
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    right = np.cross(helper, axis)
    right /= np.linalg.norm(right)
    return right, np.cross(axis, right)
