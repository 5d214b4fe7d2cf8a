"""Reflection of paints, glazes and gold: GGX gloss over a rough, refracting body. Not the models that the chain fits.

All values are relative to a perfect white diffuser that faces the lamp: π · f_r · cosθ_i.
"""

import math

import numba
import numpy as np


@numba.njit(cache=True)
def fresnel(cosine, index):
    """Unpolarised reflectance of a dielectric surface, exact; cosine of incidence 0..1, index of refraction > 1."""
    g = math.sqrt(index * index - 1.0 + cosine * cosine)
    ratio = (g - cosine) / (g + cosine)
    second = (cosine * (g + cosine) - 1.0) / (cosine * (g - cosine) + 1.0)
    return 0.5 * ratio * ratio * (1.0 + second * second)


@numba.njit(cache=True)
def ggx_gloss(n_l, n_v, n_h, v_h, alpha, index):
    """Gloss π D F G / (4 n·v) of the GGX distribution with height-correlated Smith masking.

    Walter et al., Microfacet models for refraction, EGSR 2007, eq. 33; masking: Heitz, JCGT 3(2), 2014, eq. 99.
    n_l, n_v > 0 are cosines of light and view with the normal, n_h and v_h those of the half vector; alpha > 0.
    """
    if n_l <= 0.0 or n_v <= 0.0 or n_h <= 0.0:
        return 0.0
    a2 = alpha * alpha
    spread = n_h * n_h * (a2 - 1.0) + 1.0
    # π·D = a²/spread²;  G/(4 n·l n·v) = 1/(2 (n·l √(…n·v) + n·v √(…n·l))), times cosθ_i = n·l.
    light = n_l * math.sqrt(a2 + (1.0 - a2) * n_v * n_v)
    view = n_v * math.sqrt(a2 + (1.0 - a2) * n_l * n_l)
    return a2 / (spread * spread) * fresnel(min(v_h, 1.0), index) * 0.5 / (light + view) * n_l


@numba.njit(cache=True)
def facets(n_l, n_v, h_t, h_b, h_n, l_t, l_b, v_t, v_b, alpha_t, alpha_b):
    """π D G₂ / (4 n·v) of anisotropic GGX facets, without Fresnel's factor.

    Heitz, Understanding the masking-shadowing function, JCGT 3(2), 2014: eq. 85 (distribution), 86 (slopes' variance
    along a direction), 99 (height-correlated masking). Components: along the tangent, the bitangent, the normal.
    """
    if n_l <= 0.0 or n_v <= 0.0:
        return 0.0
    spread = (h_t / alpha_t) ** 2 + (h_b / alpha_b) ** 2 + h_n * h_n
    # Masking with both square roots over a common denominator: no division by n·l or n·v, finite at grazing angles.
    light = math.sqrt(n_l * n_l + (alpha_t * l_t) ** 2 + (alpha_b * l_b) ** 2)
    view = math.sqrt(n_v * n_v + (alpha_t * v_t) ** 2 + (alpha_b * v_b) ** 2)
    return 0.5 * n_l / (alpha_t * alpha_b * spread * spread * (n_v * light + n_l * view))


@numba.njit(cache=True)
def oren_nayar(n_l, n_v, l_v, sigma):
    """Factor of Lambert's law of a rough surface, and its value where light and view are along the normal.

    Oren & Nayar, SIGGRAPH 1994, eq. 30 (qualitative model). n_l, n_v > 0, l_v : cosines of light-normal, view-normal
    and light-view. sigma : roughness, radians.
    """
    s2 = sigma * sigma
    a = 1.0 - 0.5 * s2 / (s2 + 0.33)
    b = 0.45 * s2 / (s2 + 0.09)
    # cos Δφ · sinθ_l · sinθ_v = l·v − n·l n·v;  sin α tan β = sinθ_l sinθ_v / max(n·l, n·v).
    side = (l_v - n_l * n_v) / max(n_l, n_v, 1e-6)
    return a + b * max(side, 0.0), a


@numba.njit(cache=True)
def rough_body(n_l, n_v, l_v, sigma, index):
    """Share of the body's reflection that differs from Lambert's law; 1 where light and view are along the normal.

    `oren_nayar` times the transmission of the surface for light and view. index > 1, or 1 = no surface.
    """
    value, straight = oren_nayar(n_l, n_v, l_v, sigma)
    value /= straight
    if index > 1.0:
        straight = 1.0 - fresnel(1.0, index)
        value *= (1.0 - fresnel(n_l, index)) * (1.0 - fresnel(n_v, index)) / (straight * straight)
    return value


@numba.njit(cache=True)
def rough_matter(n_l, n_v, l_v, sigma, index):
    """Body reflection of albedo 1: `oren_nayar` below a surface of this index.

    The surface's losses for light and view are not given back, so that body and gloss together never exceed the
    light that arrives.
    """
    if n_l <= 0.0 or n_v <= 0.0:
        return 0.0
    passing = (1.0 - fresnel(min(n_l, 1.0), index)) * (1.0 - fresnel(min(n_v, 1.0), index))
    return n_l * passing * oren_nayar(n_l, n_v, l_v, sigma)[0]


def metal_fresnel(cosine, straight):
    """Schlick's approximation (1994) for a surface whose reflectance at normal incidence is `straight`; any shapes."""
    return straight + (1.0 - straight) * (1.0 - np.clip(cosine, 0.0, 1.0)) ** 5
