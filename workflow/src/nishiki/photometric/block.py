"""Arithmetic on a block of neighbouring pixels held as (lights, BLOCK) float32, written so that it becomes SIMD code.

The selection needs many small fits; their accuracy need only be that of a decision, so float32 suffices. Every
operation treats each pixel alone: the result does not depend on which pixels share a block. Only the loops that take
most of the time are inlined by numba, which costs seconds of compilation for each.

Loops of little work run to the length of their arrays instead of BLOCK, and conditions are joined by & and |: the
compiler unrolls short loops of known length, and loops with branches, into scalar code, which takes four times as long.
"""

import numpy as np
from numba import njit

BLOCK = 32  # 96 lights of three float32 planes of a block fit the second-level cache, one plane the first
TERMS = 10
RIDGE = np.float32(1e-6)  # of the trace: keeps degenerate windows of lights finite; biases a fit by less than 1e-4
FAR = np.float32(3e38)


@njit(cache=True, error_model="numpy")
def sort_block(values, comparators):
    """Sort the columns of values (lights, BLOCK) upwards, in place, by a sorting network."""
    for c in range(comparators.shape[0]):
        upper = values[comparators[c, 0]]
        lower = values[comparators[c, 1]]
        for p in range(BLOCK):
            a = upper[p]
            b = lower[p]
            upper[p] = a if a < b else b
            lower[p] = b if b > a else a


@njit(cache=True, error_model="numpy")
def add_up(values, weights, products, sums):
    """Normal equations of each pixel into sums (TERMS * BLOCK): six products, three right-hand sides, the weight.

    One flat array of sums: the compiler then needs to check two pairs of arrays for overlap and not forty-five.
    """
    for p in range(TERMS * BLOCK):
        sums[p] = 0.0
    for j in range(values.shape[0]):
        row = values[j]
        weight = weights[j]
        xx, xy, xz = products[j, 0], products[j, 1], products[j, 2]
        yy, yz, zz = products[j, 3], products[j, 4], products[j, 5]
        x, y, z = products[j, 6], products[j, 7], products[j, 8]
        for p in range(BLOCK):
            w = weight[p]
            wv = w * row[p]
            sums[p] += w * xx
            sums[p + BLOCK] += w * xy
            sums[p + 2 * BLOCK] += w * xz
            sums[p + 3 * BLOCK] += w * yy
            sums[p + 4 * BLOCK] += w * yz
            sums[p + 5 * BLOCK] += w * zz
            sums[p + 6 * BLOCK] += wv * x
            sums[p + 7 * BLOCK] += wv * y
            sums[p + 8 * BLOCK] += wv * z
            sums[p + 9 * BLOCK] += w


@njit(cache=True, error_model="numpy")
def solve_block(sums, at_least, scaled):
    """Scaled normals (4 * BLOCK: x, y, z, length) from the sums; with fewer than at_least samples they stay."""
    for p in range(BLOCK):
        trace = RIDGE * (sums[p] + sums[p + 3 * BLOCK] + sums[p + 5 * BLOCK]) + np.float32(1e-30)
        a, b, c = sums[p] + trace, sums[p + BLOCK], sums[p + 2 * BLOCK]
        d, e, f = sums[p + 3 * BLOCK] + trace, sums[p + 4 * BLOCK], sums[p + 5 * BLOCK] + trace
        u, v, w = sums[p + 6 * BLOCK], sums[p + 7 * BLOCK], sums[p + 8 * BLOCK]
        c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
        c11, c12, c22 = a * f - c * c, b * c - a * e, a * d - b * b
        det = a * c00 + b * c01 + c * c02
        enough = sums[p + 9 * BLOCK] >= at_least and det > np.float32(0.0)
        scale = np.float32(1.0) / (det if enough else np.float32(1.0))
        x = (c00 * u + c01 * v + c02 * w) * scale
        y = (c01 * u + c11 * v + c12 * w) * scale
        z = (c02 * u + c12 * v + c22 * w) * scale
        x = x if enough else scaled[p]
        y = y if enough else scaled[p + BLOCK]
        z = z if enough else scaled[p + 2 * BLOCK]
        scaled[p], scaled[p + BLOCK], scaled[p + 2 * BLOCK] = x, y, z
        scaled[p + 3 * BLOCK] = np.sqrt(x * x + y * y + z * z) + np.float32(1e-20)


@njit(cache=True, error_model="numpy")
def distances(values, known, directions, scaled, above, out):
    """How badly each sample fits: |residual|, times `above` where the sample is too bright; FAR if unlit or unknown."""
    zero = np.float32(0.0)
    for j in range(values.shape[0]):
        row = values[j]
        mask = known[j]
        target = out[j]
        x, y, z = directions[j, 0], directions[j, 1], directions[j, 2]
        for p in range(len(row)):
            shading = scaled[p] * x + scaled[p + BLOCK] * y + scaled[p + 2 * BLOCK] * z
            r = row[p] - shading
            far = (shading <= zero) | (mask[p] == zero)
            d = above * r if r > zero else -r
            target[p] = FAR if far else d


@njit(cache=True, error_model="numpy")
def keep_below(distance, limit, weights):
    """Weight 1 for the samples whose distance is at most the pixel's limit (and not FAR), else 0."""
    one, zero = np.float32(1.0), np.float32(0.0)
    for j in range(distance.shape[0]):
        row = distance[j]
        weight = weights[j]
        for p in range(len(row)):
            weight[p] = one if (row[p] <= limit[p]) & (row[p] < FAR) else zero
