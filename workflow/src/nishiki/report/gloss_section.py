"""The part of the page on gloss: the specular profile, the fitted lobe, and its parameters."""

from dataclasses import replace
from typing import Any

import numpy as np

from nishiki.report.svg import PALETTE, Curve, chart

MOST_CHARTS = 6
FLAGS = {
    "NO_HIGHLIGHT": "no highlight",
    "AT_BOUND": "width at its bound",
    "TOO_FEW": "too few samples",
    "UNDETERMINED": "width not determined",
    "NOT_FINITE": "samples not finite",
    "NOT_CONVERGED": "not converged",
}
"""Flags of a fit (`nishiki.brdf.flags`) in words."""


def gloss_section(parameters: dict[str, Any], *, true_gamma: list[float] | None = None) -> dict[str, Any]:
    """Content of the section.

    parameters : parameters.json of the brdf stage; true_gamma : least, median and largest half width at half maximum of
    the true facet distribution, radians, where it is known.
    """
    rows, charts = [], []
    for number, region in enumerate(parameters["regions"]):
        name = str(region.get("name") or (f"region {number}" if len(parameters["regions"]) > 1 else "whole scene"))
        for lobe, (beta, gamma) in enumerate(zip(_list(region["beta"]), _list(region["gamma"]), strict=True)):
            rows.append(
                {
                    "name": name,
                    "lobe": lobe + 1,
                    "beta": beta,
                    "gamma": gamma,
                    "gamma_deg": None if gamma is None else float(np.degrees(gamma)),
                    "refractive_index": region["refractive_index"],
                    "samples": region.get("samples"),
                    "residual": region.get("residual"),
                    "flags": ", ".join(FLAGS.get(flag, flag) for flag in region.get("flags") or []),
                }
            )
        if region.get("profile") and len(charts) < MOST_CHARTS:
            charts += _profile_charts(region["profile"], name)
    return {
        "rows": rows,
        "charts": charts,
        "lobes": max((row["lobe"] for row in rows), default=1),
        "true_gamma_deg": None if not true_gamma else [float(np.degrees(value)) for value in true_gamma],
    }


def _profile_charts(profile: dict[str, Any], name: str) -> list[dict[str, Any]]:
    """The profile with linear and with logarithmic strength."""
    order = np.argsort(profile["phi"], kind="stable")
    phi = np.degrees(np.array(profile["phi"], float)[order])
    value, fitted = (np.array(profile[key], float)[order] for key in ("value", "fitted"))
    count = np.array(profile.get("count") or np.ones(phi.size), float)
    count = count[order] if count.size == phi.size else np.ones(phi.size)
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
        drawn, title=f"specular profile of {name}", x_range=(0, reach), y_range=(-0.05 * peak, 1.3 * peak), **axes
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        tails = [replace(curve, y=np.log10(np.where(curve.y > 1e-4 * peak, curve.y, np.nan))) for curve in drawn]
    top = float(np.log10(1.6 * peak))
    logarithmic = chart(
        tails, title=f"tails of the profile of {name}", x_range=(0, reach), y_range=(top - 4, top), decades=True, **axes
    )
    return [{"name": name, "log": False, "svg": linear}, {"name": name, "log": True, "svg": logarithmic}]


def _list(value: Any) -> list:
    return value if isinstance(value, list) else [value]
