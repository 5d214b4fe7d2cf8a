"""How the filaments on a yarn's surface reflect: anisotropic facets of a dielectric over a dyed, scattering body."""

from __future__ import annotations

import math

import numba

from nishiki.simulate.reflection import fresnel

SINGLE = 0.5
"""Share of the body's light that was scattered once only."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def facets(ix, iy, iz, ox, oy, oz, along, across, index):
    """Mirror reflection F D G / (4 cosθ_i cosθ_o) of facets, 1/sr; x along the filaments, z along the normal.

    Normally distributed slopes (P. Beckmann and A. Spizzichino, 1963) of deviations along/√2 and across/√2, masking and
    shadowing by Smith's integral of that distribution, exact, correlated by height (E. Heitz, JCGT 3(2), 2014, eq. 65,
    99), exact Fresnel reflectance. 0 where either direction is below the surface; symmetric in the two directions.
    """
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
    light, view = hidden(ix, iy, iz, along, across), hidden(ox, oy, oz, along, across)
    reach = iz * oz + oz * light + iz * view
    return fresnel(min((ix * hx + iy * hy + iz * hz) / length, 1.0), index) * d * 0.25 / reach


@numba.njit(cache=True, nogil=True, error_model="numpy")
def hidden(x, y, z, along, across):
    """cosθ Λ: Smith's integral of normally distributed slopes, times the cosine."""
    spread = math.sqrt((along * x) ** 2 + (across * y) ** 2)
    if spread <= 1e-12 * z:
        return 0.0
    a = z / spread
    return max(0.5 * (spread * math.exp(-a * a) / math.sqrt(math.pi) - z * math.erfc(a)), 0.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def body(iz, oz, index):
    """Reflection of a perfectly white body below the smooth surface, 1/sr: light scattered once and often.

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
    """A direction in the frame f = (n, t) of `points.frames`: along the filaments, across them, along the normal."""
    nx, ny, nz, tx, ty, tz = f[0], f[1], f[2], f[3], f[4], f[5]
    bx, by, bz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
    return dx * tx + dy * ty + dz * tz, dx * bx + dy * by + dz * bz, dx * nx + dy * ny + dz * nz
