"""The section of a cloth's page on its reflection: discs of all views, lobes, and what each model is as physics."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.goniometry.store import Reflectances
from nishiki.render.cloth.models import ClothModels
from nishiki.report.colour_map import coloured, heat, hexadecimal
from nishiki.report.page import Block, Figure, Figures, Section, Table
from nishiki.report.pictures import PagePicture, Scale, encoded
from nishiki.report.svg import GRID, PALETTE, SOFT, Drawing, outline

INCIDENCES_DEG = (0, 30, 60)
AZIMUTHS = {"warp": np.pi / 2, "weft": 0.0}
STEEPEST_DEG = 80
"""Steepest view of the drawn lobes: at grazing views a cloth can be so bright that nothing else would be seen."""
DISC = 168
"""Pixels along a side of a view disc."""
MODEL_NAMES = {
    "bard_linear": "BARD, linear",
    "bard_great_circle": "BARD, great circle",
    "bard_scaled": "BARD, best factor",
    "yarn_facets": "facets on yarns",
    "facets": "facet reading",
    "weave": "weave model",
    "ward": "Ward",
    "ashikhmin_shirley": "Ashikhmin-Shirley",
    "ggx": "anisotropic GGX",
}


def model_name(kind: str) -> str:
    """A model in words."""
    return MODEL_NAMES.get(kind, kind.replace("_", " "))


def reflection_section(cloth_brdf: Artifact | None, measured: Reflectances, region: str) -> Section | None:
    """Discs and lobes of the region's default model, beside the measured disc; a table of all models."""
    if cloth_brdf is None:
        return None
    models = ClothModels(cloth_brdf.folder)
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
    low = max(float(np.percentile(every, 2)), high / 3000, 1e-9)
    caption = "Lobes of the BRDF for light from the right; distance from the foot is the square root of the value."
    blocks: list[Block] = [
        "All views of the hemisphere, seen from above: the weft runs to the right, the warp upwards, distance from the "
        f"middle grows evenly with the angle from the normal. Model: {model_name(models.default)}.",
        Figures([Figure(name, "", disc_picture(part, inside, low, high)) for name, part in discs.items()], 3),
        Figures([
            Figure(f"Plane of the {plane}", caption, svg=lobes_plot(lobes(evaluate, azimuth)))
            for plane, azimuth in AZIMUTHS.items()
        ]),
    ]  # fmt: skip
    if models_of_region := (cloth_brdf.diagnostics.get("regions") or {}).get(region):
        blocks.append(table_of_models(models_of_region, models.default))
    return Section("lobes", "Reflection", blocks)


Lobe = tuple[str, np.ndarray, np.ndarray]
"""Label, angles from the normal in radians, values."""


def lobes(evaluate: Callable[[float, float, np.ndarray], np.ndarray], azimuth: float) -> list[Lobe]:
    """Lobes in the plane of the light at this azimuth. evaluate(degrees, azimuth, directions): the BRDF."""
    angle = np.radians(np.arange(-STEEPEST_DEG, STEEPEST_DEG + 1))
    along = np.stack([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)], axis=1)
    return [(f"light at {degrees}°", angle, evaluate(degrees, azimuth, along)) for degrees in INCIDENCES_DEG]


def light(degrees: float, azimuth: float) -> np.ndarray:
    """Unit vector (3,) towards a light."""
    theta = np.radians(degrees)
    return np.array([np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)])


def table_of_models(models: dict[str, dict], default: str) -> Table:
    """Reciprocity and albedo of each model, as the stage cloth_brdf reports them."""
    angles = sorted({angle for facts in models.values() for angle in facts.get("albedo_max") or {}}, key=float)
    names = sorted(models, key=lambda name: (name != default, name))
    rows = []
    for name in names:
        albedo = models[name].get("albedo_max") or {}
        values = [
            models[name].get("used"),
            models[name].get("reciprocity_error"),
            *(albedo.get(angle) for angle in angles),
        ]
        rows.append([model_name(name), *values])
    spans = (("", 3), ("albedo by incidence", len(angles)))
    return Table(
        ("model", "used", "reciprocity error", *(f"{angle}°" for angle in angles)), rows, "lrr" + "r" * len(angles),
        "All models: how many measurements their fit used; difference of light and view exchanged, relative (0: "
        "reciprocal); share of the light that they reflect in all, the greatest over warp, bias and weft (above 1: not "
        "possible).",
        spans if angles else (), marked={names.index(default)} if default in names else (),
    )  # fmt: skip


def disc_directions(size: int = DISC) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (n, 3) of the pixels inside a disc of views seen from above, and the mask (size, size).

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
    """Logarithmic picture of values (n,) at the pixels of a disc; white outside."""
    table, picture = heat(), np.full((*inside.shape, 3), 255, np.uint8)
    logs = np.log10(np.maximum(values, 1e-12))
    picture[inside] = coloured(logs[None], table, np.log10(low), np.log10(high))[0]
    stops = tuple(hexadecimal(colour) for colour in table[:: 255 // 5])
    return encoded(picture, lossless=True, scale=Scale(f"{low:.2g}", f"{high:.2g}", "1/sr, logarithmic", stops))


def lobes_plot(parts: list[Lobe], *, width: int = 520, height: int = 330) -> str:
    """Half-plane polar diagram of lobes; one scale for all.

    The distance from the foot is the square root of the value, so that weak lobes beside strong ones still show.
    """
    middle, foot, radius = width / 2, height - 42, min(width / 2 - 24, height - 70)
    top = max([float(values.max(initial=0)) for _, _, values in parts] or [0.0])
    drawing = Drawing(width, height, "lobes of the BRDF in the plane of the light")
    for r in radius * np.array([0.25, 0.5, 0.75, 1.0]):
        arc = f"M{middle - r:.1f} {foot:.1f}A{r:.1f} {r:.1f} 0 0 1 {middle + r:.1f} {foot:.1f}"
        drawing.path(arc, stroke=GRID)
    for degrees in (-60, -30, 0, 30, 60):
        x, y = radius * np.sin(np.radians(degrees)), radius * np.cos(np.radians(degrees))
        drawing.line(middle, foot, middle + x, foot - y, GRID)
        text = f"{abs(degrees)}°"
        drawing.text(middle + 1.06 * x, foot - 1.06 * y, text, anchor="middle", size=11, colour=SOFT)
    drawing.line(middle - radius, foot, middle + radius, foot, SOFT)
    for k, (label, angle, values) in enumerate(parts):
        r = radius * np.sqrt(np.maximum(values, 0) / top) if top > 0 else 0 * values
        colour = PALETTE[k % len(PALETTE)]
        line = outline(middle + r * np.sin(angle), foot - r * np.cos(angle))
        drawing.path(line, fill=colour, opacity=0.1, stroke=colour, width=1.8)
        at = 12 + k * (width - 24) / max(1, len(parts))
        drawing.line(at, height - 10, at + 18, height - 10, colour)
        drawing.text(at + 23, height - 6, label, size=11)
    return drawing.finish()
