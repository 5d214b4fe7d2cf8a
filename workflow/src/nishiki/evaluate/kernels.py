"""Compiled comparison of two pictures: colour difference, squared errors and block means, one pixel after the other.

The same formulas as `nishiki.colour.colour` (CIE 015:2018, Sharma et al. 2005) for one pixel; the tests compare both.
"""

import math

import numpy as np
from numba import njit

from nishiki.colour.colour import KNEE, OFFSET, POWER, SCALE, SLOPE

_LIMIT = 6.0 / 29.0
_POWER7 = 25.0**7
SUMS = 4  # samples, squared linear difference, squared coded difference, difference


@njit(cache=True, nogil=True, error_model="numpy")
def _f(ratio):
    """Compute the cube root of CIELAB with its linear part near 0."""
    return math.exp(math.log(ratio) / 3.0) if ratio > _LIMIT**3 else ratio / (3.0 * _LIMIT**2) + 4.0 / 29.0


@njit(cache=True, nogil=True, error_model="numpy")
def _coded(value):
    """sRGB code, 0 to 1, of a linear value; values outside 0 to 1 are clipped."""
    if value <= KNEE:
        return SLOPE * max(value, 0.0)
    return SCALE * min(value, 1.0) ** POWER - OFFSET


@njit(cache=True, nogil=True, error_model="numpy")
def _lab(channels, matrix, white, lab):
    fx, fy, fz = 0.0, 0.0, 0.0
    for c in range(3):
        total = 0.0
        for k in range(matrix.shape[1]):
            total += matrix[c, k] * channels[k]
        value = _f(total / white[c])
        if c == 0:
            fx = value
        elif c == 1:
            fy = value
        else:
            fz = value
    lab[0], lab[1], lab[2] = 116.0 * fy - 16.0, 500.0 * (fx - fy), 200.0 * (fy - fz)


@njit(cache=True, nogil=True, error_model="numpy")
def delta_e(a, b):
    """CIEDE2000 of two Lab colours (3,)."""
    mean7 = (0.5 * (math.sqrt(a[1] * a[1] + a[2] * a[2]) + math.sqrt(b[1] * b[1] + b[2] * b[2]))) ** 7
    stretch = 1.5 - 0.5 * math.sqrt(mean7 / (mean7 + _POWER7))
    a1, a2 = a[1] * stretch, b[1] * stretch
    c1, c2 = math.sqrt(a1 * a1 + a[2] * a[2]), math.sqrt(a2 * a2 + b[2] * b[2])
    h1 = math.degrees(math.atan2(a[2], a1)) % 360.0
    h2 = math.degrees(math.atan2(b[2], a2)) % 360.0
    apart, total = h2 - h1, h1 + h2
    if c1 * c2 == 0.0:
        turn, hue = 0.0, total
    else:
        turn = apart - 360.0 if apart > 180.0 else (apart + 360.0 if apart < -180.0 else apart)
        hue = 0.5 * total if abs(apart) <= 180.0 else 0.5 * (total + (360.0 if total < 360.0 else -360.0))
    light, chroma = 0.5 * (a[0] + b[0]), 0.5 * (c1 + c2)
    angle = math.radians(hue)
    t = 1.0 - 0.17 * math.cos(angle - math.radians(30.0)) + 0.24 * math.cos(2.0 * angle)
    t += 0.32 * math.cos(3.0 * angle + math.radians(6.0)) - 0.20 * math.cos(4.0 * angle - math.radians(63.0))
    offset = (light - 50.0) ** 2
    d_l = (b[0] - a[0]) / (1.0 + 0.015 * offset / math.sqrt(20.0 + offset))
    d_c = (c2 - c1) / (1.0 + 0.045 * chroma)
    d_h = 2.0 * math.sqrt(c1 * c2) * math.sin(math.radians(0.5 * turn)) / (1.0 + 0.015 * chroma * t)
    chroma7 = chroma**7
    rotation = -2.0 * math.sqrt(chroma7 / (chroma7 + _POWER7))
    rotation *= math.sin(math.radians(60.0 * math.exp(-(((hue - 275.0) / 25.0) ** 2))))
    # positive definite but for rounding
    return math.sqrt(max(d_l * d_l + d_c * d_c + d_h * d_h + rotation * d_c * d_h, 0.0))


@njit(cache=True, nogil=True, error_model="numpy")
def compare_rows(first, last, predicted, observed, classes, display, de00, sums):
    """Rows first to last - 1: colour difference into de00 and sums of errors by class into sums (rows, classes, SUMS).

    predicted, observed (rows, columns, C) float32; display: matrix (3, C) to XYZ, and white (3,); classes (rows,
    columns) uint8, 0 is left alone; de00 (rows, columns) float32.
    """
    (matrix, white), lab1, lab2 = display, np.empty(3), np.empty(3)
    for row in range(first, last):
        for column in range(classes.shape[1]):
            label = classes[row, column]
            if label == 0:
                continue
            a, b = predicted[row, column], observed[row, column]
            _lab(a, matrix, white, lab1)
            _lab(b, matrix, white, lab2)
            de00[row, column] = delta_e(lab1, lab2)
            for k in range(a.shape[0]):
                difference = np.float64(a[k]) - np.float64(b[k])
                coded = _coded(np.float64(a[k])) - _coded(np.float64(b[k]))
                sums[row, label, 0] += 1.0
                sums[row, label, 1] += difference * difference
                sums[row, label, 2] += coded * coded
                sums[row, label, 3] += difference


@njit(cache=True, nogil=True, error_model="numpy")
def add_blocks(picture, inside, start, block, sums, counts):
    """Sum a band's pixels (rows, columns, C) over square blocks; `start` is the band's first row.

    inside (rows, columns) bool; sums (block rows, block columns, C); counts (block rows, block columns).
    """
    for row in range(picture.shape[0]):
        i = (row + start) // block
        for column in range(picture.shape[1]):
            if inside[row, column]:
                j = column // block
                counts[i, j] += 1.0
                for k in range(picture.shape[2]):
                    value = np.float64(picture[row, column, k])
                    if abs(value) < np.inf:
                        sums[i, j, k] += value
