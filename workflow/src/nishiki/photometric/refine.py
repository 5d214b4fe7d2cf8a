"""Refine Lambertian normals by the lobe model, and choose the samples of every pixel again."""

from collections import namedtuple

import numpy as np
from numba import njit

from nishiki.lanes import LANES, choose, load, planes, splat, store
from nishiki.photometric import flags as bits
from nishiki.photometric.least_squares import LARGEST, LEAST_ALBEDO
from nishiki.photometric.lobe import BLOCK, choose_samples, descend, make_fit, take_lanes, tangential_variance
from nishiki.small_matrices import eigenvalues

WIDTH = 0.25  # standard deviation expected of b and d, relative to the albedo, where the samples scatter much
FARTHEST = np.float32(1e12)  # times the albedo
LEAST_FACTOR = 0.01  # mean body factor, relative to Lambert's albedo, below which Lambert's law is kept for the shading
FIRST_ROUNDS, ROUNDS = 4, 3  # Gauss-Newton steps for the samples first chosen, and for those chosen again


Block = namedtuple("Block", "index values known usable weights spare albedo kept limit more condition active state")
"""Pixels that are refined together.

index (BLOCK,) int64: their places; values, known, usable, weights, spare (lights, BLOCK) float32: samples relative
to the albedo, and masks of 0 and 1; albedo, kept, limit, more (BLOCK,) float32;
condition and active (1 where a fit goes on; BLOCK,) float64.
"""


@njit(cache=True)
def make_block(lights):
    """Make the memory of a block."""
    width = np.int64(BLOCK)  # a constant would have `planes` compiled for it alone
    memory = planes(np.int64(4), width)
    return Block(
        np.zeros(BLOCK, np.int64), planes(lights, width), planes(lights, width), planes(lights, width),
        planes(lights, width), planes(lights, width), memory[0], memory[1], memory[2], memory[3],
        np.zeros(BLOCK), np.zeros(BLOCK), make_fit(lights),
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def load_block(samples, estimates, block, width):
    """Load the pixels of a block, of which the first `width` are real; samples of the others are unknown.

    Samples are relative to the albedo; the fits become Lambert's.
    """
    observations, usable, known = samples
    index, start, albedo = block.index, block.state.fit, block.albedo
    shared_usable, shared_known = usable.shape[1] == 1, known.shape[1] == 1
    for p in range(BLOCK):
        q = index[p if p < width else 0]
        albedo[p] = estimates.scalars[0, q]
        for k in range(3):
            start[p + k * BLOCK] = estimates.normals[q, k]
        start[p + 3 * BLOCK], start[p + 4 * BLOCK], start[p + 5 * BLOCK] = 1.0, 0.0, 0.0
    zero, one = np.float32(0.0), np.float32(1.0)
    for j in range(observations.shape[0]):
        for p in range(BLOCK):
            q = index[p if p < width else 0]
            value = observations[j, q] / albedo[p]
            # so far outside of the albedo that only its sign matters: its square has to fit into float32
            value = min(max(value, -FARTHEST), FARTHEST)
            there = p < width and (known[j, 0] if shared_known else known[j, q]) != 0
            chosen = there and (usable[j, 0] if shared_usable else usable[j, q]) != 0
            block.values[j, p] = value if there else zero
            block.known[j, p], block.usable[j, p] = one if there else zero, one if chosen else zero


@njit(cache=True, error_model="numpy")
def fit_block(block, vectors, settings):
    """Fit, choose the samples again, fit again; values relative to the Lambertian albedo.

    `block.weights` and `block.kept` are the samples of the last fit, and their number.
    """
    state, kept, limit, more = block.state, block.kept, block.limit, block.more
    for p in range(BLOCK):
        state.going[p] = block.active[p]
    for p in range(0, BLOCK, LANES):
        total = splat(np.float32(0.0))
        for j in range(block.usable.shape[0]):
            weight = load(block.usable, (j, p))
            store(block.weights, (j, p), weight)
            total += weight
        store(kept, p, total)
    descend(block.values, block.weights, vectors, FIRST_ROUNDS, state)
    for _ in range(settings.reselections):
        for p in range(BLOCK):
            freedom = kept[p] - np.float32(5.0)
            variance = np.float64(state.sums[p + 20 * BLOCK]) / (freedom if freedom > np.float32(1.0) else 1.0)
            limit[p] = np.float32(3.0 * (np.sqrt(variance) + settings.noise))
        choose_samples(block.values, block.known, vectors, state.surface, limit, block.spare, more)
        for p in range(BLOCK):
            block.active[p] = block.active[p] if more[p] >= settings.at_least else 0.0
            kept[p] = more[p] if block.active[p] > 0.0 else kept[p]
            state.going[p] = limit[p] = block.active[p]
        take_lanes(limit, block.spare.reshape(-1), block.weights.reshape(-1))
        descend(block.values, block.weights, vectors, ROUNDS, state)


@njit(cache=True, nogil=True, error_model="numpy")
def refine(p, end, samples, vectors, settings, estimates, shading):
    """Refine Lambertian estimates of the pixels p .. end - 1 that have samples enough, in place.

    Parameters
    ----------
    p, end : int
    samples : nishiki.photometric.solve.Samples
    vectors : (6, lights) float32
        Directions to the lights, and half vectors.
    settings : nishiki.photometric.solve.LobeSettings
    estimates : nishiki.photometric.solve.Estimates
        As `solve_weighted` leaves them.
    shading : (pixels, 3) float32
        (a, b, d) of `nishiki.brdf.torrance_sparrow`, Lambert's (1, 0, 0) before.
    """
    scalars, lights_used, flags = estimates.scalars, estimates.lights_used, estimates.flags
    block = make_block(samples.observations.shape[0])
    state = block.state
    while p < end:
        width = 0
        while p < end and width < BLOCK:
            if not flags[p] & bits.NO_ESTIMATE:
                if lights_used[p] < settings.at_least:
                    flags[p] |= bits.FALLBACK
                else:
                    block.index[width] = p
                    width += 1
            p += 1
        if width == 0:
            continue
        load_block(samples, estimates, block, width)
        for i in range(BLOCK):
            q = block.index[i]
            spread = np.float64(scalars[3, q]) / np.float64(scalars[0, q])
            # The second part is a Gaussian prior of standard deviation WIDTH, in units of the squared residuals.
            state.prior[i] = settings.prior * lights_used[q] / 3.0 + (spread / WIDTH) ** 2
            block.active[i] = 1.0 if i < width else 0.0
        fit_block(block, vectors, settings)
        set_condition(block, vectors)
        store_fits(block, width, settings.max_condition, estimates, shading)


@njit(cache=True, error_model="numpy")
def set_condition(block, vectors):
    """Compute the condition (BLOCK,) of the 3 x 3 normal matrix of each pixel's kept lights."""
    for p in range(0, BLOCK, LANES):
        a = b = c = d = e = f = splat(0.0)
        for j in range(vectors.shape[1]):
            x, y, z = np.float64(vectors[0, j]), np.float64(vectors[1, j]), np.float64(vectors[2, j])
            kept = load(block.weights, (j, p)) > np.float32(0.0)
            a = choose(kept, a + x * x, a)
            b = choose(kept, b + x * y, b)
            c = choose(kept, c + x * z, c)
            d = choose(kept, d + y * y, d)
            e = choose(kept, e + y * z, e)
            f = choose(kept, f + z * z, f)
        least, largest = eigenvalues(a, b, c, d, e, f)
        bound = largest * 1e-30
        store(block.condition, p, largest / choose(least > bound, least, bound))


@njit(cache=True, error_model="numpy")
def store_fits(block, width, max_condition, estimates, shading):
    """Write refined pixels; where the fit is no surface (no diffuse part, singular) the Lambertian one stands."""
    normals, scalars, lights_used, flags = estimates
    fit, sums, condition = block.state.fit, block.state.sums, block.condition
    for i in range(width):
        p, kept = block.index[i], np.float64(block.kept[i])
        variance = tangential_variance(sums, i, block.state.prior[i])
        albedo = np.float64(scalars[0, p])
        # mean of a + b c over the samples, weighted c^2
        diffuse = fit[i + 3 * BLOCK] + fit[i + 4 * BLOCK] * sums[i + 10 * BLOCK] / max(sums[i + 9 * BLOCK], 1e-30)
        squares = np.float64(sums[i + 20 * BLOCK])
        residual = np.sqrt(squares / kept) * albedo
        determined = variance > 0.0 and kept > 5.0 and residual <= LARGEST  # false for NaN
        if not (determined and LEAST_ALBEDO <= diffuse * albedo <= LARGEST):
            flags[p] |= bits.FALLBACK
            continue
        for k in range(3):
            normals[p, k] = fit[i + k * BLOCK]
        scalars[0, p] = diffuse * albedo
        scalars[1, p] = min(np.sqrt(variance * squares / (kept - 5.0)), 0.5 * np.pi)
        scalars[2, p] = min(condition[i], 3e38)
        scalars[3, p] = residual
        lights_used[p] = int(kept)
        flag = flags[p] & ~(bits.ILL_CONDITIONED | bits.FACES_AWAY | bits.NO_REDUNDANCY)
        if condition[i] > max_condition:
            flag |= bits.ILL_CONDITIONED
        if fit[i + 2 * BLOCK] <= 0.0:
            flag |= bits.FACES_AWAY
        flags[p] = flag
        # the shading is scaled so that the body factor is 1 on average over the samples, weighted c^2
        a, b, d = fit[i + 3 * BLOCK], fit[i + 4 * BLOCK], fit[i + 5 * BLOCK]
        mean = a + (b * sums[i + 10 * BLOCK] + d * sums[i + 11 * BLOCK]) / np.float64(sums[i + 9 * BLOCK])
        if mean > LEAST_FACTOR:  # false for NaN
            shading[p, 0], shading[p, 1], shading[p, 2] = a / mean, b / mean, d / mean
