"""Report: one page on a painting, from the artifacts of all other stages."""

from typing import Any

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.artifacts.maps import Maps, shrink
from nishiki.artifacts.stage import Context
from nishiki.evaluate.camera_colour import read_camera_colour
from nishiki.observations.plane import Observations
from nishiki.report.page import (
    MOST_PICTURES,
    Block,
    Cell,
    Figure,
    Figures,
    Metric,
    Section,
    Table,
    film,
    film_and_notes,
    read_json,
)
from nishiki.report.pictures import Ruler, block_of, class_picture, file_picture, ruler
from nishiki.report.scene_page import SLIGHT, Head, headline, text, write_scene_page
from nishiki.report.svg import PALETTE, Curve, chart, plain
from nishiki.stages.report.capture import capture_section, export_section, facts_of_painting, kind_of
from nishiki.stages.report.mosaic import LAMPS_OF_FIELDS, mosaic_head, mosaic_section
from nishiki.stages.report.painting_prediction import part_name, relighting_section, worst_level, worst_part
from nishiki.stages.report.painting_surface import PageMaps, colour_section, shape_section
from nishiki.stages.table import CHAIN

NO_TRUTH = (
    "No truth was given, so errors are known only where lights were kept from the fits{}. Truth can be given for "
    "normals, height, reflectance and the colours under check lights, as an .npz or a truth.zarr in the column truth "
    "of the scene table (docs/stages/evaluate.md, formats of truth)."
)


def run(context: Context) -> dict:
    """Collect the sections that this scene has, and write the page."""
    inputs, settings = context.inputs, context.settings
    widest = settings.picture_columns
    diagnostics = {name: artifact.diagnostics for name, artifact in inputs.items()}
    frames = Observations(inputs["ingest"].folder)
    maps = {name: Maps(artifact.folder) for name, artifact in inputs.items() if artifact.path("maps.zarr").is_dir()}
    evaluation = read_json(inputs.get("evaluate"), "evaluation.json")
    scale_bar = ruler(frames.shape[1], frames.pixel_pitch_mm)
    held_out = inputs["normals"].settings.get("hold_out", [])
    kinds = [kind_of(name, role, held_out) for name, role in zip(frames.lights, frames.roles, strict=True)]
    names = finish_names(diagnostics["normals"].get("finishes") or [])
    relighting = relighting_section(inputs.get("evaluate"), maps.get("evaluate"), evaluation, widest, names)
    truth = evaluation or {}
    camera = read_camera_colour(inputs["ingest"].path("curves.npz"), len(frames.channels), frames.to_srgb)
    page = PageMaps(maps, frames.mask, frames.pixel_pitch_mm, truth, widest, scale_bar)
    title, tiles = diagnostics["ingest"]["capture"]["title"], at_a_glance(diagnostics, evaluation)
    if mosaic := inputs.get("mosaic"):
        head, captured = mosaic_head(title, mosaic.diagnostics, page, tiles), mosaic_section(mosaic, page, camera)
    else:
        head = Head(
            title=title,
            about=f"digitised from {len(frames.lights)} photographs, each under another light",
            facts=facts_of_painting(diagnostics["ingest"], list(frames.channels), frames.pixel_pitch_mm, kinds),
            tiles=tiles,
            verdict=verdict(diagnostics, evaluation, frames, guessed=camera.rmse is None),
        )
        captured = capture_section(
            diagnostics["ingest"], lights=list(frames.lights), kinds=kinds, directions=frames.directions
        )
    return write_scene_page(
        context,
        CHAIN,
        head,
        [
            appearance_section(inputs.get("render"), widest, settings.video_mb, scale_bar),
            relighting,
            shape_section(page, diagnostics["normals"]),
            colour_section(
                page, camera=camera, expected_de00=diagnostics.get("spectra", {}).get("expected_de00") or {}
            ),
            gloss_section(
                read_json(inputs.get("brdf"), "parameters.json"),
                finishes=finishes_of(page, diagnostics["normals"].get("finishes") or []),
                names=names,
            ),
            captured,
            export_section(inputs.get("export")),
        ],
        more_left_out=[
            *([LAMPS_OF_FIELDS] if mosaic else []),
            *(
                []
                if any(truth.get(name) for name in ("normals", "height", "reflectance"))
                else [NO_TRUTH.format("" if relighting else "; none were")]
            ),
        ],
        more_made=[choices({name: artifact.settings for name, artifact in inputs.items()})],
    )


INTRODUCTION = (
    "What is left of the observations after the diffuse part is taken off, over the angle between the normal and the "
    "half vector of light and view. A Torrance-Sparrow lobe is fitted to it; where the dots leave the curve at large "
    "angles, the true gloss has longer tails than the model."
)
LINEAR = "Dots: measured, faint where few samples met; line: fitted."
LOGARITHMIC = "The tails: what lies above the line here is gloss that the lobe lacks."
FLAGS = {"AT_BOUND": "width at its bound", "NOT_CONVERGED": "not converged"}
"""Descriptions of a fit's flags (`nishiki.brdf.fit`)."""


GLOSSY_DEG, SATIN_DEG = 6.0, 13.0
"""Largest half widths of the facets of a finish named glossy, and satin."""


def finish_names(finishes: list[dict[str, Any]]) -> list[str]:
    """Name every finish of the diagnostics of `normals` by its gloss, alike ones with a number."""
    names = []
    for finish in finishes:
        beta, gamma = (np.array(finish.get(name) or [0.0]) for name in ("gloss_beta", "gloss_gamma_deg"))
        phi = np.linspace(0, 90, 1801)
        profile = np.exp2(-((phi[:, None] / np.maximum(gamma, 1e-9)) ** 2)) @ beta
        half = float(phi[profile >= 0.5 * profile[0]].max())
        shiny = "glossy" if half < GLOSSY_DEG else "satin" if half < SATIN_DEG else "sheen"
        name = shiny if beta.any() and finish.get("gloss_counts", True) else "matt"
        if finish["joint"] and "gloss_colour" in finish:
            colour = finish["gloss_colour"]
            name = "gilding" if len(colour) == 3 and colour[0] >= colour[1] > colour[2] else "metal"
        names.append(name)
    return [f"{name} {names[: k + 1].count(name)}" if names.count(name) > 1 else name for k, name in enumerate(names)]


def finishes_of(page: PageMaps, finishes: list[dict[str, Any]]) -> list[Block]:
    """Return the map of the finishes and their figures; nothing where one explains the painting."""
    if len(finishes) < 2 or "finish" not in page.maps["normals"]:
        return []
    names = finish_names(finishes)
    block = block_of(page.mask.shape[1], page.widest)
    maps = page.maps["normals"]
    labels = shrink(
        lambda rows: np.where(page.mask[rows], maps.read("finish", rows), -1), page.mask.shape, block, "middle"
    )
    key = {k: (PALETTE[k % len(PALETTE)], name) for k, name in enumerate(names)}
    rows: list[list[Cell]] = [
        [
            name,
            100 * finish["share"],
            finish.get("gloss_transmission"),
            "from the selected lights"
            if not finish["joint"]
            else "together with the gloss"
            if finish.get("gloss_beta")
            else "from all lights, no gloss",
            finish["left_out_de00"].get("joint" if finish["joint"] else "plain"),
        ]
        for name, finish in zip(names, finishes, strict=True)
    ]
    head = ("Finish", "share, %", "loss at the surface", "normals", "ΔE00 of captured lamps left out")
    caption = (
        "Finishes: share of the painting, part of a smooth surface's loss that the body suffers, fit of the normals."
    )
    figures = Figures(
        [Figure("Finishes", "where each was found, by its fit.", class_picture(labels, key), ruler=page.ruler)]
    )
    return [figures, Table(head, rows, "lrrlr", caption)]


def gloss_section(
    parameters: dict[str, Any] | None,
    *,
    finishes: list[Block] | None = None,
    names: list[str] | None = None,
) -> Section | None:
    """Write the section on gloss; None where no gloss was fitted.

    parameters : parameters.json of the stage brdf; finishes : their map and figures; names : of the regions.
    """
    if parameters is None:
        return None
    rows: list[list[Cell]] = []
    charts: list[Figure] = []
    for number, region in enumerate(parameters["regions"]):
        name = f"region {number}" if len(parameters["regions"]) > 1 else "whole scene"
        name = names[number] if names and len(names) == len(parameters["regions"]) > 1 else name
        flags = ", ".join(FLAGS.get(flag, flag) for flag in region.get("flags") or []) or "–"
        rest = (region["refractive_index"], region.get("samples"), region.get("residual"), flags)
        for lobe, (beta, gamma) in enumerate(zip(region["beta"], region["gamma"], strict=True), 1):
            rows.append([name, lobe, beta, gamma, None if gamma is None else float(np.degrees(gamma)), *rest])
        if region.get("profile") and len(charts) < MOST_PICTURES:
            charts += _profile_charts(region["profile"], name)
    head = ("Region", "lobe", "β", "γ, rad", "γ, degrees", "n", "samples", "residual", "flags")
    caption = (
        "Torrance-Sparrow parameters: strength β relative to the white reference, half width at half maximum γ, "
        "refractive index n."
    )
    blocks: list[Block] = [*(finishes or []), INTRODUCTION, Figures(charts), Table(head, rows, "lrrrrrrrl", caption)]
    return Section("gloss", "Gloss", blocks)


def _profile_charts(profile: dict[str, Any], name: str) -> list[Figure]:
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
        Curve("measured", phi, value, PALETTE[0], dots=True, strength=np.where(phi <= reach, strength, 0)),
        # the fit is blurred by each row's own uncertainty of the normals: a line through firm rows only
        Curve("fitted lobe", phi[firm], fitted[firm], PALETTE[1]),
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
    return [Figure(heading, LINEAR, svg=linear), Figure(f"{heading}, logarithmic", LOGARITHMIC, svg=logarithmic)]


def appearance_section(render: Artifact | None, widest: int, video_mb: float, ruler: Ruler | None) -> Section | None:
    """Return pictures of at most `widest` pixels across, None without any; ruler : below those seen from the front."""
    if render is None:
        return None
    reported, pictures = render.diagnostics["pictures"], render.settings["pictures"]
    items = []
    for entry in pictures[:MOST_PICTURES]:
        exposure = exposed(reported[entry["name"]]["exposure"], chosen=entry["exposure"] == "auto")
        picture = file_picture(render.path(f"{entry['name']}.png").read_bytes(), widest)
        scale = ruler if entry["view"]["kind"] == "frontal" else None
        items.append(Figure(in_words(entry["name"]), f"{describe(entry)} {exposure}", picture, ruler=scale))
    intro = (
        "Pictures computed from the record, under lights that need not have been there. They show the object as an eye "
        "adapted to the light would see it: white balance by the lamp, exposure by the picture (each caption states "
        "it). The EXR files hold the linear values."
    )
    if render.diagnostics.get("balanced_by_object"):
        intro += " Without a white board the light parts of the object are taken as grey and as light."
    blocks: list[Block] = [intro, Figures(items)]
    for entry in render.settings["sequences"]:
        facts = reported[entry["name"]]
        moves = f"The {entry['moves']} goes round at {entry['elevation_deg']:g}° above the plane."
        caption = f"{moves} {exposed(facts['exposure'], chosen=True)}"
        blocks.append(film(render, facts["file"], in_words(entry["name"]), caption, video_mb))
    if more := [f"render/{render.key}/{entry['name']}.png" for entry in pictures[MOST_PICTURES:]]:
        blocks.append(f"Also made: {', '.join(more)}.")
    return Section("appearance", "Appearance", [*blocks, *film_and_notes(render, "", video_mb)])


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


def exposed(exposure: float, *, chosen: bool) -> str:
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


def choices(settings: dict[str, dict[str, Any]]) -> Table:
    """Tabulate, for each step with a published choice: the method run, and whether it was the published one.

    settings : stage name -> its settings, of the stages that ran.
    """
    rows = []
    for (stage, name), (paper, step, meaning) in PAPER_CHOICES.items():
        if name in settings.get(stage, {}):
            ran = str(settings[stage][name])
            published = " (the published one)" if ran == paper else ""
            rows.append((step, f"{ran}{published}", f"{stage}.{name}", f"{paper}: {meaning}"))
    return Table(
        ("Step", "ran", "setting", "published choice"), rows, "llll",
        "Which method ran where the published one can be chosen as well. Only what ran is in this page; to see the "
        "other, give the scene table a second row with that setting.",
    )  # fmt: skip


def expected_angle(normals: dict[str, Any], height: dict[str, Any] | None) -> float | None:
    """Return the median expected error of a normal, degrees: measured by the integration where that was done."""
    return (height or {}).get("expected_error_median_deg", normals.get("sigma_median_deg"))


def at_a_glance(diagnostics: dict[str, dict[str, Any]], evaluation: dict[str, Any] | None) -> list[Metric]:
    """List the most important figures; diagnostics : of the stages; evaluation : evaluation.json or None."""
    normals, evaluation = diagnostics["normals"], evaluation or {}
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
    return [Metric(value, unit, meaning) for value, unit, meaning in tiles if value is not None]


VISIBLE, PLAIN = 2.0, 5.0
"""Colour differences (CIEDE2000) visible to most people, and to everybody."""
FEW_LAMPS = 8  # that a headline warns of


def verdict(
    diagnostics: dict[str, dict[str, Any]], evaluation: dict[str, Any] | None, frames: Observations, *, guessed: bool
) -> list[tuple[str, str]]:
    """State merits and doubts of a painting's record, and its most effective improvement.

    diagnostics : of the stages; guessed : whether the colours of the camera's channels are a guess.
    """
    normals, good, doubtful = diagnostics["normals"], [], []
    names = finish_names(normals.get("finishes") or [])
    error = evaluation["overall"]["de00"]["mean"] if evaluation and evaluation.get("lights") else None
    if parts := (evaluation or {}).get("parts"):
        error = worst_part(parts)["de00"]["mean"]  # the worst finish decides
        for part in parts:
            light = worst_level(part)
            if abs(light["level_error"]) > SLIGHT:
                side = "bright" if light["level_error"] > 0 else "dark"
                doubtful.append(
                    f"{part_name(part, names)} is predicted {100 * abs(light['level_error']):.0f} % too {side} under a "
                    f"lamp {light['incidence_deg']:.0f}° from the normal"
                )
    if error is not None:
        words = (
            "hardly visible" if error < VISIBLE else "visible beside each other" if error < PLAIN else "plain to see"
        )
        text = f"photographs that no fit used are predicted with errors that are at most {words} (ΔE00 {error:.1f})"
        (good if error < PLAIN else doubtful).append(text)
    sigma = expected_angle(normals, diagnostics.get("height"))
    if sigma is not None and not (evaluation or {}).get("normals"):
        (good if sigma < VISIBLE else doubtful).append(
            f"half of the normals are expected within {sigma:.1f}° of the true ones"
        )
    if len(names) > 1:
        shares = [f"{name} {100 * part['share']:.0f} %" for name, part in zip(names, normals["finishes"], strict=True)]
        good.append(f"{len(names)} finishes were found and fitted apart ({', '.join(shares)})")
    missing = 1 - normals["valid_pixels"] / max(normals["object_pixels"], 1)
    if missing > SLIGHT:
        doubtful.append(f"{100 * missing:.0f} % of the object has no estimate")
    lamps = len(frames.lights)
    advice = [
        (
            not frames.white_board,
            "no white board: colours and brightness are relative",
            "photograph an even white or grey card in place of the object, once under every lamp (--white)",
        ),
        (
            lamps < FEW_LAMPS,
            f"{lamps} lamps are few: gloss and shadows are hard to tell apart",
            "photograph under twelve lamps or more, all round and at two elevations",
        ),
        (guessed, "colours of the camera are a guess", "photograph a colour target and run ./nishiki calibrate target"),
        (
            not frames.pixel_pitch_mm,
            "no scale: heights and lengths are in pixels",
            "measure the width of the photographs on the object (--width-mm)",
        ),
    ]
    return headline(good, doubtful, advice)
