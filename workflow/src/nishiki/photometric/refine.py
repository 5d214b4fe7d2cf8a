"""Refining Lambertian normals by the lobe model: choosing the samples and the lobe's width at every pixel."""

import numpy as np
from numba import njit, prange

from nishiki.photometric import flags as bits
from nishiki.photometric.least_squares import LARGEST, LEAST_ALBEDO, eigenvalues
from nishiki.photometric.lobe import LANES, SUMS, add_up, cholesky_solve, descend, frame_of, raised

WIDTH = 0.25  # standard deviation expected of b and d, relative to the albedo, where the samples scatter much
FARTHEST = 1e12  # times the albedo
SHADING_SQUARINGS = 3  # exponent 8 of `nishiki.brdf.body_shading`
LEAST_FACTOR = 0.01  # mean body factor, relative to Lambert's albedo, below which Lambert's law is kept for the shading
CHUNK = 256  # pixels that share one set of work arrays


@njit(cache=True, error_model="numpy")
def choose(value, known, vectors, normal, terms, squarings, limit, weight):
    """Weight 1 for the lit, known samples whose residual is at most `limit`; their number."""
    f = np.float32
    n0, n1, n2 = f(normal[0]), f(normal[1]), f(normal[2])
    a, b, d = f(terms[0]), f(terms[1]), f(terms[2])
    bound = f(limit)
    kept = 0
    for j in range(value.size):
        c = n0 * vectors[0, j] + n1 * vectors[1, j] + n2 * vectors[2, j]
        x = n0 * vectors[3, j] + n1 * vectors[4, j] + n2 * vectors[5, j]
        power = raised(x if x > f(1e-3) else f(1e-3), squarings)
        r = value[j] - c * (a + b * c + d * power)
        w = known[j] if r <= bound else f(0.0)
        w = w if r >= -bound else f(0.0)
        w = w if c > f(0.0) else f(0.0)
        weight[j] = w
        kept += 1 if w > f(0.0) else 0
    return np.float64(kept)


@njit(cache=True, error_model="numpy")
def fit_pixel(value, known, weight, spare, vectors, normal, squarings, prior, noise, reselections, at_least, work):
    """Fit, choose the samples again, fit again; values relative to the Lambertian albedo. weight: kept at the end."""
    terms = (1.0, 0.0, 0.0)
    normal, terms, _ = descend(value, weight, vectors, normal, terms, squarings, prior, 4, work)
    kept = 0.0
    for j in range(weight.size):
        kept += weight[j]
    for _ in range(reselections):
        scale = np.sqrt(work[0][20] / max(kept - 5.0, 1.0)) + noise
        more = choose(value, known, vectors, normal, terms, squarings, 3.0 * scale, spare)
        if more < at_least:
            break
        kept = more
        weight[:] = spare
        normal, terms, _ = descend(value, weight, vectors, normal, terms, squarings, prior, 3, work)
    return normal, terms, kept


@njit(cache=True, error_model="numpy")
def disagreement(value, known, vectors, normal, terms, squarings, scale):
    """Sum over the known samples of the squared residual in units of scale, at most 9 each: what a fit leaves over."""
    f = np.float32
    n0, n1, n2 = f(normal[0]), f(normal[1]), f(normal[2])
    a, b, d = f(terms[0]), f(terms[1]), f(terms[2])
    per_scale, most = f(1.0 / max(scale, 1e-6)), f(9.0)
    total = f(0.0)
    for j in range(value.size):
        c = n0 * vectors[0, j] + n1 * vectors[1, j] + n2 * vectors[2, j]
        c = c if c > f(0.0) else f(0.0)
        x = n0 * vectors[3, j] + n1 * vectors[4, j] + n2 * vectors[5, j]
        power = raised(x if x > f(1e-3) else f(1e-3), squarings)
        r = (value[j] - c * (a + b * c + d * power)) * per_scale
        square = r * r
        total += known[j] * (square if square < most else most)
    return total


@njit(cache=True, error_model="numpy")
def fit_widths(
    value, known, weight, spare, first, vectors, normal, widths, prior, noise, reselections, at_least, scale, work
):
    """The best of the fits with exponents 2^k, widths = (least k, largest k), and its k; weight and work are its own.

    first (lights) holds the samples to start from. The fits are compared by `disagreement` with one common scale.
    """
    low, high = widths
    record, chosen = np.inf, low
    for k in range(low, high + 1) if high > low else range(0):
        weight[:] = first
        found, terms, _ = fit_pixel(
            value, known, weight, spare, vectors, normal, k, prior, noise, reselections, at_least, work
        )
        score = disagreement(value, known, vectors, found, terms, k, scale)
        if score < record:
            record, chosen = score, k
    weight[:] = first
    normal, terms, kept = fit_pixel(
        value, known, weight, spare, vectors, normal, chosen, prior, noise, reselections, at_least, work
    )
    return normal, terms, kept, chosen


@njit(cache=True, error_model="numpy")
def normal_matrix_condition(weight, vectors):
    """Condition number of the 3 x 3 normal matrix of the kept lights."""
    t = np.zeros(6)
    for j in range(weight.size):
        if weight[j] > 0:
            x, y, z = np.float64(vectors[0, j]), np.float64(vectors[1, j]), np.float64(vectors[2, j])
            t[0] += x * x
            t[1] += x * y
            t[2] += x * z
            t[3] += y * y
            t[4] += y * z
            t[5] += z * z
    least, largest = eigenvalues(t[0], t[1], t[2], t[3], t[4], t[5])
    return largest / max(least, 1e-30 * largest)


@njit(cache=True, error_model="numpy")
def tangential_variance(sums, prior, matrix, step):
    """Trace of the tangential block of the inverse of the (undamped) normal equations; negative if singular."""
    total = 0.0
    for i in range(2):
        for k in range(5):
            step[k] = 1.0 if k == i else 0.0
        if not cholesky_solve(sums, 0.0, prior, matrix, step):
            return -1.0
        total += step[i]
    return total


@njit(cache=True, parallel=True, error_model="numpy")
def refine(
    observations, usable, known, vectors, settings, max_condition, normals, scalars, lights_used, flags, shading
):
    """Refine the Lambertian estimates in the outputs of `solve_weighted` where there are samples enough.

    observations (lights, pixels) float32; usable, known (lights, pixels) uint8, or (lights, 1) for all pixels alike;
    vectors (6, padded lights) float32; settings: least k of the exponents 2^k, prior, noise, reselections, at_least,
    largest k; shading (pixels, 3) float32: (a, b, d) of `nishiki.brdf.body_shading`, Lambert's (1, 0, 0) before.
    """
    lights, pixels = observations.shape
    padded = vectors.shape[1]
    widths, reselections = (int(settings[0]), int(settings[5])), int(settings[3])
    prior, noise, at_least = settings[1], settings[2], settings[4]
    shared_usable, shared_known = usable.shape[1] == 1, known.shape[1] == 1
    for chunk in prange((pixels + CHUNK - 1) // CHUNK):
        value, allowed = np.zeros(padded, np.float32), np.zeros(padded, np.float32)
        weight, spare, first = np.zeros_like(value), np.zeros_like(value), np.zeros_like(value)
        work = (np.zeros(SUMS), np.zeros(SUMS), np.zeros((5, 5)), np.zeros(5), np.zeros(SUMS * LANES, np.float32))
        for p in range(chunk * CHUNK, min((chunk + 1) * CHUNK, pixels)):
            if flags[p] & bits.NO_ESTIMATE:
                continue
            if lights_used[p] < at_least:
                flags[p] |= bits.FALLBACK
                continue
            albedo = np.float64(scalars[0, p])
            for j in range(lights):
                may = known[j, 0] if shared_known else known[j, p]
                use = usable[j, 0] if shared_usable else usable[j, p]
                # so far outside of the albedo that only its sign matters: its square has to fit into float32
                value[j] = min(max(observations[j, p] / albedo, -FARTHEST), FARTHEST) if may else 0.0
                allowed[j] = may
                first[j] = use if may else 0
            start = (np.float64(normals[p, 0]), np.float64(normals[p, 1]), np.float64(normals[p, 2]))
            spread = np.float64(scalars[3, p]) / albedo
            scale = noise + spread
            # The second part is a Gaussian prior of standard deviation WIDTH, in units of the squared residuals.
            held = prior * lights_used[p] / 3.0 + (spread / WIDTH) ** 2
            normal, terms, kept, chosen = fit_widths(
                value,
                allowed,
                weight,
                spare,
                first,
                vectors,
                start,
                widths,
                held,
                noise,
                reselections,
                at_least,
                scale,
                work,
            )
            store(
                normal,
                terms,
                kept,
                chosen,
                albedo,
                value,
                weight,
                vectors,
                held,
                max_condition,
                work,
                p,
                normals,
                scalars,
                lights_used,
                flags,
                shading,
            )


@njit(cache=True, error_model="numpy")
def store(
    normal,
    terms,
    kept,
    squarings,
    albedo,
    value,
    weight,
    vectors,
    prior,
    max_condition,
    work,
    p,
    normals,
    scalars,
    lights_used,
    flags,
    shading,
):
    """Write a refined pixel; where the fit is no surface (no diffuse part, singular) the Lambertian one stands."""
    sums, _, matrix, step, _ = work
    diffuse = terms[0] + terms[1] * sums[10] / max(sums[9], 1e-30)  # mean of a + b c over the samples, weighted c^2
    variance = tangential_variance(sums, prior, matrix, step)
    residual = np.sqrt(sums[20] / kept) * albedo
    told = variance > 0.0 and kept > 5.0 and residual <= LARGEST  # false for NaN
    if not (told and LEAST_ALBEDO <= diffuse * albedo <= LARGEST):
        flags[p] |= bits.FALLBACK
        return
    condition = normal_matrix_condition(weight, vectors)
    normals[p, 0], normals[p, 1], normals[p, 2] = normal[0], normal[1], normal[2]
    scalars[0, p] = diffuse * albedo
    scalars[1, p] = min(np.sqrt(variance * sums[20] / (kept - 5.0)), 0.5 * np.pi)
    scalars[2, p] = min(condition, 3e38)
    scalars[3, p] = residual
    lights_used[p] = int(kept)
    flag = flags[p] & ~(bits.ILL_CONDITIONED | bits.FACES_AWAY | bits.NO_REDUNDANCY)
    if condition > max_condition:
        flag |= bits.ILL_CONDITIONED
    if normal[2] <= 0.0:
        flag |= bits.FACES_AWAY
    flags[p] = flag
    if squarings != SHADING_SQUARINGS:
        terms = linear_terms(value, weight, vectors, normal, terms, prior, work)
    mean = terms[0] + (terms[1] * sums[10] + terms[2] * sums[11]) / sums[9]
    if mean > LEAST_FACTOR:  # false for NaN
        shading[p, 0], shading[p, 1], shading[p, 2] = terms[0] / mean, terms[1] / mean, terms[2] / mean


@njit(cache=True, error_model="numpy")
def linear_terms(value, weight, vectors, normal, terms, prior, work):
    """(a, b, d) of a given normal with the exponent of the shading map, where the fit chose another one.

    One Gauss-Newton step from (terms[0], 0, 0): the model is linear in the terms. `work` then holds its sums.
    """
    sums, _, matrix, step, lanes = work
    f = np.float32
    frame, _ = frame_of(normal[0], normal[1], normal[2])
    add_up(value, weight, vectors, frame, (f(terms[0]), f(0.0), f(0.0)), SHADING_SQUARINGS, lanes, sums)
    for k in range(9):
        sums[k] = 1.0 if k == 0 or k == 5 else 0.0  # the normal stands: no tangential steps
    sums[15], sums[16] = 0.0, 0.0
    for i in range(5):
        step[i] = sums[15 + i]
    if not cholesky_solve(sums, 0.0, prior, matrix, step):
        return (1.0, 0.0, 0.0)
    return (terms[0] + step[2], step[3], step[4])
