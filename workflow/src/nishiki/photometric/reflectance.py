"""Diffuse reflectance of each channel, from the selected lights and the known normals."""

from dataclasses import dataclass

import numpy as np
from numba import njit

from nishiki.errors import UserError
from nishiki.threads import over_rows

COSINE_FLOOR = 0.02
"""Samples lit at a smaller cosine carry no usable signal and divide by almost nothing: they are left out."""


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
    reflectance, used = np.zeros((pixels, channels), np.float32), np.zeros(pixels, np.uint16)
    directions, normals = np.asarray(directions, np.float32), np.asarray(normals, np.float32).reshape(pixels, 3)
    terms = np.zeros((0, 3)) if shading is None else np.reshape(shading, (pixels, 3))
    samples = np.asarray(observations, np.float32).reshape(lights, pixels, channels), usable.reshape(lights, pixels)
    surface = np.ascontiguousarray(normals), np.ascontiguousarray(terms, np.float32)
    over_rows(_fit, pixels, samples, directions, surface, method == "mean", (reflectance, used))
    return DiffuseReflectance(reflectance.reshape(rows, columns, channels), used.reshape(rows, columns))


@njit(cache=True, nogil=True, error_model="numpy")
def _fit(begin, end, samples, directions, surface, mean, out):
    """Add up the lights of each pixel in their order; terms (pixels, 3), or none of them for Lambert's law."""
    (observations, usable), (normals, terms), (reflectance, used) = samples, surface, out
    sums, one = np.empty(observations.shape[2], np.float32), np.float32(1)
    for p in range(begin, end):
        weights, count, known = np.float32(0), 0, True
        sums[:] = np.float32(0)
        for j in range(len(directions)):
            x, y, z = directions[j, 0], directions[j, 1], directions[j, 2]
            body = normals[p, 0] * x + normals[p, 1] * y + normals[p, 2] * z
            if not (usable[j, p] and body > COSINE_FLOOR):
                continue
            if len(terms):
                half = (body + normals[p, 2]) / np.sqrt(max(np.float32(2) + np.float32(2) * z, np.float32(1e-12)))
                power = max(half, np.float32(0)) ** 2
                factor = terms[p, 0] + terms[p, 1] * body + terms[p, 2] * (power * power) ** 2
                body *= max(factor, np.float32(0))
                if not body > COSINE_FLOOR:
                    continue
            factor = one / body if mean else body
            weights += factor * body
            count += 1
            for k in range(sums.size):
                sums[k] += observations[j, p, k] * factor
        for k in range(sums.size):
            known = known and weights > 0 and np.isfinite(sums[k] / weights)
        if known:
            reflectance[p], used[p] = sums / weights, count


def mean_of_channels(observations: np.ndarray) -> np.ndarray:
    """Mean (lights, rows, columns) float32 of observations (lights, rows, columns, channels) over the channels."""
    observations = np.asarray(observations, dtype=np.float32)
    total = sum(observations[..., k] for k in range(observations.shape[-1]))
    return np.asarray(total / np.float32(observations.shape[-1]))
