"""Cloth evaluation: what the cloth's models predict against what was measured and no fit has seen."""

from dataclasses import asdict

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.brdf.cloth.interface import incidences
from nishiki.errors import UserError
from nishiki.evaluate.cloth import Judged, by_incidence, in_plane, judge, plane_name
from nishiki.evaluate.tables import write_tables
from nishiki.goniometry.table import Reflectances
from nishiki.render.cloth.models import ClothModels

HELD_OUT, FITTED = "held_out", "fitted"


def run(context: Context) -> dict:
    """Judge every model of every region, on measurements left out and on those that were used."""
    measured = Reflectances(context.inputs["goniometer_samples"].folder)
    models = ClothModels(context.inputs["cloth_brdf"].folder)
    settings = context.settings
    unknown = set(settings.regions) - set(models.regions)
    if unknown:
        raise UserError(f"regions: expected some of {', '.join(models.regions)}, found {', '.join(sorted(unknown))}")
    regions = {name: region(context, measured, models, name) for name in settings.regions or models.regions}
    evaluation = {"default": models.default, "regions": regions}
    rows = [
        {"region": name, "model": model, "set": kind, **row}
        for name, evaluated in regions.items()
        for model, entry in evaluated["models"].items()
        for kind in (HELD_OUT, FITTED)
        for row in entry[kind]["rows"]
    ]
    columns = ["region", "model", "set", *Judged.__dataclass_fields__]
    write_tables(context, evaluation, columns, rows)
    told = {name: headlines(evaluated, models.default) for name, evaluated in regions.items()}
    return {"default": models.default, "regions": told}


def region(context: Context, measured: Reflectances, models: ClothModels, name: str) -> dict:
    """All models of one region.

    Held out is what is valid and no model's fit has used, so that all are judged on the same measurements. A model
    whose fit used every oblique measurement (a reference, no prediction) does not make the others' set empty: it is
    judged on the same set and marked.
    """
    number = measured.regions.index(name)
    valid = np.flatnonzero(measured.valid[:, number])
    used = {model: np.intersect1d(models.used(name, model), valid) for model in models.names(name)}
    oblique = valid[~measured.normal_incidence[valid]]
    references = {model for model, rows in used.items() if uses_all(rows, valid) or uses_all(rows, oblique)}
    seen = np.unique(np.concatenate([rows for model, rows in used.items() if model not in references] or [valid[:0]]))
    held_out = np.setdiff1d(valid, seen)
    judged_models, predicted = {}, {}
    for model in models.names(name):
        context.progress.tell(f"{name}: {model}")
        brdf = models.brdf(name, model)
        values = np.zeros((len(measured), brdf.channels))
        values[valid] = brdf.evaluate(measured.incident[valid], measured.outgoing[valid])
        predicted[model] = values
        judged_models[model] = {
            "facts": models.facts(name, model),
            "reference": model in references,
            HELD_OUT: judged(measured, number, values, held_out),
            FITTED: judged(measured, number, values, used[model]),
        }
    return {
        "valid": len(valid),
        "held_out": len(held_out),
        "models": judged_models,
        "curves": curves(measured, number, predicted, valid, held_out, context.settings.curves),
    }


def uses_all(used: np.ndarray, rows: np.ndarray) -> bool:
    """Return whether a fit used every one of these rows, and there are some."""
    return len(rows) > 0 and bool(np.isin(rows, used).all())


def judged(measured: Reflectances, number: int, predicted: np.ndarray, rows: np.ndarray) -> dict:
    """Return errors on these measurements, at each incidence and over the planes of each polar angle."""
    if not len(rows):
        return {"measurements": 0, "rows": [], "by_incidence": {}}
    values, noise = measured.values[rows, number], measured.noise[rows, number]
    directions = measured.incident[rows], measured.outgoing[rows]
    errors = judge(*directions, values, predicted[rows], noise, quarter=measured.symmetry == "quarter")
    return {"measurements": len(rows), "rows": [asdict(row) for row in errors], "by_incidence": by_incidence(errors)}


def curves(measured, number: int, predicted: dict, valid: np.ndarray, held_out: np.ndarray, count: int) -> list[dict]:
    """List measured and predicted values in the plane of the light at incidences spread evenly, sr^-1; normal first."""
    groups = [(theta, phi, valid[rows]) for theta, phi, rows in incidences(measured.incident[valid])]
    planes = []
    for theta, phi, rows in groups:
        for azimuth in (np.pi / 2, 0.0) if theta < np.radians(1) else (phi,):
            inside, angle = in_plane(measured.outgoing[rows], azimuth)
            if len(inside) >= 4:
                planes.append((theta, azimuth, rows[inside], angle))
    chosen = planes if len(planes) <= count else [planes[k * len(planes) // count] for k in range(count)]
    return [
        {
            "theta_i_deg": round(float(np.degrees(theta)), 3),
            "phi_i_deg": round(float(np.degrees(azimuth)), 3),
            "plane": plane_name(float(np.degrees(azimuth))),
            "theta_r_deg": np.round(np.degrees(angle), 4).tolist(),
            "held_out": np.isin(rows, held_out).tolist(),
            "measured": measured.values[rows, number].mean(axis=1).tolist(),
            "predicted": {model: values[rows].mean(axis=1).tolist() for model, values in predicted.items()},
        }
        for theta, azimuth, rows, angle in chosen
    ]


def headlines(evaluated: dict, default: str) -> dict:
    """Summarise for the artifact's diagnostics: the mean over the planes of rms_rel, by polar angle and model."""
    errors = {
        model: {angle: part["rms_rel"] for angle, part in entry[HELD_OUT]["by_incidence"].items()}
        for model, entry in evaluated["models"].items()
    }
    return {
        "valid": evaluated["valid"],
        "held_out": evaluated["held_out"],
        "rms_rel": errors,
        "rms_rel_default": errors[default],
        "peak_value_rel": {
            model: {angle: part["peak_value_rel"] for angle, part in entry[HELD_OUT]["by_incidence"].items()}
            for model, entry in evaluated["models"].items()
        },
        "references": sorted(model for model, entry in evaluated["models"].items() if entry["reference"]),
    }
