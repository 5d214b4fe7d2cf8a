"""Report: one page on a painting, from the artifacts of all other stages."""

from nishiki.artifacts.maps import Maps
from nishiki.artifacts.stage import Context
from nishiki.evaluate.camera_colour import read_camera_colour
from nishiki.observations.plane import Observations
from nishiki.photometric.flags import NO_ESTIMATE
from nishiki.report.files import read_json
from nishiki.report.pictures import ruler
from nishiki.report.scene_page import write_scene_page
from nishiki.stages.brdf.report import gloss_section
from nishiki.stages.evaluate.report import relighting_section
from nishiki.stages.export.report import export_section
from nishiki.stages.ingest.report import capture_section, facts_of_painting, kind_of
from nishiki.stages.normals.report import shape_section
from nishiki.stages.render.report import appearance_section
from nishiki.stages.report.summary import at_a_glance, choices
from nishiki.stages.spectra.report import colour_section
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
    held_out = inputs["normals"].settings["hold_out"]
    kinds = [kind_of(name, role, held_out) for name, role in zip(frames.lights, frames.roles, strict=True)]
    relighting = relighting_section(inputs.get("evaluate"), maps.get("evaluate"), evaluation, widest)
    truth = evaluation or {}
    return write_scene_page(
        context,
        CHAIN,
        title=diagnostics["ingest"]["capture"]["title"],
        about=f"digitised from {len(frames.lights)} photographs, each under another light",
        facts=facts_of_painting(diagnostics["ingest"], list(frames.channels), frames.pixel_pitch_mm, kinds),
        tiles=at_a_glance(diagnostics["normals"], evaluation, diagnostics.get("height"), diagnostics.get("spectra")),
        sections=[
            appearance_section(inputs.get("render"), widest, settings.video_mb, scale_bar),
            relighting,
            shape_section(
                maps["normals"],
                widest=widest,
                height=maps.get("height"),
                pitch=frames.pixel_pitch_mm,
                evaluated=maps.get("evaluate"),
                mask=frames.mask,
                evaluation=evaluation,
                refined=diagnostics["normals"].get("refined", False),
                ruler=scale_bar,
            ),
            colour_section(
                maps["normals"],
                widest=widest,
                camera=read_camera_colour(inputs["ingest"].path("curves.npz"), len(frames.channels), frames.to_srgb),
                spectra=maps.get("spectra"),
                evaluated=maps.get("evaluate"),
                evaluation=evaluation,
                known=frames.mask & ((maps["normals"].read("flags") & NO_ESTIMATE) == 0),
                expected_de00=diagnostics.get("spectra", {}).get("expected_de00"),
                ruler=scale_bar,
            ),
            gloss_section(
                read_json(inputs.get("brdf"), "parameters.json"),
                true_gamma=(truth.get("gloss") or {}).get("true_gamma_rad"),
            ),
            capture_section(
                diagnostics["ingest"], lights=list(frames.lights), kinds=kinds, directions=frames.directions
            ),
            export_section(inputs.get("export")),
        ],
        more_left_out=[]
        if any(truth.get(name) for name in ("normals", "height", "reflectance"))
        else [NO_TRUTH.format("" if relighting else "; none were")],
        more_made=[choices({name: artifact.settings for name, artifact in inputs.items()})],
    )
