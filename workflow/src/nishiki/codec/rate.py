"""Quantise coefficients uniformly with a dead zone, and estimate what each costs in bits.

The coder predicts zeros from neighbours in the plane, the parent and the sister bands, the frequencies and channels
beside (`entropy`). Here the same neighbours, those still to come included, are summed to a grade, and how often the
block's own coefficients are zero under each grade and level tells the bits.
"""

import numpy as np
from numba import njit

from nishiki.codec.entropy import bands_of, fine_grade
from nishiki.errors import UserError

DEAD_ZONE = 0.6  # of a step: smaller coefficients become 0
ROUNDING = 0.42  # of a step, added before rounding down
MOST = float(1 << 30)


@njit(cache=True, nogil=True, error_model="numpy")
def _quantise(values, step, dead, rounding, out):
    """Fill `out`; return the first index of a value that is not finite or above MOST steps, or -1."""
    for n in range(values.shape[0]):
        size = abs(values[n]) / step
        if size < dead:
            out[n] = 0
            continue
        if not size <= MOST:
            return n
        steps = max(int(size + rounding), 1)
        out[n] = steps if values[n] > 0 else -steps
    return -1


def quantise(
    values: np.ndarray, step: float, *, dead_zone: float = DEAD_ZONE, rounding: float = ROUNDING
) -> np.ndarray:
    """Quantise values of any shape to int32 multiples of `step`, 0 below `dead_zone` steps.

    Others round up from a fraction of 1 - `rounding` on; a rounding below one half favours the smaller, cheaper value.

    Raises UserError for a value of more than 2^30 steps, ValueError for one that is not finite or a step not above 0.
    """
    if not 0 < step < np.inf:
        raise ValueError(f"quantiser: expected a finite step above 0, found {step}")
    flat = np.ascontiguousarray(values).reshape(-1)
    out = np.empty(flat.shape, np.int32)
    wrong = _quantise(flat, step, dead_zone, rounding, out)
    if wrong >= 0 and not np.isfinite(flat[wrong]):
        raise ValueError(f"quantiser: value {wrong} is {flat[wrong]}")
    if wrong >= 0:
        raise UserError(
            f"the step {step:.3g} is too fine for the value {abs(float(flat[wrong])):.3g} (more than 2^30 steps). "
            "Remedy: a larger residual.amount for the target step, a lower psnr, or fewer bytes"
        )
    return out.reshape(values.shape)


@njit(cache=True, nogil=True, error_model="numpy")
def threshold_and_go_on(ahead, gradient, pace, level, momentum, held, following):
    """One proximal step on all coefficients, in place.

    A gradient step from `ahead`, hard threshold at `level` (the proximal operator of a price on every coefficient that
    is not zero); `held` becomes the result, `following` the extrapolated point. Returns how many are not zero.
    """
    count = 0
    for n in range(ahead.shape[0]):
        value = ahead[n] + pace * gradient[n]
        if abs(value) <= level:
            value = type(value)(0)
        else:
            count += 1
        following[n] = value + momentum * (value - held[n])
        held[n] = value
    return count


GRADES, LEVELS = 24, 8
MORE = 3.5  # bits: the sign, the magnitude, and neighbours' zeros made less likely


def expected_bits(coefficients: np.ndarray, step: float, levels: int) -> np.ndarray:
    """(channels, lights, views, rows, columns) float32, at least 1: bits that each coefficient adds by not being zero.

    coefficients: of that shape, float32; step: of the quantiser; levels: of the planes.
    """
    shape = coefficients.shape
    values = np.empty((shape[0], shape[1] * shape[2], *shape[3:]), np.uint8)
    magnitudes(np.ascontiguousarray(coefficients).reshape(-1), step, values.reshape(-1))
    bands = bands_of(shape[-2], shape[-1], levels)
    amounts = np.zeros(values.shape, np.int32)
    neighbourhoods(values, bands, amounts)
    tally = np.zeros((LEVELS, GRADES, 2), np.int64)
    count_grades(values, amounts, bands, tally)
    out = np.empty(values.shape, np.float32)
    look_up_bits(amounts, bands, bits_of(tally), out)
    return out.reshape(shape)


def bits_of(tally: np.ndarray) -> np.ndarray:
    """(levels, grades) float32 bits of counts (levels, grades, 2) of zeros and others; rare ones lean on all levels."""
    pooled = tally.sum(axis=0)
    chance = (pooled[:, 1] + 0.5) / (pooled.sum(axis=1) + 2)
    share = (tally[..., 1] + 8 * chance) / (tally.sum(axis=2) + 8)
    return np.maximum(np.log2((1 - share) / share) + MORE, 1).astype(np.float32)


@njit(cache=True, nogil=True, error_model="numpy")
def magnitudes(coefficients, step, out):
    """uint8 magnitudes in steps, at least 1 where not zero, at most 15."""
    for n in range(coefficients.shape[0]):
        size = abs(coefficients[n])
        out[n] = 0 if size == 0 else min(max(int(size / step + 0.5), 1), 15)


@njit(cache=True, nogil=True, error_model="numpy")
def neighbourhoods(values, bands, amounts):
    """Weighted sums of the neighbours' magnitudes, of values (channels, frequencies, rows, columns) uint8."""
    for b in range(bands.shape[0]):
        top, left = bands[b, 0], bands[b, 1]
        for c in range(values.shape[0]):
            for k in range(values.shape[1]):
                for i in range(bands[b, 2]):
                    for j in range(bands[b, 3]):
                        size = values[c, k, top + i, left + j]
                        if size > 0:
                            spread_inside(amounts, bands[b], c, k, i, j, int(size))
                            spread_to_bands(amounts, bands, b, c, k, i, j, int(size))


@njit(cache=True, nogil=True, error_model="numpy")
def spread_inside(amounts, band, c, k, i, j, size):
    """Add a magnitude at (i, j) of a band to its neighbours in the plane, the frequencies and the channels beside."""
    for di in range(-2, 3):
        for dj in range(-2, 3):
            apart = abs(di) + abs(dj)
            if apart > 2 or not (0 <= i + di < band[2] and 0 <= j + dj < band[3]):
                continue
            y, x = band[0] + i + di, band[1] + j + dj
            if apart == 1:
                amounts[c, k, y, x] += 6 * size
            elif apart == 2:
                amounts[c, k, y, x] += (3 if di != 0 and dj != 0 else 2) * size
            if apart < 2:
                near = size * (2 - apart)
                for f in range(max(0, k - 1), min(amounts.shape[1], k + 2)):
                    if f != k:
                        amounts[c, f, y, x] += 3 * near
                for d in range(amounts.shape[0]):
                    if d != c:
                        amounts[d, k, y, x] += 2 * near


@njit(cache=True, nogil=True, error_model="numpy")
def spread_to_bands(amounts, bands, b, c, k, i, j, size):
    """Add a magnitude at (i, j) of band b to its place in the sister bands, its parent and its four children."""
    orientation = bands[b, 5]
    if orientation > 0:
        for other in range(b - orientation + 1, b - orientation + 4):
            if other != b:
                amounts[c, k, bands[other, 0] + i, bands[other, 1] + j] += 3 * size
    for child in range(bands.shape[0]):
        if bands[child, 6] == b:
            for y in range(2 * i, 2 * i + 2):
                for x in range(2 * j, 2 * j + 2):
                    amounts[c, k, bands[child, 0] + y, bands[child, 1] + x] += 4 * size
    parent = bands[b, 6]
    if parent >= 0:
        amounts[c, k, bands[parent, 0] + (i >> 1), bands[parent, 1] + (j >> 1)] += 2 * size


@njit(cache=True, nogil=True, error_model="numpy")
def count_grades(values, amounts, bands, tally):
    """Count zeros and others under each level and grade."""
    for b in range(bands.shape[0]):
        top, left, level = bands[b, 0], bands[b, 1], min(bands[b, 4], 7)
        for c in range(values.shape[0]):
            for k in range(values.shape[1]):
                for i in range(top, top + bands[b, 2]):
                    for j in range(left, left + bands[b, 3]):
                        tally[level, fine_grade(amounts[c, k, i, j]), 1 if values[c, k, i, j] > 0 else 0] += 1


@njit(cache=True, nogil=True, error_model="numpy")
def look_up_bits(amounts, bands, table, out):
    """out: the table's bits at each coefficient's level and grade."""
    for b in range(bands.shape[0]):
        top, left, level = bands[b, 0], bands[b, 1], min(bands[b, 4], 7)
        for c in range(amounts.shape[0]):
            for k in range(amounts.shape[1]):
                for i in range(top, top + bands[b, 2]):
                    for j in range(left, left + bands[b, 3]):
                        out[c, k, i, j] = table[level, fine_grade(amounts[c, k, i, j])]
