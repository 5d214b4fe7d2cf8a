"""Compare predictions of a cloth's models with measurements that no fit used."""

from dataclasses import asdict, dataclass

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.brdf.cloth.interface import incidences, prediction_error, solid_angles
from nishiki.errors import UserError
from nishiki.evaluate.tables import write_tables
from nishiki.goniometry.table import Reflectances
from nishiki.render.cloth.models import ClothModels

PLANES = ((0.0, "weft"), (90.0, "warp"))
WITHIN_DEG = 2.0
"""Largest angle in degrees between an incidence and the plane of weft or warp in which it counts."""
LEAST_VIEWS = 8
"""Least number of views of one incidence for an evaluation of its peak."""


@dataclass(frozen=True)
class Judged:
    """Errors of one model at one incidence."""

    theta_i_deg: float  # theta_i_deg, phi_i_deg: of the light
    phi_i_deg: float
    plane: str  # weft, warp, or its azimuth within a quarter
    views: int  # compared
    # root mean square error over root mean square, weighted by cos theta_r and the solid angle of each view's cell
    rms_rel: float
    bias_rel: float  # weighted mean error over weighted mean
    # between the brightest predicted and the brightest measured view; None where there are fewer than 8 views
    peak_direction_deg: float | None
    peak_value_rel: float | None  # predicted over measured brightest value, less 1; None likewise
    noise_rel: float | None  # what rms_rel noise alone would give, None where unknown


def plane_name(phi_deg: float) -> str:
    """Return weft, warp, or the azimuth reduced to 0 to 90 degrees, in words."""
    folded = abs((phi_deg + 90) % 180 - 90)
    for azimuth, name in PLANES:
        if abs(folded - azimuth) <= WITHIN_DEG:
            return name
    return "bias" if abs(folded - 45) <= WITHIN_DEG else f"{folded:.0f}°"


def judge(
    incident: np.ndarray,
    outgoing: np.ndarray,
    measured: np.ndarray,
    predicted: np.ndarray,
    noise: np.ndarray,
    *,
    quarter: bool = False,
) -> list[Judged]:
    """Compute errors at every incidence; directions (n, 3), values and noise (n, channels), sr^-1; channels averaged.

    quarter: the cloth has two mirror planes, so that under normal incidence a view stands for its images too.
    """
    rows = []
    for theta, phi, chosen in incidences(incident):
        weights = solid_angles(outgoing[chosen], quarter=quarter and theta < np.radians(1))
        error = prediction_error(outgoing[chosen], measured[chosen], predicted[chosen], weights)
        weights = weights * outgoing[chosen, 2]
        true, guess = measured[chosen].mean(axis=1), predicted[chosen].mean(axis=1)
        power = float(np.sum(weights * true**2))
        spread = np.sqrt(np.sum(noise[chosen] ** 2, axis=1)) / noise.shape[1]
        enough = len(chosen) >= LEAST_VIEWS
        phi_deg = float(np.degrees(phi))
        rows.append(
            Judged(
                theta_i_deg=round(float(np.degrees(theta)), 3),
                phi_i_deg=round(phi_deg, 3),
                plane="any" if theta < np.radians(1) else plane_name(phi_deg),
                views=len(chosen),
                rms_rel=error.rms_rel,
                bias_rel=float(np.sum(weights * (guess - true)) / np.sum(weights * true)),
                peak_direction_deg=float(np.degrees(error.peak_direction)) if enough else None,
                peak_value_rel=error.peak_value if enough else None,
                noise_rel=float(np.sqrt(np.sum(weights * spread**2) / power)) if (spread > 0).any() else None,
            )
        )
    return rows


def by_incidence(rows: list[Judged]) -> dict[str, dict]:
    """Return means over the planes of one polar angle, by the angle rounded to a degree, and the worst rms_rel."""
    means = {}
    for angle in sorted({round(row.theta_i_deg) for row in rows}):
        mine = [row for row in rows if round(row.theta_i_deg) == angle]
        values = [abs(row.peak_value_rel) for row in mine if row.peak_value_rel is not None]
        turns = [row.peak_direction_deg for row in mine if row.peak_direction_deg is not None]
        means[str(angle)] = {
            "incidences": len(mine),
            "views": sum(row.views for row in mine),
            "rms_rel": float(np.mean([row.rms_rel for row in mine])),
            "worst_rms_rel": max(row.rms_rel for row in mine),
            "peak_value_rel": float(np.mean(values)) if values else None,
            "peak_direction_deg": float(np.mean(turns)) if turns else None,
        }
    return means


def in_plane(outgoing: np.ndarray, azimuth: float, *, within: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Select views (n, 3) in the plane through the normal at this azimuth; return rows and signed polar angles, rad.

    within: largest sine of the angle between the view's azimuth and the plane's; where fewer than four views are that
    near, largest sine of the angle to the plane. Angles are positive towards the azimuth; rising.
    """
    ahead, aside = np.array([np.cos(azimuth), np.sin(azimuth)]), np.array([-np.sin(azimuth), np.cos(azimuth)])
    off, tilt = np.abs(outgoing[:, :2] @ aside), np.hypot(outgoing[:, 0], outgoing[:, 1])
    rows = np.flatnonzero(off <= np.maximum(within * tilt, 1e-3))
    if len(rows) < 4:
        rows = np.flatnonzero(off <= within)
    angle = np.arctan2(outgoing[rows, :2] @ ahead, outgoing[rows, 2])
    order = np.argsort(angle, kind="stable")
    return rows[order], angle[order]


HELD_OUT, FITTED = "held_out", "fitted"


def run(context: Context) -> dict:
    """Evaluate every model of every region on measurements held out and on those used."""
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
    """Evaluate all models of one region.

    Held out is what is valid and no model's fit has used, so that all are judged on the same measurements. A model
    whose fit used every oblique measurement (a reference, no prediction) does not make the others' set empty: it is
    judged on the same set and marked.
    """
    number = measured.regions.index(name)
    valid = np.flatnonzero(measured.valid[:, number])
    used = {model: np.intersect1d(models.rows_of_fit(name, model), valid) for model in models.names(name)}
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
            HELD_OUT: judge_errors(measured, number, values, held_out),
            FITTED: judge_errors(measured, number, values, used[model]),
        }
    return {
        "valid": len(valid),
        "held_out": len(held_out),
        "models": judged_models,
        "curves": curves(measured, number, predicted, valid, held_out, context.settings.curves),
    }


def uses_all(used: np.ndarray, rows: np.ndarray) -> bool:
    """Check whether a fit used every one of these rows, and there are some."""
    return len(rows) > 0 and bool(np.isin(rows, used).all())


def judge_errors(measured: Reflectances, number: int, predicted: np.ndarray, rows: np.ndarray) -> dict:
    """Compute errors on these measurements, at each incidence and over the planes of each polar angle."""
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
