"""The section of a cloth's page on its weave: cross-sections, parameters with their intervals, the fit."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.report.page import Block, Cell, Figure, Figures, Fold, Heading, Section, Table, contents, read_json
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
YARN_MEANINGS = {
    "mean_slope_weft": "mean slope in the plane of the weft, degrees",
    "p90_slope_weft": "slope in the plane of the weft that a tenth of the surface exceeds, degrees",
    "mean_slope_warp": "mean slope in the plane of the warp, degrees",
    "p90_slope_warp": "slope in the plane of the warp that a tenth of the surface exceeds, degrees",
    "weft_share": "share of the face that is weft",
    "spacing_ratio": "spacing of the weft yarns over that of the warp yarns",
    "fill_warp": "width of a warp yarn over its spacing",
    "fill_weft": "width of a weft yarn over its spacing",
    "aspect_warp": "thickness of a warp yarn over its width",
    "aspect_weft": "thickness of a weft yarn over its width",
    "crimp": "share of the warp in how far the yarns bend",
    "bend": "length on which a yarn changes sides, in spacings",
    "arch": "rise of a float over its length",
    "rough_along_warp": "roughness of the warp along its fibres",
    "rough_across_warp": "roughness of the warp across its fibres",
    "rough_along_weft": "roughness of the weft along its fibres",
    "rough_across_weft": "roughness of the weft across its fibres",
}
ANGLES = ("theta_a", "contact")
PLANES = ("weft", "warp")


def weave_section(weave: Artifact | None, widest: int) -> Section | None:
    """Return every region of weave.json; None where no weave was fitted."""
    if weave is None:
        return None
    regions = (read_json(weave, "weave.json") or {}).get("regions") or {}
    blocks: list[Block] = []
    for name, entry in regions.items():
        suffix = f"_{name}" if len(regions) > 1 else ""
        if suffix:
            blocks.append(Heading(name))
        yarns = entry.get("yarns")
        items = drawings(weave, entry, suffix, "section", "Cut through the middle of a yarn." if yarns else None)
        if data := contents(weave, f"weave{suffix}.png"):
            caption = "As fitted, from above: the weft runs to the right."
            items.append(Figure("The surface", caption, tile_picture(data, widest)))
        blocks += [summary(entry), Figures(items)]
        published: list[Block] = []
        if rows := parameters((weave.diagnostics.get("regions") or {}).get(name) or {}, entry.get("at_bounds") or []):
            caption = (
                f"The sections of Takeda and Tanaka, with confidence intervals "
                f"({round(100 * weave.settings['confidence'])} %). Lengths are known up to a common scale."
            )
            published.append(Table(("parameter", "value", "from", "to", "meaning"), rows, "lrrrw", caption))
        curves = [curve(entry["curves"][plane], plane) for plane in PLANES if plane in entry["curves"]]
        published += [Figures(curves), *notes(entry)]
        if yarns:
            blocks.append(yarn_table(yarns, weave.settings["confidence"]))
            published.insert(0, Figures(drawings(weave, entry, suffix, "published", None)))
            blocks.append(Fold("The published model: smooth sections", unexplained(entry), published))
        else:
            blocks += published
    return Section("weave", "Weave", blocks) if blocks else None


def drawings(weave: Artifact, entry: dict[str, Any], suffix: str, kind: str, caption: str | None) -> list[Figure]:
    """Return the drawings of both planes; caption: instead of the main numbers of the published section."""
    return [
        Figure(f"Section along the {plane}", caption or section_words(entry[plane]), svg=drawing.decode())
        for plane in PLANES
        if (drawing := contents(weave, f"{kind}_{plane}{suffix}.svg"))
    ]


def tile_picture(data: bytes, widest: int) -> PagePicture:
    """Crop a PNG of a repeating surface to about as high as wide: a long repeat would fill the page."""
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
    """Return the fit in a few sentences: what it says of the weave, and how sure that is."""
    yarns = entry.get("yarns")
    if yarns is None:
        at_end = set(entry.get("at_bounds") or [])
        weave = entry["weave"]
        name = "plain weave" if weave == "plain" else f"{weave} of {entry['harness']} yarns a repeat"
        if at_end & SECTION_UNKNOWNS:
            first = f"The reflectance does not determine the weave: the sections of a {name} ended at a bound."
        else:
            first = f"Sections of a {name}, from the reflectance in the planes of weft and warp."
        left = unexplained(entry)
        return f"{first} {left[0].upper()}{left[1:]}."
    if not yarns["determined"]:
        return (
            f"The reflectance does not determine the weave: at normal incidence it varies by "
            f"{100 * yarns['variation']:.1f} % with the view, of which elliptical yarns leave "
            f"{100 * yarns['rms_rel']:.1f} % unexplained. Surface and "
            f"sections are those of the most likely weave, a {yarns['alike'][0]}."
        )
    best, *others = yarns["alike"]
    first = (
        f"Of {len(yarns['ranking'])} weaves of elliptical yarns that were fitted to the reflectance over the "
        f"hemisphere, a {best} explains it best; it leaves {100 * yarns['rms_rel']:.1f} % unexplained."
    )
    if others:
        first += f" The measurements do not tell it from {' or '.join(f'a {other}' for other in others)}."
    return first


def unexplained(entry: dict[str, Any]) -> str:
    """Return what the published sections leave of the reflectance, in words."""
    errors = entry["rms_rel"]
    weft, warp = (f"{100 * errors[plane]:.1f} %" for plane in PLANES)
    return f"the sections leave {weft} unexplained in the plane of the weft and {warp} in that of the warp"


SECTION_UNKNOWNS = {f"{name}_{plane}" for name in ("theta_a", "flank", "humps") for plane in PLANES}


def section_words(section: dict[str, float]) -> str:
    """Return main numbers of a section."""
    text = f"flanks at {np.degrees(section['theta_a']):.1f}°"
    if "n" not in section:
        return f"{text}."
    yarns = round(section["n"], 1)
    return f"{text}, single yarns." if yarns == 1 else f"{text}, {yarns:.2g} yarns side by side."


def yarn_table(yarns: dict[str, Any], confidence: float) -> Table:
    """Return every number of the weave of elliptical yarns with its interval; no value where nothing tells it."""
    rows: list[list[Cell]] = []
    for name, words in YARN_MEANINGS.items():
        number = yarns["parameters"][name]
        ends: list[Cell] = [number["low"], number["high"]]
        rows.append([words, number["value"] if number["determined"] else "not determined", *ends])
    caption = (
        f"The weave of elliptical yarns with confidence intervals ({round(100 * confidence)} %), which hold if its "
        "yarns are elliptical and alike. Slopes are those of what is seen from above. Where the measurements tell no "
        "more than is known of any cloth, the interval is that knowledge."
    )
    return Table(("", "value", "from", "to"), rows, "wrrr", caption)


def parameters(region: dict[str, Any], at_bounds: Sequence[str] = ()) -> list[list[Cell]]:
    """Name, value, ends of the interval and meaning of each parameter of the sections, from a region's diagnostics."""
    rows: list[list[Cell]] = []
    for name, value in (region.get("parameters") or {}).items():
        stem, _, plane = name.rpartition("_")
        kind, where = (stem, f", {plane}") if plane in PLANES else (name, "")
        low, high = (region.get("intervals") or {}).get(name) or (None, None)
        factor = 180 / np.pi if kind in ANGLES else 1.0
        values: list[Cell] = [None if v is None else factor * v for v in (value, low, high)]
        meaning = MEANINGS[kind] + where if kind in MEANINGS else ""
        rows.append([name, *values, meaning + "; ended at a bound: not determined" * (name in at_bounds)])
    return rows


def curve(values: dict[str, Any], plane: str) -> Figure:
    """Measured and fitted reflectance of one plane."""
    angle, measured, gloss, body = (np.array(values[name]) for name in ("theta_r_deg", "measured", "gloss", "body"))
    curves = [
        Curve("interpolated" if values["interpolated"] else "measured", angle, measured, colour=INK, dots=True),
        Curve("fitted", angle, gloss + body),
        Curve("of which from within", angle, body, colour=PALETTE[1], dashed=True),
    ]
    svg = chart(curves, x_label="view, degrees", y_label="BRDF, 1/sr", title=f"reflectance in the plane of the {plane}")
    return Figure(f"Plane of the {plane}", "light along the normal.", svg=svg)


def notes(entry: dict[str, Any]) -> list[str]:
    """Return what the data cannot tell of the sections, by the names of the table's parameters."""
    identifiability = entry.get("identifiability") or {}
    texts = []
    free = identifiability.get("free") or []  # products of powers; of lengths alone, no common scale is ever known
    lengths = {"l", "r", "m"}
    others = [text for text in free if {each.split("^")[0].rpartition("_")[0] for each in text.split(" · ")} - lengths]
    if others:
        texts.append(f"The sections are the same for any value of {'; '.join(others)}.")
    pairs = list(zip(identifiability.get("weak") or [], identifiability.get("weak_error") or [], strict=True))
    if pairs:
        combinations = "; ".join(
            f"{name} ({'not determined' if error > 1 else f'to {100 * error:.2g} %'})" for name, error in pairs
        )
        texts.append(f"Least well determined in the sections, as one standard deviation: {combinations}.")
    if entry.get("at_bounds"):
        texts.append(f"Ended at a bound, so not determined: {', '.join(entry['at_bounds'])}.")
    return texts
