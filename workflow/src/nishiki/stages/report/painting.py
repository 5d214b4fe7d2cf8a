"""Report: one page on a painting, from the artifacts of all other stages."""

import json
from typing import Any

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.observations.plane import Observations
from nishiki.report import page
from nishiki.report.pictures import class_picture, file_picture
from nishiki.report.scene_page import SLIGHT, Head, headline, text, write_scene_page
from nishiki.report.svg import PALETTE, ChartCurve, chart, plain
from nishiki.stages.report.capture import capture_section, export_section, facts_of_painting
from nishiki.stages.report.mosaic import LAMPS_OF_FIELDS, mosaic_head, mosaic_section
from nishiki.stages.report.painting_prediction import part_name, relighting_section, worst_level, worst_part
from nishiki.stages.report.painting_surface import PaintingData, colour_section, finish_names, shape_section
from nishiki.stages.table import CHAIN

NO_TRUTH = (
    "No truth was given, so errors are known only where lights were kept from the fits{}. Truth can be given for "
    "normals, height, reflectance and the colours under check lights, as an .npz or a truth.zarr in the column truth "
    "of the scene table (docs/stages/evaluate.md, formats of truth)."
)


def run(context: Context) -> dict:
    """Collect the sections that this scene has, and write the page."""
    data = PaintingData(context)
    title, tiles = data.diagnostics["ingest"]["capture"]["title"], at_a_glance(data.diagnostics, data.evaluation)
    if "mosaic" in data.inputs:
        head = mosaic_head(title, data.diagnostics["mosaic"], data, tiles)
    else:
        head = Head(
            title=title,
            about=f"digitised from {len(data.kinds)} photographs, each under another light",
            facts=facts_of_painting(data.diagnostics["ingest"], list(data.frames.channels), data.pitch, data.kinds),
            tiles=tiles,
            verdict=verdict(data.diagnostics, data.evaluation, data.frames, guessed=data.camera.rmse is None),
        )
    left_out = [LAMPS_OF_FIELDS] if "mosaic" in data.inputs else []
    if not any(data.evaluation.get(name) for name in ("normals", "height", "reflectance")):
        left_out.append(NO_TRUTH.format("" if data.evaluation.get("lights") else "; none were"))
    made = choices({name: artifact.settings for name, artifact in data.inputs.items()})
    return write_scene_page(data, CHAIN, head, SECTIONS, more_left_out=left_out, more_made=[made])


INTRODUCTION = (
    "What is left of the observations after the diffuse part is taken off, over the angle between the normal and the "
    "half vector of light and view. A Torrance-Sparrow lobe is fitted to it; where the dots leave the curve at large "
    "angles, the true gloss has longer tails than the model."
)
LINEAR = "Dots: measured, faint where few samples met; line: fitted."
LOGARITHMIC = "The tails: what lies above the line here is gloss that the lobe lacks."
FLAGS = {"AT_BOUND": "width at its bound", "NOT_CONVERGED": "not converged"}
"""Descriptions of a fit's flags in `parameters.json`."""


def finishes_of(data: PaintingData) -> list[page.Block]:
    """Return the map of the finishes and their figures; nothing where one explains the painting."""
    finishes, names = data.finishes, data.names
    if len(finishes) < 2 or "finish" not in data.maps["normals"]:
        return []
    maps = data.maps["normals"]
    labels = data.small(lambda rows: np.where(data.mask[rows], maps.read("finish", rows), -1), "middle")
    key = {k: (PALETTE[k % len(PALETTE)], name) for k, name in enumerate(names)}
    rows: list[list[page.Cell]] = []
    for name, finish in zip(names, finishes, strict=True):
        how = "together with the gloss" if finish.get("gloss_beta") else "from all lights, no gloss"
        how = how if finish["joint"] else "from the selected lights"
        error = finish["left_out_de00"].get("joint" if finish["joint"] else "plain")
        rows.append([name, 100 * finish["share"], finish.get("gloss_transmission"), how, error])
    head = ("Finish", "share, %", "loss at the surface", "normals", "ΔE00 of captured lamps left out")
    caption = (
        "Finishes: share of the painting, part of a smooth surface's loss that the body suffers, fit of the normals."
    )
    figures = page.Figures(
        [page.Figure("Finishes", "where each was found, by its fit.", class_picture(labels, key), ruler=data.ruler)]
    )
    return [figures, page.Table(head, rows, "lrrlr", caption)]


def gloss_section(data: PaintingData) -> page.PageSection:
    """Write the section on gloss."""
    parameters = json.loads(data.inputs["brdf"].path("parameters.json").read_text())
    return page.PageSection("gloss", "Gloss", [*finishes_of(data), *gloss_blocks(parameters["regions"], data.names)])


def gloss_blocks(regions: list[dict[str, Any]], names: list[str]) -> list[page.Block]:
    """Return profiles and lobes of the regions of parameters.json; names : of the finishes."""
    rows: list[list[page.Cell]] = []
    charts: list[page.Figure] = []
    for number, region in enumerate(regions):
        name = f"region {number}" if len(regions) > 1 else "whole scene"
        name = names[number] if len(names) == len(regions) > 1 else name
        flags = ", ".join(FLAGS.get(flag, flag) for flag in region.get("flags") or []) or "–"
        rest = (region["refractive_index"], region.get("samples"), region.get("residual"), flags)
        for lobe, (beta, gamma) in enumerate(zip(region["beta"], region["gamma"], strict=True), 1):
            rows.append([name, lobe, beta, gamma, None if gamma is None else float(np.degrees(gamma)), *rest])
        if region.get("profile") and len(charts) < page.MOST_PICTURES:
            charts += _profile_charts(region["profile"], name)
    head = ("Region", "lobe", "β", "γ, rad", "γ, degrees", "n", "samples", "residual", "flags")
    caption = (
        "Torrance-Sparrow parameters: strength β relative to the white reference, half width at half maximum γ, "
        "refractive index n."
    )
    return [INTRODUCTION, page.Figures(charts), page.Table(head, rows, "lrrrrrrrl", caption)]


def _profile_charts(profile: dict[str, Any], name: str) -> list[page.Figure]:
    """Draw the profile with linear and with logarithmic strength."""
    order = np.argsort(profile["phi"], kind="stable")
    phi = np.degrees(np.array(profile["phi"], float)[order])
    value, fitted, count = (np.array(profile[key], float)[order] for key in ("value", "fitted", "count"))
    peak = float(np.nanmax(fitted, initial=0.0))
    if not (phi.size and peak > 0):
        return []
    # rows of few samples are noise: as many samples as a tenth of the median row give full ink
    strength = np.clip(np.sqrt(count / max(0.1 * float(np.median(count)), 1.0)), 0.08, 0.8)
    reach = max(10.0, 2.0 * float(phi[fitted > 0.005 * peak].max(initial=0.0)))
    reach = min(reach, float(phi.max()))
    firm = (strength >= 0.5) & (phi <= reach)
    axes: dict[str, Any] = {
        "x_label": "angle φ between normal and half vector, degrees",
        "y_label": "specular part / (F G / cos θr)",
    }
    drawn = [
        ChartCurve("measured", phi, value, PALETTE[0], dots=True, strength=np.where(phi <= reach, strength, 0)),
        # the fit is blurred by each row's own uncertainty of the normals: a line through firm rows only
        ChartCurve("fitted lobe", phi[firm], fitted[firm], PALETTE[1]),
    ]
    linear = chart(
        drawn, title=f"specular profile of {name}", x_range=(0, reach), y_range=(-0.05 * peak, 1.05 * peak), **axes
    )
    top = 1.6 * peak
    logarithmic = chart(
        drawn,
        title=f"tails of the profile of {name}",
        x_range=(0, reach),
        y_range=(1e-4 * top, top),
        logarithmic=True,
        **axes,
    )
    heading = name.capitalize()
    return [
        page.Figure(heading, LINEAR, svg=linear),
        page.Figure(f"{heading}, logarithmic", LOGARITHMIC, svg=logarithmic),
    ]


def appearance_section(data: PaintingData) -> page.PageSection:
    """Return pictures and films; a scale bar is below those seen from the front."""
    render, video_mb = data.inputs["render"], data.settings.video_mb
    reported, pictures = render.diagnostics["pictures"], render.settings["pictures"]
    items = []
    for entry in pictures[: page.MOST_PICTURES]:
        exposure = describe_exposure(reported[entry["name"]]["exposure"], chosen=entry["exposure"] == "auto")
        picture = file_picture(render.path(f"{entry['name']}.png").read_bytes(), data.widest)
        scale = data.ruler if entry["view"]["kind"] == "frontal" else None
        items.append(page.Figure(in_words(entry["name"]), f"{describe(entry)} {exposure}", picture, ruler=scale))
    intro = (
        "Pictures computed from the record, under lights that need not have been there. They show the object as an eye "
        "adapted to the light would see it: white balance by the lamp, exposure by the picture (each caption states "
        "it). The EXR files hold the linear values."
    )
    if render.diagnostics.get("balanced_by_object"):
        intro += " Without a white board the light parts of the object are taken as grey and as light."
    blocks: list[page.Block] = [intro, page.Figures(items)]
    for entry in render.settings["sequences"]:
        facts = reported[entry["name"]]
        moves = f"The {entry['moves']} goes round at {entry['elevation_deg']:g}° above the plane."
        caption = f"{moves} {describe_exposure(facts['exposure'], chosen=True)}"
        blocks.append(page.film(render, facts["file"], in_words(entry["name"]), caption, video_mb))
    if more := [f"render/{render.key}/{entry['name']}.png" for entry in pictures[page.MOST_PICTURES :]]:
        blocks.append(f"Also made: {', '.join(more)}.")
    return page.PageSection("appearance", "Appearance", [*blocks, *page.film_and_notes(render, "", video_mb)])


def photographs_section(data: PaintingData) -> page.PageSection | None:
    """Return the photographs and their lights; those of a mosaic belong to its fields."""
    if "mosaic" in data.inputs:
        return None
    frames = data.frames
    return capture_section(
        data.diagnostics["ingest"], lights=list(frames.lights), kinds=data.kinds, directions=frames.directions
    )


def in_words(name: str) -> str:
    """Return the name of a picture as a heading."""
    return name.replace("-", " ").capitalize()


def describe(picture: dict[str, Any]) -> str:
    """Return lights and view of a picture in words."""
    lights = [f"{light['illuminant']} from {_place(light)}" for light in picture["lights"]]
    view = picture["view"]
    seen = "seen from the front" if view["kind"] == "frontal" else f"seen from {_place(view)}"
    ambient = f", ambient {text(picture['ambient'])}" if picture["ambient"] else ""
    return f"{' and '.join(lights) or 'no lamp'}{ambient}, {seen}."


def describe_exposure(exposure: float, *, chosen: bool) -> str:
    """Describe the exposure in a caption; chosen: from the picture itself."""
    why = ", chosen from the picture" if chosen else ""
    return f"Exposure {plain(exposure, 2)}{why} (1: a white that faces the lamp is white)."


def _place(direction: dict[str, Any]) -> str:
    return f"{direction['elevation_deg']:g}° above the plane, azimuth {direction['azimuth_deg']:g}°".replace("-", "−")


PAINTINGS = "Tominaga and Tanaka 2004"
PAPER_CHOICES = {
    ("separate", "method"): ("threshold", "selection of the lights", f"thresholds w1, w2 ({PAINTINGS}, section 3.2)"),
    ("normals", "solver"): ("least_squares", "normals", f"plain least squares ({PAINTINGS}, section 3.3)"),
    ("normals", "refine"): ("none", "normals and gloss together", "one after the other"),
    ("spectra", "method"): ("paper", "spectra", f"three bases and matrix inverse ({PAINTINGS}, eq. 8)"),
}


def choices(settings: dict[str, dict[str, Any]]) -> page.Table:
    """Tabulate, for each step with a published choice: the method run, and whether it was the published one.

    settings : stage name -> its settings, of the stages that ran.
    """
    rows = []
    for (stage, name), (paper, step, meaning) in PAPER_CHOICES.items():
        if name in settings.get(stage, {}):
            ran = str(settings[stage][name])
            published = " (the published one)" if ran == paper else ""
            rows.append((step, f"{ran}{published}", f"{stage}.{name}", f"{paper}: {meaning}"))
    return page.Table(
        ("Step", "ran", "setting", "published choice"), rows, "llll",
        "Which method ran where the published one can be chosen as well. Only what ran is in this page; to see the "
        "other, give the scene table a second row with that setting.",
    )  # fmt: skip


def expected_angle(normals: dict[str, Any], height: dict[str, Any] | None) -> float | None:
    """Return the median expected error of a normal, degrees: measured by the integration where that was done."""
    return (height or {}).get("expected_error_median_deg", normals.get("sigma_median_deg"))


def at_a_glance(diagnostics: dict[str, dict[str, Any]], evaluation: dict[str, Any]) -> list[page.Metric]:
    """List the most important figures; diagnostics : of the stages; evaluation : evaluation.json."""
    normals = diagnostics["normals"]
    tiles: list[tuple[float | None, str, str]] = []
    if lights := evaluation.get("lights"):
        overall, photographs = evaluation["overall"]["de00"], f"{len(lights)} photograph{'s' * (len(lights) > 1)}"
        guessed = (evaluation.get("colour") or {}).get("rmse_xyz") is None
        lamp = "colours taken as under D65" if guessed else "under the lamp of the capture"
        tiles.append((overall["mean"], "ΔE00", f"mean colour error of {photographs} that no fit used, {lamp}"))
        tiles.append((overall["p90"], "ΔE00", "colour error that nine of ten pixels stay below"))
        if evaluation["parts"]:
            part = worst_part(evaluation["parts"])
            name = part_name(part, finish_names(normals.get("finishes") or []))
            tiles.append((part["de00"]["mean"], "ΔE00", f"mean of the part that is predicted worst: {name}"))
    if angles := evaluation.get("normals"):
        tiles.append((angles["estimated"]["mean"], "°", "mean angle of the normals to the truth"))
    else:
        expected = expected_angle(normals, diagnostics.get("height"))
        tiles.append((expected, "°", "median expected error of a normal"))
    if reflectance := evaluation.get("reflectance"):
        error = reflectance["de00"]["D65"]["mean"]
        tiles.append((error, "ΔE00", "mean colour difference of the reflectance to the truth, D65"))
    elif colour_error := (diagnostics.get("spectra") or {}).get("expected_de00"):
        words = "expected mean colour error under daylight (D65) by the spectra alone: level and gloss as they are"
        tiles.append((colour_error["D65"], "ΔE00", words))
    if (height := evaluation.get("height")) and height["rms"] is not None:
        words = f"rms error of the height; the relief itself has {1000 * height['relief_rms']:.0f} µm"
        tiles.append((1000 * height["rms"], "µm", words))
    if count := normals.get("object_pixels"):
        tiles.append((100 * normals["valid_pixels"] / count, "%", "of the object's pixels have a normal"))
    return [page.Metric(value, unit, meaning) for value, unit, meaning in tiles if value is not None]


VISIBLE, PLAIN = 2.0, 5.0
"""Colour differences (CIEDE2000) visible to most people, and to everybody."""
FEW_LAMPS = 8  # that a headline warns of


def verdict(
    diagnostics: dict[str, dict[str, Any]], evaluation: dict[str, Any], frames: Observations, *, guessed: bool
) -> list[tuple[str, str]]:
    """State merits and doubts of a painting's record, and its most effective improvement.

    diagnostics : of the stages; guessed : whether the colours of the camera's channels are a guess.
    """
    normals = diagnostics["normals"]
    names = finish_names(normals.get("finishes") or [])
    error = evaluation["overall"]["de00"]["mean"] if evaluation.get("lights") else None
    measured: list[tuple[float | None, float, str]] = []
    if parts := evaluation.get("parts"):
        error = worst_part(parts)["de00"]["mean"]  # the worst finish decides
        for part in parts:
            light = worst_level(part)
            level = light["level_error"]
            if abs(level) > SLIGHT:
                side = f"{100 * abs(level):.0f} % too {'bright' if level > 0 else 'dark'}"
                lamp = f"under a lamp {light['incidence_deg']:.0f}° from the normal"
                measured.append((abs(level), SLIGHT, f"{part_name(part, names)} is predicted {side} {lamp}"))
    if error is not None:
        words = "hardly visible" if error < VISIBLE else "visible beside each other"
        words = words if error < PLAIN else "plain to see"
        text = f"photographs that no fit used are predicted with errors that are at most {words} (ΔE00 {error:.1f})"
        measured.append((error, PLAIN, text))
    sigma = expected_angle(normals, diagnostics.get("height"))
    if sigma is not None and not evaluation.get("normals"):
        measured.append((sigma, VISIBLE, f"half of the normals are expected within {sigma:.1f}° of the true ones"))
    if len(names) > 1:
        shares = [f"{name} {100 * part['share']:.0f} %" for name, part in zip(names, normals["finishes"], strict=True)]
        measured.append((0, 1, f"{len(names)} finishes were found and fitted apart ({', '.join(shares)})"))
    missing = 1 - normals["valid_pixels"] / max(normals["object_pixels"], 1)
    if missing > SLIGHT:
        measured.append((missing, SLIGHT, f"{100 * missing:.0f} % of the object has no estimate"))
    lamps = len(frames.lights)
    board = "photograph an even white or grey card in place of the object, once under every lamp (--white)"
    more = "photograph under twelve lamps or more, all round and at two elevations"
    target = "photograph a colour target and run ./nishiki calibrate target"
    width = "measure the width of the photographs on the object (--width-mm)"
    return headline(measured, [
        (not frames.white_board, "no white board: colours and brightness are relative", board),
        (lamps < FEW_LAMPS, f"{lamps} lamps are few: gloss and shadows are hard to tell apart", more),
        (guessed, "colours of the camera are a guess", target),
        (not frames.pixel_pitch_mm, "no scale: heights and lengths are in pixels", width),
    ])  # fmt: skip


SECTIONS = (
    ("render", appearance_section),
    ("evaluate", relighting_section),
    ("normals", shape_section),
    ("normals", colour_section),
    ("brdf", gloss_section),
    ("mosaic", mosaic_section),
    ("ingest", photographs_section),
    ("export", export_section),
)
"""Sections of the page in their order, each with the stage without which it is left out."""
