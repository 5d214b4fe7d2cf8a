"""Reflect light at simulated paints, glazes, gold and filaments, by models that no fit uses.

All values are relative to a perfect white diffuser that faces the lamp: π · f_r · cosθ_i.
"""

import math

import numba
import numpy as np


def dielectric_fresnel(cosine, index):
    """Compute the unpolarised reflectance of a dielectric surface, exact; cosine 0..1, index of refraction > 1.

    Numbers, or arrays; kernels call it by the name `fresnel`.
    """
    g = np.sqrt(index * index - 1.0 + cosine * cosine)
    ratio = (g - cosine) / (g + cosine)
    second = (cosine * (g + cosine) - 1.0) / (cosine * (g - cosine) + 1.0)
    return 0.5 * ratio * ratio * (1.0 + second * second)


fresnel = numba.njit(cache=True)(dielectric_fresnel)


@numba.njit(cache=True)
def ggx_gloss(n_l, n_v, n_h, v_h, alpha, index):
    """Compute the gloss π D F G / (4 n·v) of the GGX distribution with height-correlated Smith masking.

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


def facets(half, light, view, alpha_t, alpha_b):
    """Compute π D G₂ / (4 n·v) of anisotropic GGX facets, without Fresnel's factor.

    Heitz, Understanding the masking-shadowing function, JCGT 3(2), 2014: eq. 85 (distribution), 86 (slopes' variance
    along a direction), 99 (height-correlated masking). Components of half vector, light and view: along the tangent,
    the bitangent, the normal; arrays of one shape. 0 where light or view is below the surface.
    """
    (h_t, h_b, h_n), (l_t, l_b, n_l), (v_t, v_b, n_v) = half, light, view
    above = (n_l > 0.0) & (n_v > 0.0)
    spread = (h_t / alpha_t) ** 2 + (h_b / alpha_b) ** 2 + h_n * h_n
    # Masking with both square roots over a common denominator: no division by n·l or n·v, finite at grazing angles.
    lit = np.sqrt(n_l * n_l + (alpha_t * l_t) ** 2 + (alpha_b * l_b) ** 2)
    seen = np.sqrt(n_v * n_v + (alpha_t * v_t) ** 2 + (alpha_b * v_b) ** 2)
    reach = np.where(above, n_v * lit + n_l * seen, np.inf)
    return 0.5 * n_l / (alpha_t * alpha_b * spread * spread * reach)


def rough_factor(n_l, n_v, l_v, sigma):
    """Compute the factor of Lambert's law of a rough surface, and its value where light and view are along the normal.

    Oren & Nayar, SIGGRAPH 1994, eq. 30 (qualitative model). n_l, n_v > 0, l_v : cosines of light-normal, view-normal
    and light-view. sigma : roughness, radians. Numbers, or arrays; kernels call it by the name `oren_nayar`.
    """
    s2 = sigma * sigma
    a = 1.0 - 0.5 * s2 / (s2 + 0.33)
    b = 0.45 * s2 / (s2 + 0.09)
    # cos Δφ · sinθ_l · sinθ_v = l·v − n·l n·v;  sin α tan β = sinθ_l sinθ_v / max(n·l, n·v).
    side = (l_v - n_l * n_v) / np.maximum(np.maximum(n_l, n_v), 1e-6)
    return a + b * np.maximum(side, 0.0), a


oren_nayar = numba.njit(cache=True)(rough_factor)


@numba.njit(cache=True)
def rough_body(n_l, n_v, l_v, sigma, index):
    """Compute the body's reflection relative to Lambert's law; 1 where light and view are along the normal.

    `oren_nayar` times the transmission of the surface for light and view. index > 1, or 1 = no surface.
    """
    value, straight = oren_nayar(n_l, n_v, l_v, sigma)
    value /= straight
    if index > 1.0:
        straight = 1.0 - fresnel(1.0, index)
        value *= (1.0 - fresnel(n_l, index)) * (1.0 - fresnel(n_v, index)) / (straight * straight)
    return value


def rough_matter(n_l, n_v, l_v, sigma, index):
    """Compute the body reflection of albedo 1: `rough_factor` below a surface of this index; arrays of one shape.

    The surface's losses for light and view are not given back, so that body and gloss together never exceed the
    light that arrives.
    """
    lit, seen = (1.0 - dielectric_fresnel(np.minimum(cosine, 1.0), index) for cosine in (n_l, n_v))
    return np.where((n_l > 0.0) & (n_v > 0.0), n_l * lit * seen * rough_factor(n_l, n_v, l_v, sigma)[0], 0.0)


def metal_fresnel(cosine, straight):
    """Apply Schlick's approximation (1994) to a surface of reflectance `straight` at normal incidence; any shapes."""
    return straight + (1.0 - straight) * (1.0 - np.clip(cosine, 0.0, 1.0)) ** 5


SINGLE = 0.5
"""Share of the body's light that was scattered once only."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def reflect_filament(i, o, surface):
    """Compute the mirror reflection F D G / (4 cosθ_i cosθ_o), 1/sr; x along the filaments, z along the normal.

    i, o: unit directions to light and view; surface: roughness along and across the filaments, refractive index.

    Normally distributed slopes (P. Beckmann and A. Spizzichino, 1963) of deviations along/√2 and across/√2, masking and
    shadowing by Smith's integral of that distribution, exact, correlated by height (E. Heitz, JCGT 3(2), 2014, eq. 65,
    99), exact Fresnel reflectance. 0 where either direction is below the surface; symmetric in the two directions.
    """
    (ix, iy, iz), (ox, oy, oz), (along, across, index) = i, o, (surface[0], surface[1], surface[2])
    if iz <= 0.0 or oz <= 0.0:
        return 0.0
    hx, hy, hz = ix + ox, iy + oy, iz + oz
    if hz <= 1e-9:
        return 0.0
    tilt = ((hx / along) ** 2 + (hy / across) ** 2) / (hz * hz)
    length = math.sqrt(hx * hx + hy * hy + hz * hz)
    cosine = hz / length
    d = math.exp(-tilt) / (math.pi * along * across * cosine**4)
    # cosθ_i cosθ_o (1 + Λ_i + Λ_o), free of 0/0 at grazing angles.
    light, view = hide(ix, iy, iz, along, across), hide(ox, oy, oz, along, across)
    reach = iz * oz + oz * light + iz * view
    return fresnel(min((ix * hx + iy * hy + iz * hz) / length, 1.0), index) * d * 0.25 / reach


@numba.njit(cache=True, nogil=True, error_model="numpy")
def hide(x, y, z, along, across):
    """Compute cosθ Λ: Smith's integral of normally distributed slopes, times the cosine."""
    spread = math.sqrt((along * x) ** 2 + (across * y) ** 2)
    if spread <= 1e-12 * z:
        return 0.0
    a = z / spread
    return max(0.5 * (spread * math.exp(-a * a) / math.sqrt(math.pi) - z * math.erfc(a)), 0.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def body(iz, oz, index):
    """Compute the reflection of a perfectly white body below the smooth surface, 1/sr: light scattered once and often.

    Both transmissions, times half of 1/(2π (μ_i + μ_o)), single scattering in a deep medium (Lommel-Seeliger) with the
    cosines μ inside, and half of Lambert's 1/π.
    """
    if iz <= 0.0 or oz <= 0.0:
        return 0.0
    passed = (1.0 - fresnel(iz, index)) * (1.0 - fresnel(oz, index))
    inside = math.sqrt(1.0 - (1.0 - iz * iz) / index**2) + math.sqrt(1.0 - (1.0 - oz * oz) / index**2)
    return passed * (SINGLE / (2.0 * inside) + 1.0 - SINGLE) / math.pi


@numba.njit(cache=True, nogil=True, error_model="numpy")
def in_frame(dx, dy, dz, f):
    """Rotate a direction into the frame f = (n, t) of `points.frames`: along, across the filaments, normal."""
    nx, ny, nz, tx, ty, tz = f[0], f[1], f[2], f[3], f[4], f[5]
    bx, by, bz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
    return dx * tx + dy * ty + dz * tz, dx * bx + dy * by + dz * bz, dx * nx + dy * ny + dz * nz
