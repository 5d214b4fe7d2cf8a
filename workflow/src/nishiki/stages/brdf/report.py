"""The section of a painting's page on gloss: the specular profile, the fitted lobe, and its parameters."""

from typing import Any

import numpy as np

from nishiki.report.numbers import figure
from nishiki.report.page import Block, Cell, Figure, Figures, Section, Table
from nishiki.report.svg import PALETTE, Curve, chart

MOST_CHARTS = 6
INTRODUCTION = (
    "What is left of the observations after the diffuse part is taken off, over the angle between the normal and the "
    "half vector of light and view. A Torrance-Sparrow lobe is fitted to it; where the dots leave the curve at large "
    "angles, the true gloss has longer tails than the model."
)
LINEAR = "Dots: measured, faint where few samples met; line: fitted."
LOGARITHMIC = "The tails: what lies above the line here is gloss that the lobe lacks."
FLAGS = {
    "NO_HIGHLIGHT": "no highlight",
    "AT_BOUND": "width at its bound",
    "TOO_FEW": "too few samples",
    "UNDETERMINED": "width not determined",
    "NOT_FINITE": "samples not finite",
    "NOT_CONVERGED": "not converged",
}
"""Flags of a fit (`nishiki.brdf.flags`) in words."""


def gloss_section(parameters: dict[str, Any] | None, *, true_gamma: list[float] | None = None) -> Section | None:
    """None where no gloss was fitted.

    parameters : parameters.json of the stage brdf; true_gamma : least, median and largest half width at half maximum of
    the true facet distribution, radians, where it is known.
    """
    if parameters is None:
        return None
    rows: list[list[Cell]] = []
    charts: list[Figure] = []
    for number, region in enumerate(parameters["regions"]):
        name = f"region {number}" if len(parameters["regions"]) > 1 else "whole scene"
        flags = ", ".join(FLAGS.get(flag, flag) for flag in region.get("flags") or []) or "–"
        rest = (region["refractive_index"], region.get("samples"), region.get("residual"), flags)
        for lobe, (beta, gamma) in enumerate(zip(region["beta"], region["gamma"], strict=True), 1):
            rows.append([name, lobe, beta, gamma, None if gamma is None else float(np.degrees(gamma)), *rest])
        if region.get("profile") and len(charts) < MOST_CHARTS:
            charts += _profile_charts(region["profile"], name)
    head = ("Region", "lobe", "β", "γ, rad", "γ, degrees", "n", "samples", "residual", "flags")
    caption = (
        "Torrance-Sparrow parameters: strength β relative to the white reference, half width at half maximum γ, "
        "refractive index n."
    )
    blocks: list[Block] = [INTRODUCTION, Figures(charts), Table(head, rows, "lrrrrrrrl", caption)]
    if true_gamma:
        least, median, largest = (figure(float(np.degrees(value))) for value in true_gamma)
        blocks.append(
            f"The true facets (GGX) have half widths from {least}° to {largest}°, median {median}°. Fine relief below "
            "the size of a pixel widens what the camera sees."
        )
    return Section("gloss", "Gloss", blocks)


def _profile_charts(profile: dict[str, Any], name: str) -> list[Figure]:
    """The profile with linear and with logarithmic strength."""
    order = np.argsort(profile["phi"], kind="stable")
    phi = np.degrees(np.array(profile["phi"], float)[order])
    value, fitted, count = (np.array(profile[key], float)[order] for key in ("value", "fitted", "count"))
    peak = float(np.nanmax(fitted, initial=0.0))
    if not (phi.size and peak > 0):
        return []
    # rows of few samples are noise: as many samples as a tenth of the median row give full ink
    strength = np.clip(np.sqrt(count / max(0.1 * float(np.median(count)), 1.0)), 0.08, 0.8)
    reach = max(10.0, 2.0 * float(phi[fitted > 0.005 * peak].max(initial=0.0)))
    reach = min(reach, float(phi.max()))
    firm = (strength >= 0.5) & (phi <= reach)
    axes = {"x_label": "angle φ between normal and half vector, degrees", "y_label": "specular part / (F G / cos θr)"}
    drawn = [
        Curve("measured", phi, value, PALETTE[0], dots=True, strength=np.where(phi <= reach, strength, 0)),
        # the fit is blurred by each row's own uncertainty of the normals: a line through firm rows only
        Curve("fitted lobe", phi[firm], fitted[firm], PALETTE[1]),
    ]
    linear = chart(
        drawn, title=f"specular profile of {name}", x_range=(0, reach), y_range=(-0.05 * peak, 1.05 * peak), **axes
    )
    top = 1.6 * peak
    logarithmic = chart(
        drawn,
        title=f"tails of the profile of {name}",
        x_range=(0, reach),
        y_range=(1e-4 * top, top),
        logarithmic=True,
        **axes,
    )
    heading = name.capitalize()
    return [Figure(heading, LINEAR, svg=linear), Figure(f"{heading}, logarithmic", LOGARITHMIC, svg=logarithmic)]
