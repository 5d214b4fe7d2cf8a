"""Height as float TIFF, and as a mesh in PLY with normals and colours."""

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.colour.colour import srgb_encode
from nishiki.formats.tiff_bands import write_tiff
from nishiki.stages.export.normals import software, stamped
from nishiki.stages.export.relief_mesh import Relief, reliefs
from nishiki.stages.export.scene import ExportedScene

VERTEX = np.dtype([("place", "<f4", 3), ("normal", "<f4", 3), ("colour", "u1", 3)])
FACE = np.dtype([("count", "u1"), ("corner", "<i4", 3)])


def write(context: Context, scene: ExportedScene) -> dict:
    """`height.tif` and `height.ply`."""
    path = context.output.path
    description = (
        f"Height in {scene.unit}, towards the camera; NaN: none. Integrated from normals: parts that do not touch have "
        f"each its own zero. {stamped(context)}"
    )
    write_tiff(
        path("exports/height.tif"),
        (scene.height(rows).astype(np.float32) for rows in scene.bands()),
        (*scene.shape, 1),
        description=description,
        software=software(context),
        pitch_mm=scene.pitch_mm,
        nodata="nan",
    )
    step, vertices, faces = write_ply(context, scene)
    return {
        "files": ["exports/height.tif", "exports/height.ply"],
        "pixels_a_vertex": step * step,
        "vertices": vertices,
        "faces": faces,
    }


def write_ply(context: Context, scene: ExportedScene) -> tuple[int, int, int]:
    """The mesh, row by row of vertices: pixels along the side of a vertex, vertices, faces."""
    most = context.settings.mesh_vertices
    step = counted = corners = 0
    for relief in reliefs(scene, most, colours=None):
        step, counted, corners = relief.step, counted + len(relief.places), corners + len(relief.triangles)
    comments = [f"comment nishiki.{name} {text}" for name, text in context.stamp.items()]
    heading = [
        "ply",
        "format binary_little_endian 1.0",
        *comments,
        f"comment unit {scene.unit}; x right, y up, z towards the camera; origin: middle of the picture",
        f"element vertex {counted}",
        *(f"property float {axis}" for axis in ("x", "y", "z", "nx", "ny", "nz")),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        f"element face {corners}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    colours = scene.to_srgb()
    with open(context.output.path("exports/height.ply"), "wb") as file:
        file.write(("\n".join(heading) + "\n").encode("ascii", "replace"))
        for relief in reliefs(scene, most, colours=colours):
            file.write(vertex_bytes(relief))
        for relief in reliefs(scene, most, colours=None):
            faces = np.empty(len(relief.triangles), FACE)
            faces["count"], faces["corner"] = 3, relief.triangles
            file.write(faces.tobytes())
    return step, counted, corners


def vertex_bytes(relief: Relief) -> bytes:
    """Vertices of a band as the PLY holds them."""
    points = np.empty(len(relief.places), VERTEX)
    points["place"], points["normal"] = relief.places, relief.normals
    points["colour"] = np.floor(255 * srgb_encode(relief.colours) + 0.5)
    return points.tobytes()
