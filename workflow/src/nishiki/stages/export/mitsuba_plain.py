"""scene.xml: a painting in Mitsuba's own material `principled`, its textures, and what it shows.

A texel is a pixel, with the lobe of its region, which the slopes inside it widen.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.brdf.trowbridge_reitz import widened_roughness
from nishiki.formats.mitsuba_xml import Parameter, write_scene
from nishiki.stages.export import mitsuba_principled
from nishiki.stages.export.gltf_material import GltfMaterial
from nishiki.stages.export.look import Texels
from nishiki.stages.export.region_gloss import RegionGloss
from nishiki.stages.export.scene import ExportedScene

UP = np.array([0.0, 0.0, 1.0])
LEAST_Z = 0.01  # of a normal that the view sees


@dataclass(frozen=True)
class PrincipledPaint:
    """What principled shows of pixels."""

    material: GltfMaterial

    def shown(self, albedo: np.ndarray, normals: np.ndarray, light: np.ndarray) -> np.ndarray:
        """As `GltfMaterial.shown`; facets turned away from the view are black."""
        half = (light + UP) / np.linalg.norm(light + UP)
        cos_phi, cos_i, cos_r = (np.maximum(normals @ each, 0) for each in (half, light, UP))
        cosines = (cos_phi, cos_i, cos_r, np.full_like(cos_i, half[2]))
        material = self.material
        reflectance = float(np.max(material.reflectance_of_weight_1))  # that of all regions
        body, gloss = mitsuba_principled.shown(albedo, material.roughness, reflectance, material.weight, cosines)
        return (body + gloss[:, None]) * np.where(cos_r > 0, cos_i, 0)[:, None]


@dataclass(frozen=True)
class PlainPainting:
    """A painting as scene.xml has it.

    Attributes
    ----------
    scene : ExportedScene
        Its maps.
    gloss : RegionGloss
        Lobes of its regions.
    facets : bool
        Whether the lobes are those of the facets alone, which slopes widen.
    """

    scene: ExportedScene
    gloss: RegionGloss
    facets: bool

    def textures(self) -> dict[str, Callable[[slice], np.ndarray]]:
        """Some rows of each texture, by name."""
        textures = {"base_colour": self.base_colour, "normalmap": self.normalmap}
        if any(material.strength > 0 for material in self.gloss.materials):
            textures["roughness"] = self.roughness
            if self.gloss.labels is not None:
                textures["weight"] = self.weight
        return textures

    def base_colour(self, rows: slice) -> np.ndarray:
        """(r, columns, 3) linear sRGB; negative channels are 0, because Mitsuba leaves out samples that have any."""
        return np.maximum(self.scene.srgb(rows), 0)

    def normalmap(self, rows: slice) -> np.ndarray:
        """(r, columns, 3) normals of the relief, (n + 1) / 2; upright where there is none.

        Those turned away from the view, which Mitsuba shows black, are raised to its edge.
        """
        normals = self.scene.relief_normals(rows)
        known = np.abs(normals).max(axis=-1, keepdims=True) > 0
        raised = np.where(known, np.maximum(normals, [-1, -1, LEAST_Z]), UP)
        return (raised / np.linalg.norm(raised, axis=-1, keepdims=True) + 1) / 2

    def roughness(self, rows: slice) -> np.ndarray:
        """(r, columns) square root of alpha."""
        roughness = self._of_regions("roughness", rows)
        if not self.facets:
            return roughness
        return widened_roughness(roughness, self.scene.slope_variance(rows))

    def weight(self, rows: slice) -> np.ndarray:
        """(r, columns) share of the reflectance of weight 1."""
        return self._of_regions("weight", rows)

    def texels(self, rows: slice, columns: int) -> Texels:
        """Colours and normals of some rows, as the files hold them."""
        normals = 2 * self.normalmap(rows).reshape(-1, 3) - 1
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return Texels(
            np.arange(rows.start, rows.stop), np.arange(columns), self.base_colour(rows).reshape(-1, 3), normals
        )

    def of(self, rows: np.ndarray, columns: np.ndarray) -> PrincipledPaint:
        """The material of the texels of some rows, which follow one another."""
        roughness = self.roughness(slice(int(rows[0]), int(rows[-1]) + 1)).ravel()
        return PrincipledPaint(replace(self.gloss.of(rows, columns), roughness=roughness))

    def _of_regions(self, name: str, rows: slice) -> np.ndarray:
        values = np.array([getattr(material, name) for material in self.gloss.materials])
        if self.gloss.labels is None:
            return np.full((rows.stop - rows.start, self.scene.shape[1]), values[0])
        return values[self.gloss.labels[rows]]


def write_plain_scene(path: Path, facts: dict, painting: PlainPainting) -> None:
    """scene.xml: the painting seen from the front under one distant lamp, with the material principled."""
    wide, above = facts["width"] / 2, 2 * max(facts["width"], facts["height"])
    to_world = np.diag([-wide, wide, -1.0, 1.0])  # x of Mitsuba's cameras points to the left
    to_world[2, 3] = above
    material = painting.gloss.materials[0]
    textures = {name: bitmap(f"{name}.exr") for name in painting.textures()}
    paint = mitsuba_principled.material(
        textures["base_colour"],
        textures.get("roughness", float(material.roughness)),
        float(material.reflectance_of_weight_1),
        textures.get("weight", float(material.weight)),
    )
    objects = {
        "integrator": {"type": "path", "max_depth": Parameter("max_depth", "integer")},
        "painting": {
            **{"type": "ply", "filename": Parameter("mesh", "string")},
            "bsdf": {
                **{"type": "normalmap", "flip_invalid_normals": False, "use_shadowing_function": False},
                **{"normalmap": textures["normalmap"], "paint": paint},
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
    remark = "x, y, z: the way that the light goes; mesh: or flat.ply; filter: bilinear for close-ups"
    write_scene(path, objects, defaults={**defaults, "filter": "nearest"}, remark=remark)


def bitmap(file: str) -> dict[str, Any]:
    """A texture of values, whose texels the parameter `filter` mixes or not."""
    return {**mitsuba_principled.texture(file), "filter_type": Parameter("filter", "string")}
