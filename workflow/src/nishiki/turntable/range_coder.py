"""Adaptive binary range coder for small streams (mesh, charts).

Carry-less 32-bit range coding of bits with adaptive probabilities (G. N. N. Martin, Range encoding, 1979; the form with
a byte of carry as in the LZMA SDK's public-domain description).  Integers go as an Exp-Golomb code whose unary part and
leading bits have their own adaptive probabilities, one set a context.
"""

from __future__ import annotations

import numpy as np
from numba import njit

_BITS = 12  # of a probability
_RATE = 5
_TOP = np.uint64(1 << 24)
_MASK = np.uint64(0xFFFFFFFF)
CLASSES = 34  # classes of magnitude: 0, 1, 2..3, 4..7, ...
SLOTS = 3 * CLASSES + 1  # probabilities of one context: unary part, sign, first two bits after the leading one


@njit(cache=True, nogil=True, error_model="numpy")
def _put(state, out, probabilities, at, bit):
    """state: [low, range, cache, pending, length] uint64."""
    p = probabilities[at]
    bound = (state[1] >> np.uint64(_BITS)) * np.uint64(p)
    if bit == 0:
        state[1] = bound
        probabilities[at] = p + (((1 << _BITS) - p) >> _RATE)
    else:
        state[0] += bound
        state[1] -= bound
        probabilities[at] = p - (p >> _RATE)
    while state[1] < _TOP:
        state[1] = (state[1] << np.uint64(8)) & _MASK
        _shift(state, out)


@njit(cache=True, nogil=True, error_model="numpy")
def _shift(state, out):
    """Pass on the highest byte; bytes of 255 wait until it is known whether a carry comes."""
    if state[0] < np.uint64(0xFF000000) or state[0] > _MASK:
        carry = state[0] >> np.uint64(32)
        if state[4] > np.uint64(0):
            out[int(state[4]) - 1] = np.uint8((state[2] + carry) & np.uint64(255))
        state[4] += np.uint64(1)
        for _ in range(int(state[3])):
            out[int(state[4]) - 1] = np.uint8((np.uint64(255) + carry) & np.uint64(255))
            state[4] += np.uint64(1)
        state[3] = np.uint64(0)
        state[2] = (state[0] >> np.uint64(24)) & np.uint64(255)
    else:
        state[3] += np.uint64(1)
    state[0] = (state[0] << np.uint64(8)) & _MASK


@njit(cache=True, nogil=True, error_model="numpy")
def _get(state, data, probabilities, at):
    """state: [code, range, position] uint64."""
    p = probabilities[at]
    bound = (state[1] >> np.uint64(_BITS)) * np.uint64(p)
    if state[0] < bound:
        state[1] = bound
        probabilities[at] = p + (((1 << _BITS) - p) >> _RATE)
        bit = 0
    else:
        state[0] -= bound
        state[1] -= bound
        probabilities[at] = p - (p >> _RATE)
        bit = 1
    while state[1] < _TOP:
        k = int(state[2])
        following = np.uint64(data[k]) if k < data.size else np.uint64(0)
        state[0] = ((state[0] << np.uint64(8)) | following) & _MASK
        state[1] = (state[1] << np.uint64(8)) & _MASK
        state[2] += np.uint64(1)
    return bit


@njit(cache=True, nogil=True, error_model="numpy")
def encode_integers(values, contexts, count):
    """values (n,) int64, contexts (n,) int64 in 0..count-1 -> bytes (uint8)."""
    probabilities = np.full(count * SLOTS + 1, 1 << (_BITS - 1), np.int64)
    plain = count * SLOTS
    out = np.empty(64 + 16 * values.size, np.uint8)
    state = np.zeros(5, np.uint64)
    state[1] = _MASK
    for i in range(values.size):
        base = contexts[i] * SLOTS
        magnitude = abs(values[i])
        size = 0
        while magnitude >> size:
            size += 1
        for k in range(size):
            _put(state, out, probabilities, base + k, 1)
        _put(state, out, probabilities, base + size, 0)
        for k in range(size - 2, -1, -1):
            bit = (magnitude >> k) & 1
            if k == size - 2:
                _put(state, out, probabilities, base + CLASSES + 1 + size, bit)
            else:
                _put(state, out, probabilities, plain, bit)
                probabilities[plain] = 1 << (_BITS - 1)
        if size:
            _put(state, out, probabilities, base + CLASSES, 1 if values[i] < 0 else 0)
    for _ in range(5):
        _shift(state, out)
    return out[: int(state[4]) - 1].copy()


@njit(cache=True, nogil=True, error_model="numpy")
def decoder(data):
    """State of a decoder at the start of `data` (uint8)."""
    state = np.zeros(3, np.uint64)
    state[1] = _MASK
    for k in range(4):
        following = np.uint64(data[k]) if k < data.size else np.uint64(0)
        state[0] = (state[0] << np.uint64(8)) | following
    state[2] = np.uint64(4)
    return state


@njit(cache=True, nogil=True, error_model="numpy")
def decode_integer(state, data, probabilities, context, plain):
    """The next integer; probabilities as `new_probabilities` gives them, plain: index of the last one."""
    base = context * SLOTS
    size = 0
    while size < CLASSES - 1 and _get(state, data, probabilities, base + size):
        size += 1
    if size == 0:
        return 0
    magnitude = 1
    for k in range(size - 2, -1, -1):
        if k == size - 2:
            bit = _get(state, data, probabilities, base + CLASSES + 1 + size)
        else:
            bit = _get(state, data, probabilities, plain)
            probabilities[plain] = 1 << (_BITS - 1)
        magnitude = 2 * magnitude + bit
    return -magnitude if _get(state, data, probabilities, base + CLASSES) else magnitude


@njit(cache=True, nogil=True, error_model="numpy")
def decode_integers(data, contexts, count):
    """Inverse of `encode_integers`: the contexts have to be known beforehand."""
    probabilities = np.full(count * SLOTS + 1, 1 << (_BITS - 1), np.int64)
    state = decoder(data)
    values = np.empty(contexts.size, np.int64)
    for i in range(contexts.size):
        values[i] = decode_integer(state, data, probabilities, contexts[i], count * SLOTS)
    return values
