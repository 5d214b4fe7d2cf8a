"""Lambert's law by least squares: the kernels that turn observations into albedo times normal."""

import numpy as np
from numba import njit, prange

from nishiki.normals import flags as bits

BLOCK = 64
COPLANAR = 1e12  # condition above which double precision cannot tell the normal matrix from a singular one
TERMS = 10  # six products of the direction, three of the right-hand side, the sum of squares


@njit(cache=True, error_model="numpy")
def eigenvalues(a, b, c, d, e, f):
    """Smallest and largest eigenvalue of the symmetric matrix [[a, b, c], [b, d, e], [c, e, f]].

    The trigonometric form of the cubic's roots (O. K. Smith, Eigenvalues of a symmetric 3 x 3 matrix, CACM 1961).
    """
    mean = (a + d + f) / 3.0
    off = b * b + c * c + e * e
    spread = np.sqrt(((a - mean) ** 2 + (d - mean) ** 2 + (f - mean) ** 2 + 2.0 * off) / 6.0)
    if spread <= 0.0:
        return mean, mean
    a, d, f = (a - mean) / spread, (d - mean) / spread, (f - mean) / spread
    b, c, e = b / spread, c / spread, e / spread
    half = 0.5 * (a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d))
    angle = np.arccos(min(1.0, max(-1.0, half))) / 3.0
    return mean + 2.0 * spread * np.cos(angle + 2.0 * np.pi / 3.0), mean + 2.0 * spread * np.cos(angle)


@njit(cache=True, error_model="numpy")
def inverse(a, b, c, d, e, f):
    """The six different elements of the inverse of a symmetric 3 x 3 matrix, by cofactors."""
    c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * c00 + b * c01 + c * c02
    return c00 / det, c01 / det, c02 / det, (a * f - c * c) / det, (b * c - a * e) / det, (a * d - b * b) / det


@njit(cache=True, error_model="numpy")
def angular_sigma(m, x, y, z, length, variance):
    """Root mean square angle of the normal's error: sqrt(trace(P C P)), P the projector across the normal.

    m are the six elements of the inverse normal matrix, C = variance * m / length^2 (first order), (x, y, z) the unit
    normal. At most pi / 2, which says that nothing is known.
    """
    along = x * (m[0] * x + 2.0 * (m[1] * y + m[2] * z)) + y * (m[3] * y + 2.0 * m[4] * z) + z * m[5] * z
    trace = m[0] + m[3] + m[5] - along
    return min(np.sqrt(max(trace, 0.0) * variance) / length, 0.5 * np.pi)


@njit(cache=True, error_model="numpy")
def conditioned(t, count):
    """Condition number and inverse of the normal matrix in t; infinite where there are fewer than three lights."""
    if count < 3:
        return np.inf, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    least, largest = eigenvalues(t[0], t[1], t[2], t[3], t[4], t[5])
    if not least > largest / COPLANAR:
        return np.inf, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    return largest / least, inverse(t[0], t[1], t[2], t[3], t[4], t[5])


@njit(cache=True, error_model="numpy")
def write_pixel(t, condition, m, count, weight, max_condition, p, normals, scalars, lights_used, flags):
    """Solve one pixel's normal equations t (TERMS,), inverse matrix m, and write its row of every output.

    scalars (4, pixels) float32: albedo, sigma, condition, residual.
    """
    flag = 0
    normals[p, 0], normals[p, 1], normals[p, 2] = 0.0, 0.0, 1.0
    scalars[0, p], scalars[1, p], scalars[3, p] = 0.0, 0.5 * np.pi, 0.0
    scalars[2, p] = min(condition, 3e38)
    lights_used[p] = count
    if count < 3:
        flag |= bits.TOO_FEW_LIGHTS
    elif condition >= COPLANAR:
        flag |= bits.COPLANAR_LIGHTS
    else:
        x = m[0] * t[6] + m[1] * t[7] + m[2] * t[8]
        y = m[1] * t[6] + m[3] * t[7] + m[4] * t[8]
        z = m[2] * t[6] + m[4] * t[7] + m[5] * t[8]
        length = np.sqrt(x * x + y * y + z * z)
        if length > 0.0:
            flag |= bits.FACES_AWAY if z <= 0.0 else 0
            flag |= bits.ILL_CONDITIONED if condition > max_condition else 0
            squares = max(t[9] - (x * t[6] + y * t[7] + z * t[8]), 0.0)
            x, y, z = x / length, y / length, z / length
            normals[p, 0], normals[p, 1], normals[p, 2] = x, y, z
            scalars[0, p] = length
            scalars[3, p] = np.sqrt(squares / weight)
            if count > 3:
                scalars[1, p] = angular_sigma(m, x, y, z, length, squares / (count - 3.0))
            else:
                flag |= bits.NO_REDUNDANCY
        else:
            flag |= bits.NO_SIGNAL
    flags[p] = flag


@njit(cache=True, parallel=True, error_model="numpy")
def solve_weighted(observations, weights, products, max_condition, normals, scalars, lights_used, flags):
    """Least squares with weights of its own at every pixel (a mask is a weight of 0 or 1).

    observations (lights, pixels) float32; weights (lights, pixels) uint8 or float32; products (lights, 9): the six
    products of each direction with itself, then the direction. Accumulated in float64, a light at a time over BLOCK
    neighbouring pixels, so that the result of a pixel does not depend on where tiles begin.
    """
    lights, pixels = observations.shape
    whole = np.zeros(TERMS)
    for j in range(lights):
        for k in range(6):
            whole[k] += products[j, k]
    whole_condition, whole_inverse = conditioned(whole, lights)
    for block in prange((pixels + BLOCK - 1) // BLOCK):
        start = block * BLOCK
        width = min(BLOCK, pixels - start)
        # One flat array of sums: with a single pair of arrays to tell apart the compiler makes SIMD code of the loop.
        sums = np.zeros((TERMS + 2) * BLOCK)
        for j in range(lights):
            row, weight = observations[j, start : start + width], weights[j, start : start + width]
            xx, xy, xz = products[j, 0], products[j, 1], products[j, 2]
            yy, yz, zz = products[j, 3], products[j, 4], products[j, 5]
            x, y, z = products[j, 6], products[j, 7], products[j, 8]
            for p in range(width):
                w = float(weight[p])
                value = float(row[p]) if w > 0 else 0.0
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
        t = np.empty(TERMS)
        for p in range(width):
            for k in range(TERMS):
                t[k] = sums[p + k * BLOCK]
            weight_sum, count = sums[p + 10 * BLOCK], sums[p + 11 * BLOCK]
            # Most pixels use every light: their matrix is the same to the last bit, and so is its inverse.
            if count == lights and weight_sum == lights and t[0] == whole[0] and t[3] == whole[3] and t[5] == whole[5]:
                condition, m = whole_condition, whole_inverse
            else:
                condition, m = conditioned(t, count)
            write_pixel(
                t, condition, m, count, weight_sum, max_condition, start + p, normals, scalars, lights_used, flags
            )


@njit(cache=True, parallel=True, error_model="numpy")
def solve_shared(observations, products, max_condition, normals, scalars, lights_used, flags):
    """Least squares where every light is usable everywhere: one normal matrix serves all pixels."""
    lights, pixels = observations.shape
    shared = np.zeros(TERMS)
    for j in range(lights):
        for k in range(6):
            shared[k] += products[j, k]
    condition, m = conditioned(shared, lights)
    for block in prange((pixels + BLOCK - 1) // BLOCK):
        start = block * BLOCK
        width = min(BLOCK, pixels - start)
        sums = np.zeros((4, BLOCK))
        for j in range(lights):
            x, y, z = products[j, 6], products[j, 7], products[j, 8]
            for p in range(width):
                value = float(observations[j, start + p])
                sums[0, p] += value * x
                sums[1, p] += value * y
                sums[2, p] += value * z
                sums[3, p] += value * value
        terms = shared.copy()
        for p in range(width):
            terms[6], terms[7], terms[8], terms[9] = sums[0, p], sums[1, p], sums[2, p], sums[3, p]
            write_pixel(
                terms, condition, m, lights, lights, max_condition, start + p, normals, scalars, lights_used, flags
            )
