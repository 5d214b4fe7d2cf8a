"""Diffuse reflectance of each channel, from the selected lights and the known normals."""

from collections import namedtuple
from dataclasses import dataclass

import numba
import numpy as np

from nishiki.errors import UserError
from nishiki.threads import over_rows

BLOCK = 256  # pixels at a time
COSINE_FLOOR = 0.02
"""Samples lit at a smaller cosine carry no usable signal and divide by almost nothing: they are left out."""


Geometry = namedtuple("Geometry", "directions normals usable shading")
"""directions (lights, 3), normals (pixels, 3), shading (pixels or 0, 3) float32; usable (lights, pixels) bool."""


@dataclass(frozen=True)
class DiffuseReflectance:
    """reflectance (rows, columns, channels) float32, perfect white = 1; lights_used (rows, columns) uint16.

    Where no selected light reaches a pixel, or the sums leave float32, the reflectance is 0 and lights_used is 0.
    """

    reflectance: np.ndarray
    lights_used: np.ndarray


def diffuse_reflectance(observations, directions, normals, *, usable, method="least_squares", shading=None):
    """Reflectance per channel of a surface with known normals and body shading (Lambert's if None).

    observations (lights, rows, columns, channels) float32, perfect white facing the lamp = 1; directions (lights, 3);
    normals (rows, columns, 3); usable (lights, rows, columns) bool; shading (rows, columns, 3) or None, (a, b, d) of
    `nishiki.brdf.torrance_sparrow`.

    method, with the shading s = cos f
        "least_squares": sum(I s) / sum(s^2), the maximum-likelihood weight for equal noise in all lights.
        "mean": mean of I / s over the selected lights (Tominaga and Tanaka 2004, eq. 6), which lets grazing lights
        weigh most.

    Raises UserError on an unknown method or shapes that do not fit. Returns a DiffuseReflectance.
    """
    if method not in ("least_squares", "mean"):
        raise UserError(f"diffuse reflectance: method {method!r} is unknown; known: least_squares, mean")
    lights, rows, columns, channels = observations.shape
    if usable.shape != (lights, rows, columns) or normals.shape != (rows, columns, 3) or len(directions) != lights:
        raise UserError(
            f"diffuse reflectance: observations {observations.shape} do not fit usable {usable.shape}, "
            f"normals {normals.shape} and {len(directions)} directions"
        )
    pixels = rows * columns
    reflectance = np.zeros((pixels, channels), dtype=np.float32)
    used = np.zeros(pixels, dtype=np.uint16)
    geometry = Geometry(
        np.ascontiguousarray(directions, dtype=np.float32),
        np.ascontiguousarray(normals, dtype=np.float32).reshape(pixels, 3),
        np.ascontiguousarray(usable).reshape(lights, pixels),
        np.empty((0, 3), np.float32) if shading is None else np.ascontiguousarray(shading, np.float32).reshape(-1, 3),
    )
    observations = np.ascontiguousarray(observations, dtype=np.float32).reshape(lights, pixels, channels)
    over_rows(_accumulate, -(-pixels // BLOCK), observations, geometry, method == "mean", reflectance, used)
    return DiffuseReflectance(reflectance.reshape(rows, columns, channels), used.reshape(rows, columns))


def mean_of_channels(observations: np.ndarray) -> np.ndarray:
    """Mean (lights, rows, columns) float32 of observations (lights, rows, columns, channels) over the channels."""
    observations = np.ascontiguousarray(observations, dtype=np.float32)
    lights, rows, columns, channels = observations.shape
    out = np.empty((lights, rows * columns), np.float32)
    over_rows(_mean, lights, observations.reshape(lights, rows * columns, channels), out)
    return out.reshape(lights, rows, columns)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mean(begin, end, observations, out):
    _, pixels, channels = observations.shape
    for j in range(begin, end):
        values, mean = observations[j].reshape(-1), out[j]
        if channels == 3:  # a distance between neighbours that the compiler knows: SIMD code
            for p in range(pixels):
                mean[p] = (values[3 * p] + values[3 * p + 1] + values[3 * p + 2]) / np.float32(3)
        else:
            for p in range(pixels):
                total = values[channels * p]
                for k in range(1, channels):
                    total += values[channels * p + k]
                mean[p] = total / np.float32(channels)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _accumulate(begin, end, observations, geometry, mean, reflectance, used):
    """Sum a light at a time over BLOCK neighbouring pixels, in the order of the lights."""
    directions, normals, usable, shading = geometry
    lights, pixels, channels = observations.shape
    shaded = shading.shape[0] > 0
    for block in range(begin, end):
        start = block * BLOCK
        width = min(BLOCK, pixels - start)
        surface = np.zeros(6 * BLOCK, np.float32)  # x, y, z of the normals; a, b, d of the shading
        for p in range(width):
            for i in range(3):
                surface[i * BLOCK + p] = normals[start + p, i]
                if shaded:
                    surface[(3 + i) * BLOCK + p] = shading[start + p, i]
        factors = np.empty(BLOCK, np.float32)  # on the observation; 0: not used
        sums = np.zeros((2 + channels) * BLOCK, np.float32)  # weights, samples used, one sum a channel
        for j in range(lights):
            _factors(surface, directions[j], usable[j, start : start + width], shaded, mean, factors, sums)
            _add_channels(observations[j, start : start + width].reshape(-1), factors[:width], sums[2 * BLOCK :])
        for p in range(width):
            used[start + p] = np.uint16(sums[BLOCK + p])
            known = sums[BLOCK + p] > 0
            for k in range(channels):
                value = sums[(2 + k) * BLOCK + p] / (sums[p] if known else np.float32(1))
                reflectance[start + p, k] = value
                known = known and np.isfinite(value)
            if not known:
                for k in range(channels):
                    reflectance[start + p, k] = 0
                used[start + p] = 0


@numba.njit(cache=True, error_model="numpy")
def _factors(surface, direction, usable, shaded, mean, factors, sums):
    """Factor of one light's samples of a block; its weight and the count are added to the sums."""
    zero, one, floor = np.float32(0), np.float32(1), np.float32(COSINE_FLOOR)
    x, y, z = direction[0], direction[1], direction[2]
    per_half = one / np.sqrt(max(x * x + y * y + (z + one) * (z + one), np.float32(1e-12)))
    for p in range(len(usable)):
        nz = surface[2 * BLOCK + p]
        cosine = surface[p] * x + surface[BLOCK + p] * y + nz * z
        good = (usable[p] != 0) & (cosine > floor)
        if shaded:
            half = (cosine + nz) * per_half
            half = half if half > zero else zero
            x2 = half * half
            x4 = x2 * x2
            body = surface[3 * BLOCK + p] + surface[4 * BLOCK + p] * cosine + surface[5 * BLOCK + p] * (x4 * x4)
            cosine *= body if body > zero else zero
            good &= cosine > floor
        sums[p] += (one if mean else cosine * cosine) if good else zero
        sums[BLOCK + p] += one if good else zero
        factors[p] = (one / cosine if mean else cosine) if good else zero


@numba.njit(cache=True, error_model="numpy")
def _add_channels(values, factors, sums):
    """Add values (pixels * channels,) times their factors to the sums (channels * BLOCK,); a factor of 0: no sample."""
    zero = np.float32(0)
    channels = len(sums) // BLOCK
    if channels == 3:  # a distance between neighbours that the compiler knows: SIMD code
        for p in range(len(factors)):
            factor = factors[p]
            first, second, third = factor * values[3 * p], factor * values[3 * p + 1], factor * values[3 * p + 2]
            sums[p] += first if factor != zero else zero
            sums[BLOCK + p] += second if factor != zero else zero
            sums[2 * BLOCK + p] += third if factor != zero else zero
        return
    for p in range(len(factors)):
        if factors[p] != zero:
            for k in range(channels):
                sums[k * BLOCK + p] += factors[p] * values[channels * p + k]
