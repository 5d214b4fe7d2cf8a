"""Cloth report: one page on a cloth, from the artifacts of all other stages."""

import json
from typing import Any

from nishiki.artifacts.artifact import Artifact
from nishiki.artifacts.stage import Context
from nishiki.goniometry.table import Reflectances
from nishiki.report.numbers import figure, percent
from nishiki.report.page import (
    Block,
    Figure,
    Figures,
    Fold,
    Heading,
    Metric,
    Section,
    Table,
    film_and_notes,
    read_json,
)
from nishiki.report.pictures import file_picture
from nishiki.report.scene_page import Head, write_scene_page
from nishiki.stages.report.capture import FACTS, export_section
from nishiki.stages.report.cloth_reflection import curves_section, errors_section, model_name, reflection_section
from nishiki.stages.report.headline import cloth_headline
from nishiki.stages.report.weave import weave_section
from nishiki.stages.table import chain_of


def run(context: Context) -> dict:
    """Collect the sections that this scene has, and write the page."""
    inputs, settings = context.inputs, context.settings
    diagnostics = {name: artifact.diagnostics for name, artifact in inputs.items()}
    samples, capture = diagnostics["goniometer_samples"], diagnostics.get("ingest") or {}
    measured = Reflectances(inputs["goniometer_samples"].folder)
    region = settings.region or measured.regions[0]
    evaluation = read_json(inputs.get("cloth_evaluate"), "evaluation.json")
    widest = settings.picture_columns
    head = Head(
        title=(capture.get("capture") or {}).get("title"),
        about="a cloth measured with a goniometer",
        facts=facts(samples, capture),
        tiles=at_a_glance(samples, evaluation, region),
        verdict=cloth_headline(samples, evaluation, region),
        warnings=[*(capture.get("warnings") or []), *(samples.get("warnings") or [])],
    )
    return write_scene_page(
        context,
        chain_of("goniometer"),
        head,
        [
            rendered_section(inputs.get("cloth_render"), widest, settings.video_mb),
            weave_section(inputs.get("weave"), widest // 2),
            reflection_section(inputs.get("cloth_brdf"), measured, region),
            errors_section(evaluation),
            curves_section(evaluation, region),
            coverage_section(inputs["goniometer_samples"]),
            export_section(inputs.get("cloth_export")),
        ],
    )


def at_a_glance(samples: dict[str, Any], evaluation: dict[str, Any] | None, region: str) -> list[Metric]:
    """List the figures that matter most. samples : diagnostics of goniometer_samples; evaluation : evaluation.json."""
    tiles = [Metric(samples["directions"], "", "pairs of directions measured")]
    if evaluation is not None:
        default = evaluation["default"]
        entry = evaluation["regions"].get(region, {}).get("models", {}).get(default) or {}
        for angle, part in (entry.get("held_out", {}).get("by_incidence") or {}).items():
            if angle in ("30", "60"):
                text = f"error at {angle}° incidence, {model_name(default)}"
                tiles.append(Metric(100 * part["rms_rel"], "%", text))
    if samples.get("noise_relative") is not None:
        tiles.append(Metric(100 * samples["noise_relative"], "%", "noise of a measurement, median"))
    return tiles


def rendered_section(render: Artifact | None, widest: int, video_mb: float) -> Section | None:
    """Return pictures of at most `widest` pixels across; None where there are none."""
    if render is None:
        return None
    groups: dict[str, list[Figure]] = {"lights": [], "dyes": [], "others": []}
    diagnostics = render.diagnostics
    for name in diagnostics["pictures"]:
        group, heading, caption = words(name)
        groups[group].append(Figure(heading, caption, file_picture(render.path(f"{name}.png").read_bytes(), widest)))
    model = ", ".join(filter(None, (model_name(diagnostics.get("model", "")), diagnostics.get("region"))))
    from_file = (diagnostics.get("surface") or {}).get("kind") == "file"
    shown = (
        "A surface from a file, covered with the cloth" if from_file else "A square of the cloth that fell over a ball"
    )
    blocks: list[Block] = [
        f"{shown}; its weft is followed over every fold, and what each point sends to the eye is computed with the "
        f"fitted reflection (model: {model})."
    ]
    lights, dyes = len(groups["lights"]) - 1, len(groups["dyes"])
    if groups["lights"]:
        heading = Heading(f"From {lights} light{'s' * (lights > 1)}", "in the cloth's own colour")
        blocks += [heading, Figures(groups["lights"], 3)]
    if groups["dyes"]:
        blocks += [Heading(f"In {dyes} dye{'s' * (dyes > 1)}", "the same gloss over each"), Figures(groups["dyes"], 3)]
    blocks += [Figures(groups["others"]), *film_and_notes(render, "The film", video_mb)]
    return Section("rendered", "The cloth", blocks)


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


def coverage_section(samples: Artifact) -> Section:
    """Return the drawing, and a row for each direction of light."""
    blocks: list[Block] = ["Views that were measured for each direction of light."]
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
        Figures([Figure("Coverage", caption, svg=drawing)], 1),
        Fold("Coverage", f"{len(rows)} directions of light", [Table(head, rows, "rrrrrrr")]),
    ]
    return Section("coverage", "Measurements", blocks)


def facts(diagnostics: dict[str, Any], capture: dict[str, Any]) -> list[tuple[str, str]]:
    """Label and text of what is known of the measurements; capture : diagnostics of ingest, if there are any."""
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
