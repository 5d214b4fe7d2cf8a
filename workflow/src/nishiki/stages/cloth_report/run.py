"""Cloth report: one page on a cloth, from the artifacts of all other stages."""

from typing import Any

from nishiki.artifacts.stage import Context
from nishiki.goniometry.store import Reflectances
from nishiki.report.files import read_json
from nishiki.report.page import Tile
from nishiki.report.scene_page import write_scene_page
from nishiki.stages.cloth_brdf.report import model_name, reflection_section
from nishiki.stages.cloth_evaluate.report import curves_section, errors_section
from nishiki.stages.cloth_render.report import rendered_section
from nishiki.stages.export.report import export_section
from nishiki.stages.goniometer_samples.report import coverage_section, facts
from nishiki.stages.table import chain_of
from nishiki.stages.weave.report import weave_section


def run(context: Context) -> dict:
    """Collect the sections that this scene has, and write the page."""
    inputs, settings = context.inputs, context.settings
    diagnostics = {name: artifact.diagnostics for name, artifact in inputs.items()}
    samples, capture = diagnostics["goniometer_samples"], diagnostics.get("ingest") or {}
    measured = Reflectances(inputs["goniometer_samples"].folder)
    region = settings.region or measured.regions[0]
    evaluation = read_json(inputs.get("cloth_evaluate"), "evaluation.json")
    widest = settings.picture_columns
    return write_scene_page(
        context,
        chain_of("goniometer"),
        title=(capture.get("capture") or {}).get("title"),
        about="a cloth measured with a goniometer",
        facts=facts(samples, capture),
        tiles=at_a_glance(samples, evaluation, region),
        sections=[
            rendered_section(inputs.get("cloth_render"), widest, settings.video_mb),
            weave_section(inputs.get("weave"), widest // 2),
            reflection_section(inputs.get("cloth_brdf"), measured, region),
            errors_section(evaluation),
            curves_section(evaluation, region),
            coverage_section(inputs["goniometer_samples"]),
            export_section(inputs.get("cloth_export")),
        ],
        warnings=[*(capture.get("warnings") or []), *(samples.get("warnings") or [])],
    )


def at_a_glance(samples: dict[str, Any], evaluation: dict[str, Any] | None, region: str) -> list[Tile]:
    """The figures that matter most. samples : diagnostics of goniometer_samples; evaluation : evaluation.json."""
    tiles = []
    if samples.get("directions") is not None:
        tiles.append(Tile(samples["directions"], "", "pairs of directions measured"))
    if evaluation is not None:
        default = evaluation["default"]
        entry = evaluation["regions"].get(region, {}).get("models", {}).get(default) or {}
        for angle, part in (entry.get("held_out", {}).get("by_incidence") or {}).items():
            if angle in ("30", "60"):
                text = f"error at {angle}° incidence, {model_name(default)}"
                tiles.append(Tile(100 * part["rms_rel"], "%", text))
    if samples.get("noise_relative") is not None:
        tiles.append(Tile(100 * samples["noise_relative"], "%", "noise of a measurement, median"))
    return tiles
