"""Lobes of Trowbridge and Reitz in exported files beside the lobes of the fitted models, over lights and views.

    python benchmarks/gloss_conversion.py results/PAINTING ... [--albedo 0.3]

For each region of a painting's `brdf`: PSNR of sRGB-coded brightness, dB, of the material of `gltf`, seen at angles
from the normal of which the fit saw the first alone, under lights of which half lie around the mirror's direction; with
Schlick's reflectance, as glTF has it, and with that of a dielectric, as OpenPBR and Blender have it where the strength
is 1 or more. And the lobes of objects, a ball of albedo 0.3 under a lamp at angles from the view.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
import _project  # noqa: F401
from nishiki.brdf.scene import gloss_table
from nishiki.brdf.slopes import GRAZING, isotropic_lobe
from nishiki.brdf.torrance_sparrow import fresnel, specular
from nishiki.colour.colour import encode
from nishiki.stages.export.look import GltfMaterial, best_material, coded_errors
from nishiki.stages.export.object_look import ALPHA_PER_SIGMA

UP = np.array([0.0, 0.0, 1.0])
VIEWS = (0, 15, 30, 50, 65)
LAMPS = (3, 40, 80)


def towards(degrees: float) -> np.ndarray:
    """Unit vector at an angle from z."""
    return np.array([np.sin(np.radians(degrees)), 0, np.cos(np.radians(degrees))])


def decibels(theirs: np.ndarray, ours: np.ndarray) -> float:
    """PSNR of sRGB-coded values, peak 1."""
    coded = (np.clip(encode(np.clip(each, 0, 1), "srgb"), 0, 1) for each in (theirs, ours))
    return round(float(-10 * np.log10(np.mean(np.square(np.subtract(*coded))))), 1)


def lights_around(view: np.ndarray, width: float, count: int = 4000) -> np.ndarray:
    """(n, 3) directions more than 6° above the plane: half of them anywhere, half around the mirror's direction."""
    random = np.random.default_rng(0)
    lights = random.normal(size=(count, 3)) * [1, 1, 1]
    lights[:, 2] = np.abs(lights[:, 2])
    lights[: count // 2] = view * [-1, 1, 1] + random.normal(0, 2 * width, (count // 2, 3))
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    return lights[lights[:, 2] > 0.1]


def shown(material: GltfMaterial, albedo: float, lights: np.ndarray, view: np.ndarray, *, exact: bool) -> np.ndarray:
    """(n,) what a viewer shows of a plane."""
    base = np.clip(albedo / (1 - material.fresnel(1.0)), 0, 1)
    half = (lights + view) / np.linalg.norm(lights + view, axis=1, keepdims=True)
    reflected = material.fresnel(half @ view)
    if exact:
        root = np.sqrt(material.reflectance_of_weight_1)
        reflected = material.weight * fresnel(half @ view, (1 + root) / (1 - root))
    lobe = isotropic_lobe(half[:, 2], lights[:, 2], view[2], material.roughness**2)
    return ((1 - reflected) * base + np.pi * reflected * lobe) * lights[:, 2]


def of_painting(folder: Path, albedo: float):
    """Figures of each region."""
    beta, gamma, index, _ = gloss_table(json.loads((folder / "current/brdf/parameters.json").read_text()))
    for region, (strengths, widths) in enumerate(zip(beta, gamma, strict=True)):
        material = best_material(coded_errors(strengths, widths, float(index[region]), albedo), float(index[region]))
        lobes = {"roughness": round(material.roughness, 2), "strength": round(float(material.strength), 2)}
        line: dict = {"scene": folder.name, "region": region, **lobes, "schlick": {}, "dielectric": {}}
        for degrees in VIEWS:
            view = towards(degrees)
            lights = lights_around(view, float(widths[0]))
            ours = albedo * lights[:, 2]
            for strength, width in zip(strengths, widths, strict=True):
                given = {"beta": strength, "gamma": width, "refractive_index": index[region]}
                ours = ours + specular(UP, lights, view, **given)
            for name in ("schlick", "dielectric"):
                theirs = shown(material, albedo, lights, view, exact=name == "dielectric")
                line[name][degrees] = decibels(theirs, ours)
        yield line


def of_object(sigma: float, strength: float, albedo: float) -> dict:
    """Figures of a ball, seen along z, where K_s / cos(theta_r) (1 + a^2 / (4 sigma^2))^-2 is the gloss."""
    random = np.random.default_rng(1)
    z, turn = np.sqrt(random.random(20000)), 2 * np.pi * random.random(20000)
    normals = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
    alpha = min(ALPHA_PER_SIGMA * sigma, 1.0)
    normal = min(4 * alpha**2 * strength, 1.0)
    found = {}
    for degrees in LAMPS:
        lamp = towards(degrees)
        half = (lamp + UP) / np.linalg.norm(lamp + UP)
        cos_i, cos_phi = (np.maximum(normals @ each, 0) for each in (lamp, half))
        lobe = (1 + np.arccos(np.minimum(cos_phi, 1)) ** 2 / (4 * sigma**2)) ** -2 / np.maximum(z, GRAZING)
        ours = albedo * cos_i + np.where(cos_i > 0, strength * lobe, 0)
        reflected = normal + (1 - normal) * (1 - half[2]) ** 5
        gloss = np.pi * reflected * isotropic_lobe(cos_phi, cos_i, z, alpha)
        found[degrees] = decibels(((1 - reflected) * albedo + gloss) * cos_i, ours)
    return {"sigma": sigma, "ks": strength, "alpha": round(alpha, 2), "f0": round(normal, 3), "db": found}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=Path, help="results/SCENE")
    parser.add_argument("--albedo", type=float, default=0.3)
    options = parser.parse_args()
    for folder in options.folders:
        for line in of_painting(folder, options.albedo):
            print(json.dumps(line), flush=True)
    for sigma in (0.05, 0.1, 0.2, 0.35, 0.5):
        for strength in (0.05, 0.3):
            print(json.dumps(of_object(sigma, strength, options.albedo)), flush=True)


if __name__ == "__main__":
    main()
