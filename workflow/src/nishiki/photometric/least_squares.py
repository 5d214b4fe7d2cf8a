"""Lambert's law by least squares: the kernels that turn observations into albedo times normal."""

import numpy as np
from numba import njit

from nishiki.lanes import LANES, choose, load, root, store
from nishiki.photometric import flags as bits
from nishiki.small_matrices import eigenvalues, inverse

BLOCK = 64  # pixels at a time
LEAST_ALBEDO, LARGEST = 1e-45, 3.4028234e38  # of float32, subnormal numbers included
TERMS = 10  # six products of the direction, three of the right-hand side, the sum of squares


@njit(cache=True, error_model="numpy")
def solve_block(right, inverse_of, count, weight, solved):
    """Solutions of a block from the right-hand sides and the sums of squares, and the inverse matrices.

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
        store(solved, (0, p), x)
        store(solved, (1, p), y)
        store(solved, (2, p), z)
        store(solved, (3, p), length)
        store(solved, (4, p), choose(residual < LARGEST, residual, LARGEST))
        store(solved, (5, p), choose(sigma < 0.5 * np.pi, sigma, 0.5 * np.pi))


@njit(cache=True, error_model="numpy")
def condition_block(matrices, count, conditions, inverses):
    """Condition numbers (BLOCK,) and inverses (6, BLOCK) of the normal matrices (6, BLOCK) of a block.

    Infinite where there are fewer than three lights, and where a pivot that rounding has made 0 or negative says the
    same as a smallest eigenvalue that is lost in it.
    """
    for p in range(0, BLOCK, LANES):
        a, b, c = load(matrices, (0, p)), load(matrices, (1, p)), load(matrices, (2, p))
        d, e, f = load(matrices, (3, p)), load(matrices, (4, p)), load(matrices, (5, p))
        least, largest = eigenvalues(a, b, c, d, e, f)
        m0, m1, m2, m3, m4, m5 = inverse(a, b, c, d, e, f)
        sound = (load(count, p) >= 3.0) & (least > largest / bits.COPLANAR) & (m0 > 0.0) & (m3 > 0.0) & (m5 > 0.0)
        store(conditions, p, choose(sound, largest / least, np.inf))
        store(inverses, (0, p), choose(sound, m0, 0.0))
        store(inverses, (1, p), choose(sound, m1, 0.0))
        store(inverses, (2, p), choose(sound, m2, 0.0))
        store(inverses, (3, p), choose(sound, m3, 0.0))
        store(inverses, (4, p), choose(sound, m4, 0.0))
        store(inverses, (5, p), choose(sound, m5, 0.0))


@njit(cache=True, error_model="numpy")
def write_block(solved, condition, count, max_condition, start, width, estimates):
    """Write the estimates of a block's pixels: what `solve_block` found, where it is a surface."""
    normals, scalars, lights_used, flags = estimates
    for i in range(width):
        p, flag, length, z = start + i, 0, solved[3, i], solved[2, i]
        surface = count[i] >= 3 and condition[i] < bits.COPLANAR and LEAST_ALBEDO <= length <= LARGEST
        scalars[2, p] = min(condition[i], 3e38)
        lights_used[p] = int(count[i])
        if surface:
            flag |= bits.FACES_AWAY if z <= 0.0 else 0
            flag |= bits.ILL_CONDITIONED if condition[i] > max_condition else 0
            flag |= 0 if count[i] > 3 else bits.NO_REDUNDANCY
            normals[p, 0], normals[p, 1], normals[p, 2] = solved[0, i], solved[1, i], z
            scalars[0, p] = length
            scalars[1, p] = solved[5, i] if count[i] > 3 else 0.5 * np.pi
            scalars[3, p] = solved[4, i]
        else:
            if count[i] < 3:
                flag |= bits.TOO_FEW_LIGHTS
            elif condition[i] >= bits.COPLANAR:
                flag |= bits.COPLANAR_LIGHTS
            else:
                flag |= bits.NO_SIGNAL
            normals[p, 0], normals[p, 1], normals[p, 2] = 0.0, 0.0, 1.0
            scalars[0, p], scalars[1, p], scalars[3, p] = 0.0, 0.5 * np.pi, 0.0
        flags[p] = flag


@njit(cache=True, nogil=True, error_model="numpy")
def solve_weighted(begin, end, observations, weights, products, max_condition, estimates):
    """Least squares with weights of its own at every pixel of the blocks begin .. end - 1; a mask is 0 or 1.

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
