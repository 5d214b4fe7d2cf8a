"""Lambert's law by least squares: the kernels that turn observations into albedo times normal."""

import numpy as np
from numba import njit, prange

from nishiki.photometric import flags as bits

BLOCK = 64
CHUNK = 64  # blocks that share one set of kept matrices
SLOT_BITS = 8
SLOTS = 1 << SLOT_BITS
COPLANAR = 1e12  # condition above which double precision cannot tell the normal matrix from a singular one
LEAST_ALBEDO, LARGEST = 1e-45, 3.4028234e38  # of float32, subnormal numbers included
TERMS = 10  # six products of the direction, three of the right-hand side, the sum of squares


@njit(cache=True, error_model="numpy")
def eigenvalues(a, b, c, d, e, f):
    """Smallest and largest eigenvalue of the symmetric matrix [[a, b, c], [b, d, e], [c, e, f]].

    The trigonometric form of the cubic's roots (O. K. Smith, Eigenvalues of a symmetric 3 x 3 matrix, CACM 1961). Where
    the two small ones lie close together (lights in a narrow cone) that form keeps half of the digits: the smallest is
    then taken from the matrix across the eigenvector of the largest, to a rounding of the largest.
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
    largest = 2.0 * np.cos(angle)
    if half > 0.0:
        return mean + spread * smaller_root(a, b, c, d, e, f, largest), mean + spread * largest
    return mean + 2.0 * spread * np.cos(angle + 2.0 * np.pi / 3.0), mean + spread * largest


@njit(cache=True, error_model="numpy")
def smaller_root(a, b, c, d, e, f, largest):
    """Smallest eigenvalue of a symmetric matrix of trace 0, from its largest one, which is far from the others."""
    # the eigenvector is across the rows of the matrix less the largest: the longest of their three products
    p, q, r = a - largest, d - largest, f - largest
    x, y, z = b * e - c * q, b * c - p * e, p * q - b * b
    u, v, w = q * r - e * e, c * e - b * r, b * e - c * q
    if u * u + v * v + w * w > x * x + y * y + z * z:
        x, y, z = u, v, w
    u, v, w = c * e - b * r, p * r - c * c, b * c - p * e
    if u * u + v * v + w * w > x * x + y * y + z * z:
        x, y, z = u, v, w
    length = np.sqrt(x * x + y * y + z * z)
    x, y, z = x / length, y / length, z / length
    sign = 1.0 if z >= 0.0 else -1.0
    k = -1.0 / (sign + z)
    s0, s1, s2 = 1.0 + sign * x * x * k, sign * x * y * k, -sign * x
    t0, t1, t2 = x * y * k, sign + y * y * k, -y
    h0, h1, h2 = a * s0 + b * s1 + c * s2, b * s0 + d * s1 + e * s2, c * s0 + e * s1 + f * s2
    g0, g1, g2 = a * t0 + b * t1 + c * t2, b * t0 + d * t1 + e * t2, c * t0 + e * t1 + f * t2
    ss, tt, st = s0 * h0 + s1 * h1 + s2 * h2, t0 * g0 + t1 * g1 + t2 * g2, t0 * h0 + t1 * h1 + t2 * h2
    return 0.5 * (ss + tt) - np.sqrt(0.25 * (ss - tt) ** 2 + st * st)


@njit(cache=True, error_model="numpy")
def inverse(a, b, c, d, e, f):
    """The six different elements of the inverse of a symmetric positive 3 x 3 matrix, by L D L^T.

    Sums of squares over the pivots: its error grows with the condition, that of cofactors with the condition squared.
    """
    l10, l20 = b / a, c / a
    second = d - l10 * b
    l21 = (e - l20 * b) / second
    third = f - l20 * c - l21 * (e - l20 * b)
    k = l10 * l21 - l20
    return (
        1.0 / a + l10 * l10 / second + k * k / third,
        -l10 / second - k * l21 / third,
        k / third,
        1.0 / second + l21 * l21 / third,
        -l21 / third,
        1.0 / third,
    )


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
    m = inverse(t[0], t[1], t[2], t[3], t[4], t[5])
    # a pivot that rounding has made 0 or negative says the same as a smallest eigenvalue that is lost in it
    if not (least > largest / COPLANAR and m[0] > 0.0 and m[3] > 0.0 and m[5] > 0.0):
        return np.inf, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    return largest / least, m


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
        if LEAST_ALBEDO <= length <= LARGEST:
            flag |= bits.FACES_AWAY if z <= 0.0 else 0
            flag |= bits.ILL_CONDITIONED if condition > max_condition else 0
            # a projection leaves neither less than nothing nor more than there was, whatever the rounding
            squares = min(max(t[9] - (x * t[6] + y * t[7] + z * t[8]), 0.0), t[9])
            x, y, z = x / length, y / length, z / length
            normals[p, 0], normals[p, 1], normals[p, 2] = x, y, z
            scalars[0, p] = length
            scalars[3, p] = min(np.sqrt(squares / weight), LARGEST)
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
    all_lights = np.zeros(TERMS)
    for j in range(lights):
        for k in range(6):
            all_lights[k] += products[j, k]
    full_condition, full_inverse = conditioned(all_lights, lights)
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
        t = np.empty(TERMS)
        for p in range(width):
            for k in range(TERMS):
                t[k] = sums[p + k * BLOCK]
            weight_sum, count = sums[p + 10 * BLOCK], sums[p + 11 * BLOCK]
            # Most pixels use every light: their matrix is the same to the last bit, and so is its inverse.
            if (
                count == lights
                and weight_sum == lights
                and t[0] == all_lights[0]
                and t[3] == all_lights[3]
                and t[5] == all_lights[5]
            ):
                condition, m = full_condition, full_inverse
            else:
                condition, m = conditioned(t, count)
            write_pixel(
                t, condition, m, count, weight_sum, max_condition, start + p, normals, scalars, lights_used, flags
            )


@njit(cache=True, error_model="numpy")
def matrix_of(all_lights, selected, products, t):
    """The six products of the lights that `selected` (lights,) marks into t, and their number.

    Those of all lights less those left out; where most are left out the others are added up instead, for a small rest
    of large sums would hold their rounding.
    """
    count = 0
    for j in range(len(selected)):
        count += selected[j] != 0
    few = 2 * count < len(selected)
    start, sign = (0.0, 1.0) if few else (1.0, -1.0)
    a, b, c, d, e, f = (
        start * all_lights[0],
        start * all_lights[1],
        start * all_lights[2],
        start * all_lights[3],
        start * all_lights[4],
        start * all_lights[5],
    )
    for j in range(len(selected)):
        w = sign if few == (selected[j] != 0) else 0.0  # no branch: which lights are left out is next to random
        a += w * products[j, 0]
        b += w * products[j, 1]
        c += w * products[j, 2]
        d += w * products[j, 3]
        e += w * products[j, 4]
        f += w * products[j, 5]
    t[0], t[1], t[2], t[3], t[4], t[5] = a, b, c, d, e, f
    return count


@njit(cache=True, error_model="numpy")
def add_masked(row, mask, x, y, z, bit, sums, left_out):
    """Add one light's samples of a block to the right-hand side and the squares; a mask of 0: no sample.

    A function of its own, or the compiler does not make SIMD code of it.
    """
    for p in range(len(row)):
        value = np.float64(row[p] if mask[p] != 0 else np.float32(0.0))
        sums[p] += value * x
        sums[p + BLOCK] += value * y
        sums[p + 2 * BLOCK] += value * z
        sums[p + 3 * BLOCK] += value * value
    for p in range(len(row)):
        left_out[p] |= np.uint64(0) if mask[p] != 0 else bit


@njit(cache=True, error_model="numpy")
def slot_of(pattern):
    """Place of a pattern of lights among SLOTS (multiplicative hashing: Knuth, volume 3, section 6.4)."""
    return int((pattern * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(64 - SLOT_BITS))


@njit(cache=True, parallel=True, error_model="numpy")
def solve_masked(observations, selected, products, max_condition, normals, scalars, lights_used, flags):
    """Least squares on the samples that `selected` (lights, pixels) uint8 marks; otherwise as `solve_weighted`.

    Most samples are selected: the normal matrix is that of all lights less the few that are left out, so that only the
    right-hand side and the squares are added up at every pixel. Pixels nearby leave out the same lights in few
    different ways: the inverse of each is kept, by the pattern of these lights.
    """
    lights, pixels = observations.shape
    all_lights = np.zeros(TERMS)
    for j in range(lights):
        for k in range(6):
            all_lights[k] += products[j, k]
    full_condition, full_inverse = conditioned(all_lights, lights)
    blocks = (pixels + BLOCK - 1) // BLOCK
    for chunk in prange((blocks + CHUNK - 1) // CHUNK):
        sums, left_out = np.empty(4 * BLOCK), np.empty(BLOCK, np.uint64)  # bit j % 64: light j
        patterns = np.zeros(SLOTS, np.uint64)  # 0: nothing kept here
        kept, counts = np.empty((SLOTS, 7)), np.empty(SLOTS, np.int64)
        t = np.empty(TERMS)
        for block in range(chunk * CHUNK, min((chunk + 1) * CHUNK, blocks)):
            start = block * BLOCK
            width = min(BLOCK, pixels - start)
            sums[:] = 0.0
            left_out[:] = 0
            for j in range(lights):
                row, mask = observations[j, start : start + width], selected[j, start : start + width]
                x, y, z = products[j, 6], products[j, 7], products[j, 8]
                add_masked(row, mask, x, y, z, np.uint64(1) << np.uint64(j % 64), sums, left_out)
            for p in range(width):
                pattern = left_out[p]
                count, condition, m = lights, full_condition, full_inverse
                if pattern != 0:
                    slot = slot_of(pattern)
                    if patterns[slot] != pattern or lights > 64:
                        counts[slot] = matrix_of(all_lights, selected[:, start + p], products, t)
                        condition, m = conditioned(t, counts[slot])
                        patterns[slot], kept[slot, 6] = pattern, condition
                        for k in range(6):
                            kept[slot, k] = m[k]
                    count, condition = counts[slot], kept[slot, 6]
                    m = (kept[slot, 0], kept[slot, 1], kept[slot, 2], kept[slot, 3], kept[slot, 4], kept[slot, 5])
                for k in range(4):
                    t[6 + k] = sums[p + k * BLOCK]
                write_pixel(
                    t, condition, m, count, count, max_condition, start + p, normals, scalars, lights_used, flags
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
                value = np.float64(observations[j, start + p])
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
