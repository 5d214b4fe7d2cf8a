"""Object report: one page on a turntable scene, from the artifacts of all other stages."""

from typing import Any

from nishiki.artifacts.stage import Context
from nishiki.report.files import read_json
from nishiki.report.page import Tile
from nishiki.report.scene_page import write_scene_page
from nishiki.stages.cameras.report import cameras_section
from nishiki.stages.export.report import export_section
from nishiki.stages.ingest.report import facts_of_object
from nishiki.stages.mesh.report import geometry_section
from nishiki.stages.object_brdf.report import model_section
from nishiki.stages.object_evaluate.report import comparison_section, views_section
from nishiki.stages.object_render.report import rendered_section
from nishiki.stages.polarise.report import separation_section
from nishiki.stages.residual.report import residual_section
from nishiki.stages.table import chain_of


def run(context: Context) -> dict:
    """Collect the sections that this scene has, and write the page."""
    inputs, settings = context.inputs, context.settings
    diagnostics = {name: artifact.diagnostics for name, artifact in inputs.items()}
    evaluation = read_json(inputs.get("object_evaluate"), "evaluation.json")
    held_out = set(inputs["texels"].settings["hold_out"]) if "texels" in inputs else set()
    widest, views = settings.picture_columns, len(diagnostics["ingest"]["views"])
    one, many = "an object photographed from one place", "an object on a turntable, photographed from {} places"
    return write_scene_page(
        context,
        chain_of("turntable"),
        title=diagnostics["ingest"]["capture"].get("title"),
        about=one if views == 1 else many.format(views),
        facts=facts_of_object(diagnostics["ingest"]),
        tiles=at_a_glance(diagnostics),
        sections=[
            rendered_section(inputs.get("object_render"), widest // 2, settings.video_mb),
            comparison_section(inputs.get("object_evaluate"), evaluation),
            views_section(evaluation),
            model_section(inputs.get("object_brdf"), inputs.get("texels"), widest),
            residual_section(diagnostics.get("residual"), evaluation),
            separation_section(inputs.get("polarise"), widest),
            geometry_section(inputs.get("mesh"), widest),
            cameras_section(inputs.get("cameras"), held_out),
            export_section(inputs.get("object_export")),
        ],
        warnings=list(diagnostics["ingest"].get("warnings") or []),
    )


def at_a_glance(diagnostics: dict[str, dict[str, Any]]) -> list[Tile]:
    """The figures that matter most; diagnostics : by stage."""
    evaluation = diagnostics.get("object_evaluate") or {}
    psnr = evaluation.get("psnr") or {}
    left_out = next((figures for name, figures in psnr.items() if name.startswith("left_out")), {})
    total = (evaluation.get("bytes") or (diagnostics.get("residual") or {}).get("renderer_bytes") or {}).get("total")
    tiles = [
        ((psnr.get("captured") or {}).get("mean_psnr_db"), "dB", "rendered views against their photographs"),
        (left_out.get("mean_psnr_db"), "dB", "views that took no part, predicted"),
        ((psnr.get("model_alone") or {}).get("mean_psnr_db"), "dB", "the reflection model alone"),
        (None if total is None else total / 1000, "kB", "everything that a renderer needs"),
        (evaluation.get("bits_per_object_pixel"), "bit", "a pixel of the object"),
        ((diagnostics.get("mesh") or {}).get("triangles"), "", "triangles"),
    ]
    return [Tile(*tile) for tile in tiles if tile[0] is not None]
