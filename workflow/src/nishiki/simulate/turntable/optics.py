"""Reflection of the object's materials: GGX facets, rough or anisotropic, over a rough body. Not the fitted models.

All values are relative to a perfect white diffuser that faces the lamp: π · f_r · cosθ_i.
"""

import math

import numba
import numpy as np

from nishiki.simulate.reflection import fresnel
from nishiki.threads import over_rows

INDEX = 1.5  # of glazes and lacquer


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
def rough_matter(n_l, n_v, l_v, sigma):
    """Body reflection of albedo 1: Oren & Nayar (SIGGRAPH 1994, eq. 30) below a surface of index `INDEX`.

    The surface's losses for light and view are not given back, so that body and gloss together never exceed the
    light that arrives. sigma : roughness, radians.
    """
    if n_l <= 0.0 or n_v <= 0.0:
        return 0.0
    s2 = sigma * sigma
    a = 1.0 - 0.5 * s2 / (s2 + 0.33)
    b = 0.45 * s2 / (s2 + 0.09)
    side = (l_v - n_l * n_v) / max(n_l, n_v)
    passing = (1.0 - fresnel(min(n_l, 1.0), INDEX)) * (1.0 - fresnel(min(n_v, 1.0), INDEX))
    return n_l * passing * (a + b * max(side, 0.0))


def metal_fresnel(cosine, straight):
    """Schlick's approximation (1994) for a surface whose reflectance at normal incidence is `straight`; any shapes."""
    return straight + (1.0 - straight) * (1.0 - np.clip(cosine, 0.0, 1.0)) ** 5


@numba.njit(cache=True)
def _reflect(m, lx, ly, lz, vx, vy, vz, body, gloss):
    """Body and mirror reflection (3,) each of the material m (materials.py) for unit directions to light and view."""
    nx, ny, nz = m[9], m[10], m[11]
    n_l, n_v = nx * lx + ny * ly + nz * lz, nx * vx + ny * vy + nz * vz
    l_v = lx * vx + ly * vy + lz * vz
    matter = rough_matter(n_l, n_v, l_v, m[8])
    length = math.sqrt(max(2.0 + 2.0 * l_v, 1e-12))
    hx, hy, hz = (lx + vx) / length, (ly + vy) / length, (lz + vz) / length
    tx, ty, tz = m[12], m[13], m[14]
    bx, by, bz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
    shape = facets(
        n_l,
        n_v,
        hx * tx + hy * ty + hz * tz,
        hx * bx + hy * by + hz * bz,
        hx * nx + hy * ny + hz * nz,
        lx * tx + ly * ty + lz * tz,
        lx * bx + ly * by + lz * bz,
        vx * tx + vy * ty + vz * tz,
        vx * bx + vy * by + vz * bz,
        m[6],
        m[7],
    )
    cosine = min(max(hx * vx + hy * vy + hz * vz, 0.0), 1.0)
    glass, grazing = fresnel(cosine, INDEX), (1.0 - cosine) ** 5
    for c in range(3):
        body[c] = m[c] * matter
        gloss[c] = shape * (m[3 + c] + (1.0 - m[3 + c]) * grazing if m[3] > 0.0 else glass)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _reflect_all(start, stop, materials, lights, views, body, gloss):
    for p in range(start, stop):
        s, v = lights[p], views[p]
        _reflect(materials[p], s[0], s[1], s[2], v[0], v[1], v[2], body[p], gloss[p])


def reflected(materials: np.ndarray, lights: np.ndarray, views: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Body and mirror reflection (n, 3) of materials (n, NUMBERS) for unit directions to light and view (n, 3)."""
    body, gloss = np.zeros((len(materials), 3)), np.zeros((len(materials), 3))
    if len(materials):
        arrays = (np.ascontiguousarray(a, np.float64) for a in (materials, lights, views))
        over_rows(_reflect_all, len(materials), *arrays, body, gloss)
    return body, gloss
