"""The surface of an object for formats of scenes, and what a viewer shows of it against the photographs."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.brdf.slopes import isotropic_lobe
from nishiki.brdf.texels.model import POINT, ViewLamp, factors
from nishiki.colour.colour import decode, encode
from nishiki.evaluate.object_photographs import Photographs
from nishiki.formats.textured_surface import SurfaceLook, TexturedMesh
from nishiki.geometry.visibility import rasterise
from nishiki.render.display import three_channels
from nishiki.stages.export.object_look import METRES, ObjectLook, object_look, object_mesh, sample
from nishiki.stages.export.photographs import CodedErrors
from nishiki.stages.export.registry import INDEX, ExportedSurface, GltfLook


@dataclass(frozen=True)
class SeenPoints:
    """Surface points behind the covered pixels of a captured view, under its first light."""

    # positions, normals: (n, 3) float64 ndarray: of the points, in the cameras' world; normals of unit length
    positions: np.ndarray
    normals: np.ndarray
    places: np.ndarray  # (n, 2) float64 ndarray: row and column in the textures, in texels
    centre: np.ndarray  # (3,) float64 ndarray: the camera's place
    lamp: ViewLamp  # the light
    covered: np.ndarray  # (rows, columns) bool ndarray: the pixels, in whose order the points come

    @classmethod
    def of(cls, look: ObjectLook, view: int) -> "SeenPoints":
        """Of the triangles that have a place in the textures."""
        decoded, layout = look.decoded, look.layout
        camera, mesh = decoded.cameras[view], decoded.mesh
        raster = rasterise(mesh, camera)
        covered = raster.triangle >= 0
        covered[covered] = layout.placed[raster.triangle[covered]]
        triangle, shares = raster.triangle[covered], raster.barycentric[covered].astype(np.float64)
        shares = np.column_stack([shares, 1 - shares.sum(axis=1)])[..., None]
        positions = np.sum(mesh.vertices[mesh.triangles[triangle]] * shares, axis=1)
        normals = np.sum(mesh.normals[mesh.triangles[triangle]] * shares, axis=1)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        places = np.sum(layout.corners[triangle] * shares, axis=1)
        return cls(positions, normals, places, camera.centre, decoded.lighting.lamp(camera, 0), covered)

    def factors(self) -> tuple[np.ndarray, np.ndarray]:
        """Irradiance (n, 3) and strength of the lamp in the gloss (n,), as `nishiki.brdf.texels.model` has them."""
        irradiance, angles = factors(self.positions, self.normals, self.centre, self.lamp, 3)
        return irradiance, angles[:, 0]

    def cosines(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return (n,) of the normal with half vector, light and view, at least 0, and of view with half vector."""
        light, towards = direction_to(self.lamp, self.positions), self.centre - self.positions
        towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
        half = light + towards
        half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-9)
        cos_phi, cos_i, cos_r = (np.maximum(np.sum(self.normals * each, axis=1), 0) for each in (half, light, towards))
        return cos_phi, cos_i, cos_r, np.sum(half * towards, axis=1)


Shown = Callable[[SeenPoints], np.ndarray]
"""Linear values (n, 3) that a program shows of seen points."""


def shown_in(look: ObjectLook, name: str) -> Shown:
    """Compute what a viewer shows of `gltf`, `usd` or `materialx`, light and view without cast shadows."""
    said = look.of_one_strength() if name == "usd" else look
    alpha, strength = (said.roughness / 255) ** 2, said.specular / 255
    stored = np.concatenate([decode(look.colour / 255, "srgb"), alpha[..., None], strength[..., None]], axis=-1)

    def shown(points: SeenPoints) -> np.ndarray:
        texels = sample(stored, points.places)
        irradiance, strength = points.factors()
        cos_phi, cos_i, cos_r, cos_q = points.cosines()
        normal = texels[:, 4] * look.normal_reflectance
        grazing = texels[:, 4] if name == "gltf" else 1.0
        reflected = normal + (grazing - normal) * (1 - cos_q) ** 5
        gloss = np.pi * reflected * isotropic_lobe(cos_phi, cos_i, cos_r, texels[:, 3]) * cos_i * strength
        return look.scale * ((1 - reflected[:, None]) * texels[:, :3] * irradiance + gloss[:, None])

    return shown


def against_photographs(
    context: Context, look: ObjectLook, asked: Mapping[str, Shown]
) -> dict[str, dict[str, dict[str, float]]]:
    """Compare linear values of seen points with photographs: PSNR of left-out views and of some others."""
    decoded, settings, count = look.decoded, context.settings, len(look.decoded.views)
    left_out = decoded.numbers(settings.hold_out)
    seen = [view for view in range(count) if view not in left_out]
    spread = [seen[k * len(seen) // settings.views] for k in range(min(settings.views, len(seen)))]
    photographs = Photographs(context.inputs)
    result: dict[str, dict[str, dict[str, float]]] = {name: {} for name in asked}
    for group, views in (("fitted", spread), ("check", sorted(left_out))):
        if not views:
            continue
        found = {name: CodedErrors(len(views)) for name in asked}
        for number, view in enumerate(views):
            linear, valid = photographs.read(view, 0)
            points = SeenPoints.of(look, view)
            compared = encode(three_channels(linear)[points.covered], decoded.encoding)
            for name, shown in asked.items():
                found[name].add(number, encode(shown(points), decoded.encoding), compared, valid[points.covered])
        for name, each in found.items():
            result[name][group] = each.decibels()
    return result


def direction_to(lamp: ViewLamp, positions: np.ndarray) -> np.ndarray:
    """Return (n, 3) unit vectors to a lamp; 0 for surroundings without a highlight."""
    vectors = lamp.vector - positions if lamp.form == POINT else np.broadcast_to(lamp.vector, positions.shape)
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9)


class ObjectSurface(ExportedSurface):
    """What formats of scenes have in common."""

    stem = "object"

    @cached_property
    def look(self) -> ObjectLook:
        """Textures."""
        return object_look(self.context)

    @cached_property
    def mesh(self) -> TexturedMesh:
        """In metres where its unit is known."""
        return object_mesh(self.context, self.look)

    @property
    def unit(self) -> str:
        """What a length of 1 in a file means."""
        unit = self.context.inputs["mesh"].diagnostics.get("unit")
        return "metres" if unit in METRES else f"{unit} of the cameras"

    def look_of(self, name: str) -> SurfaceLook:
        """Return textures and material as a format takes them; the gloss has one strength in USD."""
        return (self.look.of_one_strength() if name == "usd" else self.look).surface()

    @property
    def gltf_look(self) -> GltfLook:
        """Return the look in the words of glTF."""
        look = self.look
        return GltfLook(look.colour, look.roughness, look.specular, look.factor, INDEX)

    def figures(self, name: str) -> dict:
        """Return what the diagnostics say of any format."""
        return self.look.figures()

    def errors(self, formats: list[str]) -> dict[str, dict]:
        """Return PSNR of the stored textures against photographs, as the formats take them."""
        return against_photographs(self.context, self.look, {name: shown_in(self.look, name) for name in formats})
