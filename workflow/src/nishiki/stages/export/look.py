"""How a painting looks to formats of scenes: displaced plane, textures, gloss by region."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from nishiki.artifacts.maps import shrink
from nishiki.artifacts.stage import Context
from nishiki.colour.colour import decode, encode, srgb_encode
from nishiki.formats.textured_surface import SurfaceLook, TexturedMesh
from nishiki.observations.plane import Observations
from nishiki.stages.export.gloss import PaintingGloss, RegionGloss, painting_gloss
from nishiki.stages.export.registry import METRES, CodedErrors, ExportedSurface, GltfLook
from nishiki.stages.export.scene import ExportedScene, Photographs, reliefs

FIGURES = {"roughness": "roughness", "specular": "strength", "ior": "index", "metallic": "metallic"}


class Texels(NamedTuple):
    """Rows (r,) and columns (c,) of texels; linear colours and unit normals (r c, 3), row by row."""

    rows: np.ndarray
    columns: np.ndarray
    colours: np.ndarray
    normals: np.ndarray


@dataclass(frozen=True)
class PaintingLook:
    """Material and textures of a painting."""

    gloss: PaintingGloss  # lobes of its regions, as each format takes them
    # colours, normals: (rows, columns, 3) uint8 ndarray: base colour, sRGB; normals of the relief, y up, (n + 1) / 2
    colours: np.ndarray
    normals: np.ndarray
    step: int  # pixels along the side of a texel

    def texels(self, rows: slice, columns: int) -> Texels:
        """Those that stand for pixels."""
        down, across = np.arange(rows.start, rows.stop) // self.step, np.arange(columns) // self.step
        base = decode(self.colours[down][:, across].reshape(-1, 3) / 255, "srgb")
        normals = self.normals[down][:, across].reshape(-1, 3) / 255 * 2 - 1
        return Texels(down, across, base, normals / np.linalg.norm(normals, axis=1, keepdims=True))

    def surface(self, gloss: RegionGloss) -> SurfaceLook:
        """Return the same in the words of USD and MaterialX."""
        return SurfaceLook(self.colours, gloss.roughness, gloss.reflectance, gloss.weight, self.normals, gloss.metallic)

    def figures(self, gloss: RegionGloss) -> dict:
        """Return what the diagnostics say of it."""
        materials = [
            {name: getattr(material, field) for name, field in FIGURES.items()} for material in gloss.materials
        ]
        return {"pixels_a_texel": self.step * self.step, "materials": materials}


class PaintingSurface(ExportedSurface):
    """Mesh, look and errors of a painting."""

    stem = "painting"

    def __init__(self, context: Context, scene: ExportedScene):
        super().__init__(context)
        self.scene = scene

    @cached_property
    def look(self) -> PaintingLook:
        """Material and textures, at most `gltf.texture_px` texels a side."""
        fitted = self.scene.gloss
        albedo, normals, labels, variance, step = textures(
            self.scene, self.context.settings.gltf.texture_px, slopes=bool(fitted.beta.any())
        )
        known = np.abs(normals).max(axis=-1) > 0
        gloss = painting_gloss(fitted if self.scene.glossy else None, albedo, known, labels, variance)
        rows, columns = known.shape
        colours = np.empty((rows, columns, 3), np.uint8)
        for row in range(rows):
            material = gloss.gltf.of(np.array([row]), np.arange(columns))
            colours[row] = np.rint(255 * srgb_encode(material.base_colour(albedo[row])))
        coded = np.rint((np.where(known[..., None], normals, [0, 0, 1]) + 1) / 2 * 255).astype(np.uint8)
        return PaintingLook(gloss, colours, coded, step)

    @cached_property
    def mesh(self) -> TexturedMesh:
        """The plane displaced by the height, with its own normals, because the texture holds the relief's."""
        bands = list(reliefs(self.scene, self.context.settings.mesh_vertices, colours=None))
        places, texture, triangles = (
            np.concatenate([getattr(band, name) for band in bands]) for name in ("places", "texture", "triangles")
        )
        up = np.broadcast_to(np.array([0, 0, 1], np.float32), places.shape)
        return TexturedMesh(places * METRES["mm"], up, texture, triangles)

    @property
    def unit(self) -> str:
        """What a length of 1 in the file means."""
        pitch_mm = self.scene.pitch_mm
        return f"1 is 1000 {self.scene.unit}" if pitch_mm is None else "metres"

    def look_of(self, name: str) -> SurfaceLook:
        """Return textures and material as a format takes them."""
        return self.look.surface(getattr(self.look.gloss, name))

    @property
    def gltf_look(self) -> GltfLook:
        """Return the look in the words of glTF."""
        look, gloss = self.look, self.look.gloss.gltf
        material = gloss.materials[0]
        weight = float(material.weight) if gloss.weight is None else gloss.weight
        factor, index = float(material.factor), material.index
        return GltfLook(look.colours, gloss.roughness, weight, factor, index, gloss.metallic, look.normals)

    def figures(self, name: str) -> dict:
        """Return what the diagnostics say of a format besides its error."""
        return self.look.figures(getattr(self.look.gloss, name))

    def errors(self, formats: list[str]) -> dict[str, dict]:
        """Return PSNR of formats."""
        return errors(self.context, self.scene, self.look, {name: getattr(self.look.gloss, name) for name in formats})


class TexelMaps(NamedTuple):
    """Means over texels of `step` pixels.

    Linear sRGB albedo and unit normals (rows, columns, 3); regions and variance of the slopes inside a texel (rows,
    columns), or None.
    """

    albedo: np.ndarray
    normals: np.ndarray
    labels: np.ndarray | None
    variance: np.ndarray | None
    step: int


def textures(scene: ExportedScene, most: int, *, slopes: bool) -> TexelMaps:
    """Return maps with at most `most` texels a side, read by bands; slopes: with their variance."""
    step = -(-max(scene.shape) // most)
    everything = slice(0, scene.shape[0])
    labels = scene.regions(everything)
    return TexelMaps(
        scene.mean(scene.srgb, step),
        scene.mean_normals(scene.relief_normals, step),
        None if labels is None else most_frequent(labels, scene.known(everything), step),
        scene.block_slopes(step)[..., ::2].mean(axis=-1) if slopes else None,
        step,
    )


def most_frequent(labels: np.ndarray, known: np.ndarray, step: int) -> np.ndarray:
    """Labels (rows, columns) uint8 of squares of pixels: that of most of their known pixels, of equals the smallest."""
    if step == 1:
        return labels
    present = np.unique(labels)
    shares = [shrink(((labels == label) & known).__getitem__, labels.shape, step) for label in present]
    return present[np.argmax(shares, axis=0)]


def errors(
    context: Context, scene: ExportedScene, look: PaintingLook, glosses: Mapping[str, RegionGloss]
) -> dict[str, dict[str, dict[str, float]]]:
    """Return PSNR of the stored look, seen from the front without cast shadows, under fitted and check lights.

    glosses : the look's gloss as formats take it, by their names; so are the results. The photographs are read once.
    """
    frames = Observations(context.inputs["ingest"].folder)
    photographs = Photographs(frames, scene)
    hold_out = context.settings.hold_out
    groups = {"fitted": frames.fit_lights(hold_out), "check": frames.check_lights(hold_out)}
    different = {id(gloss): gloss for gloss in glosses.values()}
    result: dict[str, dict[str, dict[str, float]]] = {name: {} for name in glosses}
    for group, lights in groups.items():
        if not len(lights):
            continue
        found = {each: CodedErrors(len(lights)) for each in different}
        for rows, values, valid in (strip for band in frames.bands() for strip in photographs.strips(band, lights)):
            texels = look.texels(rows, frames.shape[1])
            for each, gloss in different.items():
                material = gloss.of(texels.rows, texels.columns)
                for number, light in enumerate(lights):
                    shown = material.shown(texels.colours, texels.normals, frames.directions[light])
                    found[each].add(number, encode(shown, "srgb"), values[number].T, valid[number])
        for name, gloss in glosses.items():
            result[name][group] = found[id(gloss)].decibels()
    return result
