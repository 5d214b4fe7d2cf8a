"""The material of glTF 2.0 with KHR_materials_ior and KHR_materials_specular, and its fit to our gloss.

The specification's dielectric, appendix B, and KHR_materials_specular, for base colour c, roughness r (alpha = r^2),
weight w, index n and factor k of the reflectance at normal incidence:

    F = F0 + (1 - F0) (1 - v.h)^5,    F0 = min(k ((n - 1) / (n + 1))^2, 1)
    f = (1 - w F) c / pi + w F D V,   D, V: Trowbridge-Reitz with Smith's masking

Ours: pi f n.l = c n.l + sum beta D F G / n.v (Tominaga and Tanaka, 2004, eq. 10).
"""

from dataclasses import dataclass

import numpy as np

from nishiki.brdf.torrance_sparrow import specular
from nishiki.brdf.trowbridge_reitz import isotropic_lobe
from nishiki.colour.encoding import encode

ROUGHNESS = np.geomspace(1, 0.05, 90)
STRENGTH = np.append(0, np.geomspace(1e-3, 20, 120))
"""Grid of the fit: roughness, and the factor of the reflectance at normal incidence (weight where below 1)."""
ANGLES = np.radians(np.arange(0.5, 75, 1))  # of the light from the normal, seen along the normal


@dataclass(frozen=True)
class GltfMaterial:
    """Gloss of a surface, or of pixels with values of their own.

    roughness, strength : float or (n,) ndarray
        Of the reflectance along the normal, weight times factor.
    index : float
        Of refraction.
    least_factor : float
        The factor is at least this: 1, so that it is a weight up to 1 and a factor above; or the largest strength of
        several regions, whose weights share one factor.
    """

    roughness: float | np.ndarray
    strength: float | np.ndarray
    index: float
    least_factor: float = 1.0

    @property
    def weight(self) -> float | np.ndarray:
        """specularFactor."""
        return self.strength / self.factor

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

    def fresnel(self, cos_q: np.ndarray | float) -> np.ndarray:
        """w F at the cosine of view and half vector."""
        normal = self.normal_reflectance
        return normal + (self.grazing_reflectance - normal) * (1 - cos_q) ** 5

    def base_colour(self, albedo: np.ndarray) -> np.ndarray:
        """The base colour with which the body has this albedo (..., 3) under light and view along the normal."""
        return np.clip(albedo / (1 - np.expand_dims(self.fresnel(1.0), -1)), 0, 1)

    def shown(self, base: np.ndarray, normals: np.ndarray, light: np.ndarray) -> np.ndarray:
        """(n, 3) light relative to a white that faces the lamp, seen along z; base colours and normals (n, 3)."""
        view = np.array([0.0, 0.0, 1.0])
        half = (light + view) / np.linalg.norm(light + view)
        cos_i, cos_r = (np.maximum(normals @ each, 0) for each in (light, view))
        reflected = self.fresnel(half[2])
        alpha = np.square(self.roughness)
        gloss = np.pi * reflected * isotropic_lobe(np.maximum(normals @ half, 0), cos_i, cos_r, alpha)
        return (np.expand_dims(1 - reflected, -1) * base + gloss[:, None]) * cos_i[:, None]


class WhiteAtGrazing(GltfMaterial):
    """The same lobe in UsdPreviewSurface and OpenPBR, which have no weight: at grazing light they reflect all of it.

    OpenPBR has the exact reflectance of a dielectric where this has Schlick's approximation.
    """

    @property
    def grazing_reflectance(self) -> float:
        """1, whatever the weight."""
        return 1.0


def white_at_grazing(material: GltfMaterial) -> GltfMaterial:
    """A material as formats without a weight take it."""
    return WhiteAtGrazing(material.roughness, material.strength, material.index, material.least_factor)


def best_material(errors: np.ndarray, index: float) -> GltfMaterial:
    """Return the material of the least of the errors (roughness, strength) of `coded_errors`."""
    rough, strong = np.unravel_index(int(np.argmin(errors)), errors.shape)
    return GltfMaterial(float(ROUGHNESS[rough]), float(STRENGTH[strong]), index)


def coded_errors(beta: np.ndarray, gamma: np.ndarray, index: float, albedo: float) -> np.ndarray:
    """(roughness, strength) weighted sums of squared differences of coded brightness from our lobes, over the grid.

    beta, gamma : (lobes,); albedo : mean of the object, over which the gloss is seen along the normal.
    """
    cos_i, cos_q = np.cos(ANGLES), np.cos(ANGLES / 2)
    up = np.array([0.0, 0.0, 1.0])
    lights = np.stack([np.sin(ANGLES), np.zeros_like(ANGLES), cos_i], axis=1)
    lobes = np.zeros_like(cos_i)
    for strength, width in zip(beta, gamma, strict=True):
        lobes += specular(up, lights, up, beta=strength, gamma=width, refractive_index=index)
    true = np.clip(encode(albedo * cos_i + lobes, "srgb"), 0, 1)
    errors = np.empty((len(ROUGHNESS), len(STRENGTH)))
    for number, roughness in enumerate(ROUGHNESS):
        material = GltfMaterial(roughness, STRENGTH[:, None], index)
        shape = np.pi * isotropic_lobe(cos_q, cos_i, 1.0, roughness**2) * cos_i
        reflected = material.fresnel(cos_q)
        base = np.clip(albedo / (1 - material.fresnel(1.0)), 0, 1)
        shown = encode((1 - reflected) * base * cos_i + reflected * shape, "srgb")
        errors[number] = (np.clip(shown, 0, 1) - true) ** 2 @ np.sin(ANGLES)
    return errors
