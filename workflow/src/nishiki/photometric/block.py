"""Arithmetic on a block of neighbouring pixels held as (lights, BLOCK) float32, in vector registers.

The selection needs many small fits; their accuracy need only be that of a decision, so float32 suffices. Every
operation treats each pixel alone: the result does not depend on which pixels share a block. Only the loops that take
most of the time are inlined by numba, which costs seconds of compilation for each.

Conditions of loops over pixels are joined by & and |: the compiler makes scalar code of branches.
"""

import numpy as np
from numba import njit

from nishiki.lanes import LANES, choose, larger, load, smaller, splat, store
from nishiki.small_matrices import solve_by_cofactors

BLOCK = 32  # 96 lights of three float32 planes of a block fit the second-level cache, one plane the first
TERMS = 10  # sums of a pixel
RIDGE = np.float32(1e-6)  # of the trace: keeps degenerate windows of lights finite; biases a fit by less than 1e-4
FAR = np.float32(3e38)


@njit(cache=True, error_model="numpy")
def sort_block(values, comparators):
    """Sort the columns of values (lights, BLOCK) upwards, in place, by a sorting network."""
    for c in range(comparators.shape[0]):
        for p in range(0, BLOCK, LANES):
            upper, lower = (comparators[c, 0], p), (comparators[c, 1], p)
            a, b = load(values, upper), load(values, lower)
            store(values, upper, smaller(a, b))
            store(values, lower, larger(a, b))


@njit(cache=True, error_model="numpy")
def add_up(values, weights, products, sums):
    """Add each pixel's normal equations to sums (TERMS * BLOCK): six products, three right-hand sides, the weight."""
    for p in range(0, BLOCK, LANES):
        xx = xy = xz = yy = yz = zz = x = y = z = total = splat(np.float32(0.0))
        for j in range(values.shape[0]):
            w = load(weights, (j, p))
            wv = w * load(values, (j, p))
            xx += w * products[j, 0]
            xy += w * products[j, 1]
            xz += w * products[j, 2]
            yy += w * products[j, 3]
            yz += w * products[j, 4]
            zz += w * products[j, 5]
            x += wv * products[j, 6]
            y += wv * products[j, 7]
            z += wv * products[j, 8]
            total += w
        store(sums, p, xx)
        store(sums, p + BLOCK, xy)
        store(sums, p + 2 * BLOCK, xz)
        store(sums, p + 3 * BLOCK, yy)
        store(sums, p + 4 * BLOCK, yz)
        store(sums, p + 5 * BLOCK, zz)
        store(sums, p + 6 * BLOCK, x)
        store(sums, p + 7 * BLOCK, y)
        store(sums, p + 8 * BLOCK, z)
        store(sums, p + 9 * BLOCK, total)


@njit(cache=True, error_model="numpy")
def solve_block(sums, at_least, scaled):
    """Scaled normals (4 * BLOCK: x, y, z, length) from the sums; with fewer than at_least samples they stay."""
    for p in range(BLOCK):
        trace = RIDGE * (sums[p] + sums[p + 3 * BLOCK] + sums[p + 5 * BLOCK]) + np.float32(1e-30)
        a, b, c = sums[p] + trace, sums[p + BLOCK], sums[p + 2 * BLOCK]
        d, e, f = sums[p + 3 * BLOCK] + trace, sums[p + 4 * BLOCK], sums[p + 5 * BLOCK] + trace
        u, v, w = sums[p + 6 * BLOCK], sums[p + 7 * BLOCK], sums[p + 8 * BLOCK]
        x, y, z, det = solve_by_cofactors((a, b, c, d, e, f), u, v, w)
        enough = sums[p + 9 * BLOCK] >= at_least and det > np.float32(0.0)
        scale = np.float32(1.0) / (det if enough else np.float32(1.0))
        x, y, z = x * scale, y * scale, z * scale
        x = x if enough else scaled[p]
        y = y if enough else scaled[p + BLOCK]
        z = z if enough else scaled[p + 2 * BLOCK]
        scaled[p], scaled[p + BLOCK], scaled[p + 2 * BLOCK] = x, y, z
        scaled[p + 3 * BLOCK] = np.sqrt(x * x + y * y + z * z) + np.float32(1e-20)


@njit(cache=True, error_model="numpy")
def distances(values, known, directions, scaled, above, out):
    """How badly each sample fits: |residual|, times `above` where the sample is too bright; FAR if unlit or unknown."""
    zero = np.float32(0.0)
    for p in range(0, BLOCK, LANES):
        nx, ny, nz = load(scaled, p), load(scaled, p + BLOCK), load(scaled, p + 2 * BLOCK)
        for j in range(values.shape[0]):
            shading = nx * directions[j, 0] + ny * directions[j, 1] + nz * directions[j, 2]
            r = load(values, (j, p)) - shading
            far = (shading <= zero) | (load(known, (j, p)) <= zero)
            store(out, (j, p), choose(far, FAR, choose(r > zero, r * above, zero - r)))


@njit(cache=True, error_model="numpy")
def keep_below(distance, limit, weights):
    """Weight 1 for the samples whose distance is at most the pixel's limit (and not FAR), else 0."""
    one, zero = np.float32(1.0), np.float32(0.0)
    for p in range(0, BLOCK, LANES):
        most = load(limit, p)
        for j in range(distance.shape[0]):
            d = load(distance, (j, p))
            store(weights, (j, p), choose((d <= most) & (d < FAR), one, zero))
