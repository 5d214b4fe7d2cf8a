"""Points in the yarns and rays that meet them: compiled functions over the solids of `geometry`.

They take `Solids.numbers` (everything about the yarns in one row) and `Solids.free` (free distances by voxel). x along
the weft, y along the warp, z up; lengths in mm; the cloth is periodic in x and y.
"""

from __future__ import annotations

import math

import numba
import numpy as np

POWERS = 1024  # |u|^e is stored at so many steps of |u|
_BISECTIONS = 14


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _floor(value):
    """Largest integer not above a value."""
    truncated = int(value)
    return truncated - 1 if value < truncated else truncated


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _yarn_of(v, spacing, count):
    """Yarn of the slot at sideways place v, and the place from the slot's middle."""
    slot = _floor(v / spacing)
    return slot - count * _floor(slot / count), v - (slot + 0.5) * spacing


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _knots(along, length, yarn, system, numbers):
    """Where the two samples of a path about a place begin in `numbers`, and the share of the second."""
    samples = int(numbers[system + 1])
    place = along / length * samples
    low = _floor(place)
    first = low - samples * _floor(low / samples)
    second = first + 1 if first + 1 < samples else 0
    start = int(numbers[system + 4]) + 4 * samples * yarn
    return start + 4 * first, start + 4 * second, place - low


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _in_yarn(v, along, z, spacing, length, system, numbers):
    """Number of the yarn at sideways place v and place `along`, or -1 where the point is in none."""
    yarn, u = _yarn_of(v, spacing, int(numbers[system]))
    shape = int(numbers[system + 3]) + 3 * yarn
    u -= numbers[shape]
    side = abs(u) / numbers[shape + 1]
    if side >= 1.0:
        return -1
    k, n, f = _knots(along, length, yarn, system, numbers)
    height = numbers[k] + f * (numbers[n] - numbers[k])
    roll = numbers[k + 2] + f * (numbers[n + 2] - numbers[k + 2])
    zeta = (z - height - roll * u) / numbers[shape + 2]
    if zeta * zeta >= 1.0:
        return -1
    q = side * POWERS
    m = int(q)
    power = int(numbers[system + 5]) + m
    reach = numbers[power] + (q - m) * (numbers[power + 1] - numbers[power])
    return yarn if zeta * zeta + reach < 1.0 else -1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def inside(x, y, z, numbers):
    """0 where (x, y, z) lies in no yarn, 1 + k in warp yarn k, −1 − k in weft yarn k."""
    k = _in_yarn(x, y, z, numbers[0], numbers[11] * numbers[1], 5, numbers)
    if k >= 0:
        return 1 + k
    k = _in_yarn(y, x, z, numbers[1], numbers[5] * numbers[0], 11, numbers)
    return -1 - k if k >= 0 else 0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _free_at(x, y, z, numbers, free):
    """Distance (mm) that is free of yarns about a point between the lowest and the highest z."""
    k = int((z - numbers[2]) / (numbers[3] - numbers[2]) * free.shape[0])
    if k < 0 or k >= free.shape[0]:
        return 0.0
    u, v = x / (numbers[0] * numbers[5]), y / (numbers[1] * numbers[11])
    i, j = int((u - _floor(u)) * free.shape[2]), int((v - _floor(v)) * free.shape[1])
    return np.float64(free[k, min(j, free.shape[1] - 1), min(i, free.shape[2] - 1)])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def first_hit(x, y, z, dx, dy, dz, numbers, free):
    """Distance along a unit direction to the first yarn, and which (see `inside`); (−1, 0) where the ray meets none.

    Where yarns may be near, even steps of 0.12 thicknesses and a bisection: a chord shorter than a step may be missed,
    which is a penetration of less than 0.002 thicknesses.
    """
    low, high, step = numbers[2], numbers[3], numbers[4]
    t = 0.0
    if z > high:
        if dz >= 0.0:
            return -1.0, 0
        t = (high - z) / dz
    near = t
    while True:
        h = z + t * dz
        if (dz >= 0.0 and h > high) or (dz <= 0.0 and h < low):
            return -1.0, 0
        ahead = _free_at(x + t * dx, y + t * dy, h, numbers, free)
        if ahead < step:
            yarn = inside(x + t * dx, y + t * dy, h, numbers)
            if yarn != 0:
                break
            ahead = step
        near = t
        t += ahead
    far = t
    for _ in range(_BISECTIONS):
        middle = 0.5 * (near + far)
        other = inside(x + middle * dx, y + middle * dy, z + middle * dz, numbers)
        if other != 0:
            far, yarn = middle, other
        else:
            near = middle
    return near, yarn


@numba.njit(cache=True, nogil=True, error_model="numpy")
def escapes(x, y, z, dx, dy, dz, numbers, free):
    """Whether the ray from a point in a unit direction with dz > 0 leaves the cloth."""
    high, step = numbers[3], numbers[4]
    while z <= high:
        ahead = _free_at(x, y, z, numbers, free)
        if ahead < step:
            if inside(x, y, z, numbers) != 0:
                return False
            ahead = step
        x, y, z = x + ahead * dx, y + ahead * dy, z + ahead * dz
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _yarn_frame(v, along, z, spacing, length, system, numbers):
    """Outward normal, not normalised (sideways, along, up), and slope of the yarn at a point of its surface."""
    yarn, u = _yarn_of(v, spacing, int(numbers[system]))
    shape = int(numbers[system + 3]) + 3 * yarn
    u -= numbers[shape]
    a, b, exponent = numbers[shape + 1], numbers[shape + 2], numbers[system + 2]
    k, n, f = _knots(along, length, yarn, system, numbers)
    height = numbers[k] + f * (numbers[n] - numbers[k])
    slope = numbers[k + 1] + f * (numbers[n + 1] - numbers[k + 1])
    roll = numbers[k + 2] + f * (numbers[n + 2] - numbers[k + 2])
    turn = numbers[k + 3] + f * (numbers[n + 3] - numbers[k + 3])
    up = 2.0 * (z - height - roll * u) / (b * b)
    across = math.copysign(exponent * min(abs(u) / a, 1.0) ** (exponent - 1.0) / a, u) - up * roll
    return across, -up * (slope + turn * u), up, slope + turn * u


@numba.njit(cache=True, nogil=True, error_model="numpy")
def frame_at(x, y, z, which, numbers):
    """Normal n and yarn direction t, unit and perpendicular: (n_x, n_y, n_z, t_x, t_y, t_z); `which` as in `inside`."""
    if which > 0:
        nx, ny, nz, slope = _yarn_frame(x, y, z, numbers[0], numbers[11] * numbers[1], 5, numbers)
        tx, ty, tz = 0.0, 1.0, slope
    else:
        ny, nx, nz, slope = _yarn_frame(y, x, z, numbers[1], numbers[5] * numbers[0], 11, numbers)
        tx, ty, tz = 1.0, 0.0, slope
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    nx, ny, nz = nx / length, ny / length, nz / length
    dot = nx * tx + ny * ty + nz * tz  # 0 up to rounding on the surface itself
    tx, ty, tz = tx - dot * nx, ty - dot * ny, tz - dot * nz
    length = math.sqrt(tx * tx + ty * ty + tz * tz)
    return nx, ny, nz, tx / length, ty / length, tz / length


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_voxels(start, stop, sizes, numbers, empty):
    """1 where the centre of a voxel (z, y, x) of these sizes lies in no yarn, for the layers start .. stop."""
    for k in range(start, stop):
        z = numbers[2] + (k + 0.5) * sizes[0]
        for j in range(empty.shape[1]):
            for i in range(empty.shape[2]):
                empty[k, j, i] = inside((i + 0.5) * sizes[2], (j + 0.5) * sizes[1], z, numbers) == 0
