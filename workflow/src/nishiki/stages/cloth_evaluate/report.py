"""The sections of a cloth's page on errors: predicted against measured reflectance."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from nishiki.report.numbers import figure
from nishiki.report.page import Block, Cell, Figure, Figures, Fold, Heading, Note, Section, Table
from nishiki.report.svg import DASHES, INK, PALETTE, Curve, chart
from nishiki.stages.cloth_brdf.report import model_name

CURVES_OF = ("yarn_facets", "bard_great_circle", "weave", "ggx")
"""Models whose curves are drawn beside those of the default one."""
MOST_CURVES = 4
INTRODUCTION = (
    "Predicted against measured reflectance on measurements that no fit has seen. The error is the root mean square of "
    "the difference over that of the measured values, weighted by the cosine of the view's angle and by the solid "
    "angle that each view stands for; mean over the planes of incidence."
)


def errors_section(evaluation: dict[str, Any] | None) -> Section | None:
    """For each region: error against incidence as table and chart, and every row. evaluation : evaluation.json."""
    if evaluation is None:
        return None
    blocks: list[Block] = [INTRODUCTION]
    for region, facts in evaluation["regions"].items():
        if len(evaluation["regions"]) > 1:
            blocks.append(Heading(region))
        blocks += _errors_of(facts, evaluation["default"])
    return Section("errors", "Errors", blocks)


def _errors_of(region: dict[str, Any], default: str) -> list[Block]:
    if not region["held_out"]:
        return [Note(["Every measurement was used by a fit, so nothing is said of directions that were not measured."])]
    models = default_first(region["models"], default)
    held = {model: entry["held_out"]["by_incidence"] for model, entry in models.items()}
    angles = sorted({angle for part in held.values() for angle in part}, key=float)
    errors: list[list[Cell]] = []
    peaks: list[list[Cell]] = []
    every: list[list[Cell]] = []
    for model, entry in models.items():
        name, parts = model_name(model), [held[model].get(angle) for angle in angles]
        seen = f"{name} (has seen these)" if entry["reference"] else name
        values = [None if part is None else part["rms_rel"] for part in parts]
        errors.append([seen, entry["fitted"]["measurements"], *values, mean_error(entry["fitted"]["by_incidence"])])
        peaks.append([name, *(peak_error(part) for part in parts)])
        every += [[name, *row_of(row)] for row in entry["held_out"]["rows"]]
    columns, marked = [f"{angle}°" for angle in angles], {0} if default in models else set()
    caption = (
        f"Relative RMS error by incidence, on {figure(region['held_out'])} of {figure(region['valid'])} measurements. "
        "The marked line is the default model."
    )
    align = "l" + "r" * (len(angles) + 2)
    head = ("model", "used for the fit", *columns, "on what it was fitted to")
    blocks: list[Block] = [Table(head, errors, align, caption, marked=marked)]
    caption = (
        "Brightest view: error of its value (mean size over the planes) and angle between the predicted and the "
        "measured one."
    )
    blocks.append(Table(("model", *columns), peaks, align[:-2], caption, marked=marked))
    if drawing := error_chart(held, default):
        blocks.append(Figures([Figure("Relative error", "against the incidence of the light.", svg=drawing)], 1))
    head = (
        "model",
        "θi",
        "φi",
        "plane",
        "views",
        "rel. RMS",
        "mean error",
        "peak value",
        "peak direction",
        "noise alone",
    )
    blocks.append(Fold("Each incidence", f"{len(every)} rows", [Table(head, every, "lrrlrrrrrr")]))
    return blocks


def row_of(row: dict[str, Any]) -> list[Cell]:
    """One plane of incidence of one model."""
    direction = row["peak_direction_deg"]
    return [
        *(f"{figure(row[name])}°" for name in ("theta_i_deg", "phi_i_deg")),
        *(row[name] for name in ("plane", "views", "rms_rel", "bias_rel", "peak_value_rel")),
        None if direction is None else f"{figure(direction)}°",
        row["noise_rel"],
    ]


def peak_error(part: dict[str, Any] | None) -> str | None:
    """Error of the brightest view in words."""
    if part is None or part["peak_value_rel"] is None:
        return None
    return f"{round(100 * part['peak_value_rel'])} %, {figure(part['peak_direction_deg'], 2)}°"


def default_first(models: dict[str, Any], default: str) -> dict[str, Any]:
    """Models with the default one first, the rest by error on what was held out, least first."""

    def order(name: str) -> tuple:
        error = mean_error((models[name].get("held_out") or {}).get("by_incidence") or {})
        return name != default, float("inf") if error is None else error, name

    return {name: models[name] for name in sorted(models, key=order)}


def mean_error(parts: dict[str, dict]) -> float | None:
    """Mean relative error over incidences."""
    values = [part["rms_rel"] for part in parts.values()]
    return float(np.mean(values)) if values else None


def curves_section(evaluation: dict[str, Any] | None, region: str) -> Section | None:
    """Charts of measured and predicted values in the plane of the light, for one region."""
    if evaluation is None or not evaluation["regions"].get(region, {}).get("curves"):
        return None
    facts, default = evaluation["regions"][region], evaluation["default"]
    ordered = dict.fromkeys([default, *CURVES_OF, *facts["models"]])
    models = [model for model in ordered if model in facts["models"]][:MOST_CURVES]
    items = []
    for curve in facts["curves"]:
        plane = f"azimuth {curve['plane']}" if curve["plane"].endswith("°") else curve["plane"]
        heading = f"Light at {curve['theta_i_deg']:.0f}°, plane of the {plane}"
        caption = "" if any(curve["held_out"]) else "taken for the fit"
        items.append(Figure(heading, caption, svg=plane_chart(curve, models, default)))
    intro = "Values in the plane that holds the light and the normal. Dots: measured; lines: predicted."
    return Section("curves", "Measured and predicted", [intro, Figures(items)])


@dataclass(frozen=True)
class Line:
    """How a model is drawn in all charts of a page."""

    colour: str
    dashed: bool
    dash: str = DASHES[0]


def lines_of(models: list[str], default: str) -> dict[str, Line]:
    """A line for each model, no two alike: the default one is solid in the first colour, the others are dashed."""
    ordered = [default] * (default in models) + [model for model in models if model != default]
    first = int(default in models)
    colours = len(PALETTE)
    return {
        model: Line(PALETTE[k % colours], k >= first, DASHES[min(k // colours, len(DASHES) - 1)])
        for k, model in enumerate(ordered)
    }


def error_chart(models: dict[str, dict], default: str) -> str:
    """Relative error against the light's incidence on a logarithmic axis that holds every value, one line a model."""
    lines = lines_of(list(models), default)
    curves: list[Curve] = []
    for model, parts in models.items():
        points = sorted((float(angle), part["rms_rel"]) for angle, part in parts.items() if part["rms_rel"] > 0)
        if points:
            x, y = np.array(points).T
            line = lines[model]
            curves.append(Curve(model_name(model), x, y, **asdict(line)))
            curves.append(Curve("", x, y, colour=line.colour, dots=True))
    if not curves:
        return ""
    ends = [x for curve in curves for x in (curve.x.min(), curve.x.max())]
    room = (min(ends) - 2, max(ends) + 2)
    values = np.concatenate([curve.y for curve in curves])
    return chart(
        curves, x_label="incidence, degrees", y_label="relative RMS error", title="error against incidence",
        x_range=room, y_range=(0.8 * float(values.min()), 1.25 * float(values.max())), width=640, height=340,
        logarithmic=True,
    )  # fmt: skip


def plane_chart(curve: dict, models: list[str], default: str) -> str:
    """Measured values as dots, predicted ones as lines, over the view's angle in the plane of the light."""
    drawn = lines_of(models, default)
    angle, measured = np.array(curve["theta_r_deg"]), np.array(curve["measured"])
    lines = [
        Curve(model_name(model), angle, np.array(values), **asdict(drawn[model]))
        for model in models
        if (values := curve["predicted"].get(model)) is not None
    ]
    dots = Curve("measured", angle, measured, colour=INK, dots=True)
    highest = max(float(np.nanmax(line.y, initial=0.0)) for line in [dots, *lines])
    top = max(1.05 * min(highest, 1.6 * float(measured.max())), 1e-6)  # a model may leave the drawing
    return chart(
        [dots, *lines], x_label="view, degrees from the normal; the light is on the right", y_label="BRDF, 1/sr",
        title="measured and predicted in the plane of the light", y_range=(0.0, top), x_range=(-90, 90), height=260,
    )  # fmt: skip
