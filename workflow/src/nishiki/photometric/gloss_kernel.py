"""One pixel of the joint fit: normal, reflectance of each channel and gloss of a known profile, robustly.

Model of sample j in channel k, with b the body's shading and s the gloss, the same in all channels:

    I'_jk = rho_k b(n . l_j, n_z) + s_j(n),     s = F G / cos theta_r * z(phi)

The channels are rotated first, so that component 0 is their common level (times sqrt C) and the others are differences
of colour, in which white gloss cancels: component 0 is trusted less where gloss is predicted, the others are not. The
reflectances enter linearly and are eliminated (variable projection); the two tangential components of the normal are
found by damped Gauss-Newton with weights 1 / variance, times the square of Cauchy's weight of the residual.

Rows of the scratch (ROWS, lights) have names; lamps that do not light the pixel or are not known have zeros everywhere,
and variances of 1. Nothing is allocated. Everything is float64 and in the fixed order of the lights: the result of a
pixel depends on nothing else.
"""

from collections import namedtuple

import numpy as np
from numba import njit

from nishiki.brdf.gloss_profile import NODES, NODES_PER_UNIT
from nishiki.photometric.flags import NO_ESTIMATE, NormalFlag
from nishiki.photometric.height import LEAST_NZ
from nishiki.photometric.lambert_fit import FEWEST_LAMPS
from nishiki.photometric.normal_kernels import LARGEST
from nishiki.small_matrices import eigenvalues

# Rows of the scratch of a pixel, a column for each light
LIT, BODY, BODY_S, BODY_T, GLOSS, GLOSS_S, GLOSS_T, VAR_LEVEL, VAR_COLOUR, W_LEVEL, W_COLOUR = range(11)
ROWS = W_COLOUR + 1
LARGEST_STEP = 0.3  # radians
SETTLED = 1e-3  # radians: a turn of the normal that changes nothing
FOLDS = 5  # groups of lamps that are left out in turn
NOTHING = np.finfo(np.float64).tiny  # keeps sums of no weight from 0 / 0: weights are inverse squares of radiances


Pixel = namedtuple("Pixel", "y known rows rho floor")
"""A pixel in work: y (C, lights) rotated samples; known (lights,) bool; rows (ROWS, lights); rho (C,) reflectance.

floor: variance of a sample.
"""


@njit(cache=True, error_model="numpy", inline="always")
def gloss_and_gradient(n, light, cosine, table, out):
    """Compute gloss s and its gradient by n, into out (4,). light: (8,) l, h, F, cos theta_q; cosine > 0."""
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
    """Write two unit vectors across n (n_z > -1) into t (6,). T. Duff et al., J. Comput. Graph. Tech. 6 (1), 2017."""
    a = -1.0 / (1.0 + n[2])
    b = n[0] * n[1] * a
    t[0], t[1], t[2] = 1.0 + n[0] * n[0] * a, b, -n[0]
    t[3], t[4], t[5] = b, 1.0 + n[1] * n[1] * a, -n[1]


@njit(cache=True, error_model="numpy", inline="always")
def look_up_transmittance(cosine, table):
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
    view, view_slope = look_up_transmittance(n[2], table)
    for j in range(known.size):
        c = n[0] * lights[j, 0] + n[1] * lights[j, 1] + n[2] * lights[j, 2]
        if not (known[j] and c > 0.0):
            for k in range(ROWS):
                rows[k, j] = 1.0 if k == VAR_LEVEL or k == VAR_COLOUR else 0.0
            continue
        light = lights[j]
        enter, enter_slope = look_up_transmittance(c, table)
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


@njit(cache=True, error_model="numpy")
def strengths(y, rows, rho):
    """Solve weighted least squares for the reflectance of each component at fixed normal."""
    body, gloss, level, colour = rows[BODY], rows[GLOSS], rows[W_LEVEL], rows[W_COLOUR]
    value, above, below = y[0], 0.0, NOTHING
    for j in range(body.size):
        v = level[j] * body[j]
        above += v * (value[j] - gloss[j])
        below += v * body[j]
    rho[0] = above / below
    below = NOTHING
    for j in range(body.size):
        below += colour[j] * body[j] * body[j]
    for k in range(1, rho.size):
        value, above = y[k], 0.0
        for j in range(body.size):
            above += colour[j] * body[j] * value[j]
        rho[k] = above / below


@njit(cache=True, error_model="numpy")
def weigh(y, rows, rho, tolerance):
    """Compute robust weights from residuals; distrust too dark a sample in all components, for shadow takes all."""
    lit, body, gloss, level, colour = rows[LIT], rows[BODY], rows[GLOSS], rows[W_LEVEL], rows[W_COLOUR]
    of_level, of_colour = rows[VAR_LEVEL], rows[VAR_COLOUR]
    bound, components, value, first = tolerance * tolerance, rho.size, y[0], rho[0]
    for j in range(body.size):
        colour[j] = 0.0
    for k in range(1, components):
        values, strength = y[k], rho[k]
        for j in range(body.size):
            d = values[j] - strength * body[j]
            colour[j] += d * d
    limit = bound * max(components - 1, 1)
    for j in range(body.size):
        r = value[j] - first * body[j] - gloss[j]
        a = bound * of_level[j] / (bound * of_level[j] + r * r)
        e = limit * of_colour[j] / (limit * of_colour[j] + colour[j])
        e = min(a, e) if r < 0.0 else e
        level[j] = lit[j] * a * a / of_level[j]
        colour[j] = lit[j] * e * e / of_colour[j]


@njit(cache=True, error_model="numpy")
def squares(y, rows, rho):
    """Compute the weighted sum of squares at the present weights."""
    body, gloss, level, colour = rows[BODY], rows[GLOSS], rows[W_LEVEL], rows[W_COLOUR]
    value, strength, total = y[0], rho[0], 0.0
    for j in range(body.size):
        r = value[j] - strength * body[j] - gloss[j]
        total += level[j] * r * r
    for k in range(1, rho.size):
        value, strength = y[k], rho[k]
        for j in range(body.size):
            d = value[j] - strength * body[j]
            total += colour[j] * d * d
    return total


@njit(cache=True, error_model="numpy")
def gauss_newton(y, rows, rho, out):
    """Write curvature (3), right-hand side (2) by the tangents, reflectances eliminated (Schur complement), to out."""
    body, body_s, body_t, gloss = rows[BODY], rows[BODY_S], rows[BODY_T], rows[GLOSS]
    gloss_s, gloss_t, level, colour = rows[GLOSS_S], rows[GLOSS_T], rows[W_LEVEL], rows[W_COLOUR]
    h0 = h1 = h2 = g0 = g1 = p = q = 0.0
    a, value, strength = NOTHING, y[0], rho[0]
    for j in range(body.size):
        w, b = level[j], body[j]
        s, t = strength * body_s[j] + gloss_s[j], strength * body_t[j] + gloss_t[j]
        r = value[j] - strength * b - gloss[j]
        ws, wt = w * s, w * t
        a += w * b * b
        p += ws * b
        q += wt * b
        h0 += ws * s
        h1 += ws * t
        h2 += wt * t
        g0 += ws * r
        g1 += wt * r
    h0, h1, h2 = h0 - p * p / a, h1 - p * q / a, h2 - q * q / a
    # the other components share weights and, but for their reflectance, slopes
    bb, bs, bt, ss, st, tt = NOTHING, 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(body.size):
        w, b, s, t = colour[j], body[j], body_s[j], body_t[j]
        bb += w * b * b
        bs += w * b * s
        bt += w * b * t
        ss += w * s * s
        st += w * s * t
        tt += w * t * t
    for k in range(1, rho.size):
        value, strength, p, q = y[k], rho[k], 0.0, 0.0
        for j in range(body.size):
            r = colour[j] * (value[j] - strength * body[j])
            p += body_s[j] * r
            q += body_t[j] * r
        g0, g1 = g0 + strength * p, g1 + strength * q
        square = strength * strength
        h0 += square * (ss - bs * bs / bb)
        h1 += square * (st - bs * bt / bb)
        h2 += square * (tt - bt * bt / bb)
    out[0], out[1], out[2], out[3], out[4] = h0, h1, h2, g0, g1


@njit(cache=True, error_model="numpy", inline="always")
def move_normal(n, t, s, r, out):
    """Move the unit normal by the tangential step (s, r), limited and never grazing; return the step's length."""
    length = np.sqrt(s * s + r * r)
    part = LARGEST_STEP / length if length > LARGEST_STEP else 1.0
    s, r = part * s, part * r
    x, y = n[0] + s * t[0] + r * t[3], n[1] + s * t[1] + r * t[4]
    z = max(n[2] + s * t[2] + r * t[5], LEAST_NZ)
    scale = 1.0 / np.sqrt(x * x + y * y + z * z)
    out[0], out[1], out[2] = x * scale, y * scale, z * scale
    return length


@njit(cache=True, error_model="numpy")
def descend(pixel, scene, settings, n, work):
    """Fit from the normal n, in place; the rows and weights are left at the result.

    work (18,): tangents 0:6, trial normal 6:9, equations 9:14, gradient 14:18. A step that raises the weighted sum of
    squares is taken back and damped more, until it is too short to matter.
    """
    t, trial, equations, gradient = work[0:6], work[6:9], work[9:14], work[14:18]
    y, known, rows, rho, tolerance = pixel.y, pixel.known, pixel.rows, pixel.rho, settings.tolerance
    for i in range(3):
        trial[i] = n[i]
    damping, before, length, accepted = 1e-3, 0.0, np.inf, 0
    while True:
        predict(trial, pixel, scene, settings, t, gradient)
        if accepted == 0:
            for j in range(known.size):
                rows[W_LEVEL, j] = rows[LIT, j] / rows[VAR_LEVEL, j]
                rows[W_COLOUR, j] = rows[LIT, j] / rows[VAR_COLOUR, j]
        strengths(y, rows, rho)
        if accepted == 0 or length < SETTLED or not squares(y, rows, rho) > before * (1.0 + 1e-9):
            for i in range(3):
                n[i] = trial[i]
            damping = max(0.2 * damping, 1e-6) if accepted else damping
            for _ in range(1 if accepted else 2):
                weigh(y, rows, rho, tolerance)
                strengths(y, rows, rho)
            if length < SETTLED or accepted == settings.iterations:
                break
            gauss_newton(y, rows, rho, equations)
            before = squares(y, rows, rho)
            accepted += 1
        else:
            damping *= 8.0
        tangents(n, t)
        d0, d2 = equations[0] * (1.0 + damping) + 1e-12, equations[2] * (1.0 + damping) + 1e-12
        det = d0 * d2 - equations[1] * equations[1]
        s = (d2 * equations[3] - equations[1] * equations[4]) / det
        r = (d0 * equations[4] - equations[1] * equations[3]) / det
        length = move_normal(n, t, s, r, trial)
    weigh(y, rows, rho, tolerance)


@njit(cache=True, error_model="numpy")
def misfit(y, known, rows, rho, tolerance, floor):
    """Compute the robust cost (Geman and McClure), with the log of the variances, which decides between two starts.

    A sample under which the normal turns away from the lamp is predicted as black.
    """
    bound, components = tolerance * tolerance, rho.size
    total = 0.0
    for j in range(known.size):
        if not known[j]:
            continue
        if rows[LIT, j] > 0.0:
            b = rows[BODY, j]
            r = y[0, j] - rho[0] * b - rows[GLOSS, j]
            level, q = r * r / rows[VAR_LEVEL, j], 0.0
            for k in range(1, components):
                d = y[k, j] - rho[k] * b
                q += d * d / rows[VAR_COLOUR, j]
            total += level / (1.0 + level / bound) + np.log(rows[VAR_LEVEL, j] / floor)
            total += q / (1.0 + q / (bound * max(components - 1, 1)))
        else:
            q = 0.0
            for k in range(components):
                q += y[k, j] * y[k, j] / floor
            total += min(q, 5.0 * bound)
    return total


@njit(cache=True, error_model="numpy")
def jackknife(y, rows, spare, weights, equations):
    """Estimate the variance of the normal's direction, radians squared: each FOLDS-th lamp left out, one step each.

    Delete-a-group jackknife (R. G. Miller, Biometrika 61, 1974): unlike the curvature of the fit, it sees errors that
    lamps share. weights (2, lights) and spare (components,) are scratch.
    """
    for j in range(rows.shape[1]):  # rows at once would have the compiler write out their error messages
        weights[0, j], weights[1, j] = rows[W_LEVEL, j], rows[W_COLOUR, j]
    total = 0.0
    for fold in range(FOLDS):
        for j in range(rows.shape[1]):
            kept = 0.0 if j % FOLDS == fold else 1.0
            rows[W_LEVEL, j], rows[W_COLOUR, j] = kept * weights[0, j], kept * weights[1, j]
        strengths(y, rows, spare)
        gauss_newton(y, rows, spare, equations)
        h, k, m, g, i = equations[0], equations[1], equations[2], equations[3], equations[4]
        det = h * m - k * k
        square = ((m * g - k * i) ** 2 + (h * i - k * g) ** 2) / (det * det)
        total += square if square < LARGEST_STEP**2 else LARGEST_STEP**2  # also where it is no number
    for j in range(rows.shape[1]):
        rows[W_LEVEL, j], rows[W_COLOUR, j] = weights[0, j], weights[1, j]
    return total * (FOLDS - 1) / FOLDS


@njit(cache=True, error_model="numpy")
def describe(pixel, lights, variance, max_condition, p, fields):
    """Write sigma, condition, residual and lights used of a pixel, and its flags."""
    y, rows, rho, scalars = pixel.y, pixel.rows, pixel.rho, fields.scalars
    a = b = c = d = e = f = 0.0
    weight = squared = 0.0
    count = 0
    for j in range(pixel.known.size):
        if rows[LIT, j] == 0.0:
            continue
        trust = rows[W_LEVEL, j] * rows[VAR_LEVEL, j]
        count += trust > 0.5
        x, v, z = lights[j, 0], lights[j, 1], lights[j, 2]
        a, b, c = a + trust * x * x, b + trust * x * v, c + trust * x * z
        d, e, f = d + trust * v * v, e + trust * v * z, f + trust * z * z
        r = y[0, j] - rho[0] * rows[BODY, j] - rows[GLOSS, j]
        weight += trust
        squared += trust * r * r
    least, largest = eigenvalues(a, b, c, d, e, f)
    condition = largest / least if least > 0.0 else 3e38
    scalars[1, p] = np.sqrt(variance)
    scalars[2, p] = min(condition, 3e38)
    scalars[3, p] = min(np.sqrt(squared / max(weight, 1e-30) / rho.size), LARGEST)
    fields.lights_used[p] = count
    fields.flags[p] = NormalFlag.ILL_CONDITIONED if condition > max_condition else 0


@njit(cache=True, error_model="numpy")
def rotate(observations, rotation, p, y):
    """Rotate pixel p to components (C, lights); return the light of the largest level and the others' mean level."""
    lights, channels = observations.shape[0], y.shape[0]
    top, highest, total = 0, -np.inf, 0.0
    for j in range(lights):
        for k in range(channels):
            value = 0.0
            for i in range(channels):
                value += rotation[k, i] * observations[j, p, i]
            y[k, j] = value
        total += y[0, j]
        if y[0, j] > highest:
            top, highest = j, y[0, j]
    return top, (total - highest) / max(lights - 1, 1)


@njit(cache=True, error_model="numpy", nogil=True)
def refine_pixels(first, last, observations, valid, scene, settings, fields):
    """Refine the pixels first .. last - 1 in place, where their flags mark an estimate to start from.

    observations (lights, pixels, channels) float32; valid (lights, pixels) bool; scene, settings and fields are named
    tuples of `nishiki.photometric.gloss`.
    """
    normals, flags, cost, (lights, _, rotation) = fields.normals, fields.flags, fields.cost, scene
    count, channels = observations.shape[0], observations.shape[2]
    rows, y, known = np.zeros((ROWS, count)), np.zeros((channels, count)), np.zeros(count, np.bool_)
    weights, spare = np.zeros((2, count)), np.empty(channels)
    rho, colour, n, best_n = np.empty(channels), np.empty(channels), np.empty(3), np.empty(3)
    work = np.empty(18)
    tolerance = settings.tolerance
    for p in range(first, last):
        cost[p] = 0.0
        if flags[p] & NO_ESTIMATE:
            continue
        for j in range(count):
            known[j] = valid[j, p]
        top, scale = rotate(observations, rotation, p, y)
        floor = settings.noise**2 + (settings.model_error * scale) ** 2
        pixel = Pixel(y, known, rows, rho, floor)
        for i in range(3):
            n[i] = normals[p, i]
        n[2] = max(n[2], LEAST_NZ)
        value, limit = np.inf, settings.second_start * count * channels
        for attempt in range(3):  # the given normal; the one that mirrors the brightest light; back to the better one
            descend(pixel, scene, settings, n, work)
            cost_here = misfit(y, known, rows, rho, tolerance, floor)
            if attempt == 2 or (attempt == 0 and not cost_here > limit) or (attempt == 1 and cost_here < value):
                value = cost_here
                break
            if attempt == 0:
                value = cost_here
                for i in range(3):
                    best_n[i], n[i] = n[i], lights[top, 3 + i]
            else:
                for i in range(3):
                    n[i] = best_n[i]
        lit = 0
        for j in range(count):
            lit += rows[LIT, j] > 0.0
        level = 0.0
        for i in range(channels):
            total = 0.0
            for k in range(channels):
                total += rotation[k, i] * rho[k]
            colour[i] = max(total, 0.0)
            level += colour[i]
        sound = np.isfinite(n[0] + n[1] + n[2] + rho.sum() + value) and value <= LARGEST
        if lit < FEWEST_LAMPS or not (sound and level <= LARGEST):
            flags[p] |= NormalFlag.FALLBACK
            continue
        for i in range(3):
            normals[p, i] = n[i]
        for i in range(channels):
            fields.reflectance[p, i] = colour[i]
        fields.scalars[0, p] = level / channels
        cost[p] = value
        variance = jackknife(y, rows, spare, weights, work[9:14])
        describe(pixel, lights, variance, settings.max_condition, p, fields)
