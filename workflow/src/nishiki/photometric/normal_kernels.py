"""Kernels of the normals: Lambert's law by least squares, then the lobe model with samples chosen again."""

from collections import namedtuple

import numpy as np
from numba import njit

from nishiki.lanes import BLOCK, LANES, choose, load, planes, root, splat, store, store_rows
from nishiki.photometric.flags import COPLANAR, NO_ESTIMATE, NormalFlag
from nishiki.photometric.lobe import choose_samples, descend, make_fit, take_lanes, tangential_variance
from nishiki.small_matrices import eigenvalues, inverse

LEAST_ALBEDO, LARGEST = (float(each) for each in (np.finfo(np.float32).smallest_subnormal, np.finfo(np.float32).max))
PRIOR = 1e-4  # least weight of b^2 and d^2, times a third of the number of samples (about their sum of c^2)
AT_LEAST = 6  # samples below which the gloss lobe is not tried: five unknowns and one to spare
WIDTH = 0.25  # standard deviation expected of b and d, relative to the albedo, where the samples scatter much
FARTHEST = np.float32(1e12)  # times the albedo
LEAST_FACTOR = 0.01  # mean body factor, relative to Lambert's albedo, below which Lambert's law is kept for the shading
FIRST_ROUNDS, ROUNDS = 4, 3  # Gauss-Newton steps for the samples first chosen, and for those chosen again
TERMS = 10  # six products of the direction, three of the right-hand side, the sum of squares


@njit(cache=True, error_model="numpy")
def solve_block(right, inverse_of, count, weight, solved):
    """Solve a block from the right-hand sides, the sums of squares, and the inverse matrices.

    right (4, BLOCK), inverse_of (6, BLOCK), count, weight (BLOCK,); into solved (6, BLOCK): unit normal, length, root
    mean square residual, and the root mean square angle of the normal's error: sqrt(trace(P C P)), P the projector
    across the normal, C = variance * inverse / length^2 (first order); at most pi / 2, which says nothing is known.
    """
    for p in range(0, BLOCK, LANES):
        u, v, w, total = load(right, (0, p)), load(right, (1, p)), load(right, (2, p)), load(right, (3, p))
        m0, m1, m2 = load(inverse_of, (0, p)), load(inverse_of, (1, p)), load(inverse_of, (2, p))
        m3, m4, m5 = load(inverse_of, (3, p)), load(inverse_of, (4, p)), load(inverse_of, (5, p))
        x = m0 * u + m1 * v + m2 * w
        y = m1 * u + m3 * v + m4 * w
        z = m2 * u + m4 * v + m5 * w
        length = root(x * x + y * y + z * z)
        # a projection leaves neither less than nothing nor more than there was, whatever the rounding
        squares = total - (x * u + y * v + z * w)
        squares = choose(squares > 0.0, squares, 0.0)
        squares = choose(squares < total, squares, total)
        residual = root(squares / load(weight, p))
        x, y, z = x / length, y / length, z / length
        variance = squares / (load(count, p) - 3.0)
        along = x * (m0 * x + (m1 * y + m2 * z) * 2.0) + y * (m3 * y + m4 * z * 2.0) + z * m5 * z
        trace = m0 + m3 + m5 - along
        sigma = root(choose(trace > 0.0, trace, 0.0) * variance) / length
        residual = choose(residual < LARGEST, residual, LARGEST)
        sigma = choose(sigma < 0.5 * np.pi, sigma, 0.5 * np.pi)
        store_rows(solved, p, (x, y, z, length, residual, sigma))


@njit(cache=True, error_model="numpy")
def condition_block(matrices, count, conditions, inverses):
    """Compute condition numbers (BLOCK,) and inverses (6, BLOCK) of the normal matrices (6, BLOCK) of a block.

    Infinite where there are fewer than three lights, and where a pivot that rounding has made 0 or negative says the
    same as a smallest eigenvalue that is lost in it.
    """
    for p in range(0, BLOCK, LANES):
        a, b, c = load(matrices, (0, p)), load(matrices, (1, p)), load(matrices, (2, p))
        d, e, f = load(matrices, (3, p)), load(matrices, (4, p)), load(matrices, (5, p))
        least, largest = eigenvalues(a, b, c, d, e, f)
        m0, m1, m2, m3, m4, m5 = inverse(a, b, c, d, e, f)
        sound = (load(count, p) >= 3.0) & (least > largest / COPLANAR) & (m0 > 0.0) & (m3 > 0.0) & (m5 > 0.0)
        store(conditions, p, choose(sound, largest / least, np.inf))
        for row, value in enumerate((m0, m1, m2, m3, m4, m5)):
            store(inverses, (row, p), choose(sound, value, 0.0))


@njit(cache=True, error_model="numpy")
def write_block(solved, condition, count, max_condition, start, width, estimates):
    """Write the estimates of a block's pixels: the results of `solve_block`, where it is a surface."""
    normals, scalars, lights_used, flags = estimates
    for i in range(width):
        p, flag, length, z = start + i, 0, solved[3, i], solved[2, i]
        surface = count[i] >= 3 and condition[i] < COPLANAR and LEAST_ALBEDO <= length <= LARGEST
        scalars[2, p] = min(condition[i], 3e38)
        lights_used[p] = int(count[i])
        if surface:
            flag |= NormalFlag.FACES_AWAY if z <= 0.0 else 0
            flag |= NormalFlag.ILL_CONDITIONED if condition[i] > max_condition else 0
            flag |= 0 if count[i] > 3 else NormalFlag.NO_REDUNDANCY
            normals[p, 0], normals[p, 1], normals[p, 2] = solved[0, i], solved[1, i], z
            scalars[0, p] = length
            scalars[1, p] = solved[5, i] if count[i] > 3 else 0.5 * np.pi
            scalars[3, p] = solved[4, i]
        else:
            if count[i] < 3:
                flag |= NormalFlag.TOO_FEW_LIGHTS
            elif condition[i] >= COPLANAR:
                flag |= NormalFlag.COPLANAR_LIGHTS
            else:
                flag |= NormalFlag.NO_SIGNAL
            normals[p, 0], normals[p, 1], normals[p, 2] = 0.0, 0.0, 1.0
            scalars[0, p], scalars[1, p], scalars[3, p] = 0.0, 0.5 * np.pi, 0.0
        flags[p] = flag


@njit(cache=True, nogil=True, error_model="numpy")
def solve_weighted(begin, end, observations, weights, products, max_condition, estimates):
    """Solve least squares with own weights at every pixel of the blocks begin .. end - 1; a mask is 0 or 1.

    observations (lights, pixels) float32; weights (lights, pixels) uint8 or float32; products (lights, 9): the six
    products of each direction with itself, then the direction; estimates (`solve.Estimates`) are written. Accumulated
    in float64, a light at a time over BLOCK neighbouring pixels, so that the result of a pixel does not depend on where
    tiles begin.
    """
    lights, pixels = observations.shape
    # One flat array of sums: with a single pair of arrays to tell apart the compiler makes SIMD code of the loop.
    sums = np.zeros((TERMS + 2) * BLOCK)
    memory = np.zeros((13, BLOCK))
    solved, inverses, conditions = memory[:6], memory[6:12], memory[12]
    for block in range(begin, end):
        start = block * BLOCK
        width = min(BLOCK, pixels - start)
        for p in range((TERMS + 2) * BLOCK):
            sums[p] = 0.0
        for j in range(lights):
            row, weight = observations[j, start : start + width], weights[j, start : start + width]
            xx, xy, xz = products[j, 0], products[j, 1], products[j, 2]
            yy, yz, zz = products[j, 3], products[j, 4], products[j, 5]
            x, y, z = products[j, 6], products[j, 7], products[j, 8]
            for p in range(width):
                w = np.float64(weight[p])
                value = np.float64(row[p]) if w > 0 else 0.0
                weighted = w * value
                sums[p] += w * xx
                sums[p + BLOCK] += w * xy
                sums[p + 2 * BLOCK] += w * xz
                sums[p + 3 * BLOCK] += w * yy
                sums[p + 4 * BLOCK] += w * yz
                sums[p + 5 * BLOCK] += w * zz
                sums[p + 6 * BLOCK] += weighted * x
                sums[p + 7 * BLOCK] += weighted * y
                sums[p + 8 * BLOCK] += weighted * z
                sums[p + 9 * BLOCK] += weighted * value
                sums[p + 10 * BLOCK] += w
                sums[p + 11 * BLOCK] += 1.0 if w > 0 else 0.0
        rows = sums.reshape(TERMS + 2, BLOCK)
        condition_block(rows, rows[11], conditions, inverses)
        solve_block(rows[6:10], inverses, rows[11], rows[10], solved)
        write_block(solved, conditions, rows[11], max_condition, start, width, estimates)


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
def fit_block(block, vectors, noise):
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
    for p in range(BLOCK):
        freedom = kept[p] - np.float32(5.0)
        variance = np.float64(state.sums[p + 20 * BLOCK]) / (freedom if freedom > np.float32(1.0) else 1.0)
        limit[p] = np.float32(3.0 * (np.sqrt(variance) + noise))
    choose_samples(block.values, block.known, vectors, state.surface, limit, block.spare, more)
    for p in range(BLOCK):
        block.active[p] = block.active[p] if more[p] >= AT_LEAST else 0.0
        kept[p] = more[p] if block.active[p] > 0.0 else kept[p]
        state.going[p] = limit[p] = block.active[p]
    take_lanes(limit, block.spare.reshape(-1), block.weights.reshape(-1))
    descend(block.values, block.weights, vectors, ROUNDS, state)


@njit(cache=True, nogil=True, error_model="numpy")
def refine(p, end, samples, vectors, noise, max_condition, estimates, shading):
    """Refine Lambertian estimates of the pixels p .. end - 1 that have samples enough, in place.

    Parameters
    ----------
    p, end : int
    samples : nishiki.photometric.solve.Samples
    vectors : (6, lights) float32
        Directions to the lights, and half vectors.
    noise : float
        Relative to the albedo.
    max_condition : float
        Condition above which a pixel is flagged.
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
            if not flags[p] & NO_ESTIMATE:
                if lights_used[p] < AT_LEAST:
                    flags[p] |= NormalFlag.FALLBACK
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
            state.prior[i] = PRIOR * lights_used[q] / 3.0 + (spread / WIDTH) ** 2
            block.active[i] = 1.0 if i < width else 0.0
        fit_block(block, vectors, noise)
        set_condition(block, vectors)
        store_fits(block, width, max_condition, estimates, shading)


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
            flags[p] |= NormalFlag.FALLBACK
            continue
        for k in range(3):
            normals[p, k] = fit[i + k * BLOCK]
        scalars[0, p] = diffuse * albedo
        scalars[1, p] = min(np.sqrt(variance * squares / (kept - 5.0)), 0.5 * np.pi)
        scalars[2, p] = min(condition[i], 3e38)
        scalars[3, p] = residual
        lights_used[p] = int(kept)
        flag = flags[p] & ~(NormalFlag.ILL_CONDITIONED | NormalFlag.FACES_AWAY | NormalFlag.NO_REDUNDANCY)
        if condition[i] > max_condition:
            flag |= NormalFlag.ILL_CONDITIONED
        if fit[i + 2 * BLOCK] <= 0.0:
            flag |= NormalFlag.FACES_AWAY
        flags[p] = flag
        # the shading is scaled so that the body factor is 1 on average over the samples, weighted c^2
        a, b, d = fit[i + 3 * BLOCK], fit[i + 4 * BLOCK], fit[i + 5 * BLOCK]
        mean = a + (b * sums[i + 10 * BLOCK] + d * sums[i + 11 * BLOCK]) / np.float64(sums[i + 9 * BLOCK])
        if mean > LEAST_FACTOR:  # false for NaN
            shading[p, 0], shading[p, 1], shading[p, 2] = a / mean, b / mean, d / mean
