"""Integers in few bytes, for small streams (charts): Exp-Golomb codes of adaptive bits.

The unary part (number of digits), the sign and the digit after the leading one have adaptive probabilities of their
own, one set a context; further digits cost a bit each. The bits go through the range coder of the residual.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from nishiki.codec.range_coder import begin, code_bit, finish

CLASSES = 34  # classes of magnitude: 0, 1, 2..3, 4..7, ...
SLOTS = 3 * CLASSES + 1  # probabilities of one context: unary part, sign, digit after the leading one
_HALF = 1 << 15  # of 65536: an even chance
_RATE = 5


@njit(cache=True, nogil=True, error_model="numpy")
def new_chances(contexts):
    """Chances of a one, of 65536, before anything is coded: (contexts * SLOTS,) int64."""
    return np.full(contexts * SLOTS, _HALF, np.int64)


@njit(cache=True, nogil=True, error_model="numpy")
def _adaptive(bit, chances, at, state, data, decoding):
    bit = code_bit(bit, chances[at], state, data, decoding)
    chances[at] += ((65536 - chances[at]) >> _RATE) if bit else -(chances[at] >> _RATE)
    return bit


@njit(cache=True, nogil=True, error_model="numpy")
def code_integer(value, context, chances, state, data, decoding):
    """Encode `value` (below 2^33 in magnitude), or decode and return one. state (4,) int64, data (n,) uint8."""
    base = context * SLOTS
    magnitude, size = abs(value), 0
    if decoding:
        while size < CLASSES - 1 and _adaptive(0, chances, base + size, state, data, True):
            size += 1
        magnitude = 1 if size else 0
    else:
        while magnitude >> size:
            _adaptive(1, chances, base + size, state, data, False)
            size += 1
        if size < CLASSES - 1:
            _adaptive(0, chances, base + size, state, data, False)
    if size == 0:
        return 0
    for k in range(size - 2, -1, -1):
        bit = 0 if decoding else (magnitude >> k) & 1
        if k == size - 2:
            bit = _adaptive(bit, chances, base + CLASSES + 1 + size, state, data, decoding)
        else:
            bit = code_bit(bit, _HALF, state, data, decoding)
        if decoding:
            magnitude = 2 * magnitude + bit
    negative = _adaptive(1 if value < 0 else 0, chances, base + CLASSES, state, data, decoding)
    return -magnitude if negative else magnitude


@njit(cache=True, nogil=True, error_model="numpy")
def _encode(values, contexts, count, data):
    chances, state = new_chances(count), np.zeros(4, np.int64)
    begin(state, data, False)
    for i in range(values.size):
        code_integer(values[i], contexts[i], chances, state, data, False)
    return finish(state, data)


def encode_integers(values: np.ndarray, contexts: np.ndarray, count: int) -> np.ndarray:
    """values (n,) int64 below 2^33 in magnitude, contexts (n,) int64 in 0..count-1 -> bytes, uint8."""
    data = np.empty(64 + 16 * values.size, np.uint8)
    needed = _encode(values, contexts, count, data)
    if needed > data.size:
        data = np.empty(needed, np.uint8)
        _encode(values, contexts, count, data)
    return data[:needed].copy()


@njit(cache=True, nogil=True, error_model="numpy")
def decode_integers(data, contexts, count):
    """Inverse of `encode_integers`: the contexts have to be known beforehand."""
    chances, state = new_chances(count), np.zeros(4, np.int64)
    begin(state, data, True)
    values = np.empty(contexts.size, np.int64)
    for i in range(contexts.size):
        values[i] = code_integer(0, contexts[i], chances, state, data, True)
    return values
