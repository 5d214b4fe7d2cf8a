"""The material `principled` of Mitsuba 3 in place of our reflection model, for scenes without Python.

Its light for base colour c, roughness r (alpha = r^2) and index n, as Mitsuba 3.9 evaluates it (checked numerically):

    value = (1 - w) c i + w (c i B + pi F D V i)         i, o: cosines of light and view with the normal
    B = (1 - L / 2) (1 - S / 2) + R (L + S + L S (R - 1)),    L = (1 - i)^5, S = (1 - o)^5, R = 2 r q^2
    F: exact reflectance of a dielectric at q, the cosine of view and half vector; D V: Trowbridge-Reitz, light and view
    masked separately; B: B. Burley, Physically-based shading at Disney (2012)

w is the weight of a `blendbsdf` of diffuse and principled, which lets a texture say the strength of the gloss: a
principled has one index. The gloss takes no light from the body. `specular` s says n by ((n - 1) / (n + 1))^2 =
0.08 s. Its clearcoat is not used: its widest lobe has alpha 0.1, and its strength is a quarter of a 4 % reflectance.
"""

from typing import Any

import numpy as np

from nishiki.brdf.trowbridge_reitz import isotropic_lobe
from nishiki.formats.mitsuba_xml import Parameter
from nishiki.formats.textured_surface import index_of


def texture(file: str, *, raw: bool = True) -> dict[str, Any]:
    """A picture of values (raw) or of sRGB colours, as Mitsuba's dictionary."""
    return {"type": "bitmap", "filename": file, "raw": raw, "wrap_mode": "clamp"}


def material(
    colour: dict[str, Any], roughness: float | dict[str, Any], reflectance: float, weight: float | dict[str, Any]
) -> dict[str, Any]:
    """As Mitsuba's dictionary; reflectance: along the normal where the weight is 1; weight, roughness: or textures."""
    gloss = {"type": "principled", "base_color": colour, "roughness": roughness, "eta": index_of(reflectance)}
    body = {"type": "diffuse", "reflectance": colour}
    if not isinstance(weight, dict) and not 0 < weight < 1:
        return gloss if weight >= 1 else body
    return {"type": "blendbsdf", "weight": weight, "without": body, "with": gloss}


def film(columns: int, rows: int) -> dict[str, Any]:
    """Film and sampler of a sensor; the parameter `samples` is the samples of a pixel."""
    return {
        "film": {
            **{"type": "hdrfilm", "width": columns, "height": rows, "rfilter": {"type": "box"}},
            **{"component_format": "float32", "pixel_format": "rgb"},
        },
        "sampler": {"type": "independent", "sample_count": Parameter("samples", "integer")},
    }


def shown(
    colour: np.ndarray,
    roughness: np.ndarray | float,
    reflectance: float,
    weight: np.ndarray | float,
    cosines: tuple[np.ndarray, ...],
) -> tuple[np.ndarray, np.ndarray]:
    """Body (n, 3) and gloss (n,) of points, each to be multiplied by the irradiance of a white there.

    colour : (n, 3); roughness, weight : (n,) or numbers; reflectance : along the normal where the weight is 1; cosines
    : (n,) each, of the normal with half vector, light and view, and of view with half vector.
    """
    cos_phi, cos_i, cos_r, cos_q = cosines
    alpha = np.maximum(np.square(roughness), 1e-3)  # as Mitsuba bounds it
    light, view = ((1 - each) ** 5 for each in (cos_i, cos_r))
    back = 2 * roughness * cos_q**2
    burley = (1 - light / 2) * (1 - view / 2) + back * (light + view + light * view * (back - 1))
    gloss = np.pi * dielectric(cos_q, index_of(reflectance)) * isotropic_lobe(cos_phi, cos_i, cos_r, alpha)
    return colour * (1 - weight + weight * burley)[..., None], weight * gloss


def dielectric(cosine: np.ndarray, index: float) -> np.ndarray:
    """Exact reflectance of unpolarised light at a cosine, 0 to 1."""
    inside = np.sqrt(np.maximum(1 - (1 - np.square(cosine)) / index**2, 0))
    across = (cosine - index * inside) / (cosine + index * inside)
    along = (index * cosine - inside) / (index * cosine + inside)
    return (across**2 + along**2) / 2
