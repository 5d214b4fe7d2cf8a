"""A draped cloth as a scene of Mitsuba 3: mesh with its weft, paper, lamps, camera, and the BRDF as a table."""

import json
from pathlib import Path

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh_files import write_ply
from nishiki.render.cloth.brdf_table import EDGE, STEPS, BrdfTable
from nishiki.render.cloth.studio import MARGIN, framed, paper_below
from nishiki.stages.cloth_export import mitsuba_cloth
from nishiki.stages.cloth_export.against_model import errors
from nishiki.stages.cloth_export.scene import ExportedCloth
from nishiki.stages.cloth_render.scene import lights_of


def write(context: Context, cloth: ExportedCloth) -> dict:
    """The folder `mitsuba`; how far its table is from the model."""
    folder = context.output.path("exports/mitsuba/scene.json").parent
    shown, surface = cloth.shown, cloth.draped.surface
    azimuth = np.radians(shown.view.azimuth_deg)
    stamp = {f"nishiki.{name}": text for name, text in context.stamp.items()}
    about = {"stamp": stamp, "unit": "m" if shown.mesh is None else "of the file"}
    write_ply(folder / "cloth.ply", surface.mesh, **about, uv=cloth.draped.uv, attributes={"weft": surface.weft})
    names = ["cloth.ply", "brdf.npz", "scene.json", "nishiki_cloth.py"]
    if shown.paper > 0:
        write_ply(folder / "paper.ply", paper_below(surface.mesh.vertices, azimuth=azimuth).mesh, **about)
        names.append("paper.ply")
    table = BrdfTable.of(cloth.brdf)
    np.savez_compressed(folder / "brdf.npz", codes=table.codes, largest=table.largest, steps=STEPS, edge=EDGE)
    facts = {
        "camera": camera_facts(camera_of(cloth), surface.mesh.vertices.mean(axis=0)),
        "lamps": {
            name: {
                "direction": light.lamp(azimuth).direction,
                "colour": light.colour,
                "radius_deg": float(np.degrees(light.radius)),
            }
            for name, light in zip(shown.lights, lights_of(shown), strict=True)
        },
        "around": shown.around,
        "paper": shown.paper,
        "stamp": dict(context.stamp),
    }
    (folder / "scene.json").write_text(json.dumps(facts, indent=1) + "\n")
    (folder / "nishiki_cloth.py").write_text(Path(mitsuba_cloth.__file__).read_text(encoding="utf-8"))
    return {
        "files": [f"exports/mitsuba/{name}" for name in names],
        "vertices": len(surface.mesh.vertices),
        "against_model": errors(cloth, table),
    }


def camera_of(cloth: ExportedCloth) -> Camera:
    """The camera of the draped pictures."""
    view = cloth.shown.view
    place = {"elevation": np.radians(view.elevation_deg), "azimuth": np.radians(view.azimuth_deg)}
    size = {"rows": view.rows, "columns": view.columns, "distance": view.distance}
    return framed(cloth.draped.surface.mesh.vertices, **place, **size, margin=MARGIN)


def camera_facts(camera: Camera, middle: np.ndarray) -> dict:
    """Place, target, up, vertical field of view, degrees, and size of the picture, whose middle is the camera's axis;
    distance: from the cloth's middle (3,)."""
    distance = float(np.linalg.norm(camera.centre - middle))
    focal = camera.intrinsics[1, 1]
    return {
        "origin": camera.centre.tolist(),
        "target": (camera.centre + camera.rotation[2]).tolist(),
        "up": (-camera.rotation[1]).tolist(),
        "field_of_view_deg": float(2 * np.degrees(np.arctan(camera.rows / (2 * focal)))),
        "rows": camera.rows,
        "columns": camera.columns,
        "distance": distance,
    }
