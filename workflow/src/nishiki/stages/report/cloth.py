"""Cloth report: one page on a cloth, from the artifacts of all other stages; its section on the weave."""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.artifacts.stage import Context
from nishiki.report import page
from nishiki.report.pictures import PagePicture, encode_picture, file_picture
from nishiki.report.scene_page import SLIGHT, Head, SceneData, at, headline, write_scene_page
from nishiki.report.svg import INK, PALETTE, ChartCurve, chart, figure, percent
from nishiki.stages.report import cloth_reflection
from nishiki.stages.report.capture import FACTS, export_section
from nishiki.stages.table import chain_of


def run(context: Context) -> dict:
    """Collect the sections that this scene has, and write the page."""
    data = SceneData(context)
    samples, capture = data.diagnostics["goniometer_samples"], data.diagnostics.get("ingest") or {}
    region = cloth_reflection.drawn_region(data)
    head = Head(
        title=at(capture, "capture", "title"),
        about="a cloth measured with a goniometer",
        facts=facts(samples, capture),
        tiles=at_a_glance(samples, data.evaluation, region),
        verdict=cloth_headline(samples, data.evaluation, region),
        warnings=[*(capture.get("warnings") or []), *(samples.get("warnings") or [])],
    )
    return write_scene_page(data, chain_of("goniometer"), head, SECTIONS)


def held_out_errors(evaluation: dict[str, Any], region: str) -> dict[str, dict[str, Any]]:
    """Return the errors of a region's default model on directions that no fit used, by incidence."""
    return at(evaluation, "regions", region, "models", evaluation.get("default", ""), "held_out", "by_incidence") or {}


def at_a_glance(samples: dict[str, Any], evaluation: dict[str, Any], region: str) -> list[page.Metric]:
    """List the most important figures. samples : diagnostics of goniometer_samples; evaluation : evaluation.json."""
    tiles = [page.Metric(samples["directions"], "", "pairs of directions measured")]
    for angle, part in held_out_errors(evaluation, region).items():
        if angle in ("30", "60"):
            text = f"error at {angle}° incidence, {cloth_reflection.model_name(evaluation['default'])}"
            tiles.append(page.Metric(100 * part["rms_rel"], "%", text))
    if samples.get("noise_relative") is not None:
        tiles.append(page.Metric(100 * samples["noise_relative"], "%", "noise of a measurement, median"))
    return tiles


CLOTH_ERROR = 0.15  # relative error on directions left out from which a cloth's gloss looks different


def cloth_headline(samples: dict[str, Any], evaluation: dict[str, Any], region: str) -> list[tuple[str, str]]:
    """Return the headline of a cloth; samples : diagnostics of goniometer_samples; evaluation : evaluation.json."""
    error, noise = cloth_reflection.mean_error(held_out_errors(evaluation, region)), samples.get("noise_relative")
    left_out = f"directions that no fit used are predicted with a mean error of {100 * (error or 0):.0f} %"
    noisy = f"half of the measurements have a noise below {figure(100 * (noise or 0), 2)} %"
    saturated = samples.get("saturated") or 0
    cut = f"{saturated} measurements are saturated: the gloss is cut off"
    along = "measure one set of views with the light along the normal"
    untested = "no direction was left out to test the others"
    advice = [
        (samples.get("normal_incidence") == 0, "nothing was lit along the normal", along),
        (saturated > 0, cut, "measure the brightest directions again with a shorter exposure"),
        (error is None, untested, "run cloth_evaluate, with a second plane of light"),
        (noise is None, "the noise of a measurement is not known", "measure some directions twice"),
    ]
    return headline([(error, CLOTH_ERROR, left_out), (noise, SLIGHT, noisy)], advice)


def rendered_section(data: SceneData) -> page.PageSection:
    """Return the rendered pictures by kind: under each light, in each dye, and others."""
    render = data.inputs["cloth_render"]
    groups: dict[str, list[page.Figure]] = {"lights": [], "dyes": [], "others": []}
    diagnostics = render.diagnostics
    for name in diagnostics["pictures"]:
        group, heading, caption = words(name)
        groups[group].append(
            page.Figure(heading, caption, file_picture(render.path(f"{name}.png").read_bytes(), data.widest))
        )
    model = ", ".join(
        filter(None, (cloth_reflection.model_name(diagnostics.get("model", "")), diagnostics.get("region")))
    )
    from_file = at(diagnostics, "surface", "kind") == "file"
    shown = (
        "A surface from a file, covered with the cloth" if from_file else "A square of the cloth that fell over a ball"
    )
    blocks: list[page.Block] = [
        f"{shown}; its weft is followed over every fold, and what each point sends to the eye is computed with the "
        f"fitted reflection (model: {model})."
    ]
    lights, dyes = len(groups["lights"]) - 1, len(groups["dyes"])
    if groups["lights"]:
        heading = page.Heading(f"From {lights} light{'s' * (lights > 1)}", "in the cloth's own colour")
        blocks += [heading, page.Figures(groups["lights"], 3)]
    if groups["dyes"]:
        blocks += [
            page.Heading(f"In {dyes} dye{'s' * (dyes > 1)}", "the same gloss over each"),
            page.Figures(groups["dyes"], 3),
        ]
    blocks += [page.Figures(groups["others"]), *page.film_and_notes(render, "The film", data.settings.video_mb)]
    return page.PageSection("rendered", "The cloth", blocks)


def words(name: str) -> tuple[str, str, str]:
    """Return group, heading and caption of a picture."""
    if name.startswith("drape-dye-"):
        return "dyes", name.removeprefix("drape-dye-").capitalize(), ""
    if name.startswith("drape-light-"):
        return "lights", f"Light {name.removeprefix('drape-light-')} alone", ""
    if name == "drape":
        return "lights", "All lights", ""
    if name == "cylinders":
        return "others", "On cylinders", "the warp upright, oblique, and around."
    return "others", name.replace("-", " ").capitalize(), ""


def coverage_section(data: SceneData) -> page.PageSection:
    """Return the drawing, and a row for each direction of light."""
    samples = data.inputs["goniometer_samples"]
    blocks: list[page.Block] = ["Views that were measured for each direction of light."]
    caption = "Each disc is one direction of light; dots are views seen from above, the weft to the right."
    drawing = samples.path("coverage.svg").read_text()
    rows = [
        (
            *(f"{figure(row[name])}°" for name in ("theta_deg", "phi_deg")),
            *(row["views"], row["unusable"], percent(100 * row["covered"])),
            *(f"{figure(row[name])}°" for name in ("gap_deg", "steepest_deg")),
        )
        for row in json.loads(samples.path("reflectance.json").read_text())["coverage"]
    ]
    head = ("θi", "φi", "views", "unusable", "covered", "widest gap", "steepest view")
    blocks += [
        page.Figures([page.Figure("Coverage", caption, svg=drawing)], 1),
        page.Fold("Coverage", f"{len(rows)} directions of light", [page.Table(head, rows, "rrrrrrr")]),
    ]
    return page.PageSection("coverage", "Measurements", blocks)


def facts(diagnostics: dict[str, Any], capture: dict[str, Any]) -> list[tuple[str, str]]:
    """List label and text of each fact on the measurements; capture : diagnostics of ingest, if there are any."""
    about = capture.get("capture") or {}
    rows = [(label, str(about[key])) for key, label in FACTS if about.get(key)]
    directions, along = diagnostics["directions"], diagnostics["normal_incidence"]
    measured = f"{directions} pairs of directions, {diagnostics['incidences']} of light; {along} with the light along "
    kinds = {"quarter": "two mirror planes", "half": "half a turn", "none": "none"}
    symmetry, tried = kinds[diagnostics["symmetry"]], diagnostics["symmetry_errors"]
    if tried and len(tried) > 1:
        errors = ", ".join(f"{kinds[name]} {percent(100 * error)}" for name, error in tried.items())
        symmetry += f", chosen by the error of left-out views: {errors}"
    elif tried is not None:
        symmetry += ", assumed: the views are too few to compare symmetries"
    return [
        *rows,
        ("Measured", measured + "the normal"),
        ("Cloths", ", ".join(diagnostics["regions"])),
        ("Channels", ", ".join(diagnostics["channels"])),
        ("Symmetry", symmetry),
        ("Weave", diagnostics["weave"]),
    ]


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


def weave_section(data: SceneData) -> page.PageSection | None:
    """Return every region of weave.json."""
    weave = data.inputs["weave"]
    regions = (page.read_json(weave, "weave.json") or {}).get("regions") or {}
    blocks: list[page.Block] = []
    for name, entry in regions.items():
        suffix = f"_{name}" if len(regions) > 1 else ""
        if suffix:
            blocks.append(page.Heading(name))
        items = drawings(weave, entry, suffix, "section", "Cut through the middle of a yarn.")
        if picture := page.contents(weave, f"weave{suffix}.png"):
            caption = "As fitted, from above: the weft runs to the right."
            items.append(page.Figure("The surface", caption, tile_picture(picture, data.widest // 2)))
        blocks += [summary(entry), page.Figures(items)]
        published: list[page.Block] = []
        if rows := parameters(at(weave.diagnostics, "regions", name) or {}, entry.get("at_bounds") or []):
            caption = (
                f"The sections of Takeda and Tanaka, with confidence intervals "
                f"({round(100 * weave.settings['confidence'])} %). Lengths are known up to a common scale."
            )
            published.append(page.Table(("parameter", "value", "from", "to", "meaning"), rows, "lrrrw", caption))
        curves = [curve(entry["curves"][plane], plane) for plane in PLANES if plane in entry["curves"]]
        published += [page.Figures(curves), *notes(entry)]
        published.insert(0, page.Figures(drawings(weave, entry, suffix, "published", None)))
        blocks.append(yarn_table(entry["yarns"], weave.settings["confidence"]))
        weft, warp = (f"{100 * entry['rms_rel'][plane]:.1f} %" for plane in PLANES)
        text = f"the sections leave {weft} unexplained in the plane of the weft and {warp} in that of the warp"
        blocks.append(page.Fold("The published model: smooth sections", text, published))
    return page.PageSection("weave", "Weave", blocks) if blocks else None


def drawings(weave: Artifact, entry: dict[str, Any], suffix: str, kind: str, caption: str | None) -> list[page.Figure]:
    """Return the drawings of both planes; caption: instead of the main numbers of the published section."""
    return [
        page.Figure(f"Section along the {plane}", caption or section_words(entry[plane]), svg=drawing.decode())
        for plane in PLANES
        if (drawing := page.contents(weave, f"{kind}_{plane}{suffix}.svg"))
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
    return encode_picture(codes[..., ::-1])


def summary(entry: dict[str, Any]) -> str:
    """Describe the fit in a few sentences: the weave, and its certainty."""
    yarns = entry["yarns"]
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


def section_words(section: dict[str, float]) -> str:
    """Format the main numbers of a section."""
    text = f"flanks at {np.degrees(section['theta_a']):.1f}°"
    if "n" not in section:
        return f"{text}."
    yarns = round(section["n"], 1)
    return f"{text}, single yarns." if yarns == 1 else f"{text}, {yarns:.2g} yarns side by side."


def yarn_table(yarns: dict[str, Any], confidence: float) -> page.Table:
    """Tabulate the weave of elliptical yarns with intervals; no value for undetermined numbers."""
    rows: list[list[page.Cell]] = []
    for name, words in YARN_MEANINGS.items():
        number = yarns["parameters"][name]
        ends: list[page.Cell] = [number["low"], number["high"]]
        rows.append([words, number["value"] if number["determined"] else "not determined", *ends])
    caption = (
        f"The weave of elliptical yarns with confidence intervals ({round(100 * confidence)} %), over all weaves that "
        "fit about as well; they hold if the yarns are elliptical and alike. Slopes are those of the surface visible "
        "from above. Where the measurements add nothing to the general experience of cloths, the interval states that."
    )
    return page.Table(("", "value", "from", "to"), rows, "wrrr", caption)


def parameters(region: dict[str, Any], at_bounds: Sequence[str] = ()) -> list[list[page.Cell]]:
    """List name, value, ends of the interval and meaning of each parameter of a region's sections."""
    rows: list[list[page.Cell]] = []
    for name, value in (region.get("parameters") or {}).items():
        stem, _, plane = name.rpartition("_")
        kind, where = (stem, f", {plane}") if plane in PLANES else (name, "")
        low, high = (region.get("intervals") or {}).get(name) or (None, None)
        factor = 180 / np.pi if kind in ANGLES else 1.0
        values: list[page.Cell] = [None if v is None else factor * v for v in (value, low, high)]
        meaning = MEANINGS[kind] + where if kind in MEANINGS else ""
        rows.append([name, *values, meaning + "; ended at a bound: not determined" * (name in at_bounds)])
    return rows


def curve(values: dict[str, Any], plane: str) -> page.Figure:
    """Draw measured and fitted reflectance of one plane."""
    angle, measured, gloss, body = (np.array(values[name]) for name in ("theta_r_deg", "measured", "gloss", "body"))
    curves = [
        ChartCurve("interpolated" if values["interpolated"] else "measured", angle, measured, colour=INK, dots=True),
        ChartCurve("fitted", angle, gloss + body),
        ChartCurve("of which from within", angle, body, colour=PALETTE[1], dashed=True),
    ]
    svg = chart(curves, x_label="view, degrees", y_label="BRDF, 1/sr", title=f"reflectance in the plane of the {plane}")
    return page.Figure(f"Plane of the {plane}", "light along the normal.", svg=svg)


def notes(entry: dict[str, Any]) -> list[str]:
    """List what the data do not determine of the sections, by the names of the table's parameters."""
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


SECTIONS = (
    ("cloth_render", rendered_section),
    ("weave", weave_section),
    ("cloth_brdf", cloth_reflection.reflection_section),
    ("cloth_evaluate", cloth_reflection.errors_section),
    ("cloth_evaluate", cloth_reflection.curves_section),
    ("goniometer_samples", coverage_section),
    ("cloth_export", export_section),
)
"""Sections of the page in their order, each with the stage without which it is left out."""
