"""The section of a cloth's page on its weave: cross-sections, parameters with their intervals, the fit."""

from __future__ import annotations

from typing import Any

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.report.files import contents, read_json
from nishiki.report.page import Block, Cell, Figure, Figures, Heading, Section, Table
from nishiki.report.pictures import PagePicture, encoded
from nishiki.report.svg import INK, PALETTE, Curve, chart

MEANINGS = {
    "theta_a": "slope of the straight flanks, degrees",
    "l": "length of a flank",
    "r": "radius of the arcs",
    "m": "length of the flat top",
    "n": "yarns that lie side by side in a float",
    "contact": "steepest slope where yarns touch, degrees",
    "a": "width of the gloss",
    "index": "refractive index",
    "k_s": "strength of the gloss, mean of the channels",
    "k_d": "strength of the light from within, mean of the channels",
}
ANGLES = ("theta_a", "contact")
MOST_WEAK = 3
"""Combinations of parameters named as badly determined."""
PLANES = ("weft", "warp")


def weave_section(weave: Artifact | None, widest: int) -> Section | None:
    """Every region of weave.json; None where no weave was fitted."""
    regions = (read_json(weave, "weave.json") or {}).get("regions") or {}
    blocks: list[Block] = []
    for name, entry in regions.items():
        suffix = f"_{name}" if len(regions) > 1 else ""
        if suffix:
            blocks.append(Heading(name))
        items = []
        for plane in PLANES:
            if drawing := contents(weave, f"section_{plane}{suffix}.svg"):
                items.append(Figure(f"Section along the {plane}", section_words(entry[plane]), svg=drawing.decode()))
        if data := contents(weave, f"weave{suffix}.png"):
            caption = f"{entry['weave']}, as fitted, from above: the weft runs to the right."
            items.append(Figure("The surface", caption, tile_picture(data, widest)))
        blocks += [summary(entry), Figures(items)]
        if rows := parameters((weave.diagnostics.get("regions") or {}).get(name) or {}):
            caption = (
                f"Parameters with their confidence intervals ({round(100 * weave.settings['confidence'])} %). Lengths "
                "are known up to a common scale."
            )
            blocks.append(Table(("parameter", "value", "from", "to", "meaning"), rows, "lrrrw", caption))
        curves = [curve(entry["curves"][plane], plane) for plane in PLANES if plane in entry["curves"]]
        blocks += [Figures(curves), *notes(entry)]
    return Section("weave", "Weave", blocks) if blocks else None


def tile_picture(data: bytes, widest: int) -> PagePicture:
    """The upper part of a PNG of a repeating surface, about as high as wide: a long repeat would fill the page."""
    import cv2

    codes = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if codes is None:
        raise ValueError("not a picture")
    rows, columns = codes.shape[:2]
    codes = codes[: min(rows, columns)]
    if columns > widest:
        codes = cv2.resize(codes, (widest, round(len(codes) * widest / columns)), interpolation=cv2.INTER_AREA)
    return encoded(codes[..., ::-1])


def summary(entry: dict[str, Any]) -> str:
    """The fit in a sentence."""
    errors = entry["rms_rel"]
    return (
        f"A {entry['weave']} of {entry['harness']} yarns a repeat: cross-sections found from the reflectance in the "
        f"planes of weft and warp. What the fit leaves unexplained is {100 * errors['weft']:.1f} % of the reflectance "
        f"along the weft and {100 * errors['warp']:.1f} % along the warp."
    )


def section_words(section: dict[str, float]) -> str:
    """Main numbers of a section."""
    text = f"flanks at {np.degrees(section['theta_a']):.1f}°"
    return f"{text}, {section['n']:.2g} yarns side by side." if "n" in section else f"{text}."


def parameters(region: dict[str, Any]) -> list[list[Cell]]:
    """Name, value, ends of the interval and meaning of each parameter; told : diagnostics of a region."""
    rows: list[list[Cell]] = []
    for name, value in (region.get("parameters") or {}).items():
        stem, _, plane = name.rpartition("_")
        kind = stem if plane in PLANES else name
        low, high = (region.get("intervals") or {}).get(name) or (None, None)
        factor = 180 / np.pi if kind in ANGLES else 1.0
        meaning = MEANINGS.get(kind, "")
        meaning += f", {plane}" if plane in PLANES and meaning else ""
        rows.append([name, *(None if v is None else factor * v for v in (value, low, high)), meaning])
    return rows


def curve(values: dict[str, Any], plane: str) -> Figure:
    """Measured and fitted reflectance at normal incidence (or at the first incidence there is) of one plane."""
    theta_i, theta_r = np.array(values["theta_i_deg"]), np.array(values["theta_r_deg"])
    first = theta_i[np.argmin(np.abs(theta_i))] if len(theta_i) else 0.0
    rows = np.flatnonzero(np.abs(theta_i - first) < 0.5)
    rows = rows[np.argsort(theta_r[rows], kind="stable")]
    angle = theta_r[rows]
    measured, gloss, body = (np.array(values[name])[rows] for name in ("measured", "gloss", "body"))
    curves = [
        Curve("interpolated" if values["interpolated"] else "measured", angle, measured, colour=INK, dots=True),
        Curve("fitted", angle, gloss + body),
        Curve("of which from within", angle, body, colour=PALETTE[1], dashed=True),
    ]
    svg = chart(curves, x_label="view, degrees", y_label="BRDF, 1/sr", title=f"reflectance in the plane of the {plane}")
    return Figure(f"Plane of the {plane}", f"light at {abs(first):.0f}°.", svg=svg)


def notes(entry: dict[str, Any]) -> list[str]:
    """What the data cannot tell."""
    identifiability = entry.get("identifiability") or {}
    texts = []
    if identifiability.get("free"):
        texts.append(f"Not determined by measurements of this kind: {'; '.join(identifiability['free'])}.")
    pairs = list(zip(identifiability.get("weak") or [], identifiability.get("weak_error") or [], strict=True))[
        :MOST_WEAK
    ]
    if pairs:
        combinations = "; ".join(
            f"{name}: {'not determined' if error > 1 else f'to {100 * error:.2g} %'}" for name, error in pairs
        )
        texts.append(f"Least well determined combinations (one standard deviation): {combinations}.")
    if entry.get("at_bounds"):
        texts.append(f"At the end of their range: {', '.join(entry['at_bounds'])}.")
    return texts
