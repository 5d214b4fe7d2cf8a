"""What the viewer of a cloth is given: surfaces with their weft and the light that reaches them from around, and the
models as tables."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nishiki.render.cloth import around, brdf_table
from nishiki.render.cloth.brdf_table import BrdfTable
from nishiki.render.cloth.drape import read_drape
from nishiki.render.cloth.dyes import dyed, gloss_alone
from nishiki.render.cloth.local import LEAST_COSINE, LIFT
from nishiki.render.cloth.scene import Brdf, Surface
from nishiki.render.cloth.sheet import sheet, swatch
from nishiki.render.cloth.studio import Studio, studio, tubes
from nishiki.stages.cloth_render.declaration import MeshSettings
from nishiki.stages.cloth_render.scene import surface_from_file

SIDE = 193
"""Points along a side of the draped cloth, as `cloth_render` draws it."""
PAPER = 0.14
"""Reflectance of the paper below, as `cloth_render` has it."""
POSITION_STEPS = 1 << 16
"""Steps of a place in an extent of the cloth."""
SIZE = {"rows": 600, "columns": 800}
"""Of the picture that the first view of a surface fills."""


def draped() -> Studio:
    """The cloth over a ball."""
    return on_paper(sheet(read_drape(), side=SIDE)[0])


def on_paper(surface: Surface) -> Studio:
    """A surface on paper without a wall: it is seen from all sides."""
    view = {"elevation": np.radians(21), "azimuth": np.radians(12), "distance": 2.2}
    return studio([surface], [], **view, **SIZE, level=1.0, reflectance=PAPER, wall=False)


def flat() -> Studio:
    """A flat sample that faces the eye, weft to the right."""
    view = {"elevation": 0.0, "azimuth": 0.0, "distance": 2.2}
    return studio([swatch(1.0, 1.0)], [], **view, **SIZE, level=1.0, reflectance=0.0)


def cylinders() -> Studio:
    """Three cylinders: warp upright, oblique and around."""
    view = {"elevation": np.radians(12), "azimuth": 0.0, "distance": 2.6}
    return studio(tubes(), [], **view, **SIZE, level=1.0, reflectance=PAPER, wall=False, margin=1.1)


SHAPES: dict[str, Callable[[], Studio]] = {"drape": draped, "flat": flat, "cylinders": cylinders}
FILE = "file"
"""Name of the surface of a file, whose unit of length nobody knows."""


def surfaces(mesh: MeshSettings | None) -> dict[str, Callable[[], Studio]]:
    """What the page shows, by name; the surface of a file first."""
    own = {} if mesh is None else {FILE: lambda: on_paper(surface_from_file(mesh).surface)}
    return own | SHAPES


@dataclass(frozen=True)
class Shape:
    """A surface for the page: arrays of its block, and numbers for the manifest."""

    arrays: dict[str, np.ndarray]
    numbers: dict


def shape_of(scene: Studio) -> Shape:
    """A studio's surfaces: vertices as whole steps, unit vectors in 1/32767, openness in 1/255; differences of
    consecutive rows, which deflate well, all but the openness."""
    mesh, weft, camera = scene.scene.mesh, scene.scene.weft, scene.camera
    cloth = np.zeros(len(mesh.vertices), bool)
    cloth[mesh.triangles[scene.scene.material == 0]] = True
    low, high = mesh.vertices[cloth].min(axis=0), mesh.vertices[cloth].max(axis=0)
    step = float(np.linalg.norm(high - low)) / POSITION_STEPS
    light = scene.surroundings
    arrays = {
        "vertices": differences(np.round(mesh.vertices / step).astype(np.int32)),
        "normals": differences(unit_steps(mesh.normals)),
        "weft": differences(unit_steps(weft)),
        "triangles": differences(mesh.triangles.astype(np.int32)),
        "cloth": cloth.astype(np.uint8),
        "around": np.round(255 * np.concatenate([light.open, light.from_above], axis=1)).astype(np.uint8),
    }
    centre = (low + high) / 2
    numbers = {
        "step": step,
        "centre": centre.tolist(),
        "radius": float(np.linalg.norm(mesh.vertices[cloth] - centre, axis=1).max()),
        "camera": camera.as_dict(),
        "lift": LIFT * scene.scene.scale,
        "reflectance": scene.paper.albedo[0] if scene.paper else 0.0,
        "floor": float(mesh.vertices[:, 1].min()) if scene.paper else None,
    }
    return Shape(arrays, numbers)


def differences(values: np.ndarray) -> np.ndarray:
    """(n, k) integers less the row before, modulo their type's range."""
    out = values.copy()
    out[1:] -= values[:-1]
    return out


def unit_steps(vectors: np.ndarray) -> np.ndarray:
    """Unit vectors (n, 3) in steps of 1/32767, int16."""
    return np.round(32767 * np.asarray(vectors, np.float64)).astype(np.int16)


def material_arrays(brdf: Brdf) -> dict[str, dict[str, np.ndarray]]:
    """Blocks of a model: `measured`, its table and its share of even light; `gloss`, the table of its gloss alone, and
    the directional albedo that a dye below it needs."""
    dye = dyed(brdf, {"white": (1.0, 1.0, 1.0)})["white"]
    through = {
        "albedo": dye.gloss_albedo.astype(np.float32),
        "albedo_of_views": dye.gloss_albedo_at(around.grid_views()).astype(np.float32),
        "mean_albedo": np.float32([dye.mean_albedo]),
    }
    measured = table_arrays(brdf) | {"shares": around.shares(brdf).astype(np.float32)}
    return {"measured": measured, "gloss": table_arrays(gloss_alone(brdf)) | through}


def table_arrays(brdf: Brdf) -> dict[str, np.ndarray]:
    """A BRDF's table, ring after ring as differences."""
    table = BrdfTable.of(brdf)
    codes = np.moveaxis(table.codes, 2, 0)
    changes = differences(codes.reshape(len(codes), -1))
    return {"codes": changes.reshape(codes.shape), "largest": np.float32([table.largest])}


def table_numbers() -> dict:
    """Sizes of the tables, and constants of the look-up and of the shading."""
    return {
        "sides": brdf_table.SIDES, "rings": brdf_table.RINGS, "turns": brdf_table.TURNS, "edge": brdf_table.EDGE,
        "steps": brdf_table.STEPS, "least_cosine": LEAST_COSINE,
    }  # fmt: skip
