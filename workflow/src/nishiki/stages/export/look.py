"""How a painting looks to formats of scenes: displaced plane, textures, and gloss by region.

The gloss is fitted as materials of glTF 2.0 with KHR_materials_ior and _specular. The specification's dielectric,
appendix B, and KHR_materials_specular, for base colour c, roughness r (alpha = r^2),
weight w, index n and factor k of the reflectance at normal incidence:

    F = F0 + (1 - F0) (1 - v.h)^5,    F0 = min(k ((n - 1) / (n + 1))^2, 1)
    f = (1 - w F) c / pi + w F D V,   D, V: Trowbridge-Reitz with Smith's masking

Ours: pi f n.l = c n.l + sum beta D F G / n.v (Tominaga and Tanaka, 2004, eq. 10). A metal has metallic 1 and no body:

    f = F D V,    F = c + (1 - c) (1 - v.h)^5

A texel has the region that most of its pixels have, so that its gloss is one that was fitted: a mean of roughness and
strength would be the gloss of neither paint. The slopes inside the texel widen it: a texel shows the mean gloss of its
facets, not the gloss of their mean normal.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from nishiki.artifacts.maps import shrink
from nishiki.artifacts.stage import Context
from nishiki.brdf.slopes import isotropic_lobe, widened_roughness
from nishiki.brdf.torrance_sparrow import MIRROR, specular
from nishiki.colour.colour import decode, encode, srgb_encode
from nishiki.formats.textured_surface import INDEX, SurfaceLook, TexturedMesh
from nishiki.observations.plane import Observations
from nishiki.render.plane.scene import Gloss
from nishiki.stages.export.registry import METRES, CodedErrors, ExportedSurface, GltfLook
from nishiki.stages.export.scene import CodedPhotographs, ExportedScene, reliefs

ROUGHNESS = np.geomspace(1, 0.05, 90)
STRENGTH = np.append(0, np.geomspace(1e-3, 20, 120))
"""Grid of the fit: roughness, and the factor of the reflectance at normal incidence (weight where below 1)."""
ANGLES = np.radians(np.arange(0.5, 75, 1))  # of the light from the normal, seen along the normal


@dataclass(frozen=True)
class GltfMaterial:
    """Gloss of a surface, or of pixels with values of their own.

    roughness, strength : float or (n,) ndarray
        Of the reflectance along the normal, weight times factor; that of a metal is ignored.
    index : float
        Of refraction.
    least_factor : float
        The factor is at least this: 1, so that it is a weight up to 1 and a factor above; or the largest strength of
        several regions, whose weights share one factor.
    metallic : float or (n,) ndarray
        1 of a metal, whose base colour is that of its mirror; else 0.
    """

    roughness: float | np.ndarray
    strength: float | np.ndarray
    index: float
    least_factor: float = 1.0
    metallic: float | np.ndarray = 0.0

    @property
    def weight(self) -> float | np.ndarray:
        """specularFactor; 1 of a metal, which OpenPBR dims by it."""
        return np.maximum(self.strength / self.factor, self.metallic)

    @property
    def factor(self) -> float | np.ndarray:
        """specularColorFactor, of each channel."""
        return np.maximum(self.strength, self.least_factor)

    @property
    def reflectance_of_weight_1(self) -> float | np.ndarray:
        """F0."""
        return np.minimum(self.factor * ((self.index - 1) / (self.index + 1)) ** 2, 1.0)

    @property
    def normal_reflectance(self) -> float | np.ndarray:
        """w F0."""
        return self.weight * self.reflectance_of_weight_1

    @property
    def grazing_reflectance(self) -> float | np.ndarray:
        """w F at grazing light."""
        return self.weight

    def fresnel(self, cos_q: np.ndarray | float) -> np.ndarray | float:
        """Compute w F at the cosine of view and half vector."""
        normal = self.normal_reflectance
        return normal + (self.grazing_reflectance - normal) * (1 - cos_q) ** 5

    def base_colour(self, albedo: np.ndarray) -> np.ndarray:
        """Compute the base colour that yields this albedo (..., 3) (or a metal's) for light and view at the normal."""
        return np.clip(albedo / (1 - np.expand_dims(self.fresnel(1.0) * (1 - self.metallic), -1)), 0, 1)

    def render(self, base: np.ndarray, normals: np.ndarray, light: np.ndarray) -> np.ndarray:
        """Render light (n, 3) relative to a white that faces the lamp, along z; base colours and normals (n, 3)."""
        view = np.array([0.0, 0.0, 1.0])
        half = (light + view) / np.linalg.norm(light + view)
        cos_i, cos_r = (np.maximum(normals @ each, 0) for each in (light, view))
        reflected, metal = np.expand_dims(self.fresnel(half[2]), -1), np.expand_dims(self.metallic, -1)
        lobe = np.pi * isotropic_lobe(np.maximum(normals @ half, 0), cos_i, cos_r, np.square(self.roughness))
        body = (1 - metal) * (1 - reflected) * base
        reflected = reflected + metal * (base + (1 - base) * (1 - half[2]) ** 5 - reflected)
        return (body + reflected * lobe[:, None]) * cos_i[:, None]


class WhiteAtGrazing(GltfMaterial):
    """The same lobe in UsdPreviewSurface and OpenPBR, which lack a weight: they reflect all grazing light.

    OpenPBR has the exact reflectance of a dielectric where this has Schlick's approximation.
    """

    @property
    def grazing_reflectance(self) -> float:
        """1, whatever the weight."""
        return 1.0


def best_material(errors: np.ndarray, index: float, metallic: float = 0.0) -> GltfMaterial:
    """Return the material with the least of the errors (roughness, strength) of `coded_errors`."""
    rough, strong = np.unravel_index(int(np.argmin(errors)), errors.shape)
    return GltfMaterial(float(ROUGHNESS[rough]), float(STRENGTH[strong]), index, metallic=metallic)


def coded_errors(beta: np.ndarray, gamma: np.ndarray, index: float, albedo: float) -> np.ndarray:
    """Compute (roughness, strength) sums of weighted squared coded differences from our lobes, over the grid.

    beta, gamma : (lobes,); albedo : mean of the object, over which the gloss is seen along the normal. Those of a metal
    do not depend on the strength.
    """
    cos_i, cos_q = np.cos(ANGLES), np.cos(ANGLES / 2)
    up = np.array([0.0, 0.0, 1.0])
    lights = np.stack([np.sin(ANGLES), np.zeros_like(ANGLES), cos_i], axis=1)
    lobes = np.zeros_like(cos_i)
    for strength, width in zip(beta, gamma, strict=True):
        lobes += specular(up, lights, up, beta=strength, gamma=width, refractive_index=index)
    metal = index >= MIRROR
    true = np.clip(encode(albedo * lobes if metal else albedo * cos_i + lobes, "srgb"), 0, 1)
    errors = np.empty((len(ROUGHNESS), len(STRENGTH)))
    for number, roughness in enumerate(ROUGHNESS):
        material = GltfMaterial(roughness, STRENGTH[:, None], index)
        shape = np.pi * isotropic_lobe(cos_q, cos_i, 1.0, roughness**2) * cos_i
        reflected = albedo + (1 - albedo) * (1 - cos_q) ** 5 if metal else material.fresnel(cos_q)
        base = 0.0 if metal else np.clip(albedo / (1 - material.fresnel(1.0)), 0, 1)
        shown = encode((1 - reflected) * base * cos_i + reflected * shape, "srgb")
        errors[number] = (np.clip(shown, 0, 1) - true) ** 2 @ np.sin(ANGLES)
    return errors


MATTE = GltfMaterial(1.0, 0.0, INDEX)


@dataclass(frozen=True)
class RegionGloss:
    """Materials of one or several regions."""

    # one a region, all of the same index of refraction and factor; with several regions as 8 bits hold them
    materials: tuple[GltfMaterial, ...]
    # (rows, columns) uint8 ndarray or None: region of each texel; None where there is one region only
    labels: np.ndarray | None = None
    # (rows, columns) uint8 ndarray or None: roughness of each texel's lobe with the slopes inside the texel, 255 is 1;
    # None: that of the material
    widened: np.ndarray | None = None

    def of(self, rows: np.ndarray, columns: np.ndarray) -> GltfMaterial:
        """Return the material of the texels in some rows and columns, row by row."""
        material = self.materials[0]
        if self.labels is not None:
            numbers = self.labels[rows][:, columns].ravel()
            names = ("roughness", "strength", "metallic")
            material = replace(material, **{name: self._values(name)[numbers] for name in names})
        if self.widened is not None:
            material = replace(material, roughness=self.widened[rows][:, columns].ravel() / 255)
        return material

    @property
    def roughness(self) -> float | np.ndarray:
        """One value, or a texture (rows, columns) uint8."""
        if self.widened is not None:
            return self.widened
        return float(self.materials[0].roughness) if self.labels is None else self._texture("roughness")

    @property
    def weight(self) -> np.ndarray | None:
        """Share of the reflectance, a texture (rows, columns) uint8; None where there is one region only."""
        return None if self.labels is None else self._texture("weight")

    @property
    def metallic(self) -> float | np.ndarray:
        """One value, or a texture (rows, columns) uint8 where some regions are metal."""
        values = self._values("metallic")
        return float(values[0]) if (values == values[0]).all() else self._texture("metallic")

    @property
    def reflectance(self) -> float:
        """Reflectance along the normal; with several regions, at weight 1."""
        material = self.materials[0]
        return float(material.normal_reflectance if self.labels is None else material.reflectance_of_weight_1)

    def _values(self, name: str) -> np.ndarray:
        return np.array([getattr(material, name) for material in self.materials])

    def _texture(self, name: str) -> np.ndarray:
        return np.rint(255 * self._values(name)).astype(np.uint8)[self.labels]


@dataclass(frozen=True)
class PaintingGloss:
    """Gloss of a painting in the parameters of each format."""

    gltf: RegionGloss
    materialx: RegionGloss
    usd: RegionGloss


def painting_gloss(
    fitted: Gloss | None,
    albedo: np.ndarray,
    known: np.ndarray,
    labels: np.ndarray | None,
    variance: np.ndarray | None = None,
) -> PaintingGloss:
    """Fit one lobe to every region's lobes, nearest in coded brightness; matte where the gloss is omitted.

    albedo : (rows, columns, 3), over whose mean in a region its gloss is seen; known, labels : (rows, columns);
    variance : (rows, columns) of the slopes inside a texel, which widens its lobe.
    UsdPreviewSurface has one strength for all: that with which all regions together are nearest.
    """
    if fitted is None:
        matte = RegionGloss((MATTE,))
        return PaintingGloss(matte, _white(matte), _white(matte))
    beta, gamma, index = fitted.beta, fitted.gamma, fitted.refractive_index
    labels = labels if len(beta) > 1 else None
    metal = (index >= MIRROR).astype(float)
    common = float(INDEX if metal.all() else index.min())  # nothing shows that of a metal
    errors, counts = [], []
    for region in range(len(beta)):
        texels = known if labels is None else known & (labels == region)
        mean = float(albedo[texels].mean()) if texels.any() else 0.5
        errors.append(coded_errors(beta[region], gamma[region], float(index[region]), mean))
        counts.append(np.count_nonzero(texels))
    free = [best_material(each, common, mirror) for each, mirror in zip(errors, metal, strict=True)]
    together = sum(count * each.min(axis=0) for count, each in zip(counts, errors, strict=True))
    only = np.where(np.arange(together.size) == np.argmin(together), 0, np.inf)
    alike = [best_material(each + only, common, mirror) for each, mirror in zip(errors, metal, strict=True)]
    stored = tuple if labels is None else _quantise
    gltf, usd = (RegionGloss(stored(each), labels, _widen_roughness(each, labels, variance)) for each in (free, alike))
    return PaintingGloss(gltf, _white(gltf), _white(usd))


def _widen_roughness(
    materials: Sequence[GltfMaterial], labels: np.ndarray | None, variance: np.ndarray | None
) -> np.ndarray | None:
    """Compute the roughness of the texels' lobes, as 8 bits; None without widening or gloss."""
    if variance is None or all(material.strength + material.metallic == 0 for material in materials):
        return None
    roughness = np.array([material.roughness for material in materials])
    texture = np.empty(variance.shape, np.uint8)
    for row, each in enumerate(variance):
        narrow = roughness[0] if labels is None else roughness[labels[row]]
        texture[row] = np.maximum(np.rint(255 * widened_roughness(narrow, each)), 1)
    return texture


def _white(gloss: RegionGloss) -> RegionGloss:
    return replace(gloss, materials=tuple(WhiteAtGrazing(**vars(material)) for material in gloss.materials))


def _quantise(materials: Sequence[GltfMaterial]) -> tuple[GltfMaterial, ...]:
    """Quantise roughness and weight to 8 bits, with one factor."""
    most = max(1.0, *(float(material.strength) for material in materials))
    return tuple(
        replace(
            material,
            roughness=max(round(255 * float(material.roughness)), 1) / 255,
            strength=most * round(255 * float(material.strength) / most) / 255,
            least_factor=most,
        )
        for material in materials
    )


FIGURES = {"roughness": "roughness", "specular": "strength", "ior": "index", "metallic": "metallic"}


class TexelBlock(NamedTuple):
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

    def texels(self, rows: slice, columns: int) -> TexelBlock:
        """Select the texels that represent pixels."""
        down, across = np.arange(rows.start, rows.stop) // self.step, np.arange(columns) // self.step
        base = decode(self.colours[down][:, across].reshape(-1, 3) / 255, "srgb")
        normals = self.normals[down][:, across].reshape(-1, 3) / 255 * 2 - 1
        return TexelBlock(down, across, base, normals / np.linalg.norm(normals, axis=1, keepdims=True))

    def surface(self, gloss: RegionGloss) -> SurfaceLook:
        """Convert the look to the terms of USD and MaterialX."""
        return SurfaceLook(self.colours, gloss.roughness, gloss.reflectance, gloss.weight, self.normals, gloss.metallic)

    def figures(self, gloss: RegionGloss) -> dict:
        """Return the look's figures for the diagnostics."""
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
        """Length of 1 unit in the file."""
        pitch_mm = self.scene.pitch_mm
        return f"1 is 1000 {self.scene.unit}" if pitch_mm is None else "metres"

    def look_of(self, name: str) -> SurfaceLook:
        """Return textures and material in a format's terms."""
        return self.look.surface(getattr(self.look.gloss, name))

    @property
    def gltf_look(self) -> GltfLook:
        """Look in the terms of glTF."""
        look, gloss = self.look, self.look.gloss.gltf
        material = gloss.materials[0]
        weight = float(material.weight) if gloss.weight is None else gloss.weight
        factor, index = float(material.factor), material.index
        return GltfLook(look.colours, gloss.roughness, weight, factor, index, gloss.metallic, look.normals)

    def figures(self, name: str) -> dict:
        """Return a format's figures for the diagnostics besides its error."""
        return self.look.figures(getattr(self.look.gloss, name))

    def errors(self, formats: list[str]) -> dict[str, dict]:
        """Compute the PSNR of formats."""
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
    """Average maps to at most `most` texels a side, by bands; slopes: with their variance."""
    step = -(-max(scene.shape) // most)
    everything = slice(0, scene.shape[0])
    labels = scene.regions(everything)
    return TexelMaps(
        scene.mean(scene.srgb, step),
        scene.mean_normals(scene.relief_normals, step),
        None if labels is None else most_frequent(labels, scene.read_known(everything), step),
        scene.block_slopes(step)[..., ::2].mean(axis=-1) if slopes else None,
        step,
    )


def most_frequent(labels: np.ndarray, known: np.ndarray, step: int) -> np.ndarray:
    """Return labels (rows, columns) uint8 of squares of pixels: the most frequent known one, the smallest of equals."""
    if step == 1:
        return labels
    present = np.unique(labels)
    shares = [shrink(((labels == label) & known).__getitem__, labels.shape, step) for label in present]
    return present[np.argmax(shares, axis=0)]


def errors(
    context: Context, scene: ExportedScene, look: PaintingLook, glosses: Mapping[str, RegionGloss]
) -> dict[str, dict[str, dict[str, float]]]:
    """Compute the PSNR of the stored look, from the front without cast shadows, under fitted and check lights.

    glosses : the look's gloss as formats take it, by their names; so are the results. The photographs are read once.
    """
    frames = Observations(context.inputs["ingest"].folder)
    photographs = CodedPhotographs(frames, scene)
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
                    shown = material.render(texels.colours, texels.normals, frames.directions[light])
                    found[each].add(number, encode(shown, "srgb"), values[number].T, valid[number])
        for name, gloss in glosses.items():
            result[name][group] = found[id(gloss)].decibels()
    return result
