"""Evaluate the reflectance of the weave model: gloss and body, each linear in its strength.

A direction in space sees a section as its projection on the section's plane does, so each column is made of a factor of
the weft plane (x, z) and one of the warp plane (y, z). Two readings of the same sections:

* paper: Takeda and Tanaka, eq. 15, rho = k_s D F G / cos(theta_r) + k_d d G; a section enters by its masking alone.
* shaded: every piece of a section that is lit and seen reflects by its own slope, the gloss by facets that scatter
  about it, D(theta_h - slope), the body by Lambert's law; integrated over these pieces in closed form.

Light off the normal: G is the share that is lit and seen, the gloss is divided by cos(theta_i) as well. For light and
view along the normal both columns are 1 without the Fresnel term, so a strength is its part of rho: k_s F0, k_d d.

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
def pieces(shape, width, theta_i, theta_r, half):
    """Gloss (without Fresnel) and body of the pieces lit and seen, times cos(theta_i) cos(theta_r), over the period.

    half: angle of the half vector, which in the plane lies midway.
    """
    theta_a, length, radius, flat, yarns, contact = shape
    rows, apart, middle = yarns - 1.0, cos(theta_i - theta_r), theta_i + theta_r
    lit, seen = side_lengths(shape, theta_i), side_lengths(shape, theta_r)
    arc = radius * theta_a
    hump_gloss = hump_body = 0.0
    gloss, body = flat * lobe(half, width), flat * cos(theta_i) * cos(theta_r)
    for k in range(2):
        side = 1.0 if k == 0 else -1.0
        outer, inner = min(lit[k], seen[k]), min(lit[k + 2], seen[k + 2])
        straight, angle = max(outer - arc, 0.0), (min(outer, arc) / radius if radius > 0.0 else 0.0)
        low, high = (half - angle, half) if k == 0 else (half, half + angle)
        hump_gloss += straight * lobe(half - side * theta_a, width)
        hump_gloss += radius * lobe_integral(low, high, width)
        hump_body += straight * cos(theta_i - side * theta_a) * cos(theta_r - side * theta_a)
        # integral of cos(theta_i - side x) cos(theta_r - side x) over 0..angle
        hump_body += 0.5 * radius * (angle * apart + sin(angle) * cos(angle - side * middle))
        if rows > 0.0:
            low, high = (half - inner, half) if k == 0 else (half, half + inner)
            gloss += rows * radius * lobe_integral(low, high, width)
            body += 0.5 * rows * radius * (inner * apart + sin(inner) * cos(inner - side * middle))
    wide = 4.0 * (length * cos(theta_a) + radius * sin(theta_a)) + flat + 2.0 * rows * radius * sin(contact)
    # the first hump with its flat top or contacts, then the second
    return (gloss + hump_gloss) / wide + hump_gloss / wide, (body + hump_body) / wide + hump_body / wide


@njit(cache=True, nogil=True, error_model="numpy")
def _plane_factor(shape, width, reading, above, i, r, half):
    """Gloss (times cos i cos r) and body factor of one plane, paper and shaded reading; 1 along the normal."""
    if i == 0.0 and r == 0.0 and half == 0.0:
        return 1.0, 1.0
    if reading < SHADED:
        seen = visible_share(shape, i, r)
        return lobe(half, width) * seen, seen
    gloss, body = pieces(shape, width, i, r, half)
    return gloss / above[0] if above[0] > TINY else 0.0, body / (above[1] * cos(i) * cos(r))


@njit(cache=True, nogil=True, error_model="numpy")
def fill_columns(weft, warp, across, along, rows, f0, reading, out):
    """Fill out (n, 2), the gloss and body columns of two sections in the directions of `rows` (see plane_rows).

    A section is (theta_a, l, r, m, n, contact); across, along: widths of the lobes in the weft and the warp plane.
    """
    above_x = above_y = (1.0, 1.0)
    if reading == SHADED:
        above_x = pieces(weft, across, 0.0, 0.0, 0.0)
        above_y = pieces(warp, along, 0.0, 0.0, 0.0)
    for k in range(len(rows)):
        row = rows[k]
        schlick = 1.0 + (1.0 / f0 - 1.0) * (1.0 - row[8]) ** 5  # over its value f0 at normal incidence
        fresnel = schlick / (row[6] * row[7])
        x = _plane_factor(weft, across, reading, above_x, row[0], row[1], row[2])
        y = _plane_factor(warp, along, reading, above_y, row[3], row[4], row[5])
        out[k, 0], out[k, 1] = fresnel * x[0] * y[0], x[1] * y[1]


def plane_rows(plane: int, theta_i, theta_r) -> np.ndarray:
    """Compute angles and cosines (..., 9) of directions in one plane (0 weft, 1 warp) at signed angles, radians.

    Angles of light, view and half vector in the weft plane, the same in the warp plane, cosines of light and view with
    the normal, and of light with the half vector.
    """
    theta_i, theta_r = np.broadcast_arrays(np.asarray(theta_i, float), np.asarray(theta_r, float))
    rows = np.zeros((*theta_r.shape, 9))
    rows[..., 3 * plane], rows[..., 3 * plane + 1] = theta_i, theta_r
    rows[..., 3 * plane + 2] = 0.5 * (theta_i + theta_r)
    rows[..., 6], rows[..., 7], rows[..., 8] = np.cos(theta_i), np.cos(theta_r), np.cos(0.5 * (theta_r - theta_i))
    return rows


def columns(weft, warp, widths, rows: np.ndarray, *, f0: float, reading: int) -> np.ndarray:
    """Gloss and body column (..., 2) of two sections' shapes for rows (..., 9); see fill_columns."""
    flat = np.ascontiguousarray(rows.reshape(-1, 9))
    out = np.empty((len(flat), 2))
    shapes = (tuple(map(float, weft)), tuple(map(float, warp)))
    fill_columns(*shapes, float(widths[0]), float(widths[1]), flat, float(f0), reading, out)
    return out.reshape(*rows.shape[:-1], 2)
