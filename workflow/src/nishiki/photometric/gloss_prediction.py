"""What the joint fit predicts of a pixel: shading, gloss and their slopes under every lamp, and the variances.

Compiled, float64, nothing allocated. Rows of the scratch (ROWS, lights) by their names; lamps that do not light the
pixel or are not known have zeros everywhere, and variances of 1.
"""

import numpy as np
from numba import njit

from nishiki.brdf.gloss_profile import NODES, NODES_PER_UNIT

LANES = 4  # lights are padded to a multiple, unlit: the sums over them then become SIMD code
STEEPEST = 0.05  # n_z is kept above it
# Rows of the scratch of a pixel, a column for each light
LIT, BODY, BODY_S, BODY_T, GLOSS, GLOSS_S, GLOSS_T, VAR_LEVEL, VAR_COLOUR, W_LEVEL, W_COLOUR = range(11)
ROWS = 11


@njit(cache=True, error_model="numpy", inline="always")
def gloss_and_gradient(n, light, cosine, table, out):
    """Gloss s and its gradient by n, into out (4,). light: (8,) l, h, F, cos theta_q; cosine > 0."""
    x = n[0] * light[3] + n[1] * light[4] + n[2] * light[5]
    place = np.sqrt(max(2.0 * (1.0 - x), 0.0)) * NODES_PER_UNIT
    node = min(int(place), NODES - 2)
    part = place - node
    value = table[0, node] + part * (table[0, node + 1] - table[0, node])
    slope = 2.0 * (table[1, node] + part * (table[1, node + 1] - table[1, node]))  # dz / dx
    f, nz = light[6], n[2]
    groove = 2.0 * f / light[7]
    ratio = min(1.0, cosine / nz)
    factor = groove * x * ratio
    if factor < f / nz:
        gl = groove * x / nz if cosine < nz else 0.0
        gh = groove * ratio
        gz = -gl * cosine / nz
    else:
        factor, gl, gh, gz = f / nz, 0.0, 0.0, -f / (nz * nz)
    gh = value * gh + factor * slope
    gl, gz = value * gl, value * gz
    out[0] = factor * value
    out[1] = gl * light[0] + gh * light[3]
    out[2] = gl * light[1] + gh * light[4]
    out[3] = gl * light[2] + gh * light[5] + gz


@njit(cache=True, error_model="numpy", inline="always")
def tangents(n, t):
    """Two unit vectors across n (n_z > -1), into t (6,). T. Duff et al., J. Comput. Graph. Tech. 6 (1), 2017."""
    a = -1.0 / (1.0 + n[2])
    b = n[0] * n[1] * a
    t[0], t[1], t[2] = 1.0 + n[0] * n[0] * a, b, -n[0]
    t[3], t[4], t[5] = b, 1.0 + n[1] * n[1] * a, -n[1]


@njit(cache=True, error_model="numpy", inline="always")
def transmitted(cosine, table):
    """Look up the body's transmittance at this cosine (0 to 1), relative to frontal, and its slope."""
    place = max(min(cosine, 1.0), 0.0) * NODES_PER_UNIT
    node = min(int(place), NODES_PER_UNIT - 1)
    part = place - node
    value = table[2, node] + part * (table[2, node + 1] - table[2, node])
    return value, table[3, node] + part * (table[3, node + 1] - table[3, node])


@njit(cache=True, error_model="numpy")
def predict(n, pixel, scene, settings, t, gradient):
    """Fill the rows for the normal n: shading and gloss with their slopes along both tangents, and the variances."""
    known, rows, floor, (lights, table, rotation) = pixel.known, pixel.rows, pixel.floor, scene
    tangents(n, t)
    root = np.sqrt(np.float64(rotation.shape[0]))
    kappa, tilt = settings.gloss_error**2, settings.tilt_error**2
    view, view_slope = transmitted(n[2], table)
    for j in range(known.size):
        c = n[0] * lights[j, 0] + n[1] * lights[j, 1] + n[2] * lights[j, 2]
        if not (known[j] and c > 0.0):
            for k in range(ROWS):
                rows[k, j] = 1.0 if k == VAR_LEVEL or k == VAR_COLOUR else 0.0
            continue
        light = lights[j]
        enter, enter_slope = transmitted(c, table)
        along, by_view = (enter + c * enter_slope) * view, c * enter * view_slope
        ls = light[0] * t[0] + light[1] * t[1] + light[2] * t[2]
        lt = light[0] * t[3] + light[1] * t[4] + light[2] * t[5]
        gloss_and_gradient(n, light, c, table, gradient)
        gs = root * (gradient[1] * t[0] + gradient[2] * t[1] + gradient[3] * t[2])
        gt = root * (gradient[1] * t[3] + gradient[2] * t[4] + gradient[3] * t[5])
        s = root * gradient[0]
        rows[LIT, j], rows[BODY, j], rows[GLOSS, j] = 1.0, c * enter * view, s
        rows[BODY_S, j], rows[BODY_T, j] = along * ls + by_view * t[2], along * lt + by_view * t[5]
        rows[GLOSS_S, j], rows[GLOSS_T, j] = gs, gt
        rows[VAR_LEVEL, j] = floor + kappa * s * s + tilt * (gs * gs + gt * gt)
        rows[VAR_COLOUR, j] = floor
