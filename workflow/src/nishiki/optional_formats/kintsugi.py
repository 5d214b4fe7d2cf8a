"""Write an object as glTF with tables of gloss, for Kintsugi 3D Viewer."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.brdf.texels.model import facet_lobe
from nishiki.colour.colour import decode, srgb_encode
from nishiki.formats.banded_pictures import png_bytes
from nishiki.formats.textured_surface import NORMAL_REFLECTANCE, Glb, quantise, sample

FOLDER = "exports/kintsugi"
TABLES = "basisFunctions.csv"
BASES = 8  # as many as the viewer's shader adds up
SAMPLES = 91  # of a table, as the Builder writes them
NARROWEST, WIDEST = 0.01, 1.0  # radians; a table ends at 60 degrees
FIRST_STEP = 1 / 255
"""Light from behind: it avoids a division by 0 in the shader and is invisible in 8 bits."""


@dataclass(frozen=True)
class LobeBasis:
    """Gloss as a sum of weighted tables.

    Reflectance in Kintsugi 3D Viewer (source: its shader BasisIBR-ORM, and the serialiser of its Builder):

        f = d / pi + D(phi) G,    D(phi) = sum_b w_b T_b(u),    u = sqrt(3 phi / pi)

    d: diffuse colour; phi: angle of normal and half vector; T_b: a table for each of eight functions and three
    channels, even steps of u from 0 to 1 (60 degrees), linear between; w_b: weights in 0 to 1; G: masking over 4 n.l
    n.v. Our lobe K_s / n.v (1 + phi^2 / (4 sigma^2))^-2, relative to a white that faces the lamp, is D = 4 K_s / pi
    (..)^-2 without masking. The tables are such lobes of eight widths, and the weights of a texel the least squares of
    its own lobe.
    """

    tables: np.ndarray  # (8, 3, 91) float64 ndarray: D of each function, for red, green and blue
    weights: np.ndarray  # (rows, columns, 8) uint8 ndarray: shares of 255 of the functions at texels

    @classmethod
    def of(cls, ks: np.ndarray, sigma: np.ndarray) -> "LobeBasis":
        """Fit lobes at texels: ks (rows, columns, 3) relative to a lamp of strength 1; sigma (rows, columns), radians.

        All texels have the mean colour of the gloss. The strongest 0.1 % of the weights of a function are clipped.
        """
        from scipy.optimize import nnls

        strength, width = ks.mean(axis=-1), np.clip(sigma, NARROWEST, WIDEST)
        glossy = width[strength > 0] if (strength > 0).any() else width
        low, high = np.percentile(glossy, (0.5, 99.5))
        widths = np.geomspace(low, max(high, 1.1 * low), BASES)
        own = np.geomspace(widths[0], widths[-1], 8 * BASES)
        basis = lobes(widths)
        # nonnegative shares of these lobes whose sum is next to a lobe of each width
        shares = np.array([nnls(basis.T, lobe)[0] for lobe in lobes(own)])
        peak, colour = 4 / np.pi * strength, ks.mean(axis=(0, 1)) / max(strength.mean(), 1e-12)
        tables, weights = np.empty((BASES, 3, SAMPLES)), np.empty((*strength.shape, BASES), np.uint8)
        for number, lobe in enumerate(basis):
            wanted = peak * np.interp(width, own, shares[:, number])
            largest = float(np.percentile(wanted[wanted > 0], 99.9)) if (wanted > 0).any() else 0.0
            tables[number] = largest * colour[:, None] * lobe
            weights[..., number] = quantise(wanted / max(largest, 1e-12))
        return cls(tables, weights)

    def text(self) -> str:
        """Write the tables in the viewer's format: three rows a function."""
        rows = [
            ", ".join([f"{channel}#{number}", *(f"{value:.9f}" for value in table)])
            for number, tables in enumerate(self.tables)
            for channel, table in zip(("Red", "Green", "Blue"), tables, strict=True)
        ]
        return "\n".join(rows) + "\n"


def lobes(widths: np.ndarray) -> np.ndarray:
    """Compute (k, 91) (1 + phi^2 / (4 sigma^2))^-2 at the samples of a table, of widths sigma (k,) in radians."""
    phi = np.pi / 3 * np.linspace(0, 1, SAMPLES) ** 2
    return facet_lobe(phi**2, widths[:, None])


def write_kintsugi(context: Context, surface: Any) -> dict:
    """Write the folder `kintsugi` of an `ObjectSurface`; return its error against photographs."""
    look, model = surface.look, surface.model
    basis = LobeBasis.of(model["ks"] / look.scale, model["sigma"][..., 0])
    glb = Glb()

    def put(name: str, data: bytes) -> str:
        context.output.path(f"{FOLDER}/{name}").write_bytes(data)
        return name

    def texture(name: str, picture: np.ndarray) -> int:
        return glb.texture_of(uri=put(f"{name}.png", png_bytes(picture)))

    normal = srgb_encode(look.specular[..., None] / 255 * look.normal_reflectance * np.ones(3))
    weights = [texture(f"weights{b:02}{b + 3:02}", basis.weights[..., b : b + 4]) for b in range(0, BASES, 4)]
    extras = {
        "diffuseTexture": {"index": texture("diffuse", look.colour)},
        "diffuseConstantTexture": {"index": texture("constant", quantise(np.full((1, 1, 3), FIRST_STEP)))},
        "specularTexture": {"index": texture("specular", quantise(normal))},
        "basisFunctionsUri": put(TABLES, basis.text().encode("ascii")),
        "specularWeights": {"stride": 4, "textures": [{"index": each} for each in weights]},
    }
    surface.add_to(glb, texture, extras=extras)
    surface.save(glb, f"{FOLDER}/object.glb")
    found = surface.compare({"kintsugi": draw_as_viewer(look, basis)})
    return {
        "vertices": len(surface.mesh.positions),
        **look.figures(),
        "kinds": {name: {"psnr_db": figures} for name, figures in found.items()},
    }


def draw_as_viewer(look: Any, basis: LobeBasis) -> Callable[[Any], np.ndarray]:
    """Render visible points (`SeenPoints`) with these textures as the viewer's shader does.

    Its masking G = 0.5 / max(0.05, n.v sqrt(S(l)^2 + n.l S(v))) is, on a smooth surface, by sqrt(2 n.l / (n.l + n.v))
    too strong: 1.41 with the lamp at the camera. Fresnel's rise is that from 0.04 to 1.
    """
    colour = decode(look.colour / 255, "srgb")

    def draw(points: Any) -> np.ndarray:
        body = sample(colour, points.places)
        weights, roughness = (sample(each, points.places) / 255 for each in (basis.weights, look.roughness[..., None]))
        irradiance, strength = points.factors()
        cos_phi, cos_i, cos_r, cos_q = points.cosines()
        last = basis.tables.shape[-1] - 1  # 0 beyond 60 degrees, as in the viewer's shader
        place = np.sqrt(3 * np.arccos(np.clip(cos_phi, 0, 1)) / np.pi) * last
        before = np.minimum(place.astype(np.int64), last + 1)
        share = np.minimum(place - before, 1)
        padded = np.pad(basis.tables, ((0, 0), (0, 0), (0, 2)))
        found = np.einsum("nb,bcn->nc", weights, padded[..., before] * (1 - share) + padded[..., before + 1] * share)
        grazing = found.mean(axis=1, keepdims=True) / NORMAL_REFLECTANCE
        rising = found + (grazing - found) * ((1 - cos_q) ** 5)[:, None]
        light, view = (each**2 + roughness[:, 0] ** 4 * (1 - each**2) for each in (cos_i, cos_r))  # S^2
        masking = 0.5 / np.maximum(cos_r * np.sqrt(light + cos_i * np.sqrt(view)), 0.05)
        gloss = rising * (masking * cos_i * strength)[:, None]
        return look.scale * (body * irradiance + np.pi * gloss)

    return draw
