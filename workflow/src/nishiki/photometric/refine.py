"""Refine Lambertian normals by the lobe model, and choose the samples of every pixel again."""

import numpy as np
from numba import njit

from nishiki.photometric import flags as bits
from nishiki.photometric.lanes import LANES, choose, load, planes, splat, store
from nishiki.photometric.least_squares import LARGEST, LEAST_ALBEDO, eigenvalues
from nishiki.photometric.lobe import (
    BLOCK,
    FIT,
    SUMS,
    SURFACE,
    choose_samples,
    descend,
    descent_work,
    take_lanes,
    tangential_variance,
)

WIDTH = 0.25  # standard deviation expected of b and d, relative to the albedo, where the samples scatter much
FARTHEST = np.float32(1e12)  # times the albedo
LEAST_FACTOR = 0.01  # mean body factor, relative to Lambert's albedo, below which Lambert's law is kept for the shading
FIRST_ROUNDS, ROUNDS = 4, 3  # Gauss-Newton steps for the samples first chosen, and for those chosen again


@njit(cache=True, error_model="numpy")
def load_block(observations, usable, known, index, width, scalars, normals, values, may, use, start):
    """Load a block of pixels, `index` (BLOCK,) of which the first `width` are real: samples relative to the albedo.

    start (FIT * BLOCK): Lambert's fits. Samples of what is no real pixel are unknown.
    """
    shared_usable, shared_known = usable.shape[1] == 1, known.shape[1] == 1
    memory = planes(np.int64(2), np.int64(BLOCK))  # constants would have it compiled for them alone
    albedo, row = memory[0], memory[1:]
    for p in range(BLOCK):
        q = index[p if p < width else 0]
        albedo[p] = scalars[0, q]
        for k in range(3):
            start[p + k * BLOCK] = normals[q, k]
        start[p + 3 * BLOCK], start[p + 4 * BLOCK], start[p + 5 * BLOCK] = 1.0, 0.0, 0.0
    first = index[0]
    neighbours = width == BLOCK and index[BLOCK - 1] == first + BLOCK - 1
    there, is_usable = np.zeros((1, BLOCK), np.uint8), np.zeros((1, BLOCK), np.uint8)
    for j in range(values.shape[0]):
        if neighbours and not shared_known and not shared_usable:
            load_light(observations, known, usable, (j, first), albedo, values, may, use, j)
            continue
        for p in range(BLOCK):
            q = index[p if p < width else 0]
            row[0, p] = observations[j, q]
            there[0, p] = (known[j, 0] if shared_known else known[j, q]) if p < width else 0
            is_usable[0, p] = usable[j, 0] if shared_usable else usable[j, q]
        load_light(row, there, is_usable, (np.int64(0), np.int64(0)), albedo, values, may, use, j)


@njit(cache=True, error_model="numpy")
def load_light(samples, known, usable, place, albedo, values, may, use, j):
    """Light j of a block from a place of the samples, relative to the albedo; samples that are not known are 0."""
    zero, one = np.float32(0.0), np.float32(1.0)
    row, first = place
    for p in range(0, BLOCK, LANES):
        value = load(samples, (row, first + p)) / load(albedo, p)
        # so far outside of the albedo that only its sign matters: its square has to fit into float32
        value = choose(value < FARTHEST, value, FARTHEST)
        value = choose(value > -FARTHEST, value, -FARTHEST)
        there = load(known, (row, first + p))
        store(values, (j, p), choose(there, value, zero))
        store(may, (j, p), choose(there, one, zero))
        store(use, (j, p), choose(there & load(usable, (row, first + p)), one, zero))


@njit(cache=True, error_model="numpy")
def fit_block(
    values, known, usable, vectors, start, held, noise, reselections, at_least, active, result, buffers, work
):
    """Fit, choose the samples again, fit again; values relative to the Lambertian albedo.

    result (fit, surface, sums, weights, kept): kept (BLOCK,) float32 samples, with weight 1, of the last fit.
    """
    fit, surface, sums, weights, kept = result
    spare, limit, more, going = buffers
    one = np.float32(1.0)
    for p in range(fit.size):
        fit[p] = start[p]
    for p in range(BLOCK):
        going[p] = active[p]
    for j in range(values.shape[0]):
        for p in range(0, BLOCK, LANES):
            store(weights, (j, p), load(usable, (j, p)))
    for choice in range(reselections + 1):
        if choice == 0:
            for p in range(0, BLOCK, LANES):
                total = splat(np.float32(0.0))
                for j in range(values.shape[0]):
                    total += load(weights, (j, p))
                store(kept, p, total)
        else:
            for p in range(BLOCK):
                freedom = kept[p] - np.float32(5.0)
                variance = np.float64(sums[p + 20 * BLOCK]) / (freedom if freedom > one else one)
                limit[p] = np.float32(3.0 * (np.sqrt(variance) + noise))
            choose_samples(values, known, vectors, surface, limit, spare, more)
            for p in range(BLOCK):
                going[p] = going[p] if more[p] >= at_least else 0.0
                kept[p] = more[p] if going[p] > 0.0 else kept[p]
                limit[p] = going[p]
            take_lanes(limit, spare.reshape(-1), weights.reshape(-1))
        rounds = FIRST_ROUNDS if choice == 0 else ROUNDS
        descend(values, weights, vectors, held, rounds, going, fit, surface, sums, work)


@njit(cache=True, nogil=True, error_model="numpy")
def refine(
    p, end, observations, usable, known, vectors, settings, max_condition, normals, scalars, lights_used, flags, shading
):
    """Refine Lambertian estimates in the outputs of `solve_weighted`: of the pixels p .. end - 1 with samples enough.

    observations (lights, pixels) float32; usable, known (lights, pixels) uint8, or (lights, 1) for all pixels alike;
    vectors (6, lights) float32; settings: prior, noise, reselections, at_least; shading (pixels, 3) float32: (a, b, d)
    of `nishiki.brdf.torrance_sparrow`, Lambert's (1, 0, 0) before.
    """
    lights = observations.shape[0]
    prior, noise, reselections, at_least = settings[0], settings[1], int(settings[2]), settings[3]
    memory = planes(5 * lights + 3 + SURFACE + SUMS, np.int64(BLOCK))
    values, known_here = memory[:lights], memory[lights : 2 * lights]
    use, spare, row = memory[2 * lights : 3 * lights], memory[3 * lights : 4 * lights], 5 * lights
    start, held, active, variance = np.zeros(FIT * BLOCK), np.zeros(BLOCK), np.zeros(BLOCK), np.zeros(BLOCK)
    buffers = spare, memory[row], memory[row + 1], np.zeros(BLOCK)
    result = (
        np.zeros(FIT * BLOCK),
        memory[row + 3 : row + 3 + SURFACE].ravel(),
        memory[row + 3 + SURFACE :].ravel(),
        memory[4 * lights : row],
        memory[row + 2],
    )
    condition = np.zeros(BLOCK)
    work = descent_work(lights)
    index = np.zeros(BLOCK, np.int64)
    while p < end:
        width = 0
        while p < end and width < BLOCK:
            if not flags[p] & bits.NO_ESTIMATE:
                if lights_used[p] < at_least:
                    flags[p] |= bits.FALLBACK
                else:
                    index[width] = p
                    width += 1
            p += 1
        if width == 0:
            continue
        load_block(observations, usable, known, index, width, scalars, normals, values, known_here, use, start)
        for i in range(BLOCK):
            q = index[i if i < width else 0]
            spread = np.float64(scalars[3, q]) / np.float64(scalars[0, q])
            # The second part is a Gaussian prior of standard deviation WIDTH, in units of the squared residuals.
            held[i] = prior * lights_used[q] / 3.0 + (spread / WIDTH) ** 2
            active[i] = 1.0 if i < width else 0.0
        fit_block(
            values, known_here, use, vectors, start, held, noise, reselections, at_least, active, result, buffers,
            work,
        )  # fmt: skip
        tangential_variance(result[2], held, variance)
        conditions_of(result[3], vectors, condition)
        store_fits(
            index, width, result, variance, condition, max_condition, normals, scalars, lights_used, flags, spare
        )
        store_shading(index, width, result, spare, shading)


@njit(cache=True, error_model="numpy")
def conditions_of(weights, vectors, out):
    """Condition (BLOCK,) of the 3 x 3 normal matrix of each pixel's kept lights."""
    for p in range(0, BLOCK, LANES):
        a = b = c = d = e = f = splat(0.0)
        for j in range(weights.shape[0]):
            x, y, z = np.float64(vectors[0, j]), np.float64(vectors[1, j]), np.float64(vectors[2, j])
            kept = load(weights, (j, p)) > np.float32(0.0)
            a = choose(kept, a + x * x, a)
            b = choose(kept, b + x * y, b)
            c = choose(kept, c + x * z, c)
            d = choose(kept, d + y * y, d)
            e = choose(kept, e + y * z, e)
            f = choose(kept, f + z * z, f)
        least, largest = eigenvalues(a, b, c, d, e, f)
        bound = largest * 1e-30
        store(out, p, largest / choose(least > bound, least, bound))


@njit(cache=True, error_model="numpy")
def store_fits(index, width, best, variance, condition, max_condition, normals, scalars, lights_used, flags, stored):
    """Write refined pixels; where the fit is no surface (no diffuse part, singular) the Lambertian one stands.

    stored (lights, BLOCK): its first row becomes 1 where a pixel was written.
    """
    fit, _, sums, _, number = best
    for i in range(width):
        p, kept = index[i], np.float64(number[i])
        albedo = np.float64(scalars[0, p])
        # mean of a + b c over the samples, weighted c^2
        diffuse = fit[i + 3 * BLOCK] + fit[i + 4 * BLOCK] * sums[i + 10 * BLOCK] / max(sums[i + 9 * BLOCK], 1e-30)
        squares = np.float64(sums[i + 20 * BLOCK])
        residual = np.sqrt(squares / kept) * albedo
        determined = variance[i] > 0.0 and kept > 5.0 and residual <= LARGEST  # false for NaN
        stored[0, i] = np.float32(0.0)
        if not (determined and LEAST_ALBEDO <= diffuse * albedo <= LARGEST):
            flags[p] |= bits.FALLBACK
            continue
        stored[0, i] = np.float32(1.0)
        for k in range(3):
            normals[p, k] = fit[i + k * BLOCK]
        scalars[0, p] = diffuse * albedo
        scalars[1, p] = min(np.sqrt(variance[i] * squares / (kept - 5.0)), 0.5 * np.pi)
        scalars[2, p] = min(condition[i], 3e38)
        scalars[3, p] = residual
        lights_used[p] = int(kept)
        flag = flags[p] & ~(bits.ILL_CONDITIONED | bits.FACES_AWAY | bits.NO_REDUNDANCY)
        if condition[i] > max_condition:
            flag |= bits.ILL_CONDITIONED
        if fit[i + 2 * BLOCK] <= 0.0:
            flag |= bits.FACES_AWAY
        flags[p] = flag


@njit(cache=True, error_model="numpy")
def store_shading(index, width, best, stored, shading):
    """Store (a, b, d), scaled so that the body factor is 1 on average over the samples, weighted c^2."""
    fit, _, sums, _, _ = best
    for i in range(width):
        if stored[0, i] > np.float32(0.0):
            a, b, d = fit[i + 3 * BLOCK], fit[i + 4 * BLOCK], fit[i + 5 * BLOCK]
            mean = a + (b * sums[i + 10 * BLOCK] + d * sums[i + 11 * BLOCK]) / np.float64(sums[i + 9 * BLOCK])
            if mean > LEAST_FACTOR:  # false for NaN
                p = index[i]
                shading[p, 0], shading[p, 1], shading[p, 2] = a / mean, b / mean, d / mean
