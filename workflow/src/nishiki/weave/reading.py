"""What a woven section reflects in its plane: a gloss and a body column, each linear in its strength.

Two readings of one section. `paper`: W eq. 15, rho = k_s D F G / cos(theta_r) + k_d d G, in which the section enters by
its masking alone. `shaded`: every piece of the section that is lit and seen reflects by its own slope, the gloss by
facets that scatter about it, D(theta_h - slope), the body by Lambert's law; integrated over these pieces in closed
form. Light off the normal: G is the share that is lit and seen, the gloss is divided by cos(theta_i) as well. For light
and view along the normal both columns are 1 without the Fresnel term, so a strength is its part of rho: k_s F0, k_d d.

The lobe D is W's exp(-x^2 / a^2), or that of GGX in the plane (Walter et al., EGSR 2007), whose tails are those of
fibres: 1 / (cos^2 x + sin^2 x / a^2)^2.
"""

from math import atan, cos, erf, exp, pi, sin, sqrt, tan

import numpy as np
from numba import njit

from nishiki.weave.visibility import HALF_PI, share_seen, side_lengths

PARAMETERS = ("theta_a", "flank", "humps", "log_width", "contact")  # of one plane; see shape_of
PLANES = ("weft", "warp")  # 0, 1
PAPER, SHADED = 0, 2  # a reading's number is one of these plus one of the lobes'
GAUSS, GGX = 0, 1
SIZE = len(PARAMETERS)


@njit(cache=True, nogil=True, error_model="numpy")
def shape_of(p, plane):
    """(theta_a, l, r, m, n, contact) of one plane's parameters, scaled to l + r theta_a = 1.

    p = (theta_a, flank = l / (l + a), humps = share of the length outside of flat top or contacts, log of the lobe's
    width, contact): all within bounds and of like size, whatever the lengths are.
    """
    theta_a, flank, humps, contact = p[0], p[1], p[2], p[4]
    radius = (1.0 - flank) / theta_a
    rest = 4.0 * (1.0 - humps) / humps
    if plane == 1:
        return (theta_a, flank, radius, rest, 1.0, HALF_PI)
    return (theta_a, flank, radius, 0.0, 1.0 + rest / (2.0 * radius * contact), contact)


@njit(cache=True, nogil=True, error_model="numpy")
def schlick(f0, cosine):
    """Schlick's Fresnel term, over its value f0 at normal incidence."""
    return 1.0 + (1.0 / f0 - 1.0) * (1.0 - cosine) ** 5


@njit(cache=True, nogil=True, error_model="numpy")
def lobe(x, width, kind):
    """D at an angle x from the middle, 1 at 0; 0 beyond pi/2 for GGX."""
    if kind == GAUSS:
        return exp(-((x / width) ** 2))
    if abs(x) >= HALF_PI:
        return 0.0
    c, s = cos(x), sin(x) / width
    return 1.0 / (c * c + s * s) ** 2


@njit(cache=True, nogil=True, error_model="numpy")
def lobe_integral(low, high, width, kind):
    """Integral of the lobe over low..high."""
    if kind == GAUSS:
        return 0.5 * sqrt(pi) * width * (erf(high / width) - erf(low / width))
    return _ggx_until(high, width) - _ggx_until(low, width)


@njit(cache=True, nogil=True, error_model="numpy")
def _ggx_until(x, width):
    """Integral of the GGX lobe from 0 to x, by s = tan x / width: of (1 + width^2 s^2) / (1 + s^2)^2."""
    if x >= HALF_PI:
        return 0.5 * width * (1.0 + width * width) * HALF_PI
    if x <= -HALF_PI:
        return -0.5 * width * (1.0 + width * width) * HALF_PI
    s = tan(x) / width
    return 0.5 * width * ((1.0 + width * width) * atan(s) + (1.0 - width * width) * s / (1.0 + s * s))


@njit(cache=True, nogil=True, error_model="numpy")
def pieces(shape, width, kind, theta_i, theta_r, half):
    """Gloss (without Fresnel) and body of the pieces lit and seen, both times cos(theta_i) cos(theta_r), unscaled.

    half: angle of the half vector; in the plane it lies midway.
    """
    theta_a, radius, flat, rows = shape[0], shape[2], shape[3], shape[4] - 1.0
    apart, middle = cos(theta_i - theta_r), theta_i + theta_r
    lit, seen = side_lengths(shape, theta_i), side_lengths(shape, theta_r)
    arc = radius * theta_a
    gloss, body = flat * lobe(half, width, kind), flat * cos(theta_i) * cos(theta_r)
    for k in range(2):
        side = 1.0 if k == 0 else -1.0
        outer, inner = min(lit[k], seen[k]), min(lit[k + 2], seen[k + 2])
        straight = 2.0 * max(outer - arc, 0.0)
        gloss += straight * lobe(half - side * theta_a, width, kind)
        body += straight * cos(theta_i - side * theta_a) * cos(theta_r - side * theta_a)
        for j in range(2):
            angle = (min(outer, arc) / radius if radius > 0.0 else 0.0) if j == 0 else inner
            weight = 2.0 * radius if j == 0 else rows * radius
            ends = (half - angle, half) if side > 0.0 else (half, half + angle)
            gloss += weight * lobe_integral(ends[0], ends[1], width, kind)
            # integral of cos(theta_i - side x) cos(theta_r - side x) over 0..angle
            turned = sin(angle) * cos(angle - side * middle)
            body += 0.5 * weight * (angle * apart + turned)
    return gloss, body


@njit(cache=True, nogil=True, error_model="numpy")
def fill_columns(shape, width, theta_i, theta_r, f0, reading, out):
    """out (n, 2): gloss and body column of a section, shape (theta_a, l, r, m, n, contact), at signed angles (n,)."""
    kind = reading % 2
    above = pieces(shape, width, kind, 0.0, 0.0, 0.0) if reading >= SHADED else (1.0, 1.0)
    for k in range(theta_r.size):
        i, r = theta_i[k], theta_r[k]
        fresnel, slant = schlick(f0, cos(0.5 * (r - i))), cos(i) * cos(r)
        if reading >= SHADED:
            gloss, body = pieces(shape, width, kind, i, r, 0.5 * (i + r))
            out[k, 0] = fresnel * gloss / (above[0] * slant) if above[0] > 0.0 else 0.0
            out[k, 1] = body / (above[1] * slant)
        else:
            seen = share_seen(shape, i, r)
            out[k, 0] = lobe(0.5 * (i + r), width, kind) * fresnel * seen / slant
            out[k, 1] = seen


def columns_of(shape, width: float, theta_i, theta_r, *, f0: float, reading: int) -> np.ndarray:
    """Gloss and body column (..., 2) of a section at signed angles (...,), radians from the normal, below pi/2."""
    theta_i, theta_r = np.broadcast_arrays(np.asarray(theta_i, np.float64), np.asarray(theta_r, np.float64))
    out = np.empty((theta_r.size, 2))
    flat = (np.ascontiguousarray(angle).reshape(-1) for angle in (theta_i, theta_r))
    fill_columns(tuple(map(float, shape)), float(width), *flat, f0, reading, out)
    return out.reshape(*theta_r.shape, 2)
