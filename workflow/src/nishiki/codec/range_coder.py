"""Code bits by adaptive binary arithmetic coding.

Carry-free range coder with 32-bit bounds (as in M. Mahoney's lpaq, 2007, after Rissanen and Langdon 1979);
probabilities of several contexts are mixed in the logistic domain by weights that follow the coding cost (M. Mahoney,
Adaptive weighing of context models for lossless data compression, 2005). All arithmetic is in integers, so that a
decoder on any machine repeats what the encoder computed.

Bits are coded within the loops that call for them (inline): passing the arrays on would count references to each, which
takes longer than the coding.

State of a coder: [low, high, place in the bytes, code word]. A context's probability of a one has 22 bits
in `chance`; `seen` counts how often it was used, up to a limit, and sets how fast it learns.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

INPUTS = 8  # of the mixing of chances
LIMIT = 250  # of the count that sets the rate of a chance
LOW, HIGH, PLACE, WORD = 0, 1, 2, 3
FULL_RANGE = 0xFFFFFFFF  # of 32 bits
UNIT = 65536  # of a chance, 16 bits


# tables and states are of small types, so that they stay in the processor's first-level cache
STRETCH = np.round(np.log((np.arange(4096) + 0.5) / (4095.5 - np.arange(4096))) * 256).astype(np.int16)
SQUASH = np.clip(np.round(65536 / (1 + np.exp(-np.arange(-3071, 3072) / 256))), 4, 65532).astype(np.uint16)
RATE = np.round(65536 / (np.arange(LIMIT + 1) + 1.6)).astype(np.uint16)


class Coder(NamedTuple):
    """The state of an entropy coder, which changes in place: its bytes, data (n,) uint8, and its adaptive models.

    chance (contexts,) int32, seen (contexts,) uint8, tally (contexts, 2) int32 zeros and ones, for training, weights
    (groups, INPUTS) and state (4,) int64.
    """

    chance: np.ndarray
    seen: np.ndarray
    tally: np.ndarray
    weights: np.ndarray
    state: np.ndarray
    data: np.ndarray
    decoding: bool
    tables: tuple = (STRETCH, SQUASH, RATE)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def code_bit(bit, p_one, state, data, decoding):
    """Encode `bit`, or decode and return one, with probability p_one / 65536 of a one; data (n,) uint8.

    Bytes beyond the end of data are counted and not written (`finish` tells how many it takes).
    """
    low, high = state[LOW], state[HIGH]
    middle = low + ((high - low) >> 16) * p_one + ((((high - low) & 0xFFFF) * p_one) >> 16)
    if decoding:
        bit = 1 if state[WORD] <= middle else 0
    if bit:
        high = middle
    else:
        low = middle + 1
    while ((low ^ high) & 0xFF000000) == 0:
        place = state[PLACE]
        if decoding:
            following = data[place] if place < data.shape[0] else 0
            state[WORD] = ((state[WORD] << 8) & FULL_RANGE) | following
        elif place < data.shape[0]:
            data[place] = high >> 24
        state[PLACE] = place + 1
        low = (low << 8) & FULL_RANGE
        high = ((high << 8) & FULL_RANGE) | 255
    state[LOW], state[HIGH] = low, high
    return bit


@njit(cache=True, nogil=True, error_model="numpy")
def begin(state, data, decoding):
    """Set a coder to its start; a decoder reads its first four bytes (bytes beyond the end are zeros)."""
    state[LOW], state[HIGH], state[PLACE], state[WORD] = 0, FULL_RANGE, 0, 0
    if decoding:
        for k in range(4):
            state[WORD] = (state[WORD] << 8) | (data[k] if k < data.shape[0] else 0)
        state[PLACE] = 4


@njit(cache=True, nogil=True, error_model="numpy")
def finish(state, data):
    """Write the shortest byte string inside the last interval; return its length, zeros at the end left out.

    More than data holds: nothing can be used, so many bytes are needed.
    """
    low, high, place = state[LOW], state[HIGH], state[PLACE]
    for kept in range(5):
        shift = 32 - 8 * kept
        value = ((low + (1 << shift) - 1) >> shift) << shift
        if value <= high:
            if place + kept > data.shape[0]:
                return place + kept
            for k in range(kept):
                data[place + k] = (value >> (24 - 8 * k)) & 255
            place += kept
            break
    while place > 0 and data[place - 1] == 0:
        place -= 1
    return place


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def code_mixed(bit, contexts, count, group, coder):
    """Code one bit under `count` contexts (places in `chance`), mixed by the weights of `group`; learn from it."""
    stretch, squash, rate = coder.tables
    chance, seen, tally, weight = coder.chance, coder.seen, coder.tally, coder.weights[group]
    total = weight[INPUTS - 1] * 256
    for k in range(count):
        total += weight[k] * np.int64(stretch[chance[contexts[k]] >> 10])
    total = (total + 32768) >> 16
    total = min(max(total, -3071), 3071)
    p_one = np.int64(squash[total + 3071])
    bit = code_bit(bit, p_one, coder.state, coder.data, coder.decoding)
    error = ((bit << 16) - p_one) * 6
    goal = (bit << 22) - bit
    for k in range(count):
        place = contexts[k]
        now, uses = np.int64(chance[place]), seen[place]
        weight[k] += (np.int64(stretch[now >> 10]) * error + (1 << 19)) >> 20
        chance[place] = now + (((goal - now) * np.int64(rate[uses])) >> 16)
        if uses < LIMIT:
            seen[place] = uses + 1
        tally[place, bit] += 1
    weight[INPUTS - 1] += (256 * error + (1 << 19)) >> 20
    return bit
