"""Evaluate the reflectance of the weave model: gloss and body, each linear in its strength.

The light comes along the normal, the views lie in the plane of the weft (x, z) or in that of the warp (y, z). Two
readings of the same sections:

* paper: Takeda and Tanaka, eq. 15, rho = k_s D F G / cos(theta_r) + k_d d G; a section enters by its masking alone.
* shaded: every piece of a section that is seen reflects by its own slope, the gloss by facets that scatter
  about it, D(theta_h - slope), the body by Lambert's law; integrated over these pieces in closed form.

Along the normal both columns are 1 without the Fresnel term, so a strength is its part of rho: k_s F0, k_d d.

The lobe D is the paper's exp(-x^2 / a^2).
"""

from math import cos, erfc, exp, pi, sin, sqrt

import numpy as np
from numba import njit

from nishiki.weave.section import HALF_PI, side_lengths, visible_share

PARAMETERS = ("theta_a", "flank", "humps", "log_width", "contact")  # of one plane; see shape_of
PLANES = ("weft", "warp")  # 0, 1
PAPER, SHADED = 0, 2  # as files have them
SIZE = len(PARAMETERS)
TINY = 1e-150  # a gloss column that is no more along the normal stands for nothing that is seen


@njit(cache=True, nogil=True, error_model="numpy")
def shape_of(p, plane):
    """(theta_a, l, r, m, n, contact) of one plane's parameters, scaled to l + r theta_a = 1.

    p = (theta_a, flank = l / (l + a), humps = share of the length outside of flat top or contacts, log of the lobe's
    width, contact): all within bounds and of like size, whatever the lengths are. humps = -h < 0 (weft): n = h - 1, the
    yarns of a repeat of which one is bound.
    """
    theta_a, flank, humps, contact = p[0], p[1], p[2], p[4]
    radius = (1.0 - flank) / theta_a
    if humps < 0.0:
        return (theta_a, flank, radius, 0.0, -humps - 1.0, contact)
    rest = 4.0 * (1.0 - humps) / humps
    if plane == 1:
        return (theta_a, flank, radius, rest, 1.0, HALF_PI)
    return (theta_a, flank, radius, 0.0, 1.0 + rest / (2.0 * radius * contact), contact)


@njit(cache=True, nogil=True, error_model="numpy")
def lobe(x, width):
    """D at an angle x from the middle, 1 at 0."""
    return exp(-((x / width) ** 2))


@njit(cache=True, nogil=True, error_model="numpy")
def lobe_integral(low, high, width):
    """Integral of the lobe over low..high, never negative: on one side of the middle a difference of tails."""
    if low < 0.0 and high > 0.0:
        return width * sqrt(pi) - _beyond(high, width) - _beyond(-low, width)
    near, far = (low, high) if low >= 0.0 else (-high, -low)
    return max(_beyond(near, width) - _beyond(far, width), 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _beyond(x, width):
    """Integral of the lobe from x >= 0 on, to full relative accuracy far out."""
    return 0.5 * sqrt(pi) * width * erfc(x / width)


@njit(cache=True, nogil=True, error_model="numpy")
def pieces(shape, width, theta):
    """Gloss (without Fresnel) and body of the pieces seen from theta, times cos(theta), over the period."""
    theta_a, length, radius, flat, yarns, contact = shape
    rows, half, seen = yarns - 1.0, 0.5 * theta, side_lengths(shape, theta)
    arc = radius * theta_a
    hump_gloss = hump_body = 0.0
    gloss, body = flat * lobe(half, width), flat * cos(theta)
    for k in range(2):
        side = 1.0 if k == 0 else -1.0
        outer, inner = seen[k], seen[k + 2]
        straight, angle = max(outer - arc, 0.0), (min(outer, arc) / radius if radius > 0.0 else 0.0)
        low, high = (half - angle, half) if k == 0 else (half, half + angle)
        hump_gloss += straight * lobe(half - side * theta_a, width)
        hump_gloss += radius * lobe_integral(low, high, width)
        hump_body += straight * cos(theta_a) * cos(theta - side * theta_a)
        # integral of cos(x) cos(theta - side x) over 0..angle
        hump_body += 0.5 * radius * (angle * cos(theta) + sin(angle) * cos(angle - side * theta))
        if rows > 0.0:
            low, high = (half - inner, half) if k == 0 else (half, half + inner)
            gloss += rows * radius * lobe_integral(low, high, width)
            body += 0.5 * rows * radius * (inner * cos(theta) + sin(inner) * cos(inner - side * theta))
    wide = 4.0 * (length * cos(theta_a) + radius * sin(theta_a)) + flat + 2.0 * rows * radius * sin(contact)
    # the first hump with its flat top or contacts, then the second
    return (gloss + hump_gloss) / wide + hump_gloss / wide, (body + hump_body) / wide + hump_body / wide


@njit(cache=True, nogil=True, error_model="numpy")
def _section_factor(shape, width, reading, above, theta):
    """Gloss (times the cosine) and body factor of one section, paper and shaded reading; 1 along the normal."""
    if theta == 0.0:
        return 1.0, 1.0
    if reading < SHADED:
        seen = visible_share(shape, theta)
        return lobe(0.5 * theta, width) * seen, seen
    gloss, body = pieces(shape, width, theta)
    return gloss / above[0] if above[0] > TINY else 0.0, body / (above[1] * cos(theta))


@njit(cache=True, nogil=True, error_model="numpy")
def fill_columns(weft, warp, across, along, rows, f0, reading, out):
    """Fill out (n, 2), the gloss and body columns of two sections in the directions of `rows` (see plane_rows).

    A section is (theta_a, l, r, m, n, contact); across, along: widths of the lobes in the weft and the warp plane.
    """
    above_x = above_y = (1.0, 1.0)
    if reading == SHADED:
        above_x, above_y = pieces(weft, across, 0.0), pieces(warp, along, 0.0)
    for k in range(len(rows)):
        schlick = 1.0 + (1.0 / f0 - 1.0) * (1.0 - rows[k, 3]) ** 5  # over its value f0 at normal incidence
        if rows[k, 0] == 0.0:
            gloss, body = _section_factor(weft, across, reading, above_x, rows[k, 1])
        else:
            gloss, body = _section_factor(warp, along, reading, above_y, rows[k, 1])
        out[k, 0], out[k, 1] = schlick / rows[k, 2] * gloss, body


def plane_rows(plane: int, theta) -> np.ndarray:
    """Rows (..., 4) of views in one plane (0 weft, 1 warp) at signed angles, radians.

    Plane, angle, cosine of the view with the normal, and of the light with the half vector.
    """
    theta = np.asarray(theta, float)
    return np.stack([np.full(theta.shape, float(plane)), theta, np.cos(theta), np.cos(0.5 * theta)], axis=-1)


def columns(weft, warp, widths, rows: np.ndarray, *, f0: float, reading: int) -> np.ndarray:
    """Gloss and body column (..., 2) of two sections' shapes for rows (..., 4); see fill_columns."""
    flat = np.ascontiguousarray(rows.reshape(-1, 4))
    out = np.empty((len(flat), 2))
    shapes = (tuple(map(float, weft)), tuple(map(float, warp)))
    fill_columns(*shapes, float(widths[0]), float(widths[1]), flat, float(f0), reading, out)
    return out.reshape(*rows.shape[:-1], 2)
