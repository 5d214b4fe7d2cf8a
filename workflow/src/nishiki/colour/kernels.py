"""Compiled loops over pixels: response to coefficients, standard deviation and flags.

One pass a pixel. The correction is read from a table over whitened coordinates (three channels) or summed over the
kernels (any number of channels). The loops release the interpreter lock instead of being parallel themselves: threads
over slices of the pixels run as fast, and compile in half the time.
"""

from collections import namedtuple
from enum import IntEnum

import numpy as np
from numba import njit

TAPER_START, TAPER_END = 1.0, 3.0  # whitened standard deviations beyond the training box
DARK = 0.05  # mean response at which the correction has half its weight: black stays black


class SpectralFlag(IntEnum):
    """Bits of a pixel's flags."""

    OUTSIDE_UNIT = 1  # reflectance outside 0 to 1 beyond the tolerance
    OUTSIDE_TRAINING = 2  # response unlike every training response: the estimate falls back to the linear map
    NOT_FINITE = 4  # response or result not finite: coefficients and standard deviation set to 0
    ILL_CONDITIONED = 8  # camera and lamp cannot separate the bases: minimum-norm solution
    NEGATIVE_RESPONSE = 16  # negative response in some channel (noise in the dark)


@njit(cache=True, error_model="numpy")
def _whiten(response, mean, whiten, z):
    """Whiten one response to z; return (mean non-negative response, finite, negative)."""
    channels = response.size
    brightness = 0.0
    negative = False
    finite = True
    for j in range(channels):
        z[j] = 0.0
    for i in range(channels):
        value = response[i]
        finite = finite and np.isfinite(value)
        negative = negative or value < 0.0
        positive = max(value, np.float32(0.0))
        brightness += positive
        root = np.sqrt(positive) - mean[i]
        for j in range(channels):
            z[j] += whiten[j, i] * root
    return brightness / channels, finite, negative


@njit(cache=True, error_model="numpy")
def _taper(z, low, high):
    """Multiply the smooth steps of all axes; return the largest excess over the box, too."""
    product = 1.0
    excess = 0.0
    for j in range(z.size):
        outside = max(max(low[j] - z[j], z[j] - high[j]), 0.0)
        excess = max(excess, outside)
        t = min(max((TAPER_END - outside) / (TAPER_END - TAPER_START), 0.0), 1.0)
        product *= t * t * (3.0 - 2.0 * t)
    return product, excess


@njit(cache=True, error_model="numpy")
def _linear_and_anchor(response, linear, anchor, precision, out):
    """Set out to linear @ response, plus the share of the white anchor."""
    channels = response.size
    square = 0.0
    for i in range(channels):
        square += (response[i] - 1.0) ** 2
    exponent = square / channels * precision
    share = np.exp(-exponent) if exponent < 40.0 else 0.0
    for k in range(out.size):
        total = share * anchor[k]
        for i in range(channels):
            total += linear[k, i] * response[i]
        out[k] = total


@njit(cache=True, error_model="numpy")
def _outside_unit(coefficients, basis, low, high, spectrum):
    """Return True if any band of the spectrum is outside [low, high]."""
    bands = basis.shape[1]
    for b in range(bands):
        spectrum[b] = 0.0
    for k in range(basis.shape[0]):
        c = coefficients[k]
        for b in range(bands):
            spectrum[b] += c * basis[k, b]
    bad = 0
    for b in range(bands):
        bad |= (spectrum[b] < low) | (spectrum[b] > high)
    return bad != 0


@njit(cache=True, error_model="numpy")
def _interpolate(table, z, origin, step, out):
    """Interpolate the last axis of a (n0, n1, n2, C) table trilinearly at z, clamped to its box."""
    i0, f0 = _cell(z[0], origin[0], step[0], table.shape[0])
    i1, f1 = _cell(z[1], origin[1], step[1], table.shape[1])
    i2, f2 = _cell(z[2], origin[2], step[2], table.shape[2])
    for c in range(out.size):
        out[c] = 0.0
    for corner in range(8):
        a, b, d = corner >> 2, (corner >> 1) & 1, corner & 1
        share = np.float32((f0 if a else 1.0 - f0) * (f1 if b else 1.0 - f1) * (f2 if d else 1.0 - f2))
        row = table[i0 + a, i1 + b, i2 + d]
        for c in range(out.size):
            out[c] += share * row[c]


@njit(cache=True, error_model="numpy")
def _cell(value, origin, step, nodes):
    position = min(max((value - origin) / step, 0.0), nodes - 1.0)
    index = min(int(position), nodes - 2)
    return index, position - index


@njit(cache=True, error_model="numpy")
def _kernel_sums(z, centres, weights, radius, variance, far_variance, apart, out):
    """Sum over all centres: out[:K] correction, out[K] variance, out[K + 1] nearest distance.

    centres is (N, M): the inner loops run along centres, so that the compiler can use vector instructions.
    """
    count = centres.shape[1]
    size = weights.shape[1]
    for m in range(count):
        apart[m] = np.float32(0.0)
    for j in range(z.size):
        position = np.float32(z[j])
        for m in range(count):
            difference = position - centres[j, m]
            apart[m] += difference * difference
    for c in range(out.size):
        out[c] = 0.0
    nearest = apart[0]
    for m in range(count):
        nearest = min(nearest, apart[m])
    one, inverse = np.float32(1.0), np.float32(1.0) / np.float32(radius)
    for m in range(count):  # squared distance becomes kernel, in place
        ratio = np.sqrt(apart[m]) * inverse
        rest = max(one - ratio, np.float32(0.0))
        rest *= rest
        apart[m] = rest * rest * (np.float32(4.0) * ratio + one)
    top, bottom = np.float32(0.0), np.float32(0.0)
    for m in range(count):
        kernel = apart[m]
        if kernel > 0.0:
            for c in range(size):
                out[c] += kernel * weights[m, c]
            share = kernel * kernel
            share *= share
            top += share * variance[m]
            bottom += share
    out[size] = (top + 1e-2 * far_variance) / (bottom + 1e-2)
    out[size + 1] = np.sqrt(nearest)


@njit(cache=True, nogil=True, error_model="numpy")
def fill_table(axes, centres, weights, radius, variance, far_variance, table):
    """Fill a (n0, n1, n2, K + 2) float32 table with `_kernel_sums` at the nodes of three axes."""
    for i in range(axes[0].size):
        z = np.empty(3, np.float64)
        apart = np.empty(centres.shape[1], np.float32)
        z[0] = axes[0][i]
        for j in range(axes[1].size):
            z[1] = axes[1][j]
            for k in range(axes[2].size):
                z[2] = axes[2][k]
                _kernel_sums(z, centres, weights, radius, variance, far_variance, apart, table[i, j, k])


Tables = namedtuple(
    "Tables",
    "linear anchor precision mean whiten low high table origin step centres weights radius variance far_variance "
    "noise_variance gamut_distance basis unit_low unit_high ill_conditioned",
)
"""A `SpectralEstimator` as its kernel takes it; precision: 1 / (2 width^2) of its white anchor, 0 without one."""


@njit(cache=True, nogil=True, error_model="numpy")
def apply_estimator(responses, e, coefficients, sigma, flags):
    """Fill coefficients (P, K), sigma (P,), flags (P,) for responses (P, N), all float32 or uint8.

    The correction comes from `table` (three channels) where it has nodes, else from `centres` where there are any,
    else it is zero (a linear estimator).
    """
    pixels, channels = responses.shape
    size = e.basis.shape[0]
    z = np.empty(channels, np.float64)
    extra = np.empty(size + 2, np.float32)
    apart = np.empty(e.centres.shape[1], np.float32)
    spectrum = np.empty(e.basis.shape[1], np.float32)
    for p in range(pixels):
        response = responses[p]
        out = coefficients[p]
        brightness, finite, negative = _whiten(response, e.mean, e.whiten, z)
        if not finite:
            for k in range(size):
                out[k] = 0.0
            sigma[p] = 0.0
            flags[p] = SpectralFlag.NOT_FINITE
            continue
        flag = SpectralFlag.NEGATIVE_RESPONSE if negative else 0
        _linear_and_anchor(response, e.linear, e.anchor, e.precision, out)
        taper, excess = _taper(z, e.low, e.high)
        local_variance, distance = e.far_variance, excess
        if e.table.shape[0] > 1 or e.centres.shape[1] > 0:
            if taper > 0.0:
                if e.table.shape[0] > 1:
                    _interpolate(e.table, z, e.origin, e.step, extra)
                else:
                    _kernel_sums(z, e.centres, e.weights, e.radius, e.variance, e.far_variance, apart, extra)
                scale = np.float32(taper * brightness / (brightness + DARK))
                for k in range(size):
                    out[k] += scale * extra[k]
                local_variance, distance = max(extra[size], 0.0), extra[size + 1]
            else:
                distance = np.inf
        sigma[p] = np.sqrt(local_variance + e.noise_variance)
        if distance > e.gamut_distance:
            flag |= SpectralFlag.OUTSIDE_TRAINING
        if e.ill_conditioned:
            flag |= SpectralFlag.ILL_CONDITIONED
        if _outside_unit(out, e.basis, e.unit_low, e.unit_high, spectrum):
            flag |= SpectralFlag.OUTSIDE_UNIT
        for k in range(size):
            finite = finite and np.isfinite(out[k])
        if not (finite and np.isfinite(sigma[p])):  # overflow of a huge response
            out[:] = 0.0
            sigma[p] = 0.0
            flag = SpectralFlag.NOT_FINITE
        flags[p] = flag


@njit(cache=True, nogil=True, error_model="numpy")
def code_pixels(values, matrix, table, out):
    """Fill out (pictures, 3, n) with the nodes of a table next to matrix (3, channels) times values.

    values: (pictures, n, channels). The matrix brings a value of 1 to the last node; values below 0, and those that are
    no number, take the first.
    """
    last = np.float32(table.size - 1)
    channels = values.shape[2]
    for j in range(values.shape[0]):
        for k in range(3):
            for p in range(values.shape[1]):
                place = np.float32(0.5)
                if channels == 3:  # a distance between neighbours that the compiler knows: SIMD code
                    place += matrix[k, 0] * values[j, p, 0] + matrix[k, 1] * values[j, p, 1]
                    place += matrix[k, 2] * values[j, p, 2]
                else:
                    for c in range(channels):
                        place += matrix[k, c] * values[j, p, c]
                place = place if place > np.float32(0) else np.float32(0)
                out[j, k, p] = table[np.int32(place if place < last else last)]
