"""Uniform quantisation with a dead zone, and the thresholds of a rate that counts."""

from __future__ import annotations

import numpy as np
from numba import njit

DEAD_ZONE = 0.6
ROUNDING = 0.42


@njit(cache=True, nogil=True, error_model="numpy")
def _quantise(values, step, dead, rounding, out):
    for n in range(values.shape[0]):
        size = abs(values[n]) / step
        if size < dead:
            out[n] = 0
            continue
        whole = max(int(size + rounding), 1)
        out[n] = whole if values[n] > 0 else -whole


def quantise(
    values: np.ndarray, step: float, *, dead_zone: float = DEAD_ZONE, rounding: float = ROUNDING
) -> np.ndarray:
    """int32 multiples of `step`, of any shape: 0 below `dead_zone` steps, else rounded up from a fraction of
    1 - `rounding` on; a rounding below one half favours the smaller, cheaper value."""
    flat = np.ascontiguousarray(values).reshape(-1)
    out = np.empty(flat.shape, np.int32)
    _quantise(flat, step, dead_zone, rounding, out)
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
