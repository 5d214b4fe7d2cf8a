"""A painting as a scene of Mitsuba 3: relief, textures, and our reflection model in Python."""

import json
from pathlib import Path

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.brdf.parameters import gloss_table
from nishiki.formats.exr_bands import ExrWriter
from nishiki.report.files import read_json
from nishiki.stages.export import mitsuba_paint
from nishiki.stages.export.relief_mesh import reliefs
from nishiki.stages.export.scene import ExportedScene

VERTEX = np.dtype([("place", "<f4", 3), ("texture", "<f4", 2)])
FACE = np.dtype([("count", "u1"), ("corner", "<i4", 3)])
MATTE = ([0.0], [0.5], 1.45, 0.0)


def write(context: Context, scene: ExportedScene) -> dict:
    """The folder `mitsuba`; what of the model it leaves out."""
    folder = context.output.path("exports/mitsuba/scene.json").parent
    beta, gamma, index, transmission = gloss(context)
    names = {"albedo": scene.srgb, "normals": scene.normals, "shading": scene.shading}
    clipped = 0
    header = {f"nishiki.{name}": text for name, text in context.stamp.items()}
    for name, read in names.items():
        with ExrWriter(folder / f"{name}.exr", "RGB", *scene.shape, header) as exr:
            for rows in scene.bands():
                values = read(rows)
                if name == "albedo":  # the renderer drops samples with a channel below 0
                    clipped += int(np.count_nonzero(values < 0))
                    values = np.maximum(values, 0)
                exr.write(values)
    count = write_relief(folder, context, scene)
    facts = {
        "rows": scene.shape[0],
        "columns": scene.shape[1],
        "width": scene.shape[1] * scene.pitch,
        "height": scene.shape[0] * scene.pitch,
        "unit": scene.unit,
        "gloss": {
            "beta": " ".join(map(str, beta)),
            "gamma": " ".join(map(str, gamma)),
            "index": index,
            "transmission": transmission,
        },
        "stamp": dict(context.stamp),
    }
    (folder / "scene.json").write_text(json.dumps(facts, indent=1) + "\n")
    (folder / "nishiki_paint.py").write_text(Path(mitsuba_paint.__file__).read_text(encoding="utf-8"))
    made = ("scene.json", "nishiki_paint.py", "relief.ply", "flat.ply", *(f"{name}.exr" for name in names))
    files = [f"exports/mitsuba/{name}" for name in made]
    return {
        "files": files,
        "vertices": count,
        "shading_terms_left_out": max(scene.shading_terms - 3, 0),
        "clipped": clipped / (3 * scene.shape[0] * scene.shape[1]),
    }


def gloss(context: Context) -> tuple[list[float], list[float], float, float]:
    """Strengths, half widths, index and losses of the region with the most samples; matte without the stage brdf."""
    parameters = read_json(context.inputs.get("brdf"), "parameters.json")
    if parameters is None:
        return MATTE
    beta, gamma, index, transmission = gloss_table(parameters)
    largest = int(np.argmax([region.get("samples", 0) for region in parameters["regions"]]))
    return beta[largest].tolist(), gamma[largest].tolist(), float(index[largest]), transmission


def write_relief(folder: Path, context: Context, scene: ExportedScene) -> int:
    """relief.ply, the displaced plane with the place of each vertex in the textures, and flat.ply; its vertices."""
    most = context.settings.mesh_vertices
    counts = np.sum([(len(band.places), len(band.triangles)) for band in reliefs(scene, most, colours=None)], axis=0)
    with open(folder / "relief.ply", "wb") as file:
        file.write(heading(*counts))
        for band in reliefs(scene, most, colours=None):
            file.write(vertices(band.places, band.texture))
        for band in reliefs(scene, most, colours=None):
            file.write(faces(band.triangles))
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], float)
    size = np.array([scene.shape[1], scene.shape[0]]) * scene.pitch
    places = np.column_stack([(corners - 0.5) * size * [1, -1], np.zeros(4)])
    flat = heading(4, 2) + vertices(places, corners) + faces(np.array([[0, 2, 1], [1, 2, 3]]))
    (folder / "flat.ply").write_bytes(flat)
    return int(counts[0])


def heading(count: int, triangles: int) -> bytes:
    """Of a binary PLY with places in the textures, u from the left and v from the top."""
    lines = [
        *("ply", "format binary_little_endian 1.0", f"element vertex {count}"),
        *(f"property float {name}" for name in "xyzuv"),
        *(f"element face {triangles}", "property list uchar int vertex_indices", "end_header"),
    ]
    return ("\n".join(lines) + "\n").encode("ascii")


def vertices(places: np.ndarray, texture: np.ndarray) -> bytes:
    """Vertices as the PLY holds them."""
    points = np.empty(len(places), VERTEX)
    points["place"], points["texture"] = places, texture
    return points.tobytes()


def faces(triangles: np.ndarray) -> bytes:
    """Triangles as the PLY holds them."""
    corners = np.empty(len(triangles), FACE)
    corners["count"], corners["corner"] = 3, triangles
    return corners.tobytes()
