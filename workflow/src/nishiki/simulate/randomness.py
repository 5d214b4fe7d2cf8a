"""Random numbers and smooth noise that depend on a key and a position only, never on order or number of threads."""

import math

import numba
import numpy as np

from nishiki.threads import over_rows

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
GOLDEN_RATIO = (math.sqrt(5.0) - 1.0) / 2.0  # its multiples are even whatever their number
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_SHIFT_30, _SHIFT_27, _SHIFT_31, _SHIFT_11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_UNIT = 1.0 / 9007199254740992.0  # 2^-53


def mix_bits(key, counter):
    """Mix 64 bits of (key, counter) well: the output function of SplitMix64 (Steele, Lea, Flood, OOPSLA 2014).

    Numbers, or arrays of uint64; kernels call it by the name `hash_uint`.
    """
    z = np.uint64(key) + (np.uint64(counter) + np.uint64(1)) * _GOLDEN
    z = (z ^ (z >> _SHIFT_30)) * _MIX_1
    z = (z ^ (z >> _SHIFT_27)) * _MIX_2
    return z ^ (z >> _SHIFT_31)


hash_uint = numba.njit(cache=True)(mix_bits)


@numba.njit(cache=True)
def uniform(key, counter):
    """Draw a number in [0, 1) from (key, counter)."""
    return np.float64(hash_uint(key, counter) >> _SHIFT_11) * _UNIT


def uniforms(key, counter) -> np.ndarray:
    """Draw numbers in [0, 1) from keys and counters, which broadcast."""
    return (mix_bits(key, np.atleast_1d(counter)) >> _SHIFT_11) * _UNIT


def normals(key, counter: np.ndarray) -> np.ndarray:
    """Draw standard normal numbers from keys and counters: Box-Muller on two hashed uniforms (one is used)."""
    radius = np.sqrt(-2.0 * np.log1p(-uniforms(key, 2 * counter)))
    return radius * np.cos(2.0 * np.pi * uniforms(key, 2 * counter + 1))


@numba.njit(cache=True)
def line_noise(key, x):
    """Compute smooth noise in [0, 1] on a line: hashed values at the integers, joined by the smoothstep polynomial."""
    cell = math.floor(x)
    f = x - cell
    left = uniform(key, np.uint64(np.int64(cell)))
    right = uniform(key, np.uint64(np.int64(cell) + 1))
    return left + (right - left) * f * f * (3.0 - 2.0 * f)


@numba.njit(cache=True)
def plane_noise(key, x, y):
    """Compute smooth noise in [0, 1] on the plane: hashed values at the integer lattice, joined by smoothsteps."""
    column, row = math.floor(x), math.floor(y)
    fx, fy = x - column, y - row
    fx = fx * fx * (3.0 - 2.0 * fx)
    fy = fy * fy * (3.0 - 2.0 * fy)
    i, j = np.int64(column), np.int64(row)
    key_0, key_1 = hash_uint(key, np.uint64(j)), hash_uint(key, np.uint64(j + 1))
    a, b = uniform(key_0, np.uint64(i)), uniform(key_0, np.uint64(i + 1))
    c, d = uniform(key_1, np.uint64(i)), uniform(key_1, np.uint64(i + 1))
    top, bottom = a + (b - a) * fx, c + (d - c) * fx
    return top + (bottom - top) * fy


@numba.njit(cache=True, nogil=True)
def _fractal(start, stop, key, x, y, octaves, out):
    for row in range(start, stop):
        for column in range(out.shape[1]):
            total, weight, scale = 0.0, 0.0, 1.0
            for octave in range(octaves):
                total += plane_noise(key + np.uint64(octave), x[row, column] / scale, y[row, column] / scale) * scale
                weight += scale
                scale *= 0.5
            out[row, column] = total / weight


def fractal_noise(x: np.ndarray, y: np.ndarray, *, key: int, octaves: int = 3) -> np.ndarray:
    """Sum octaves of smooth noise, each twice as fine and half as strong.

    x, y : (rows, columns) positions in units of the coarsest cell. Returns (rows, columns) float32 in [0, 1].
    """
    x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
    out = np.empty(x.shape, np.float32)
    over_rows(_fractal, len(out), np.uint64(key), np.ascontiguousarray(x), np.ascontiguousarray(y), octaves, out)
    return out


def subkey(seed: int, purpose: str) -> int:
    """Derive a 63-bit key for one purpose of one seed, so that two purposes never share random numbers."""
    import hashlib

    digest = hashlib.sha256(f"{int(seed)}:{purpose}".encode()).digest()
    return int.from_bytes(digest[:8], "little") >> 1


def solid_noise(key, x, y, z) -> np.ndarray:
    """Compute smooth noise in [0, 1] in space: hashed values at the integer lattice, joined by smoothsteps.

    key : uint64, x, y, z : positions; numbers or arrays that broadcast, x an array.
    """
    cells = [np.floor(each) for each in np.broadcast_arrays(x, y, z)]
    fx, fy, fz = (f * f * (3.0 - 2.0 * f) for f in (each - cell for each, cell in zip((x, y, z), cells, strict=True)))
    i, j, k = (cell.astype(np.int64).astype(np.uint64) for cell in cells)
    total = np.zeros(i.shape)
    for c, b in np.ndindex(2, 2):
        bits = mix_bits(mix_bits(key, k + np.uint64(c)), j + np.uint64(b))
        left, right = uniforms(bits, i), uniforms(bits, i + np.uint64(1))
        total += (fy if b else 1.0 - fy) * (fz if c else 1.0 - fz) * (left + (right - left) * fx)
    return total


def solid_fractal(key, x, y, z, octaves: int) -> np.ndarray:
    """Average octaves of `solid_noise`, each twice as fine and half as strong."""
    scales = 0.5 ** np.arange(octaves)
    parts = (s * solid_noise(key + np.uint64(n), x / s, y / s, z / s) for n, s in enumerate(scales))
    return sum(parts) / scales.sum()


def crack_distance(key, x, y) -> np.ndarray:
    """Compute the distance (lattice units) to the nearest border of the cells about jittered lattice points, 0 on it.

    Half the difference of the distances to the two nearest points: Worley, A cellular texture basis function,
    SIGGRAPH 1996. x, y : arrays.
    """
    column, row = np.floor(x), np.floor(y)
    first, second = np.full(x.shape, np.inf), np.full(x.shape, np.inf)
    for i, j in np.ndindex(3, 3):
        line, place = row + i - 1, column + j - 1
        bits = mix_bits(key, line.astype(np.int64).astype(np.uint64))
        bits = mix_bits(bits, place.astype(np.int64).astype(np.uint64))
        distance = np.hypot(place + uniforms(bits, 1) - x, line + uniforms(bits, 2) - y)
        second = np.minimum(second, np.maximum(first, distance))
        first = np.minimum(first, distance)
    return 0.5 * (second - first)
