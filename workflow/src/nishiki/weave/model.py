"""Evaluate the reflectance of the weave model: gloss and body, each linear in its strength.

The light comes along the normal, the views lie in the plane of the weft (x, z) or in that of the warp (y, z). Two
readings of the same sections:

* paper: Takeda and Tanaka, eq. 15, rho = k_s D F G / cos(theta_r) + k_d d G; a section enters by its masking alone.
* shaded: every piece of a section that is seen reflects by its own slope, the gloss by facets that scatter
  about it, D(theta_h - slope), the body by Lambert's law; integrated over these pieces in closed form.

Along the normal both columns are 1 without the Fresnel term, so a strength is its part of rho: k_s F0, k_d d.

The lobe D is the paper's exp(-x^2 / a^2).
"""

from math import pi, sqrt

import numpy as np

from nishiki.weave.section import HALF_PI, side_lengths, visible_share

PARAMETERS = ("theta_a", "flank", "humps", "log_width", "contact")  # of one plane; see shape_of
PLANES = ("weft", "warp")  # 0, 1
PAPER, SHADED = 0, 2  # as files have them
SIZE = len(PARAMETERS)
TINY = 1e-150  # a gloss column that is no more along the normal stands for nothing that is seen


def shape_of(p: np.ndarray, plane: int) -> tuple[np.ndarray, ...]:
    """Convert one plane's parameters (..., SIZE) to (theta_a, l, r, m, n, contact), scaled to l + r theta_a = 1.

    p = (theta_a, flank = l / (l + a), humps = share of the length outside of flat top or contacts, log of the lobe's
    width, contact): all within bounds and of like size, whatever the lengths are. humps = -h < 0 (weft): n = h - 1, the
    yarns of a repeat of which one is bound.
    """
    theta_a, flank, humps, _, contact = np.moveaxis(np.asarray(p, float)[..., :SIZE], -1, 0)
    radius, counted = (1.0 - flank) / theta_a, humps < 0.0
    rest = np.where(counted, 0.0, 4.0 * (1.0 - humps) / np.abs(humps))
    if plane == 1:
        yarns, contact = np.where(counted, -humps - 1.0, 1.0), np.where(counted, contact, HALF_PI)
        return theta_a, flank, radius, rest, yarns, contact
    yarns = np.where(counted, -humps - 1.0, 1.0 + rest / (2.0 * radius * contact))
    return theta_a, flank, radius, np.zeros_like(rest), yarns, contact


def lobe(x, width):
    """Evaluate D at an angle x from the middle, 1 at 0."""
    return np.exp(-((x / width) ** 2))


def lobe_integral(low, high, width) -> np.ndarray:
    """Integrate the lobe over low..high, never negative: on one side of the middle a difference of tails."""
    over = (low < 0.0) & (high > 0.0)
    near, far = np.where(low < 0.0, -high, low), np.where(low < 0.0, -low, high)
    across = width * sqrt(pi) - _beyond(high, width) - _beyond(-low, width)
    return np.where(over, across, np.maximum(_beyond(near, width) - _beyond(far, width), 0.0))


def _beyond(x, width):
    """Integrate the lobe from x >= 0 on, to full relative accuracy far out."""
    from scipy.special import erfc

    return 0.5 * sqrt(pi) * width * erfc(x / width)


def pieces(shape, width, theta) -> tuple[np.ndarray, np.ndarray]:
    """Sum gloss (no Fresnel) and body of the pieces seen from theta, times cos(theta), over the period; broadcasts."""
    theta_a, length, radius, flat, yarns, contact = shape
    rows, half, seen, cosine = yarns - 1.0, 0.5 * theta, side_lengths(shape, theta), np.cos(theta)
    arc = radius * theta_a
    hump_gloss = hump_body = 0.0
    gloss, body = flat * lobe(half, width), flat * cosine
    for k, (side, back, ahead) in enumerate(((1.0, 1, 0), (-1.0, 0, 1))):
        outer, inner = seen[k], seen[k + 2]
        straight, angle = np.maximum(outer - arc, 0.0), np.minimum(outer, arc) / np.maximum(radius, 1e-300)
        hump_gloss += straight * lobe(half - side * theta_a, width)
        hump_gloss += radius * lobe_integral(half - back * angle, half + ahead * angle, width)
        hump_body += straight * np.cos(theta_a) * np.cos(theta - side * theta_a)
        # integral of cos(x) cos(theta - side x) over 0..angle
        hump_body += 0.5 * radius * (angle * cosine + np.sin(angle) * np.cos(angle - side * theta))
        gloss += rows * radius * lobe_integral(half - back * inner, half + ahead * inner, width)
        body += 0.5 * rows * radius * (inner * cosine + np.sin(inner) * np.cos(inner - side * theta))
    wide = 4.0 * (length * np.cos(theta_a) + radius * np.sin(theta_a)) + flat + 2.0 * rows * radius * np.sin(contact)
    # the first hump with its flat top or contacts, then the second
    return (gloss + 2 * hump_gloss) / wide, (body + 2 * hump_body) / wide


def plane_rows(plane: int, theta) -> np.ndarray:
    """Make rows (..., 4) of views in one plane (0 weft, 1 warp) at signed angles, radians.

    Plane, angle, cosine of the view with the normal, and of the light with the half vector.
    """
    theta = np.asarray(theta, float)
    return np.stack([np.full(theta.shape, float(plane)), theta, np.cos(theta), np.cos(0.5 * theta)], axis=-1)


def columns(weft, warp, widths, rows: np.ndarray, *, f0, reading: int) -> np.ndarray:
    """Compute gloss and body column (..., 2) of two sections' shapes for rows (..., 4); see `plane_rows`.

    widths: of the lobes in the weft and the warp plane. Many models at once where these and the numbers of the shapes
    have a shape (models, 1); the columns of each are then (models, ..., 2).
    """
    flat = rows.reshape(-1, 4)
    # the last two rows are the sections along the normal, where gloss and body are 1
    plane, theta = np.append(flat[:, 0], (0, 1)), np.append(flat[:, 1], (0, 0))
    shape, width = [np.where(plane == 0, *pair) for pair in zip(weft, warp, strict=True)], np.where(plane == 0, *widths)
    if reading < SHADED:
        body = visible_share(shape, theta)
        gloss = lobe(0.5 * theta, width) * body
    else:
        gloss, body = pieces(shape, width, theta)
        above = len(flat) + plane.astype(int)
        gloss_above, body = gloss[..., above], body / (body[..., above] * np.cos(theta))
        shines = gloss_above > TINY
        gloss = np.where(shines, gloss / np.where(shines, gloss_above, 1), 0.0)
    schlick = 1.0 + (1.0 / f0 - 1.0) * (1.0 - flat[:, 3]) ** 5  # over its value f0 at normal incidence
    gloss, body = (np.where(theta == 0.0, 1.0, factor)[..., : len(flat)] for factor in (gloss, body))
    return np.stack([schlick / flat[:, 2] * gloss, body], axis=-1).reshape(*gloss.shape[:-1], *rows.shape[:-1], 2)
