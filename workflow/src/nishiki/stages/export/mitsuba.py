"""A painting as a scene of Mitsuba 3: relief, textures, and two materials: our reflection model in Python, and
`principled` for scenes without Python."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.brdf.parameters import gloss_table, is_facets
from nishiki.formats.exr_bands import ExrWriter
from nishiki.formats.mitsuba_xml import Parameter, write_scene
from nishiki.formats.textured_ply import faces, heading, vertices
from nishiki.report.files import read_json
from nishiki.stages.export import mitsuba_paint, mitsuba_principled
from nishiki.stages.export.gltf_material import GltfMaterial
from nishiki.stages.export.look import Texels, errors
from nishiki.stages.export.region_gloss import RegionGloss, region_materials
from nishiki.stages.export.relief_mesh import reliefs
from nishiki.stages.export.scene import ExportedScene

UP = np.array([0.0, 0.0, 1.0])
MATTE = (np.array([[0.0]]), np.array([[0.5]]), np.array([1.45]), 0.0)
ONE_CHANNEL = ("regions", "roughness", "weight")
Texture = Callable[[slice], np.ndarray]
"""Some rows of a texture, of the picture's columns."""


def write(context: Context, scene: ExportedScene) -> dict:
    """The folder `mitsuba`; what of the model it leaves out."""
    folder = context.output.path("exports/mitsuba/scene.json").parent
    parameters = read_json(context.inputs.get("brdf"), "parameters.json")
    gloss = RegionGloss(region_materials(context, scene), None)
    if len(gloss.materials) > 1:
        gloss = replace(gloss, labels=scene.regions(slice(0, scene.shape[0])))
    of_model, of_principled = model_textures(scene, parameters), principled_textures(scene, gloss)
    header = {f"nishiki.{name}": text for name, text in context.stamp.items()}
    for name, read in {**of_model, **of_principled}.items():
        channels = "Y" if name in ONE_CHANNEL else "RGB"
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
        "textures": list(of_model),
        "shadows": not scene.has_directional_shading,
        "gloss": gloss_facts(parameters),
        "stamp": dict(context.stamp),
    }
    (folder / "scene.json").write_text(json.dumps(facts, indent=1) + "\n")
    (folder / "nishiki_paint.py").write_text(Path(mitsuba_paint.__file__).read_text(encoding="utf-8"))
    write_plain_scene(folder / "scene.xml", facts, gloss)
    clipped = sum(int(np.count_nonzero(scene.srgb(rows) < 0)) for rows in scene.bands())
    names = ("scene.json", "nishiki_paint.py", "scene.xml", "relief.ply", "flat.ply")
    files = [f"exports/mitsuba/{name}" for name in (*names, *(f"{name}.exr" for name in (*of_model, *of_principled)))]
    return {
        "files": files,
        "vertices": count,
        "clipped": clipped / (3 * scene.shape[0] * scene.shape[1]),
        "kinds": {
            "principled": {"psnr_db": errors(context, scene, PaintingFiles(scene), {"": PrincipledGloss(gloss)})[""]}
        },
    }


def model_textures(scene: ExportedScene, parameters: dict | None) -> dict[str, Texture]:
    """What `nishiki_paint.py` reads, by name; parameters: of the stage brdf, None for a matte painting."""
    textures: dict[str, Texture] = {
        "albedo": lambda rows: np.maximum(scene.srgb(rows), 0),  # samples with a channel below 0 would be dropped
        "normals": scene.shading_normals,
        "shading": scene.shading,
    }
    if scene.has_directional_shading:
        textures["directional"] = lambda rows: np.pad(scene.directional_terms(rows), ((0, 0), (0, 0), (0, 1)))
    if parameters is not None and is_facets(parameters):
        textures["slopes"] = scene.slopes
    if parameters is not None and len(parameters["regions"]) > 1:
        textures["regions"] = scene.regions
    return textures


def principled_textures(scene: ExportedScene, gloss: RegionGloss) -> dict[str, Texture]:
    """What `scene.xml` reads beside the albedo."""
    textures: dict[str, Texture] = {"normalmap": lambda rows: coded(scene.relief_normals(rows))}
    if gloss.labels is not None:
        for name in ("roughness", "weight"):
            values = np.array([getattr(material, name) for material in gloss.materials])
            textures[name] = lambda rows, values=values: values[gloss.labels[rows]]
    return textures


def gloss_facts(parameters: dict | None) -> dict:
    """Lobes of each region, and the losses of the body's light at the surface."""
    beta, gamma, index, transmission = MATTE if parameters is None else gloss_table(parameters)
    names = ("beta", "gamma", "index")
    regions = [
        dict(zip(names, each, strict=True)) for each in zip(beta.tolist(), gamma.tolist(), index.tolist(), strict=True)
    ]
    return {"regions": regions, "transmission": transmission}


def coded(normals: np.ndarray) -> np.ndarray:
    """Normals (..., 3) as a normal map has them, (n + 1) / 2; upright where there is none."""
    known = np.abs(normals).max(axis=-1, keepdims=True) > 0
    return (np.where(known, normals, UP) + 1) / 2


@dataclass(frozen=True)
class PaintingFiles:
    """Colours and normals of a painting as albedo.exr and normalmap.exr hold them."""

    scene: ExportedScene

    def texels(self, rows: slice, columns: int) -> Texels:
        """A texel is a pixel."""
        normals = 2 * coded(self.scene.relief_normals(rows)).reshape(-1, 3) - 1
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        colours = np.maximum(self.scene.srgb(rows), 0).reshape(-1, 3)
        return Texels(np.arange(rows.start, rows.stop), np.arange(columns), colours, normals)


@dataclass(frozen=True)
class PrincipledPaint:
    """What principled shows of a painting."""

    material: GltfMaterial

    def shown(self, albedo: np.ndarray, normals: np.ndarray, light: np.ndarray) -> np.ndarray:
        """As `GltfMaterial.shown`: (n, 3) light relative to a white that faces the lamp, seen along z."""
        half = (light + UP) / np.linalg.norm(light + UP)
        cos_phi, cos_i, cos_r = (np.maximum(normals @ each, 0) for each in (half, light, UP))
        cosines = (cos_phi, cos_i, cos_r, np.full_like(cos_i, half[2]))
        material = self.material
        reflectance = float(np.max(material.reflectance_of_weight_1))  # of all regions
        body, gloss = mitsuba_principled.shown(albedo, material.roughness, reflectance, material.weight, cosines)
        return (body + gloss[:, None]) * cos_i[:, None]


@dataclass(frozen=True)
class PrincipledGloss:
    """The gloss of a painting as principled takes it."""

    gloss: RegionGloss

    def of(self, rows: np.ndarray, columns: np.ndarray) -> PrincipledPaint:
        """The material of the texels in some rows and columns."""
        return PrincipledPaint(self.gloss.of(rows, columns))


def write_plain_scene(path: Path, facts: dict, gloss: RegionGloss) -> None:
    """scene.xml: the painting seen from the front under one distant lamp, with the material principled."""
    wide, above = facts["width"] / 2, 2 * max(facts["width"], facts["height"])
    to_world = np.diag([-wide, wide, -1.0, 1.0])  # x of Mitsuba's cameras points to the left
    to_world[2, 3] = above
    first = gloss.materials[0]
    values = (
        (float(first.roughness), float(first.weight))
        if gloss.labels is None
        else (mitsuba_principled.texture(f"{name}.exr", exact=True) for name in ("roughness", "weight"))
    )
    roughness, weight = values
    paint = mitsuba_principled.material(
        mitsuba_principled.texture("albedo.exr"), roughness, float(first.reflectance_of_weight_1), weight
    )
    objects = {
        "integrator": {"type": "path", "max_depth": Parameter("max_depth", "integer")},
        "painting": {
            **{"type": "ply", "filename": Parameter("mesh", "string")},
            "bsdf": {
                **{"type": "normalmap", "flip_invalid_normals": False, "use_shadowing_function": False},
                **{"normalmap": mitsuba_principled.texture("normalmap.exr"), "paint": paint},
            },
        },
        "lamp": {
            **{"type": "directional", "direction": [Parameter(axis, "float") for axis in "xyz"]},
            "irradiance": {"type": "rgb", "value": [float(np.pi)] * 3},
        },
        "sensor": {
            **{"type": "orthographic", "to_world": to_world, "near_clip": 0.01 * above, "far_clip": 2 * above},
            **mitsuba_principled.film(facts["columns"], facts["rows"]),
        },
    }
    defaults = {"mesh": "relief.ply", "samples": 16, "max_depth": 2, "x": -0.5, "y": -0.5, "z": -0.7071}
    write_scene(path, objects, defaults=defaults, remark="x, y, z: the way that the light goes; mesh: or flat.ply")


def write_relief(folder: Path, context: Context, scene: ExportedScene) -> int:
    """relief.ply, the displaced plane with the place of each vertex in the textures, and flat.ply; its vertices.

    Their normals are those of the plane: principled takes the relief's from its texture, our model the faces'.
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
