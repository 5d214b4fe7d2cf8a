"""Would KHR_materials_clearcoat hold the gloss of a painting better than one lobe? Measured on its photographs.

    .venv/bin/python benchmarks/clearcoat.py results/SCENE ...

Each region's lobe is fitted once alone, as the export does, and once below a clearcoat of any roughness and strength,
both by coded brightness. Printed: rms error of both fits, and PSNR of coded pictures (dB, peak 1) against photographs
under the lights of the fit and under others.
"""

import argparse
import json
import sys
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from scipy.optimize import least_squares

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
import _project  # noqa: F401
from nishiki.artifacts.artifact import open_artifact
from nishiki.brdf.scene import gloss_table
from nishiki.brdf.slopes import isotropic_lobe
from nishiki.brdf.torrance_sparrow import specular
from nishiki.colour.colour import decode, encode
from nishiki.report.page import read_json
from nishiki.stages.export import ExportSettings
from nishiki.stages.export.look import ANGLES, GltfMaterial, PaintingSurface, RegionGloss, errors, textures
from nishiki.stages.export.scene import ExportedScene

UP = np.array([0.0, 0.0, 1.0])
COAT = 0.04  # reflectance along the normal of a clearcoat, whose index is 1.5
LEAST, MOST = (0.05, 0.0, 0.0, 0.05), (1.0, 20.0, 1.0, 1.0)  # roughness, strength, clearcoat, its roughness


@dataclass(frozen=True)
class Coated:
    """f = f_base (1 - c F) + c F D V; plain: the material that the stored base colours are of."""

    plain: GltfMaterial
    base: GltfMaterial
    coat: np.ndarray | float
    rough: np.ndarray | float

    def render(self, colours: np.ndarray, normals: np.ndarray, light: np.ndarray) -> np.ndarray:
        """As `GltfMaterial.shown`."""
        half = (light + UP) / np.linalg.norm(light + UP)
        cos_i, cos_r, cos_phi = (np.maximum(normals @ each, 0) for each in (light, UP, half))
        albedo = colours * (1 - np.expand_dims(self.plain.fresnel(1.0), -1))
        below = self.base.base_colour(albedo / (1 - COAT * np.expand_dims(self.coat, -1)))
        fresnel = self.coat * (COAT + (1 - COAT) * (1 - half[2]) ** 5)
        coat = np.pi * fresnel * isotropic_lobe(cos_phi, cos_i, cos_r, np.square(self.rough)) * cos_i
        return np.expand_dims(1 - fresnel, -1) * self.base.render(below, normals, light) + coat[:, None]


@dataclass(frozen=True)
class CoatedGloss:
    """parameters (regions, 4): roughness, strength, clearcoat and its roughness."""

    gloss: RegionGloss
    parameters: np.ndarray

    def of(self, rows: np.ndarray, columns: np.ndarray) -> Coated:
        """As `RegionGloss.of`."""
        labels = self.gloss.labels
        numbers = 0 if labels is None else labels[rows][:, columns].ravel()
        roughness, strength, coat, rough = self.parameters[numbers].T
        plain = self.gloss.of(rows, columns)
        return Coated(plain, GltfMaterial(roughness, strength, plain.index), coat, rough)


def fitted(plain: GltfMaterial, lobes: np.ndarray, albedo: float) -> tuple[np.ndarray, float, float]:
    """Parameters (4,) of the best coated material, and rms errors of the coded brightness of the plain and of it."""
    lights = np.stack([np.sin(ANGLES), np.zeros_like(ANGLES), np.cos(ANGLES)], axis=1)
    true = np.clip(encode(albedo * lights[:, 2] + lobes, "srgb"), 0, 1)
    weights = np.sqrt(np.sin(ANGLES) / np.sum(np.sin(ANGLES)))
    colour = plain.base_colour(np.full((1, 3), albedo))

    def difference(x: np.ndarray) -> np.ndarray:
        coated = Coated(plain, GltfMaterial(x[0], x[1], plain.index), x[2], x[3])
        shown = [coated.render(colour, UP[None], light)[0, 0] for light in lights]
        return weights * (np.clip(encode(np.array(shown), "srgb"), 0, 1) - true)

    alone = difference(np.array([plain.roughness, plain.strength, 0, 0.5]))
    starts = product(
        (plain.roughness, 0.8), (0.5 * plain.strength, plain.strength), ((0.3, 0.2), (0.3, 0.6), (0.9, 0.5))
    )
    found = [
        least_squares(difference, [roughness, strength + 0.01, *coat], bounds=(LEAST, MOST), x_scale=0.2, max_nfev=200)
        for roughness, strength, coat in starts
    ]
    best = min(found, key=lambda each: each.cost)
    return best.x, float(np.sqrt(alone @ alone)), float(np.sqrt(2 * best.cost))


def measured(folder: Path) -> dict:
    """Figures of one scene."""
    current = folder / "current"
    names = [name for name in ("ingest", "normals", "height", "spectra", "brdf") if (current / name).exists()]
    inputs = {name: open_artifact(current / name) for name in names}
    context, scene = SimpleNamespace(inputs=inputs, settings=ExportSettings()), ExportedScene(inputs)
    look = PaintingSurface(context, scene).look
    gloss, colours = replace(look.gloss.gltf, widened=None), decode(look.colours / 255, "srgb")
    beta, gamma, index, _ = gloss_table(read_json(inputs["brdf"], "parameters.json"))
    lights = np.stack([np.sin(ANGLES), np.zeros_like(ANGLES), np.cos(ANGLES)], axis=1)
    known = np.abs(textures(scene, context.settings.gltf.texture_px, slopes=False).normals).max(axis=-1) > 0
    regions, parameters = [], []
    for number, plain in enumerate(gloss.materials):
        lobes = sum(
            specular(UP, lights, UP, beta=b, gamma=g, refractive_index=index[number])
            for b, g in zip(beta[number], gamma[number], strict=True)
        )
        inside = known if gloss.labels is None else known & (gloss.labels == number)
        albedo = float(colours[inside].mean() * (1 - plain.fresnel(1.0)))
        best, alone, coated = fitted(plain, lobes, albedo)
        parameters.append(best)
        regions.append({"one lobe, rms": alone, "coated, rms": coated, "coated": best.round(3).tolist()})
    found = errors(context, scene, look, {"one lobe": gloss, "coated": CoatedGloss(gloss, np.array(parameters))})
    psnr = {name: {group: each["all"] for group, each in groups.items()} for name, groups in found.items()}
    return {"scene": folder.name, "regions": regions, "psnr_db": psnr}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, help="results/SCENE")
    for folder in parser.parse_args().folders:
        print(json.dumps(measured(folder)), flush=True)


if __name__ == "__main__":
    main()
