"""The Torrance-Sparrow lobe for one pixel, put together from the compiled parts that renderers and fits loop over."""

import numpy as np
from numba import njit

from nishiki.brdf.torrance_sparrow import fresnel_scalar, phi_squared

# A facet distribution below 2^-60 (8.7e-19 of its peak) counts as 0: beyond 7.7 half widths nothing else is computed.
_NEGLIGIBLE = 60.0


@njit(cache=True, error_model="numpy")
def masking_over_cos_r_scalar(cos_phi, cos_i, cos_r, cos_q):
    """G / cos_r for cos_i, cos_r, cos_q > 0; see `torrance_sparrow.masking_over_cos_r`."""
    groove = 2.0 * cos_phi / cos_q
    if cos_i < cos_r:
        groove *= cos_i / cos_r
    return max(0.0, min(1.0 / cos_r, groove))


@njit(cache=True, error_model="numpy")
def lobe_coordinates_scalar(nx, ny, nz, lx, ly, lz, vx, vy, vz, widest, refractive_index):
    """(phi^2, F G / cos_r) of unit normal n, direction to the light l and to the viewer v: what lobes have in common.

    A renderer with several lobes sums beta_k 2^-(phi^2 / gamma_k^2) itself and multiplies once.  `widest`: the largest
    half width, radians.  (0, 0) where n . l <= 0 or n . v <= 0, and where that lobe is below 2^-60 of its peak.
    """
    cos_i = np.float64(nx) * lx + np.float64(ny) * ly + np.float64(nz) * lz
    cos_r = np.float64(nx) * vx + np.float64(ny) * vy + np.float64(nz) * vz
    if not (cos_i > 0.0 and cos_r > 0.0):
        return 0.0, 0.0
    hx, hy, hz = np.float64(lx) + vx, np.float64(ly) + vy, np.float64(lz) + vz
    cx, cy, cz = ny * hz - nz * hy, nz * hx - nx * hz, nx * hy - ny * hx
    length2 = hx * hx + hy * hy + hz * hz
    sin2 = (cx * cx + cy * cy + cz * cz) / length2
    reach2 = _NEGLIGIBLE * widest * widest
    if sin2 > reach2:  # sin phi <= phi: outside for certain
        return 0.0, 0.0
    length = np.sqrt(length2)
    cos_phi = (cos_i + cos_r) / length
    # 1 - cos phi = sin^2 phi / (1 + cos phi) has no cancellation at phi -> 0
    phi2 = phi_squared(min(0.5, 0.5 * sin2 / (1.0 + cos_phi)))
    if phi2 > reach2:
        return 0.0, 0.0
    cos_q = min(1.0, 0.5 * length)
    return phi2, fresnel_scalar(cos_q, refractive_index) * masking_over_cos_r_scalar(cos_phi, cos_i, cos_r, cos_q)


@njit(cache=True, error_model="numpy")
def specular_scalar(nx, ny, nz, lx, ly, lz, vx, vy, vz, gamma, refractive_index):
    """D F G / cos_r of Tominaga and Tanaka (2004), eq. 10 for unit normal n, direction to the light l and to the viewer
    v; multiply by beta.

    `gamma` radians > 0, `refractive_index` >= 1.  0 where n . l <= 0 or n . v <= 0, and where D is below 2^-60.
    """
    phi2, factor = lobe_coordinates_scalar(nx, ny, nz, lx, ly, lz, vx, vy, vz, np.float64(gamma), refractive_index)
    if factor == 0.0:
        return 0.0
    ratio = 1.0 / np.float64(gamma)
    return np.exp2(-(phi2 * ratio) * ratio) * factor
