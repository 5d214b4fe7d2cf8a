"""Compiled sums over the facets of two families of yarns: see `nishiki.brdf.cloth.yarn_facets` for the model."""

import math

import numpy as np
from numba import njit

from nishiki.brdf.kernels import fresnel_scalar

HALF_PI = 0.5 * math.pi
OPEN = 9.0  # limit of a side that the direction does not come from
# Columns of an atom: its normal, its yarn's direction on the surface, the third axis, tilts along x and y, weight
NORMAL, ALONG, ACROSS, TILT_X, TILT_Y, WEIGHT, ATOM = 0, 3, 6, 9, 10, 11, 12


@njit(cache=True, nogil=True, error_model="numpy")
def _limit(table, component, up):
    """Steepest tilt that a direction still reaches in one plane, from a table over its angle in 0 .. pi/2."""
    last = table.shape[0] - 1
    place = math.atan2(abs(component), up) / HALF_PI * last
    low = min(int(place), last - 1)
    share = place - low
    return table[low] * (1.0 - share) + table[low + 1] * share


@njit(cache=True, nogil=True, error_model="numpy")
def _narrow(tables, family, direction, limits):
    """Lower limits[family] = (x >= 0, x < 0, y >= 0, y < 0) to what a direction reaches."""
    for axis in range(2):
        limit = _limit(tables[family, axis], direction[axis], direction[2])
        side = 2 * axis + (0 if direction[axis] >= 0.0 else 1)
        limits[family, side] = min(limits[family, side], limit)


@njit(cache=True, nogil=True, error_model="numpy")
def _share(margin, softness):
    """Share of facets that are reached, from how far they are inside of the limit: 0 .. 1 over four softnesses."""
    u = min(max(0.5 + 0.25 * margin / softness, 0.0), 1.0)
    return u * u * (3.0 - 2.0 * u)


@njit(cache=True, error_model="numpy", inline="always")
def facet_reflection(a, i, o, half, ci, co, along, across):
    """D G / 2 of anisotropic GGX facets at a point of a yarn (Walter et al. 2007), so that the point's share of the
    cloth's reflectance is F / 2 times it: n.i n.o / (i_z o_z) F D G / (4 n.i n.o), where the facets' own cosines cancel
    those of the yarn's surface.

    a: columns normal, along and across the fibres; i, o, half: directions of light, view and between them; ci, co:
    cosines of i and o with the normal; along, across: roughness.
    """
    hx, hy, hz = half
    h1 = (hx * a[3] + hy * a[4] + hz * a[5]) / along
    h2 = (hx * a[6] + hy * a[7] + hz * a[8]) / across
    h3 = hx * a[0] + hy * a[1] + hz * a[2]
    spread = h1 * h1 + h2 * h2 + h3 * h3
    i1 = (i[0] * a[3] + i[1] * a[4] + i[2] * a[5]) * along
    i2 = (i[0] * a[6] + i[1] * a[7] + i[2] * a[8]) * across
    o1 = (o[0] * a[3] + o[1] * a[4] + o[2] * a[5]) * along
    o2 = (o[0] * a[6] + o[1] * a[7] + o[2] * a[8]) * across
    si = math.sqrt(i1 * i1 + i2 * i2 + ci * ci)
    so = math.sqrt(o1 * o1 + o2 * o2 + co * co)
    return ci * co / (math.pi * along * across * spread * spread * (co * si + ci * so))


@njit(cache=True, nogil=True, error_model="numpy")
def sums(incident, outgoing, atoms, split, rough, index, tables, softness, out):
    """out (n, 4): mirror reflection and body, 1 / sr, of the warp's and of the weft's facets.

    incident, outgoing (n, 3); atoms (p, ATOM), the warp's first, `split` of them; rough (2, 2) along and across the
    fibres of warp and weft; tables (2, 2, m) limits by family and plane.
    """
    limits = np.empty((2, 4))
    for k in range(incident.shape[0]):
        i, o = incident[k], outgoing[k]
        out[k, 0] = out[k, 1] = out[k, 2] = out[k, 3] = 0.0
        if not (i[2] > 0.0 and o[2] > 0.0):
            continue
        hx, hy, hz = i[0] + o[0], i[1] + o[1], i[2] + o[2]
        length = math.sqrt(hx * hx + hy * hy + hz * hz)
        hx, hy, hz = hx / length, hy / length, hz / length
        mirror = 0.5 * fresnel_scalar(min(0.5 * length, 1.0), index)
        limits[:] = OPEN
        for family in range(2):
            _narrow(tables, family, i, limits)
            _narrow(tables, family, o, limits)
        mirror_warp = mirror_weft = body_warp = body_weft = 0.0
        for p in range(atoms.shape[0]):
            a = atoms[p]
            ci = a[0] * i[0] + a[1] * i[1] + a[2] * i[2]
            co = a[0] * o[0] + a[1] * o[1] + a[2] * o[2]
            if ci <= 0.0 or co <= 0.0:
                continue
            family = 0 if p < split else 1
            seen = a[WEIGHT]
            if limits[family, 0] < HALF_PI:
                seen *= _share(limits[family, 0] - a[TILT_X], softness)
            if limits[family, 1] < HALF_PI:
                seen *= _share(limits[family, 1] + a[TILT_X], softness)
            if limits[family, 2] < HALF_PI:
                seen *= _share(limits[family, 2] - a[TILT_Y], softness)
            if limits[family, 3] < HALF_PI:
                seen *= _share(limits[family, 3] + a[TILT_Y], softness)
            if seen <= 0.0:
                continue
            ra, rc = rough[family, 0], rough[family, 1]
            facets = facet_reflection(a, i, o, (hx, hy, hz), ci, co, ra, rc)
            value = seen * mirror * facets
            through = (1.0 - fresnel_scalar(ci, index)) * (1.0 - fresnel_scalar(co, index))
            if family == 0:
                mirror_warp += value
                body_warp += seen * ci * co * through
            else:
                mirror_weft += value
                body_weft += seen * ci * co * through
        scale = 1.0 / (i[2] * o[2])
        out[k, 0], out[k, 1] = scale * mirror_warp, scale * body_warp / math.pi
        out[k, 2], out[k, 3] = scale * mirror_weft, scale * body_weft / math.pi
