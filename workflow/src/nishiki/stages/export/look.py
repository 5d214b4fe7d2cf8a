"""How a painting looks to formats of scenes: textures of colour and normals, and one lobe of gloss for all of it."""

from dataclasses import dataclass

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.brdf.parameters import gloss_table
from nishiki.colour.colour import srgb_encode
from nishiki.colour.encoding import decode, encode
from nishiki.formats.textured_surface import SurfaceLook, TexturedMesh
from nishiki.observations.plane import Observations
from nishiki.report.files import read_json
from nishiki.stages.export.gltf_material import GltfMaterial, fitted_material
from nishiki.stages.export.photographs import CodedErrors, Photographs
from nishiki.stages.export.relief_mesh import block_mean, reliefs
from nishiki.stages.export.scene import ExportedScene

METRES = 1e-3  # of a millimetre; of a pixel where the capture states no scale


@dataclass(frozen=True)
class PaintingLook:
    """Material and textures of a painting.

    Attributes
    ----------
    material : GltfMaterial
        The lobe of gloss.
    colours, normals : (rows, columns, 3) uint8 ndarray
        Base colour, sRGB; normals of the relief, y up, (n + 1) / 2.
    step : int
        Pixels along the side of a texel.
    """

    material: GltfMaterial
    colours: np.ndarray
    normals: np.ndarray
    step: int

    def surface(self) -> SurfaceLook:
        """The same in the words of USD and MaterialX."""
        material = self.material
        return SurfaceLook(self.colours, material.roughness, material.normal_reflectance, normals=self.normals)

    def figures(self) -> dict:
        """What the diagnostics say of it."""
        material = self.material
        return {
            "pixels_a_texel": self.step * self.step,
            "material": {"roughness": material.roughness, "specular": material.strength, "ior": material.index},
        }


def painting_look(context: Context, scene: ExportedScene) -> PaintingLook:
    """Material and textures, at most `gltf.texture_px` texels a side."""
    albedo, normals, step = textures(scene, context.settings.gltf.texture_px)
    known = np.abs(normals).max(axis=-1) > 0
    mean = float(albedo[known].mean()) if known.any() else 0.5
    material = material_of(context, mean)
    colours = np.rint(255 * srgb_encode(material.base_colour(albedo))).astype(np.uint8)
    coded = np.rint((np.where(known[..., None], normals, [0, 0, 1]) + 1) / 2 * 255).astype(np.uint8)
    return PaintingLook(material, colours, coded, step)


def painting_mesh(context: Context, scene: ExportedScene) -> TexturedMesh:
    """The plane displaced by the height. Its normals are those of the plane, because the texture holds the relief's."""
    bands = list(reliefs(scene, context.settings.mesh_vertices, colours=None))
    places, texture, triangles = (
        np.concatenate([getattr(band, name) for band in bands]) for name in ("places", "texture", "triangles")
    )
    return TexturedMesh(places * METRES, np.broadcast_to(np.float32([0, 0, 1]), places.shape), texture, triangles)


def unit_of(scene: ExportedScene) -> str:
    """What a length of 1 in the file means."""
    return f"1 is 1000 {scene.unit}" if scene.pitch_mm is None else "metres"


def textures(scene: ExportedScene, most: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Linear sRGB albedo and unit normals (rows, columns, 3), at most `most` texels a side; pixels along a texel."""
    rows, columns = scene.shape
    step = -(-max(rows, columns) // most)
    high = max(1, scene.band_rows // step) * step
    albedo, normals = [], []
    for top in range(0, rows, high):
        band = slice(top, min(top + high, rows))
        known = scene.known(band)[..., None]
        share = np.maximum(block_mean(known, step), 1e-9)
        albedo.append((block_mean(scene.srgb(band), step) / share).astype(np.float32))
        mean = block_mean(scene.relief_normals(band), step)
        length = np.linalg.norm(mean, axis=-1, keepdims=True)
        normals.append((mean / np.where(length > 0, length, 1)).astype(np.float32))
    return np.concatenate(albedo), np.concatenate(normals), step


def material_of(context: Context, albedo: float) -> GltfMaterial:
    """One lobe for the whole painting: the largest region's, matte where the gloss is left out."""
    parameters = read_json(context.inputs.get("brdf"), "parameters.json")
    if parameters is None:
        return GltfMaterial(1.0, 0.0, 1.5)
    beta, gamma, index, _ = gloss_table(parameters)
    largest = int(np.argmax([region.get("samples", 0) for region in parameters["regions"]]))
    return fitted_material(beta[largest], gamma[largest], float(index[largest]), albedo)


def errors(
    context: Context,
    scene: ExportedScene,
    look: PaintingLook,
    material: GltfMaterial,
) -> dict[str, dict[str, float]]:
    """PSNR of the stored look, seen from the front without cast shadows, under fitted and check lights.

    material : how the format takes the look's lobe.
    """
    frames = Observations(context.inputs["ingest"].folder)
    photographs = Photographs(frames, scene)
    hold_out = context.settings.hold_out
    groups = {"fitted": frames.fit_lights(hold_out), "check": frames.check_lights(hold_out)}
    result = {}
    for name, lights in groups.items():
        if not len(lights):
            continue
        found = CodedErrors(len(lights))
        for rows, values, valid in (strip for band in frames.bands() for strip in photographs.strips(band, lights)):
            down = np.arange(rows.start, rows.stop) // look.step
            across = np.arange(frames.shape[1]) // look.step
            base = decode(look.colours[down][:, across].reshape(-1, 3) / 255, "srgb")
            normals = look.normals[down][:, across].reshape(-1, 3) / 255 * 2 - 1
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            for number, light in enumerate(lights):
                shown = material.shown(base, normals, frames.directions[light])
                found.add(number, encode(shown, "srgb"), values[:, number], valid[:, number])
        result[name] = found.decibels()
    return result
