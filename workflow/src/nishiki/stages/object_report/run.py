"""Object report: one page on a turntable scene, from the artifacts of all other stages."""

import io
import json

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.artifacts.stage import Context
from nishiki.atlas.atlas import Atlas
from nishiki.atlas.store import ATLAS
from nishiki.brdf.texels.flags import TexelFlag
from nishiki.brdf.texels.store import ParameterMaps
from nishiki.formats.stored import load_arrays
from nishiki.geometry.cameras_file import load_cameras
from nishiki.report import object_sections as sections
from nishiki.report.conditions import conditions
from nishiki.report.left_out_section import left_out_section
from nishiki.report.object_atlas import parameter_pictures
from nishiki.report.page import OBJECT_TEMPLATE, render_page
from nishiki.report.pictures import data_uri, file_picture
from nishiki.report.provenance import stage_record
from nishiki.stages.table import LIMITS, chain_of

SHOWN = 6
PREVIEWS = ("preview.png", "mesh.png")
LIGHTING = {
    "camera": "a lamp beside the camera",
    "direction": "lamps of known direction",
    "position": "lamps at known places",
    "environment": "not stated; an irradiance over the normal was fitted",
}


def run(context: Context) -> dict:
    """Collect the sections that this scene has, and write the page."""
    page = render_page(content_of(context), OBJECT_TEMPLATE)
    context.output.path("report.html").write_text(page, encoding="utf-8")
    return {"bytes": len(page.encode()), "stages": sorted(context.inputs)}


def content_of(context: Context) -> dict:
    """Everything that the template names."""
    inputs, settings = context.inputs, context.settings
    told = {name: artifact.diagnostics for name, artifact in inputs.items()}
    evaluation = evaluation_of(inputs.get("object_evaluate"))
    held_out = set(inputs["texels"].settings["hold_out"]) if "texels" in inputs else set()
    chain = chain_of("turntable")
    widest = settings.picture_columns
    return {
        "title": settings.title or told["ingest"]["capture"].get("title") or context.stamp["scene"],
        "scene": context.stamp["scene"],
        "stamp": context.stamp,
        "views": len(told["ingest"]["views"]),
        "facts": sections.facts(told["ingest"]),
        "warnings": list(told["ingest"].get("warnings") or []),
        "glance": sections.glance(told),
        "rendered": rendered(inputs.get("object_render"), widest // 2, settings.video_mb),
        "comparisons": comparisons(inputs.get("object_evaluate"), evaluation),
        "evaluation": sections.evaluation_section(evaluation),
        "model": model(inputs, widest),
        "residual": sections.residual_section(told.get("residual"), evaluation),
        "separation": separation(inputs.get("polarise"), widest),
        "geometry": sections.geometry_section(told["mesh"]) if "mesh" in told else None,
        "preview": first_picture(inputs.get("mesh"), PREVIEWS, widest),
        "cameras": turn(inputs.get("cameras"), held_out),
        "left_out": left_out_section(settings.left_out, {name: told[name] for name in chain if name in told}),
        "conditions": conditions((inputs[name].manifest for name in chain if name in inputs), LIMITS),
        "records": [
            stage_record(inputs[name].manifest, chain[name].settings, chain[name].does)
            for name in chain
            if name in inputs
        ],
    }


def turn(artifact: Artifact | None, held_out: set[str]) -> dict | None:
    """The cameras seen from above and their errors; None where nothing told where they were."""
    if artifact is None:
        return None
    cameras = load_cameras(artifact.path("cameras.json"))
    centres = np.array([camera.centre for camera in cameras])
    return sections.cameras_section(artifact.diagnostics, centres, [camera.name for camera in cameras], held_out)


def evaluation_of(artifact: Artifact | None) -> dict | None:
    """The evaluation; None where the stage is not there."""
    return None if artifact is None else json.loads(artifact.path("evaluation.json").read_text(encoding="utf-8"))


def contents(artifact: Artifact | None, name: str) -> bytes | None:
    """A file that the artifact lists; None where there is none."""
    if artifact is None or name not in artifact.manifest["files"]:
        return None
    return artifact.path(name).read_bytes()


def first_picture(artifact: Artifact | None, names: tuple[str, ...], widest: int):
    """The first of these pictures that the artifact has, or None."""
    found = next((data for name in names if (data := contents(artifact, name)) is not None), None)
    return None if found is None else file_picture(found, widest)


def rendered(artifact: Artifact | None, widest: int, video_mb: float) -> dict:
    """Rendered pictures and the video."""
    if artifact is None:
        return {"pictures": [], "film": None, "notes": []}
    told = artifact.diagnostics
    pictures = []
    for name in list(told.get("pictures") or {})[:SHOWN]:
        data = contents(artifact, f"{name}.png")
        if data is not None:
            pictures.append({"picture": file_picture(data, widest), "name": words(name), "caption": ""})
    film, video = None, told.get("video") or {}
    data = contents(artifact, video["file"]) if video.get("file") else None
    if data is not None:
        carried = len(data) <= video_mb * 1e6 and video["file"].endswith(".mp4")
        source = data_uri(data, "video/mp4") if carried else ""
        film = {"source": source, "file": f"object_render/{artifact.key}/{video['file']}", "frames": video["frames"]}
    return {"pictures": pictures, "film": film, "notes": list(told.get("notes") or [])}


def words(name: str) -> str:
    """A picture's file name in words."""
    kind, _, rest = name.partition("-")
    predicted = rest.endswith("-predicted")
    rest = rest.removesuffix("-predicted")
    text = f"Between views {rest.replace('-', ' and ')}" if kind == "between" else f"View {rest}"
    return text + (" (left out, predicted)" if predicted else "")


def comparisons(artifact: Artifact | None, evaluation: dict | None) -> list[dict]:
    """Photographs beside renderings, as the evaluation kept them."""
    arrays = {}
    for entry in (evaluation or {}).get("pictures") or []:
        data = contents(artifact, entry["arrays"])
        if data is not None:
            arrays[entry["arrays"]] = load_arrays(io.BytesIO(data), name=entry["arrays"])
    return sections.comparisons(evaluation, arrays)


def model(inputs: dict[str, Artifact], widest: int) -> dict | None:
    """Parameter maps as sheets of all charts, and what the fit says of itself."""
    if "object_brdf" not in inputs or "texels" not in inputs:
        return None
    maps, told = ParameterMaps(inputs["object_brdf"].folder), inputs["object_brdf"].diagnostics

    def read(tile: int) -> dict:
        part = maps.read(tile)
        known = (part.flags & (TexelFlag.OUTSIDE | TexelFlag.UNSEEN)) == 0
        return {"kd": part.kd, "ks": part.ks, "sigma": part.sigma, "known": known}

    width = told["median_sigma"]
    names = ("texels", "samples", "psnr_db", "highlight_share", "filled_share", "unseen_share")
    return {
        "pictures": parameter_pictures(read, Atlas.load(inputs["texels"].path(ATLAS)), widest),
        "lighting": LIGHTING.get(told["lighting"], told["lighting"]),
        "median_sigma_deg": None if width is None else float(np.degrees(width)),
        **{name: told[name] for name in names},
    }


def separation(artifact: Artifact | None, widest: int) -> dict | None:
    """What the polarisers separated, with the first pictures that the stage drew."""
    if artifact is None:
        return None
    files = sorted(name for name in artifact.manifest["files"] if name.endswith("_side_by_side.png"))[:2]
    shown = [(name.split("/")[-1].split("_")[0], file_picture(contents(artifact, name), widest)) for name in files]
    pictures = [(f"View {view}: whole, diffuse, specular", picture) for view, picture in shown]
    return sections.separation_section(artifact.diagnostics, pictures)
