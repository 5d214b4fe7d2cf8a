"""Cloth report: one page on a cloth, from the artifacts of all other stages."""

import json

from nishiki.artifacts.artifact import Artifact
from nishiki.artifacts.stage import Context
from nishiki.goniometry.store import Reflectances
from nishiki.render.cloth.models import ClothModels
from nishiki.report import cloth_sections as sections
from nishiki.report.cloth_plots import model_name
from nishiki.report.cloth_weave import tile_picture, weave_section
from nishiki.report.conditions import conditions
from nishiki.report.left_out_section import left_out_section
from nishiki.report.page import render_page
from nishiki.report.pictures import data_uri, file_picture
from nishiki.report.provenance import stage_record
from nishiki.stages.table import CHAIN, LIMITS

ORDER = ("ingest", "goniometer_samples", "weave", "cloth_brdf", "cloth_render", "cloth_evaluate")


def run(context: Context) -> dict:
    """Collect the sections that this scene has, and write the page."""
    page = render_page(content_of(context), sections.TEMPLATE)
    context.output.path("report.html").write_text(page, encoding="utf-8")
    return {"bytes": len(page.encode()), "stages": sorted(context.inputs)}


def content_of(context: Context) -> dict:
    """Everything that the template names."""
    inputs, settings = context.inputs, context.settings
    told = {name: artifact.diagnostics for name, artifact in inputs.items()}
    measured = Reflectances(inputs["goniometer_samples"].folder)
    region = settings.region or measured.regions[0]
    evaluation = read_json(inputs.get("cloth_evaluate"), "evaluation.json")
    capture = told.get("ingest") or {}
    widest = settings.picture_columns
    return {
        "title": settings.title or (capture.get("capture") or {}).get("title") or context.stamp["scene"],
        "scene": context.stamp["scene"],
        "stamp": context.stamp,
        "facts": sections.facts(told["goniometer_samples"], capture),
        "warnings": [*(capture.get("warnings") or []), *(told["goniometer_samples"].get("warnings") or [])],
        "glance": sections.glance(told, evaluation, region),
        "rendered": rendered(inputs.get("cloth_render"), widest, settings.video_mb),
        "weave": weave(inputs.get("weave"), widest),
        "lobes": lobes(inputs.get("cloth_brdf"), measured, region),
        "models": models(inputs.get("cloth_brdf"), region),
        "errors": sections.errors_section(evaluation),
        "curves": sections.curves_section(evaluation, region),
        "coverage": {
            "svg": text_of(inputs["goniometer_samples"], "coverage.svg"),
            "rows": sections.coverage_rows(read_json(inputs["goniometer_samples"], "reflectance.json") or {}),
        },
        "left_out": left_out_section(settings.left_out, {name: told[name] for name in ORDER if name in told}),
        "conditions": conditions((inputs[name].manifest for name in ORDER if name in inputs), LIMITS),
        "records": records(inputs),
    }


def records(inputs: dict[str, Artifact]) -> list:
    """What the page says of each stage."""
    names = [name for name in ORDER if name in CHAIN and name in inputs]
    return [stage_record(inputs[name].manifest, CHAIN[name].settings, CHAIN[name].does) for name in names]


def contents(artifact: Artifact | None, name: str) -> bytes | None:
    """A file that the artifact lists; None where there is none."""
    if artifact is None or name not in artifact.manifest["files"]:
        return None
    return artifact.path(name).read_bytes()


def text_of(artifact: Artifact | None, name: str) -> str:
    """A text file that the artifact lists; empty where there is none."""
    data = contents(artifact, name)
    return "" if data is None else data.decode("utf-8")


def read_json(artifact: Artifact | None, name: str) -> dict | None:
    """A JSON file that the artifact lists; None where there is none."""
    data = contents(artifact, name)
    return None if data is None else json.loads(data)


def rendered(artifact: Artifact | None, widest: int, video_mb: float) -> dict:
    """Rendered pictures and the video."""
    found = {"lights": [], "dyes": [], "others": [], "film": None, "notes": [], "model": "", "region": ""}
    if artifact is None:
        return found
    told = artifact.diagnostics
    found |= {"model": model_name(told.get("model", "")), "notes": list(told.get("notes") or [])}
    for name in told.get("pictures") or {}:
        data = contents(artifact, f"{name}.png")
        if data is None:
            continue
        kind, heading, caption = words(name)
        found[kind].append({"picture": file_picture(data, widest), "name": heading, "caption": caption})
    video = told.get("video") or {}
    data = contents(artifact, video["file"]) if video.get("file") else None
    if data is not None:
        carried = len(data) <= video_mb * 1e6 and video["file"].endswith(".mp4")
        source = data_uri(data, "video/mp4") if carried else ""
        found["film"] = {
            "source": source,
            "file": f"cloth_render/{artifact.key}/{video['file']}",
            "frames": video["frames"],
        }
    return found


def words(name: str) -> tuple[str, str, str]:
    """Group, heading and caption of a picture."""
    if name.startswith("drape-dye-"):
        return "dyes", name.removeprefix("drape-dye-").capitalize(), ""
    if name.startswith("drape-light-"):
        return "lights", f"Light {name.removeprefix('drape-light-')} alone", ""
    if name == "drape":
        return "lights", "All lights", ""
    if name == "cylinders":
        return "others", "On cylinders", "the warp upright, oblique, and around."
    return "others", name.replace("-", " ").capitalize(), ""


def lobes(artifact: Artifact | None, measured: Reflectances, region: str) -> dict | None:
    """Lobes of the region's default model."""
    if artifact is None:
        return None
    found = ClothModels(artifact.folder)
    number = measured.regions.index(region)
    normal = None
    if measured.basic is not None:
        normal = lambda views: measured.basic.evaluate(views, number)  # noqa: E731
    return sections.lobes_section(found.brdf(region), normal, found.default)


def models(artifact: Artifact | None, region: str) -> dict | None:
    """What each model is as physics: reciprocity and the greatest albedo, as the stage cloth_brdf reports them."""
    told = {} if artifact is None else (artifact.diagnostics.get("regions") or {}).get(region) or {}
    return sections.models_section(told, artifact.diagnostics["default"]) if told else None


def weave(artifact: Artifact | None, widest: int) -> list[dict]:
    """Sections, surface and parameters of the weave."""
    if artifact is None:
        return []
    names = sorted(artifact.manifest["files"])
    drawings = {name: text_of(artifact, name) for name in names if name.endswith(".svg")}
    pictures = {name: tile_picture(contents(artifact, name), widest // 2) for name in names if name.endswith(".png")}
    stored, confidence = read_json(artifact, "weave.json") or {}, artifact.settings["confidence"]
    return weave_section(stored, artifact.diagnostics, drawings, pictures, confidence)
