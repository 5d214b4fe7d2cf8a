"""Quantise coefficients uniformly with a dead zone, and estimate the cost of each in bits.

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


def quantise(
    values: np.ndarray, step: float, *, dead_zone: float = DEAD_ZONE, rounding: float = ROUNDING
) -> np.ndarray:
    """Quantise values of any shape to int32 multiples of `step`, 0 below `dead_zone` steps.

    Others round up from a fraction of 1 - `rounding` on; a rounding below one half favours the smaller, cheaper value.

    Raises UserError for a value of more than 2^30 steps, ValueError for one that is not finite or a step not above 0.
    """
    if not 0 < step < np.inf:
        raise ValueError(f"quantiser: expected a finite step above 0, found {step}")
    with np.errstate(over="ignore"):
        size = np.abs(values) / np.float64(step)
    wrong = ~(size < dead_zone) & ~(size <= MOST)
    if wrong.any():
        value = float(values[wrong][0])
        if not np.isfinite(value):
            raise ValueError(f"quantiser: expected finite values, found {value}")
        raise UserError(
            f"the step {step:.3g} is too fine for the value {abs(value):.3g} (more than 2^30 steps). "
            "Remedy: a larger residual.amount for the target step, a lower psnr, or fewer bytes"
        )
    steps = np.where(size < dead_zone, 0, np.maximum((size + rounding).astype(np.int32), 1))
    return np.where(values > 0, steps, -steps).astype(np.int32)


GRADES, LEVELS = 24, 8
GRADE_OF = np.array([fine_grade(amount) for amount in range(128)])
"""Grade of a sum of magnitudes; larger sums have the last one."""
MORE = 3.5  # bits: the sign, the magnitude, and neighbours' zeros made less likely


def expected_bits(coefficients: np.ndarray, step: float, levels: int) -> np.ndarray:
    """Estimate the bit cost, >= 1, of each non-zero coefficient: (channels, lights, views, rows, columns) float32.

    coefficients: of that shape, float32; step: of the quantiser; levels: of the planes.
    """
    shape = coefficients.shape
    values = magnitudes(coefficients, step).reshape(shape[0], shape[1] * shape[2], *shape[3:])
    bands = bands_of(shape[-2], shape[-1], levels)
    amounts = np.zeros(values.shape, np.int16)
    neighbourhoods(values, bands, amounts)
    tally = np.zeros((LEVELS * GRADES, 2), np.int64)
    place_grades(values, bands, GRADE_OF, amounts, tally)
    return bits_of(tally.reshape(LEVELS, GRADES, 2)).ravel().take(amounts).reshape(shape)


def bits_of(tally: np.ndarray) -> np.ndarray:
    """Convert counts (levels, grades, 2) of zeros and others to bits (levels, grades) float32; pool rare grades."""
    pooled = tally.sum(axis=0)
    chance = (pooled[:, 1] + 0.5) / (pooled.sum(axis=1) + 2)
    share = (tally[..., 1] + 8 * chance) / (tally.sum(axis=2) + 8)
    return np.maximum(np.log2((1 - share) / share) + MORE, 1).astype(np.float32)


@njit(cache=True, nogil=True, error_model="numpy")
def magnitudes(coefficients, step):
    """Return uint8 magnitudes in steps, at least 1 where not zero, at most 15."""
    out = np.zeros(coefficients.shape, np.uint8)
    sizes, values = out.reshape(-1), coefficients.reshape(-1)
    for n in range(len(values)):
        if values[n] != 0:
            sizes[n] = max(1, int(min(abs(values[n]) / np.float64(step) + 0.5, 15.0)))
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def place_grades(values, bands, grade_of, amounts, tally):
    """Turn sums of magnitudes into their place among levels and grades; count zeros and others (places, 2) at each."""
    for b in range(len(bands)):
        top, left, height, width, level = bands[b, 0], bands[b, 1], bands[b, 2], bands[b, 3], bands[b, 4]
        first = min(level, LEVELS - 1) * GRADES
        for c in range(values.shape[0]):
            for k in range(values.shape[1]):
                alone = 0
                for i in range(top, top + height):
                    size, amount = values[c, k, i], amounts[c, k, i]
                    for j in range(left, left + width):
                        place = first
                        if amount[j] == 0 and size[j] == 0:
                            alone += 1
                        else:
                            place += grade_of[min(amount[j], len(grade_of) - 1)]
                            tally[place, 1 if size[j] > 0 else 0] += 1
                        amount[j] = place
                tally[first, 0] += alone


@njit(cache=True, nogil=True, error_model="numpy")
def neighbourhoods(values, bands, amounts):
    """Sum the neighbours' magnitudes, weighted, of values (channels, frequencies, rows, columns) uint8."""
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
