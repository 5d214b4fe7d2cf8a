"""Write a painting as a scene of Mitsuba 3: relief, textures, and our reflection model as a BSDF in Python."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.brdf.parameters import gloss_table
from nishiki.formats.exr_bands import ExrWriter
from nishiki.formats.textured_ply import faces, heading, vertices
from nishiki.report.files import read_json
from nishiki.stages.export import mitsuba_paint
from nishiki.stages.export.region_gloss import region_materials, slopes_widen
from nishiki.stages.export.relief_mesh import reliefs
from nishiki.stages.export.scene import ExportedScene

UP = np.array([0.0, 0.0, 1.0])
Texture = Callable[[slice], np.ndarray]
"""Some rows of a texture, of the picture's columns."""


def write(context: Context, scene: ExportedScene) -> dict:
    """The folder `mitsuba`; what of the model it leaves out."""
    folder = context.output.path("exports/mitsuba/scene.json").parent
    parameters = read_json(context.inputs.get("brdf"), "parameters.json")
    regions = len(region_materials(context, scene)) > 1
    textures = model_textures(scene, facets=slopes_widen(context), regions=regions)
    header = {f"nishiki.{name}": text for name, text in context.stamp.items()}
    for name, read in textures.items():
        channels = "Y" if name == "regions" else "RGB"
        with ExrWriter(folder / f"{name}.exr", channels, *scene.shape, header) as exr:
            for rows in scene.bands():
                exr.write(read(rows).reshape(-1, scene.shape[1], len(channels)))
    count = write_relief(folder, context, scene)
    facts = {
        "rows": scene.shape[0],
        "columns": scene.shape[1],
        "width": scene.shape[1] * scene.pitch,
        "height": scene.shape[0] * scene.pitch,
        "unit": scene.unit,
        "textures": list(textures),
        "shadows": not scene.has_directional_shading,
        "gloss": gloss_facts(parameters),
        "stamp": dict(context.stamp),
    }
    (folder / "scene.json").write_text(json.dumps(facts, indent=1) + "\n")
    (folder / "nishiki_paint.py").write_text(Path(mitsuba_paint.__file__).read_text(encoding="utf-8"))
    clipped = sum(int(np.count_nonzero(scene.srgb(rows) < 0)) for rows in scene.bands())
    names = ("scene.json", "nishiki_paint.py", "relief.ply", "flat.ply", *(f"{name}.exr" for name in textures))
    return {
        "files": [f"exports/mitsuba/{name}" for name in names],
        "vertices": count,
        "clipped": clipped / (3 * scene.shape[0] * scene.shape[1]),
    }


def model_textures(scene: ExportedScene, *, facets: bool, regions: bool) -> dict[str, Texture]:
    """What `nishiki_paint.py` reads, by name; facets: slopes widen the gloss; regions: there are several."""
    textures: dict[str, Texture] = {
        "albedo": scene.srgb,
        "normals": scene.shading_normals,
        "shading": scene.shading,
    }
    if scene.has_directional_shading:
        textures["directional"] = lambda rows: np.pad(scene.directional_terms(rows), ((0, 0), (0, 0), (0, 1)))
    if facets:
        textures["slopes"] = scene.slopes
    if regions:
        textures["regions"] = scene.regions
    return textures


def gloss_facts(parameters: dict | None) -> dict:
    """Lobes of each region, and the losses of the body's light at the surface."""
    beta, gamma, index, transmission = gloss_table(parameters)
    names = ("beta", "gamma", "index")
    regions = [
        dict(zip(names, each, strict=True)) for each in zip(beta.tolist(), gamma.tolist(), index.tolist(), strict=True)
    ]
    return {"regions": regions, "transmission": transmission}


def write_relief(folder: Path, context: Context, scene: ExportedScene) -> int:
    """relief.ply, the displaced plane with the place of each vertex in the textures, and flat.ply; its vertices.

    Their normals are those of the plane: the model takes those of the faces.
    """
    most = context.settings.mesh_vertices
    counts = np.sum([(len(band.places), len(band.triangles)) for band in reliefs(scene, most, colours=None)], axis=0)
    with open(folder / "relief.ply", "wb") as file:
        file.write(heading(*counts))
        for band in reliefs(scene, most, colours=None):
            file.write(vertices(band.places, np.broadcast_to(UP, band.places.shape), band.texture))
        for band in reliefs(scene, most, colours=None):
            file.write(faces(band.triangles))
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], float)
    size = np.array([scene.shape[1], scene.shape[0]]) * scene.pitch
    places = np.column_stack([(corners - 0.5) * size * [1, -1], np.zeros(4)])
    flat = heading(4, 2) + vertices(places, np.tile(UP, (4, 1)), corners) + faces(np.array([[0, 2, 1], [1, 2, 3]]))
    (folder / "flat.ply").write_bytes(flat)
    return int(counts[0])
