"""The gloss of a painting as materials of its regions, and the textures that hold them.

A texel has the region that most of its pixels have, so that its gloss is one that was fitted: a mean of roughness and
strength would be the gloss of neither paint. The slopes inside the texel widen it: a texel shows the mean gloss of its
facets, not the gloss of their mean normal.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.brdf.parameters import gloss_table, is_facets
from nishiki.brdf.trowbridge_reitz import widened_roughness
from nishiki.report.files import read_json
from nishiki.stages.export.gltf_material import GltfMaterial, best_material, coded_errors, white_at_grazing
from nishiki.stages.export.scene import ExportedScene

MATTE = GltfMaterial(1.0, 0.0, 1.5)


@dataclass(frozen=True)
class RegionGloss:
    """Materials of one or several regions.

    Attributes
    ----------
    materials : tuple of GltfMaterial
        One a region, all of the same index of refraction and factor; with several regions as 8 bits hold them.
    labels : (rows, columns) uint8 ndarray or None
        Region of each texel; None where there is one region only.
    widened : (rows, columns) uint8 ndarray or None
        Roughness of each texel's lobe with the slopes inside the texel, 255 is 1; None: that of the material.
    """

    materials: tuple[GltfMaterial, ...]
    labels: np.ndarray | None = None
    widened: np.ndarray | None = None

    def of(self, rows: np.ndarray, columns: np.ndarray) -> GltfMaterial:
        """The material of the texels in some rows and columns, row by row."""
        material = self.materials[0]
        if self.labels is not None:
            numbers = self.labels[rows][:, columns].ravel()
            roughness, strength = (self._values(name)[numbers] for name in ("roughness", "strength"))
            material = replace(material, roughness=roughness, strength=strength)
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
    def reflectance(self) -> float:
        """Along the normal; where there are several regions, of weight 1."""
        material = self.materials[0]
        return float(material.normal_reflectance if self.labels is None else material.reflectance_of_weight_1)

    def _values(self, name: str) -> np.ndarray:
        return np.array([getattr(material, name) for material in self.materials])

    def _texture(self, name: str) -> np.ndarray:
        return np.rint(255 * self._values(name)).astype(np.uint8)[self.labels]


@dataclass(frozen=True)
class PaintingGloss:
    """The gloss of a painting as each format takes it."""

    gltf: RegionGloss
    materialx: RegionGloss
    usd: RegionGloss


def slopes_widen(context: Context) -> bool:
    """Whether there is a gloss, and its lobes are those of the facets alone."""
    parameters = read_json(context.inputs.get("brdf"), "parameters.json")
    return parameters is not None and is_facets(parameters) and bool(gloss_table(parameters)[0].any())


def painting_gloss(
    context: Context,
    albedo: np.ndarray,
    known: np.ndarray,
    labels: np.ndarray | None,
    variance: np.ndarray | None = None,
) -> PaintingGloss:
    """Every region's lobes as one lobe, nearest in coded brightness; matte where the gloss is left out.

    albedo : (rows, columns, 3), over whose mean in a region its gloss is seen; known, labels : (rows, columns);
    variance : (rows, columns) of the slopes inside a texel, which widens its lobe.
    UsdPreviewSurface has one strength for all: that with which all regions together are nearest.
    """
    parameters = read_json(context.inputs.get("brdf"), "parameters.json")
    if parameters is None:
        return _one_region(MATTE)
    beta, gamma, index, _ = gloss_table(parameters)
    if labels is None or len(beta) == 1:
        mean = float(albedo[known].mean()) if known.any() else 0.5
        material = best_material(coded_errors(beta[0], gamma[0], float(index[0]), mean), float(index[0]))
        return _one_region(material, _widened([material], None, variance))
    errors, counts = [], []
    for region in range(len(beta)):
        texels = known & (labels == region)
        mean = float(albedo[texels].mean()) if texels.any() else 0.5
        errors.append(coded_errors(beta[region], gamma[region], float(index[0]), mean))
        counts.append(np.count_nonzero(texels))
    free = [best_material(each, float(index[0])) for each in errors]
    together = sum(count * each.min(axis=0) for count, each in zip(counts, errors, strict=True))
    only = np.where(np.arange(together.size) == np.argmin(together), 0, np.inf)
    alike = [best_material(each + only, float(index[0])) for each in errors]
    gltf, usd = (RegionGloss(_stored(each), labels, _widened(each, labels, variance)) for each in (free, alike))
    return PaintingGloss(gltf, _white(gltf), _white(usd))


def region_materials(context: Context, scene: ExportedScene) -> tuple[GltfMaterial, ...]:
    """The lobe of each region, as `painting_gloss` finds it from pixels, in full precision; read by bands."""
    parameters = read_json(context.inputs.get("brdf"), "parameters.json")
    if parameters is None:
        return (MATTE,)
    beta, gamma, index, _ = gloss_table(parameters)
    totals, counts = np.zeros(len(beta)), np.zeros(len(beta))
    for rows in scene.bands():
        known, labels = scene.known(rows), scene.regions(rows)
        numbers = np.zeros(known.shape, np.uint8) if labels is None or len(beta) == 1 else labels
        colours = scene.srgb(rows)[known].mean(axis=-1)
        totals += np.bincount(numbers[known], colours, len(beta))
        counts += np.bincount(numbers[known], minlength=len(beta))
    means = np.where(counts > 0, totals / np.maximum(counts, 1), 0.5)
    materials = [
        best_material(coded_errors(*lobes, float(index[0]), mean), float(index[0]))
        for *lobes, mean in zip(beta, gamma, means, strict=True)
    ]
    factor = max(1.0, *(float(material.strength) for material in materials))
    return tuple(replace(material, least_factor=factor) for material in materials)


def _one_region(material: GltfMaterial, widened: np.ndarray | None = None) -> PaintingGloss:
    gloss = RegionGloss((material,), None, widened)
    white = _white(gloss)
    return PaintingGloss(gloss, white, white)


def _widened(
    materials: Sequence[GltfMaterial], labels: np.ndarray | None, variance: np.ndarray | None
) -> np.ndarray | None:
    """Roughness of the texels' lobes, as 8 bits hold it; None where nothing widens them, or there is no gloss."""
    if variance is None or all(material.strength == 0 for material in materials):
        return None
    roughness = np.array([material.roughness for material in materials])
    texture = np.empty(variance.shape, np.uint8)
    for row, each in enumerate(variance):
        narrow = roughness[0] if labels is None else roughness[labels[row]]
        texture[row] = np.maximum(np.rint(255 * widened_roughness(narrow, each)), 1)
    return texture


def _white(gloss: RegionGloss) -> RegionGloss:
    return replace(gloss, materials=tuple(white_at_grazing(material) for material in gloss.materials))


def _stored(materials: Sequence[GltfMaterial]) -> tuple[GltfMaterial, ...]:
    """With one factor, and with what 8 bits leave of roughness and weight."""
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
