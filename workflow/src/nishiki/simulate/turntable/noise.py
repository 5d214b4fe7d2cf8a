"""Smooth noise in space and cells on the plane, from hashed lattice points: no state, no order."""

import math

import numba
import numpy as np

from nishiki.simulate.randomness import hash_uint, uniform


@numba.njit(cache=True)
def solid_noise(key, x, y, z):
    """Smooth noise in [0, 1] in space: hashed values at the integer lattice, joined by the smoothstep polynomial."""
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    fx, fy, fz = x - i, y - j, z - k
    fx, fy, fz = fx * fx * (3.0 - 2.0 * fx), fy * fy * (3.0 - 2.0 * fy), fz * fz * (3.0 - 2.0 * fz)
    total = 0.0
    for corner in range(8):  # a loop, not eight lines: what uses this noise compiles in a third of the time
        a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
        bits = hash_uint(hash_uint(key, np.uint64(np.int64(k) + c)), np.uint64(np.int64(j) + b))
        weight = (fx if a else 1.0 - fx) * (fy if b else 1.0 - fy) * (fz if c else 1.0 - fz)
        total += weight * uniform(bits, np.uint64(np.int64(i) + a))
    return total


@numba.njit(cache=True)
def solid_fractal(key, x, y, z, octaves):
    """Mean of octaves of `solid_noise`, each twice as fine and half as strong."""
    total, weight, scale = 0.0, 0.0, 1.0
    for octave in range(octaves):
        total += scale * solid_noise(key + np.uint64(octave), x / scale, y / scale, z / scale)
        weight += scale
        scale *= 0.5
    return total / weight


@numba.njit(cache=True)
def crack_distance(key, x, y):
    """Distance from the nearest border between the cells about jittered lattice points (0 on it), in lattice units.

    Half the difference of the distances to the two nearest points: Worley, A cellular texture basis function,
    SIGGRAPH 1996.
    """
    column, row = math.floor(x), math.floor(y)
    first, second = 1e9, 1e9
    for i in range(-1, 2):
        for j in range(-1, 2):
            bits = hash_uint(hash_uint(key, np.uint64(np.int64(row) + i)), np.uint64(np.int64(column) + j))
            dx = column + j + uniform(bits, np.uint64(1)) - x
            dy = row + i + uniform(bits, np.uint64(2)) - y
            distance = dx * dx + dy * dy
            if distance < first:
                first, second = distance, first
            elif distance < second:
                second = distance
    return 0.5 * (math.sqrt(second) - math.sqrt(first))
