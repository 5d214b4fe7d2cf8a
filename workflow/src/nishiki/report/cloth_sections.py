"""The parts of a cloth's page, from what the stages reported."""

from __future__ import annotations

from typing import Any

import numpy as np

from nishiki.report.cloth_plots import (
    disc_directions,
    disc_picture,
    error_chart,
    lobes_plot,
    model_name,
    plane_chart,
)

TEMPLATE = "cloth.html.j2"
INCIDENCES_DEG = (0, 30, 60)
SHOWN_MODELS = ("yarn_facets", "bard_great_circle", "weave", "ggx")
STEEPEST_DEG = 80
"""Steepest view of the drawn lobes: at grazing views a cloth can be so bright that nothing else would be seen."""


def facts(reflectance: dict[str, Any], capture: dict[str, Any]) -> list[tuple[str, str]]:
    """Label and text of what is known of the measurements; capture: diagnostics of ingest, if there are any."""
    about = capture.get("capture") or {}
    named = ("object_id", "creator", "date", "rights", "notes")
    found = [(key.removesuffix("_id").capitalize(), str(about[key])) for key in named if about.get(key)]
    directions, along = reflectance.get("directions"), reflectance.get("normal_incidence")
    if directions is not None:
        text = f"{directions} pairs of directions, {reflectance.get('incidences')} of light"
        found.append(("Measured", text + (f"; {along} with the light along the normal" if along is not None else "")))
    regions, channels = reflectance.get("regions") or [], reflectance.get("channels") or []
    if regions:
        found.append(("Cloths", ", ".join(regions)))
    if channels:
        found.append(("Channels", ", ".join(channels)))
    symmetry = {"quarter": "two mirror planes", "half": "half a turn", "none": "none"}
    if reflectance.get("symmetry"):
        found.append(("Symmetry", symmetry.get(reflectance["symmetry"], str(reflectance["symmetry"]))))
    if reflectance.get("weave"):
        found.append(("Weave", str(reflectance["weave"])))
    return found


def glance(told: dict[str, dict], evaluation: dict[str, Any] | None, region: str) -> list[dict]:
    """The figures that matter most."""
    tiles = []

    def tile(value, unit, meaning):
        if value is not None:
            tiles.append({"value": value, "unit": unit, "meaning": meaning})

    reflectance = told.get("goniometer_samples") or {}
    tile(reflectance.get("directions"), "", "pairs of directions measured")
    if evaluation is not None:
        entry = evaluation["regions"].get(region, {}).get("models", {}).get(evaluation["default"])
        for angle, part in ((entry or {}).get("held_out", {}).get("by_incidence") or {}).items():
            if angle in ("30", "60"):
                tile(100 * part["rms_rel"], "%", f"error at {angle}° incidence, {model_name(evaluation['default'])}")
    noise = reflectance.get("noise_relative")
    tile(None if noise is None else 100 * noise, "%", "noise of a measurement, median")
    return tiles


def errors_section(evaluation: dict[str, Any] | None) -> list[dict]:
    """For each region: error against incidence as table and chart, and every row."""
    if evaluation is None:
        return []
    sections = []
    for region, found in evaluation["regions"].items():
        found = {**found, "models": default_first(found["models"], evaluation["default"])}
        held = {model: entry["held_out"]["by_incidence"] for model, entry in found["models"].items()}
        angles = sorted({angle for part in held.values() for angle in part}, key=float)
        table = [
            {
                "model": model_name(model),
                "default": model == evaluation["default"],
                "reference": found["models"][model]["reference"],
                "used": found["models"][model]["fitted"]["measurements"],
                "cells": [held[model].get(angle) for angle in angles],
                "fitted": mean_of(found["models"][model]["fitted"]["by_incidence"]),
            }
            for model in found["models"]
        ]
        rows = [
            {"model": model_name(model), **row}
            for model, entry in found["models"].items()
            for row in entry["held_out"]["rows"]
        ]
        sections.append(
            {
                "region": region,
                "held_out": found["held_out"],
                "valid": found["valid"],
                "angles": angles,
                "table": table,
                "svg": error_chart(held, evaluation["default"]),
                "rows": rows,
            }
        )
    return sections


def default_first(models: dict[str, Any], default: str) -> dict[str, Any]:
    """Models with the default one first, the rest by error on what was held out, least first."""

    def order(name: str) -> tuple:
        error = mean_of((models[name].get("held_out") or {}).get("by_incidence") or {})
        return name != default, float("inf") if error is None else error, name

    return {name: models[name] for name in sorted(models, key=order)}


def mean_of(parts: dict[str, dict]) -> float | None:
    """Mean relative error over the incidences that a fit used."""
    values = [part["rms_rel"] for part in parts.values()]
    return float(np.mean(values)) if values else None


def curves_section(evaluation: dict[str, Any] | None, region: str) -> list[dict]:
    """Charts of measured and predicted values in the plane of the light, for one region."""
    if evaluation is None or region not in evaluation["regions"]:
        return []
    found = evaluation["regions"][region]
    known = list(found["models"])
    default = evaluation["default"]
    models = [default] + [model for model in SHOWN_MODELS if model in known and model != default]
    if len(models) < 4:
        models += [model for model in known if model not in models][: 4 - len(models)]
    models = [model for model in models if model in known]
    return [
        {
            "svg": plane_chart(curve, models, default),
            "heading": f"Light at {curve['theta_i_deg']:.0f}°, plane of the {plane_words(curve['plane'])}",
            "caption": "taken for the fit" if not any(curve["held_out"]) else "",
        }
        for curve in found["curves"]
    ]


def plane_words(plane: str) -> str:
    """A plane of incidence in words."""
    return f"azimuth {plane}" if plane.endswith("°") else plane


def lobes_section(brdf, normal, name: str) -> dict:
    """Lobes in the planes of weft and warp, and discs of all views, of a model; normal: measured values at normal
    incidence as a function of directions (n, 3), or None."""
    views, inside = disc_directions()
    discs = []
    measured = None if normal is None else normal(views).mean(axis=1)
    predicted = {}
    for degrees in INCIDENCES_DEG:
        for plane, azimuth in (("warp", np.pi / 2), ("weft", 0.0))[: 1 if degrees == 0 else 2]:
            incident = light(degrees, azimuth)
            predicted[degrees, plane] = brdf.evaluate(incident, views).mean(axis=-1)
    values = np.concatenate([*predicted.values(), *([] if measured is None else [measured])])
    high = float(np.percentile(values, 99.7)) or 1.0
    low = max(float(np.percentile(values, 2)), high / 3000, 1e-9)
    if measured is not None:
        discs.append({"picture": disc_picture(measured, inside, low, high), "name": "Measured, light along the normal"})
    for (degrees, plane), part in predicted.items():
        where = "along the normal" if degrees == 0 else f"at {degrees}° in the plane of the {plane}"
        discs.append({"picture": disc_picture(part, inside, low, high), "name": f"Model, light {where}"})
    angle = np.radians(np.arange(-STEEPEST_DEG, STEEPEST_DEG + 1))
    planes = []
    for plane, azimuth in (("warp", np.pi / 2), ("weft", 0.0)):
        along = np.stack([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)], axis=1)
        lobes = [
            (f"light at {degrees}°", angle, brdf.evaluate(light(degrees, azimuth), along).mean(axis=-1))
            for degrees in INCIDENCES_DEG
        ]
        planes.append({"svg": lobes_plot(lobes), "name": f"Plane of the {plane}"})
    return {"model": model_name(name), "discs": discs, "planes": planes}


def light(degrees: float, azimuth: float) -> np.ndarray:
    """Unit vector (3,) towards a light."""
    theta = np.radians(degrees)
    return np.array([np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)])


def models_section(told: dict[str, dict], default: str) -> dict:
    """Reciprocity and albedo of each model, told by the stage cloth_brdf."""
    angles = sorted({angle for facts in told.values() for angle in facts.get("albedo_max") or {}}, key=float)
    rows = []
    for name in sorted(told, key=lambda name: (name != default, name)):
        albedo = told[name].get("albedo_max") or {}
        values = [told[name].get("used"), told[name].get("reciprocity_error"), *(albedo.get(angle) for angle in angles)]
        rows.append({"model": model_name(name), "default": name == default, "values": values})
    columns = ["measurements used", "reciprocity error", *(f"albedo, light at {angle}°" for angle in angles)]
    return {"columns": columns, "rows": rows}


def coverage_rows(reflectance: dict[str, Any]) -> list[dict]:
    """Coverage of each direction of light."""
    return [
        {
            "theta": row.get("theta_deg"),
            "phi": row.get("phi_deg"),
            "views": row.get("views"),
            "unusable": row.get("unusable"),
            "covered": None if row.get("covered") is None else 100 * row["covered"],
            "gap": row.get("gap_deg"),
            "steepest": row.get("steepest_deg"),
        }
        for row in reflectance.get("coverage") or []
    ]
