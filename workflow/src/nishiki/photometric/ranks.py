"""Selection by rank: the brightest and the darkest share of each pixel's observations are left out."""

from functools import lru_cache

import numpy as np
from numba import njit, prange

BLOCK = 64  # pixels sorted together: 96 lights of them fill three quarters of a 32 KiB first-level cache


@lru_cache(maxsize=64)
def sorting_network(size, smallest=None):
    """Comparators (n, 2) int32 of Batcher's odd-even merge sort for any number of values.

    smallest: number of values, counted from the smallest, that have to be in their places; default all. Comparators
    that reach none of them are left out.

    A network compares the same places whatever the values are, so that one pass sorts as many pixels as the vector
    unit has lanes. Source: K. E. Batcher, Sorting networks and their applications, AFIPS 1968; for sizes that are no
    power of two, Knuth, The Art of Computer Programming 3, section 5.2.2, algorithm M.
    """
    pairs = []
    span = 1 << max(0, (size - 1).bit_length() - 1)
    p = span
    while p > 0:
        q, r, d = span, 0, p
        while True:
            pairs += [(i, i + d) for i in range(size - d) if i & p == r]
            if q == p:
                break
            d, q, r = q - p, q >> 1, p
        p >>= 1
    needed, kept = set(range(size if smallest is None else smallest)), []
    for pair in reversed(pairs):
        if needed & {*pair}:
            needed |= {*pair}
            kept.append(pair)
    return np.array(kept[::-1], dtype=np.int32).reshape(-1, 2)


@njit(cache=True, inline="always")
def sort_columns(values, comparators, width):
    """Sort the first `width` columns of values (lights, BLOCK) upwards, in place, by a sorting network."""
    for c in range(comparators.shape[0]):
        upper, lower = comparators[c, 0], comparators[c, 1]
        for p in range(width):
            a = values[upper, p]
            b = values[lower, p]
            values[upper, p] = a if a < b else b
            values[lower, p] = b if a < b else a


@njit(cache=True, inline="always")
def band(count, low, high, at_least):
    """First and last rank (inclusive) of the share [low, high) of `count` values, widened to `at_least` values."""
    first = int(np.floor(low * count + 0.5))
    last = int(np.floor(high * count + 0.5)) - 1
    while last - first + 1 < at_least and (first > 0 or last < count - 1):
        # Highlights mislead more than attached shadows do: widen towards the dark side first.
        if first > 0:
            first -= 1
        if last - first + 1 < at_least and last < count - 1:
            last += 1
    return first, last


@njit(cache=True, parallel=True, error_model="numpy")
def rank_selection(observations, valid, comparators, low, high, at_least, usable, highlights, shadows):
    """Mark in `usable` the valid samples whose rank among the pixel's valid samples lies in the share [low, high).

    Equal values are treated alike: all samples equal to a kept one are kept. Shapes as in `threshold_selection`.
    """
    lights, pixels = observations.shape
    shared = valid.shape[1] == 1
    infinity = np.float32(np.inf)
    for block in prange((pixels + BLOCK - 1) // BLOCK):
        start = block * BLOCK
        width = min(BLOCK, pixels - start)
        values = np.empty((lights, BLOCK), dtype=np.float32)
        count = np.zeros(BLOCK, dtype=np.int64)
        for j in range(lights):
            for p in range(width):
                known = valid[j, 0] if shared else valid[j, start + p]
                values[j, p] = observations[j, start + p] if known else infinity
                count[p] += known
        sort_columns(values, comparators, width)
        floor = np.empty(BLOCK, dtype=np.float32)
        ceiling = np.empty(BLOCK, dtype=np.float32)
        for p in range(width):
            floor[p], ceiling[p] = infinity, -infinity
            if count[p] > 0:
                first, last = band(count[p], low, high, at_least)
                floor[p], ceiling[p] = values[first, p], values[last, p]
        highlights[start : start + width] = 0
        shadows[start : start + width] = 0
        for j in range(lights):
            for p in range(width):
                known = valid[j, 0] if shared else valid[j, start + p]
                value = observations[j, start + p]
                usable[j, start + p] = known and floor[p] <= value and value <= ceiling[p]
                highlights[start + p] += known and value > ceiling[p]
                shadows[start + p] += known and value < floor[p]
