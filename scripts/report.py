"""Report: one page that tells everything, from the artifacts of all other stages."""

import _project  # noqa: F401, I001

import json

from nishiki.chains.stages import CHAIN
from nishiki.contract.artifact import Artifact
from nishiki.contract.maps import Maps
from nishiki.contract.stage import Context, run_stage
from nishiki.evaluate.camera_colour import CameraColour, assumed_colour, fitted_colour
from nishiki.ingest.observations import Observations
from nishiki.normals.flags import NO_ESTIMATE
from nishiki.outside.stored import load_arrays
from nishiki.report.appearance_section import appearance_section
from nishiki.report.capture_section import capture_section
from nishiki.report.colour_section import colour_section
from nishiki.report.conditions import conditions
from nishiki.report.gloss_section import gloss_section
from nishiki.report.left_out_section import left_out_section
from nishiki.report.page import render_page
from nishiki.report.pictures import ruler
from nishiki.report.provenance import stage_record
from nishiki.report.relighting_section import relighting_section
from nishiki.report.shape_section import shape_section
from nishiki.report.summary import at_a_glance, choices
from nishiki.settings.report import ReportSettings
from nishiki.spectra.training import synthetic_reflectances


def run(context: Context) -> dict:
    """Collect the sections that this scene has, and write the page."""
    page = render_page(content_of(context))
    context.output.path("report.html").write_text(page, encoding="utf-8")
    return {"bytes": len(page.encode()), "stages": sorted(context.inputs)}


def content_of(context: Context) -> dict:
    """Everything that the template names."""
    inputs, settings = context.inputs, context.settings
    frames = Observations(inputs["ingest"].folder)
    maps = {name: Maps(artifact.folder) for name, artifact in inputs.items() if artifact.path("maps.zarr").is_dir()}
    evaluation = read_json(inputs.get("evaluate"), "evaluation.json")
    parameters = read_json(inputs.get("brdf"), "parameters.json")
    known = frames.mask & ((maps["normals"].read("flags") & NO_ESTIMATE) == 0)
    records = [
        stage_record(inputs[name].manifest, CHAIN[name].settings, CHAIN[name].does) for name in CHAIN if name in inputs
    ]
    widest = settings.picture_columns
    return {
        "title": settings.title or inputs["ingest"].diagnostics["capture"]["title"] or context.stamp["scene"],
        "scene": context.stamp["scene"],
        "stamp": context.stamp,
        "glance": at_a_glance(
            inputs["normals"].diagnostics,
            evaluation,
            inputs["height"].diagnostics if "height" in inputs else None,
            inputs["spectra"].diagnostics if "spectra" in inputs else None,
        ),
        "choices": choices({name: artifact.settings for name, artifact in inputs.items()}),
        "capture": capture_section(
            inputs["ingest"].diagnostics,
            lights=list(frames.lights),
            roles=list(frames.roles),
            directions=frames.directions,
            held_out=list(inputs["normals"].settings["hold_out"]),
            channels=list(frames.channels),
            pitch_mm=frames.pixel_pitch_mm,
        ),
        "appearance": appearance(inputs.get("render"), widest),
        "relighting": relighting(inputs.get("evaluate"), maps.get("evaluate"), evaluation, widest),
        "shape": shape_section(
            maps["normals"],
            widest=widest,
            height=maps.get("height"),
            pitch=frames.pixel_pitch_mm,
            evaluated=maps.get("evaluate"),
            mask=frames.mask,
        ),
        "normals": {"refined": False, **inputs["normals"].diagnostics},
        "ruler": ruler(frames.shape[1], frames.pixel_pitch_mm),
        "colour": colour_section(
            maps["normals"],
            widest=widest,
            camera=camera_of(inputs["ingest"], len(frames.channels)),
            spectra=maps.get("spectra"),
            evaluated=maps.get("evaluate"),
            evaluation=evaluation,
            known=known,
        ),
        "expected_de00": inputs["spectra"].diagnostics.get("expected_de00") if "spectra" in inputs else None,
        "gloss": None
        if parameters is None
        else gloss_section(parameters, true_gamma=((evaluation or {}).get("gloss") or {}).get("true_gamma_rad")),
        "evaluation": evaluation,
        "left_out": left_out_section(
            settings.left_out, {name: inputs[name].diagnostics for name in CHAIN if name in inputs}
        ),
        "conditions": conditions(inputs[name].manifest for name in CHAIN if name in inputs),
        "records": records,
        "with_truth": any((evaluation or {}).get(name) for name in ("normals", "height", "reflectance")),
    }


def read_json(artifact: Artifact | None, name: str) -> dict | None:
    """A JSON file of an artifact; None where the stage is not there."""
    return None if artifact is None else json.loads(artifact.path(name).read_text(encoding="utf-8"))


def camera_of(ingest: Artifact, channels: int) -> CameraColour:
    """Map from the camera's channels to XYZ, fitted where the capture has sensitivities and a lamp spectrum."""
    path = ingest.path("curves.npz")
    curves = load_arrays(path) if path.is_file() else {}
    if "sensitivities" not in curves or "illuminant" not in curves or len(curves["sensitivities"]) != channels:
        return assumed_colour(channels)
    return fitted_colour(synthetic_reflectances(), curves["illuminant"], curves["sensitivities"])


def appearance(render: Artifact | None, widest: int) -> dict | None:
    """Rendered pictures, those that the artifact lists."""
    if render is None:
        return None

    def read(name: str) -> bytes | None:
        return render.path(name).read_bytes() if name in render.manifest["files"] else None

    folder = f"render/{render.key}"
    return appearance_section(render.settings, render.diagnostics, read=read, widest=widest, folder=folder)


def relighting(evaluate: Artifact | None, maps: Maps | None, evaluation: dict | None, widest: int) -> dict | None:
    """Predictions beside photographs, where lights were kept from the fits."""
    if evaluation is None or not evaluation["lights"]:
        return None
    previews = {
        light["index"]: load_arrays(evaluate.path(f"preview_{light['index']:03d}.npz"))
        for light in evaluation["lights"]
    }
    return relighting_section(evaluation, maps, previews, widest=widest)


if __name__ == "__main__":
    run_stage(ReportSettings, run, __doc__)
