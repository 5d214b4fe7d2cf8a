"""How the filaments on a yarn's surface reflect: anisotropic facets of a dielectric over a dyed, scattering body."""

from __future__ import annotations

import math

import numba

from nishiki.simulate.reflection import fresnel


@numba.njit(cache=True, nogil=True, error_model="numpy")
def facets(ix, iy, iz, ox, oy, oz, along, across, index):
    """Mirror reflection F D G / (4 cosθ_i cosθ_o) of facets, 1/sr; x along the filaments, z along the normal.

    Anisotropic GGX distribution with height-correlated Smith masking (Heitz, JCGT 3(2), 2014, eq. 85, 87, 99) and exact
    Fresnel reflectance. 0 where either direction is below the surface; symmetric in the two directions.
    """
    if iz <= 0.0 or oz <= 0.0:
        return 0.0
    hx, hy, hz = ix + ox, iy + oy, iz + oz
    length = math.sqrt(hx * hx + hy * hy + hz * hz)
    hx, hy, hz = hx / length, hy / length, hz / length
    spread = hx * hx / (along * along) + hy * hy / (across * across) + hz * hz
    d = 1.0 / (math.pi * along * across * spread * spread)
    light = math.sqrt(iz * iz + (along * ix) ** 2 + (across * iy) ** 2)
    view = math.sqrt(oz * oz + (along * ox) ** 2 + (across * oy) ** 2)
    # G/(4 cosθ_i cosθ_o) = 1/(2 (cosθ_o √.. + cosθ_i √..)), free of 0/0 at grazing angles.
    return fresnel(min(ix * hx + iy * hy + iz * hz, 1.0), index) * d * 0.5 / (oz * light + iz * view)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def body(iz, oz, index):
    """Reflection of a perfectly white body below the smooth surface, 1/sr: Lambert's law times both transmissions."""
    if iz <= 0.0 or oz <= 0.0:
        return 0.0
    return (1.0 - fresnel(iz, index)) * (1.0 - fresnel(oz, index)) / math.pi


@numba.njit(cache=True, nogil=True, error_model="numpy")
def in_frame(dx, dy, dz, f):
    """A direction in the frame f = (n, t) of `points.frames`: along the filaments, across them, along the normal."""
    nx, ny, nz, tx, ty, tz = f[0], f[1], f[2], f[3], f[4], f[5]
    bx, by, bz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
    return dx * tx + dy * ty + dz * tz, dx * bx + dy * by + dz * bz, dx * nx + dy * ny + dz * nz
