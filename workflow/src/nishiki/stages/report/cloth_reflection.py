"""Write the sections of a cloth's page on its reflection: discs of all views, lobes, and errors of the models."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from nishiki.goniometry.table import Reflectances
from nishiki.render.cloth.models import ClothModels
from nishiki.report.page import Block, Cell, Figure, Figures, Heading, Note, PageSection, Table
from nishiki.report.pictures import PagePicture, Scale, colour_map, encode_picture, heat, hexadecimal
from nishiki.report.scene_page import SceneData
from nishiki.report.svg import INK, PALETTE, ChartCurve, chart, figure

INCIDENCES_DEG = (0, 30, 60)
AZIMUTHS = {"warp": np.pi / 2, "weft": 0.0}
STEEPEST_DEG = 80
"""Steepest view of the drawn lobes: at grazing views a cloth can outshine all others."""
VIEW, BRDF = "view, degrees from the normal; the light is on the right", "BRDF, 1/sr"
"""Labels of the axes of charts in the plane of the light."""
LOBES_SPAN = 3000  # largest ratio of the values of a logarithmic scale, so that weak lobes show beside strong ones
DISC = 168
"""Side of a view disc in pixels."""
MODEL_NAMES = {
    "yarns": "interlaced yarns",
    "yarn_facets": "facets on yarns",
    "bard_great_circle": "BARD, great circle",
    "bard_linear": "BARD, linear",
}


def model_name(kind: str) -> str:
    """Return the name of a model in words."""
    return MODEL_NAMES.get(kind, kind.replace("_", " "))


def drawn_region(data: SceneData) -> str:
    """Return the region whose lobes and curves are drawn."""
    return data.settings.region or Reflectances(data.inputs["goniometer_samples"].folder).regions[0]


def reflection_section(data: SceneData) -> PageSection:
    """Return discs and lobes of the region's default model, beside the measured disc; a table of all models."""
    measured, region = Reflectances(data.inputs["goniometer_samples"].folder), drawn_region(data)
    models = ClothModels(data.inputs["cloth_brdf"].folder)
    brdf = models.brdf(region)

    def evaluate(degrees: float, azimuth: float, directions: np.ndarray) -> np.ndarray:
        return brdf.evaluate(light(degrees, azimuth), directions).mean(axis=-1)

    views, inside = disc_directions()
    discs = {}
    if measured.basic is not None:
        values = measured.basic.evaluate(views, measured.regions.index(region)).mean(axis=1)
        discs["Measured, light along the normal"] = values
    for degrees in INCIDENCES_DEG:
        for plane, azimuth in list(AZIMUTHS.items())[: 1 if degrees == 0 else 2]:
            where = "along the normal" if degrees == 0 else f"at {degrees}° in the plane of the {plane}"
            discs[f"Model, light {where}"] = evaluate(degrees, azimuth, views)
    every = np.concatenate(list(discs.values()))
    high = float(np.percentile(every, 99.7)) or 1.0
    low = max(float(np.percentile(every, 2)), high / LOBES_SPAN, 1e-9)
    caption = "Lobes of the BRDF for light from the right, on a logarithmic scale."
    blocks: list[Block] = [
        "All views of the hemisphere, seen from above: the weft runs to the right, the warp upwards, distance from the "
        f"middle grows evenly with the angle from the normal. Model: {model_name(models.default)}.",
        Figures([Figure(name, "", disc_picture(part, inside, low, high)) for name, part in discs.items()], 3),
        Figures([
            Figure(f"Plane of the {plane}", caption, svg=lobes_plot(evaluate, plane))
            for plane in AZIMUTHS
        ]),
    ]  # fmt: skip
    if models_of_region := data.value("cloth_brdf", "regions", region):
        blocks.append(table_of_models(models_of_region, models.default))
    return PageSection("lobes", "Reflection", blocks)


def lobes_plot(evaluate: Callable[[float, float, np.ndarray], np.ndarray], plane: str) -> str:
    """Draw lobes in the plane of the light. evaluate(degrees, azimuth, directions): the BRDF."""
    angle, azimuth = np.arange(-STEEPEST_DEG, STEEPEST_DEG + 1), AZIMUTHS[plane]
    along = np.concatenate([light(float(degrees), azimuth)[None] for degrees in angle])
    curves = [
        ChartCurve(f"light at {degrees}°", angle, evaluate(degrees, azimuth, along), PALETTE[k])
        for k, degrees in enumerate(INCIDENCES_DEG)
    ]
    top = max(float(curve.y.max()) for curve in curves) or 1.0
    low = max(min(float(curve.y.min()) for curve in curves), top / LOBES_SPAN)
    return chart(
        curves, x_label=VIEW, y_label=BRDF, title=f"lobes of the BRDF in the plane of the {plane}",
        y_range=(0.9 * low, 1.1 * top), logarithmic=True,
    )  # fmt: skip


def light(degrees: float, azimuth: float) -> np.ndarray:
    """Compute the unit vector (3,) towards a light."""
    theta = np.radians(degrees)
    return np.array([np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)])


def table_of_models(models: dict[str, dict], default: str) -> Table:
    """Return reciprocity and albedo of each model, as the stage cloth_brdf reports them."""
    angles = sorted({angle for facts in models.values() for angle in facts.get("albedo_max") or {}}, key=float)
    names = sorted(models, key=lambda name: (name != default, name))
    rows = []
    for name in names:
        albedo = models[name].get("albedo_max") or {}
        facts = [models[name].get(key) for key in ("used", "left_out_error", "reciprocity_error")]
        rows.append([model_name(name), *facts, *(albedo.get(angle) for angle in angles)])
    spans = (("", 4), ("albedo by incidence", len(angles)))
    return Table(
        ("model", "used", "predicted", "reciprocity error", *(f"{angle}°" for angle in angles)), rows,
        "lrrr" + "r" * len(angles),
        "All models: how many measurements their fit used; relative error of the oblique measurements as predicted "
        "from light along the normal alone, by which the model is chosen (where none were measured, the misfit along "
        "the normal); difference of light and view exchanged, relative (0: reciprocal); share of the light that they "
        "reflect in all, the greatest over warp, bias and weft (above 1: not possible).",
        spans if angles else (), marked={names.index(default)} if default in names else (),
    )  # fmt: skip


def disc_directions(size: int = DISC) -> tuple[np.ndarray, np.ndarray]:
    """Compute unit vectors (n, 3) of the pixels inside a disc of views from above, and the mask (size, size).

    Distance from the middle grows evenly with the polar angle; x (weft) to the right, y (warp) up.
    """
    place = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(place, -place)
    radius = np.hypot(x, y)
    inside = radius < 0.985
    theta, safe = radius[inside] * np.pi / 2, np.maximum(radius[inside], 1e-12)
    across = np.sin(theta) / safe
    return np.stack([across * x[inside], across * y[inside], np.cos(theta)], axis=1), inside


def disc_picture(values: np.ndarray, inside: np.ndarray, low: float, high: float) -> PagePicture:
    """Draw a logarithmic picture of values (n,) at the pixels of a disc; white outside."""
    table, picture = heat(), np.full((*inside.shape, 3), 255, np.uint8)
    logs = np.log10(np.maximum(values, 1e-12))
    picture[inside] = colour_map(logs[None], table, np.log10(low), np.log10(high))[0]
    stops = tuple(hexadecimal(colour) for colour in table[:: 255 // 5])
    return encode_picture(picture, lossless=True, scale=Scale(f"{low:.2g}", f"{high:.2g}", "1/sr, logarithmic", stops))


INTRODUCTION = (
    "Predicted against measured reflectance on measurements that no fit has seen. The error is the root mean square of "
    "the difference over that of the measured values, weighted by the cosine of the view's angle and by the solid "
    "angle that each view stands for; mean over the planes of incidence."
)


def errors_section(data: SceneData) -> PageSection:
    """Write the error against incidence of each region as table and chart."""
    evaluation = data.evaluation
    blocks: list[Block] = [INTRODUCTION]
    for region, facts in evaluation["regions"].items():
        if len(evaluation["regions"]) > 1:
            blocks.append(Heading(region))
        blocks += _errors_of(facts, evaluation["default"])
    return PageSection("errors", "Errors", blocks)


def _errors_of(region: dict[str, Any], default: str) -> list[Block]:
    if not region["held_out"]:
        return [Note(["Every measurement was used by a fit, so nothing is said of directions that were not measured."])]

    def order(name: str) -> tuple:
        """Sort models: the default first, the rest by their error on held-out data, least first."""
        error = mean_error((region["models"][name].get("held_out") or {}).get("by_incidence") or {})
        return name != default, float("inf") if error is None else error, name

    models = {name: region["models"][name] for name in sorted(region["models"], key=order)}
    held = {model: entry["held_out"]["by_incidence"] for model, entry in models.items()}
    angles = sorted({angle for part in held.values() for angle in part}, key=float)
    errors: list[list[Cell]] = []
    peaks: list[list[Cell]] = []
    for model, entry in models.items():
        name, parts = model_name(model), [held[model].get(angle) for angle in angles]
        seen = f"{name} (has seen these)" if entry["reference"] else name
        values = [None if part is None else part["rms_rel"] for part in parts]
        errors.append([seen, entry["fitted"]["measurements"], *values, mean_error(entry["fitted"]["by_incidence"])])
        peaks.append(
            [
                name,
                *(
                    None
                    if part is None or part["peak_value_rel"] is None
                    else f"{round(100 * part['peak_value_rel'])} %, {figure(part['peak_direction_deg'], 2)}°"
                    for part in parts
                ),
            ]
        )
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
    blocks.append("Each incidence of every model is a row of evaluation.csv.")
    return blocks


def mean_error(parts: dict[str, dict]) -> float | None:
    """Return the mean relative error over incidences."""
    values = [part["rms_rel"] for part in parts.values()]
    return float(np.mean(values)) if values else None


def curves_section(data: SceneData) -> PageSection | None:
    """Return charts of measured and predicted values in the plane of the light, for one region."""
    facts, default = data.evaluation["regions"].get(drawn_region(data), {}), data.evaluation["default"]
    if not facts.get("curves"):
        return None
    models = sorted(facts["models"], key=lambda model: model != default)
    items = []
    for curve in facts["curves"]:
        plane = f"azimuth {curve['plane']}" if curve["plane"].endswith("°") else curve["plane"]
        heading = f"Light at {curve['theta_i_deg']:.0f}°, plane of the {plane}"
        caption = "" if any(curve["held_out"]) else "taken for the fit"
        items.append(Figure(heading, caption, svg=plane_chart(curve, models, default)))
    intro = "Values in the plane that holds the light and the normal. Dots: measured; lines: predicted."
    return PageSection("curves", "Measured and predicted", [intro, Figures(items)])


def lines_of(models: Sequence[str], default: str) -> dict[str, dict[str, Any]]:
    """Give each model a colour; the default one is solid, the others are dashed."""
    return {model: {"colour": PALETTE[k % len(PALETTE)], "dashed": model != default} for k, model in enumerate(models)}


def error_chart(models: dict[str, dict], default: str) -> str:
    """Draw the relative error against incidence on a logarithmic axis that holds every value, one line a model."""
    lines = lines_of(sorted(models, key=lambda model: model != default), default)
    curves: list[ChartCurve] = []
    for model, parts in models.items():
        points = sorted((float(angle), part["rms_rel"]) for angle, part in parts.items() if part["rms_rel"] > 0)
        if points:
            x, y = np.array(points).T
            curves.append(ChartCurve(model_name(model), x, y, **lines[model]))
            curves.append(ChartCurve("", x, y, colour=lines[model]["colour"], dots=True))
    if not curves:
        return ""
    ends = [x for curve in curves for x in (curve.x.min(), curve.x.max())]
    room = (min(ends) - 2, max(ends) + 2)
    values = np.concatenate([curve.y for curve in curves])
    return chart(
        curves, x_label="incidence, degrees", y_label="relative RMS error", title="error against incidence",
        x_range=room, y_range=(0.8 * float(values.min()), 1.25 * float(values.max())), size=(640, 340),
        logarithmic=True,
    )  # fmt: skip


def plane_chart(curve: dict, models: list[str], default: str) -> str:
    """Draw measured values as dots, predicted ones as lines, over the view's angle in the plane of the light."""
    drawn = lines_of(models, default)
    angle, measured = np.array(curve["theta_r_deg"]), np.array(curve["measured"])
    lines = [
        ChartCurve(model_name(model), angle, np.array(values), **drawn[model])
        for model in models
        if (values := curve["predicted"].get(model)) is not None
    ]
    dots = ChartCurve("measured", angle, measured, colour=INK, dots=True)
    highest = max(float(np.nanmax(line.y, initial=0.0)) for line in [dots, *lines])
    top = max(1.05 * min(highest, 1.6 * float(measured.max())), 1e-6)  # a model may leave the drawing
    return chart(
        [dots, *lines], x_label=VIEW, y_label=BRDF,
        title="measured and predicted in the plane of the light", x_range=(-90, 90), y_range=(0, top), size=(560, 260),
    )  # fmt: skip
