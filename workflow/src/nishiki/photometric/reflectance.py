"""Diffuse reflectance of each channel, from the selected lights and the known normals."""

from dataclasses import dataclass

import numpy as np

from nishiki.errors import UserError
from nishiki.threads import over_rows

PIXELS = 4096  # at a time
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
    terms = None if shading is None else np.asarray(shading, np.float32).reshape(pixels, 3)
    usable = usable.reshape(lights, pixels)
    observations = np.asarray(observations, np.float32).reshape(lights, pixels, channels)

    def fit(begin: int, end: int, observations: np.ndarray) -> None:
        """Add up a light at a time, in the order of the lights."""
        for first in range(begin, end, PIXELS):
            here = slice(first, min(first + PIXELS, end))
            sums, weights, count = np.zeros((channels, here.stop - first), np.float32), np.float32(0), 0
            for j, direction in enumerate(directions):
                body = _body(normals[here].T, None if terms is None else terms[here].T, direction)
                good = usable[j, here] & (body > COSINE_FLOOR)
                body = np.where(good, body, np.float32(1))
                factor = np.where(good, 1 / body if method == "mean" else body, np.float32(0))
                weights = weights + factor * body
                count = count + good
                for k in range(channels):
                    sums[k] += np.where(good, observations[j, here, k], np.float32(0)) * factor
            values = (sums / np.where(weights > 0, weights, np.float32(1))).T
            known = np.logical_and(weights > 0, np.isfinite(values).all(axis=1))
            reflectance[here], used[here] = np.where(known[:, None], values, np.float32(0)), np.where(known, count, 0)

    with np.errstate(over="ignore", invalid="ignore"):
        over_rows(fit, pixels, observations)
    return DiffuseReflectance(reflectance.reshape(rows, columns, channels), used.reshape(rows, columns))


def _body(normals: np.ndarray, terms: np.ndarray | None, direction: np.ndarray) -> np.ndarray:
    """Body shading (pixels,) under a light from `direction` (3,): cosine, times the factor of terms (3, pixels)."""
    cosine = sum(part * along for part, along in zip(normals, direction, strict=True))
    if terms is None:
        return cosine
    half = np.maximum(cosine + normals[2], 0) / np.sqrt(np.maximum(2 + 2 * direction[2], np.float32(1e-12)))
    factor = terms[0] + terms[1] * cosine + terms[2] * half**8
    return np.where(cosine > COSINE_FLOOR, cosine * np.maximum(factor, 0), np.float32(0))


def mean_of_channels(observations: np.ndarray) -> np.ndarray:
    """Mean (lights, rows, columns) float32 of observations (lights, rows, columns, channels) over the channels."""
    observations = np.asarray(observations, dtype=np.float32)
    total = sum(observations[..., k] for k in range(observations.shape[-1]))
    return np.asarray(total / np.float32(observations.shape[-1]))
