"""Cloth_viewer: a page on which a cloth hangs, lies flat and is dyed under any lamp, data beside it or inside it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.brdf.cloth.interface import gloss_of
from nishiki.progress import Progress
from nishiki.render.cloth import scene
from nishiki.render.cloth.models import LEAST_COSINE, LIFT, ClothModels, apply_dyes, grid_views, shares
from nishiki.render.cloth.scene import Brdf, BrdfTable, Surface
from nishiki.render.cloth.studio import Studio, Viewpoint, studio, tubes
from nishiki.render.cloth.surfaces import read_drape, sheet, swatch
from nishiki.report.viewer.page import Blocks, pack_arrays, write_page
from nishiki.stages.render import ClothRenderSettings, SurfaceFile
from nishiki.stages.render.cloth import FINEST_SIDE, surface_from_file

PAGE = Path(__file__).with_suffix(".js")


def run(context: Context) -> dict:
    """Write the surfaces, a table of every model, and the page."""
    blocks = Blocks(context.output, inline_bytes=int(context.settings.inline_mb * 1e6))
    models = ClothModels(context.inputs["cloth_brdf"].folder)
    about = {**context.stamp, "title": context.inputs["ingest"].diagnostics["capture"]["title"]}
    chosen = {"dyes": context.settings.dyes, "mesh": context.settings.mesh}
    return write_cloth(models, blocks, about, **chosen, progress=context.progress)


def write_cloth(
    models: ClothModels,
    blocks: Blocks,
    about: dict,
    *,
    dyes: dict[str, str],
    mesh: SurfaceFile | None = None,
    progress: Progress,
) -> dict:
    """Write blocks and page of a cloth; return sizes in bytes.

    about: title and stamp; dyes: sRGB colours (#rrggbb) by name; mesh: a further surface, which the page opens with.
    """
    shapes = {}
    for name, make in surfaces(mesh).items():
        shape = shape_of(make())
        blocks.add(f"shape-{name}", pack_arrays(shape.arrays))
        shapes[name] = shape.numbers
    chosen = [
        (region, model)
        for region in models.regions
        for model in sorted(models.names(region), key=lambda name: name != models.default)
    ]
    for region, model in progress.through(chosen, len(chosen), "model"):
        for part, arrays in material_arrays(models.brdf(region, model)).items():
            blocks.add(f"{part}-{region}-{model}", pack_arrays(arrays))
    table = {
        "sides": scene.SIDES, "rings": scene.RINGS, "turns": scene.TURNS, "edge": scene.EDGE,
        "steps": scene.STEPS, "least_cosine": LEAST_COSINE,
    }  # fmt: skip
    manifest = {
        "format": 1, "chain": "cloth", **about, "shapes": shapes, "table": table, "dyes": dyes,
        "materials": [{"region": region, "model": model} for region, model in chosen],
    }  # fmt: skip
    shape_bytes = sum(size for name, size in blocks.bytes.items() if name.startswith("shape-"))
    return {**write_page(blocks, manifest, PAGE), "shape_bytes": shape_bytes, "models": len(chosen)}


POSITION_STEPS = 1 << 16
"""Number of steps of a position over the cloth's extent."""
SIZE = (600, 800)
"""Size of the first view's picture, filled by the surface."""


def on_paper(cloths: list[Surface], view: Viewpoint, **more: Any) -> Studio:
    """Return surfaces on paper without a wall: they are visible from all sides."""
    return studio(cloths, [], view, level=1.0, reflectance=ClothRenderSettings().paper, wall=False, **more)


def surfaces(mesh: SurfaceFile | None) -> dict[str, Callable[[], Studio]]:
    """Return the page's surfaces by name; the surface of a file, of unknown unit of length, first.

    drape: over a ball; flat: a sample that faces the eye, weft to the right; cylinders: warp upright, oblique, around.
    """
    above = Viewpoint(np.radians(21), np.radians(12), 2.2, *SIZE)
    own = {} if mesh is None else {"file": lambda: on_paper([surface_from_file(mesh).surface], above)}
    return own | {
        "drape": lambda: on_paper([sheet(read_drape(), side=FINEST_SIDE)[0]], above),
        "flat": lambda: studio([swatch(1.0, 1.0)], [], Viewpoint(0.0, 0.0, 2.2, *SIZE), level=1.0, reflectance=0.0),
        "cylinders": lambda: on_paper(tubes(), Viewpoint(np.radians(12), 0.0, 2.6, *SIZE), margin=1.1),
    }


@dataclass(frozen=True)
class ViewerSurface:
    """A surface for the page: arrays of its block, and numbers for the manifest."""

    arrays: dict[str, np.ndarray]
    numbers: dict


def shape_of(scene: Studio) -> ViewerSurface:
    """Encode a studio's surfaces: vertices as whole steps, unit vectors in 1/32767, openness in 1/255.

    All but the openness are differences of consecutive rows, which deflate well.
    """
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
    return ViewerSurface(arrays, numbers)


def differences(values: np.ndarray) -> np.ndarray:
    """Compute (n, k) integers less the row before, modulo their type's range."""
    out = values.copy()
    out[1:] -= values[:-1]
    return out


def unit_steps(vectors: np.ndarray) -> np.ndarray:
    """Quantise unit vectors (n, 3) in steps of 1/32767, int16."""
    return np.round(32767 * np.asarray(vectors, np.float64)).astype(np.int16)


def material_arrays(brdf: Brdf) -> dict[str, dict[str, np.ndarray]]:
    """Return a model's blocks: its table and share of ambient light, its gloss alone and the albedo for dyes."""
    gloss = gloss_of(brdf)
    of_all, of_gloss = shares(brdf, gloss)
    dye = apply_dyes(gloss, {"white": (1.0, 1.0, 1.0)}, of_gloss)["white"]
    through = {
        "albedo": dye.gloss_albedo.astype(np.float32),
        "albedo_of_views": dye.gloss_albedo_at(grid_views()).astype(np.float32),
        "mean_albedo": np.array([dye.mean_albedo], np.float32),
    }
    parts = {}
    more = {"measured": {"shares": of_all.astype(np.float32)}, "gloss": through}
    for (name, others), table in zip(more.items(), BrdfTable.of(brdf, gloss), strict=True):
        codes = np.moveaxis(table.codes, 2, 0)
        changes = differences(codes.reshape(len(codes), -1)).reshape(codes.shape)  # ring after ring
        parts[name] = {"codes": changes, "largest": np.array([table.largest], np.float32)} | others
    return parts
