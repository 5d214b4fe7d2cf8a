"""Fit the BRDF of every region of a cloth over the whole hemisphere, with several models."""

import csv
import json
from pathlib import Path

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.brdf.cloth import interface
from nishiki.brdf.cloth.models import BEST, YARNS, Fitted, fit_models, left_out_error
from nishiki.brdf.cloth.store import goniometer_rows, save_brdf
from nishiki.brdf.cloth.yarn_fit import Measured
from nishiki.goniometry.directions import unit
from nishiki.goniometry.hemisphere import complete
from nishiki.goniometry.table import Reflectances, ReflectanceSet
from nishiki.model_selection.decision import Decision, economy
from nishiki.model_selection.sufficient import measured_choice, static_choice, with_normal_rows
from nishiki.optional_formats.reflectance_tables import write_utia
from nishiki.stages.brdf import CLOTH_OUTPUTS
from nishiki.weave.store import read_yarns

FORMAT = 1  # of the file; readers refuse others
ALBEDO_DEG = (0, 30, 60, 80)
EXPORT_INCIDENT_DEG = [
    (0.0, 0.0),
    *((t, p) for t in (15.0, 30.0, 45.0, 60.0, 75.0) for p in np.arange(0.0, 360.0, 15.0)),
]
EXPORT_VIEWS_DEG = [(0.0, 0.0), *((t, p) for t in np.arange(5.0, 90.0, 5.0) for p in np.arange(0.0, 360.0, 15.0))]


def run(context: Context) -> dict:
    """Fit every model of every region; write the models, the default's exports and cloth_brdf.json."""
    reflectances, decision = used_measurements(context)
    asked = context.settings.model
    names = tuple(dict.fromkeys(((*BEST,) if asked == "auto" else (asked,)) + context.settings.compare))
    regions = []
    for number, region in enumerate(reflectances.regions):
        context.progress.tell(f"region {region}: {', '.join(names)}")
        measured = Measured.of(reflectances, number)
        regions.append((measured, fits(context, reflectances, measured, number, names)))
    left_out = [
        {name: round(left_out_error(measured, fitted[name]), 5) for name in BEST if name in fitted}
        for measured, fitted in regions
    ]
    fitted_everywhere = [name for name in BEST if all(name in errors for errors in left_out)]
    default = asked if asked != "auto" else min(fitted_everywhere, key=lambda n: sum(errors[n] for errors in left_out))
    stored_facts, diagnostics = {}, {}
    for region, (measured, fitted), errors in zip(reflectances.regions, regions, left_out, strict=True):
        folder = Path("models") / region
        for name, fit in fitted.items():
            save_brdf(context.output.path(str(folder / f"{name}.npz")), fit.brdf, CLOTH_OUTPUTS)
        several = len(reflectances.regions) > 1
        stored = context.output.path(f"brdf_{region}.npz" if several else "brdf.npz")
        save_brdf(stored, fitted[default].brdf, CLOTH_OUTPUTS)
        for name in context.settings.export:
            TABLES[name](context, fitted[default].brdf, f"_{region}" if several else "", reflectances.channels)
        stored_facts[region] = {name: {"used": fit.used.tolist(), **fit.facts} for name, fit in fitted.items()}
        diagnostics[region] = {name: judge(measured, fit) for name, fit in fitted.items()}
        for name, error in errors.items():
            diagnostics[region][name]["left_out_error"] = error
    listing = {"format": FORMAT, "default": default, "regions": list(reflectances.regions), "models": stored_facts}
    text = json.dumps(listing, indent=1, sort_keys=True, allow_nan=False)
    context.output.path("cloth_brdf.json").write_text(text + "\n")
    return {"default": default, "regions": diagnostics, "economy": economy(decision)}


def used_measurements(context: Context) -> tuple[ReflectanceSet, Decision | None]:
    """Return the reflectances with the normal-incidence views for fits, and the hemisphere completed from them."""
    artifact = context.inputs["goniometer_samples"]
    measured = Reflectances(artifact.folder)
    setting = context.settings.measurements
    grid_deg = artifact.settings["grid_deg"]
    if setting == "auto":
        rows, decision = measured_choice(measured, grid_deg=grid_deg) if measured.basic is not None else (None, None)
    else:
        rows, decision = static_choice(measured, setting)
    if decision:
        context.progress.tell(str(decision))
    if rows is None:
        return measured, decision
    fewer = with_normal_rows(measured, rows)
    if measured.basic is not None:
        fewer = complete(fewer, grid_deg=grid_deg)[0]
    return fewer, decision


def fits(context: Context, reflectances, measured: Measured, number: int, names) -> dict[str, Fitted]:
    """Fit all models of one region."""
    basic = reflectances.basic
    settings = context.settings
    if basic is not None:
        basic = (lambda views: reflectances.basic.evaluate(views, number), basic.values[number])
    yarns = read_yarns(context.inputs["weave"].folder, number) if "weave" in context.inputs else None
    if settings.model == "auto" and not (yarns and yarns[1]["determined"]):
        names = tuple(name for name in names if name != YARNS)
    return fit_models(measured, basic, names, oblique=settings.oblique, yarns=yarns)


def judge(measured: Measured, fit: Fitted) -> dict:
    """Compute reciprocity, albedo, and the error on the fitted data, by polar angle of the light."""
    used = measured.take(fit.used)
    predicted = fit.brdf.evaluate(used.incident, used.outgoing)
    errors = {}
    for theta, _, rows in interface.incidences(used.incident):
        quarter = measured.quarter and theta < np.radians(1)
        solid = interface.solid_angles(used.outgoing[rows], quarter=quarter)
        error = interface.prediction_error(used.outgoing[rows], used.values[rows], predicted[rows], solid)
        errors.setdefault(f"{np.degrees(theta):.0f}", []).append(error.rms_rel)
    albedo = {}
    for theta in ALBEDO_DEG:
        light = unit(np.radians(theta), np.radians([0.0, 45.0, 90.0]))
        albedo[str(theta)] = round(float(interface.directional_albedo(fit.brdf, light).max()), 5)
    return {
        "used": len(fit.used),
        "rms_rel_used": {angle: round(float(np.mean(values)), 5) for angle, values in errors.items()},
        "reciprocity_error": round(interface.reciprocity_error(fit.brdf), 6),
        "albedo_max": albedo,
        "at_bounds": fit.facts.get("at_bounds", []),
    }


def write_rows(context: Context, brdf, suffix: str, channels) -> None:
    """Write a model as a table of reflectances, as a capture holds it."""
    rows = goniometer_rows(brdf, incident_deg=EXPORT_INCIDENT_DEG, outgoing_deg=EXPORT_VIEWS_DEG)
    with context.output.path(f"brdf{suffix}.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["theta_i_deg", "phi_i_deg", "theta_r_deg", "phi_r_deg", *channels])
        table.writerows([*(f"{angle:g}" for angle in row[:4]), *(f"{value:.6g}" for value in row[4:])] for row in rows)


TABLES = {"csv": write_rows, "utia": write_utia}
"""Writers of the default model, by format."""
