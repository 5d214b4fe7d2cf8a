"""Drawings of a cloth's page: errors against incidence, curves in the plane of the light, polar lobes, view discs."""

from __future__ import annotations

import numpy as np

from nishiki.report.colour_map import coloured, heat, hexadecimal
from nishiki.report.pictures import PagePicture, Scale, encoded
from nishiki.report.svg import GRID, PALETTE, SOFT, Curve, _line, _open, _text, chart

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
DISC = 168
"""Pixels along a side of a view disc."""


def model_name(kind: str) -> str:
    """A model in words."""
    return MODEL_NAMES.get(kind, kind.replace("_", " "))


def colours_of(models: list[str], default: str) -> dict[str, str]:
    """A colour for each model; the default one has the first."""
    ordered = [default] * (default in models) + [model for model in models if model != default]
    return {model: PALETTE[k % len(PALETTE)] for k, model in enumerate(ordered)}


def error_chart(models: dict[str, dict], default: str) -> str:
    """Relative error against the light's incidence, one line a model; values above 1.5 leave the drawing."""
    colours = colours_of(list(models), default)
    curves, top = [], 0.0
    for model, found in models.items():
        points = sorted((float(angle), part["rms_rel"]) for angle, part in found.items())
        if points:
            x, y = np.array(points).T
            top = max(top, float(y.max()))
            dashed = model != default
            curves.append(Curve(model_name(model), x, y, colour=colours[model], dashed=dashed))
            curves.append(Curve("", x, y, colour=colours[model], dots=True))
    if not curves:
        return ""
    ends = [x for curve in curves for x in (curve.x.min(), curve.x.max())]
    room = (min(ends) - 2, max(ends) + 2 + 0.4 * (max(ends) - min(ends)))  # the legend stands on the right
    return chart(
        curves, x_label="incidence, degrees", y_label="relative RMS error", title="error against incidence",
        x_range=room, y_range=(0.0, min(1.5, 1.1 * top)), width=640, height=340,
    )  # fmt: skip


def plane_chart(curve: dict, models: list[str], default: str) -> str:
    """Measured values as dots, predicted ones as lines, over the view's angle in the plane of the light."""
    colours = colours_of(models, default)
    angle, measured = np.array(curve["theta_r_deg"]), np.array(curve["measured"])
    predicted = {model: np.array(curve["predicted"][model]) for model in models if model in curve["predicted"]}
    lines = [
        Curve(model_name(model), angle, values, colour=colours[model], dashed=model != default)
        for model, values in predicted.items()
    ]
    dots = Curve("measured", angle, measured, colour="#22262b", dots=True)
    top = max(1.6 * float(measured.max()), 1e-6)
    return chart(
        [dots, *lines], x_label="view, degrees from the normal; the light is on the right", y_label="BRDF, 1/sr",
        title="measured and predicted in the plane of the light", y_range=(0.0, top), x_range=(-90, 90), height=260,
    )  # fmt: skip


def lobes_plot(lobes: list[tuple[str, np.ndarray, np.ndarray]], *, width: int = 520, height: int = 330) -> str:
    """Half-plane polar diagram of lobes: (label, angle from the normal in radians, value); one scale for all.

    The distance from the foot is the square root of the value, so that weak lobes beside strong ones still show.
    """
    middle, foot, radius = width / 2, height - 42, min(width / 2 - 24, height - 70)
    top = max([float(values.max(initial=0)) for _, _, values in lobes] or [0.0])
    parts = [_open(width, height, "lobes of the BRDF in the plane of the light")]
    for share in (0.25, 0.5, 0.75, 1.0):
        r = radius * share
        parts.append(
            f'<path d="M{middle - r:.1f} {foot:.1f}A{r:.1f} {r:.1f} 0 0 1 {middle + r:.1f} {foot:.1f}" fill="none" '
            f'stroke="{GRID}"/>'
        )
    for degrees in (-60, -30, 0, 30, 60):
        x, y = radius * np.sin(np.radians(degrees)), radius * np.cos(np.radians(degrees))
        parts.append(_line(middle, foot, middle + x, foot - y, GRID))
        at = (middle + 1.06 * x, foot - 1.06 * y)
        parts.append(_text(*at, f"{abs(degrees)}°", anchor="middle", size=11, colour=SOFT))
    parts.append(_line(middle - radius, foot, middle + radius, foot, SOFT))
    for k, (label, angle, values) in enumerate(lobes):
        r = radius * np.sqrt(np.maximum(values, 0) / top) if top > 0 else 0 * values
        x, y = middle + r * np.sin(angle), foot - r * np.cos(angle)
        path = "".join(f"{'L' if n else 'M'}{a:.1f} {b:.1f}" for n, (a, b) in enumerate(zip(x, y, strict=True)))
        colour = PALETTE[k % len(PALETTE)]
        parts.append(f'<path d="{path}" fill="{colour}" fill-opacity="0.10" stroke="{colour}" stroke-width="1.8"/>')
        at = 12 + k * (width - 24) / max(1, len(lobes))
        parts.append(_line(at, height - 10, at + 18, height - 10, colour))
        parts.append(_text(at + 23, height - 6, label, size=11))
    return "".join([*parts, "</svg>"])


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
