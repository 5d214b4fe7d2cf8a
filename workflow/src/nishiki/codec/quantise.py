"""Uniform quantisation with a dead zone, and the thresholds of a rate that counts."""

from __future__ import annotations

import numpy as np
from numba import njit

from nishiki.errors import UserError

DEAD_ZONE = 0.6
ROUNDING = 0.42
MOST = float(1 << 30)


@njit(cache=True, nogil=True, error_model="numpy")
def _quantise(values, step, dead, rounding, out):
    """Fills out; the first value that is not finite or above MOST steps, or -1."""
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
    """int32 multiples of `step`, of any shape: 0 below `dead_zone` steps, else rounded up from a fraction of
    1 - `rounding` on; a rounding below one half favours the smaller, cheaper value.

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
            f"the step {step:.3g} is too fine: a value of {abs(float(flat[wrong])):.3g} has more than 2^30 of them. "
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
