"""Diffuse reflectance of each channel, from the selected lights and the known normals."""

from dataclasses import dataclass

import numba
import numpy as np

from nishiki.brdf.body_shading import body_factor_scalar
from nishiki.errors import UserError

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
    `nishiki.brdf.body_shading`.

    method, with the shading s = cos f
        "least_squares": sum(I s) / sum(s^2), the maximum-likelihood weight for equal noise in all lights.
        "mean": mean of I / s over the selected lights (P eq. 6), which lets grazing lights weigh most.

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
    _accumulate(
        np.ascontiguousarray(observations, dtype=np.float32).reshape(lights, pixels, channels),
        np.ascontiguousarray(directions, dtype=np.float32),
        np.ascontiguousarray(normals, dtype=np.float32).reshape(pixels, 3),
        np.ascontiguousarray(usable).reshape(lights, pixels),
        np.empty((0, 3), np.float32) if shading is None else np.ascontiguousarray(shading, np.float32).reshape(-1, 3),
        method == "mean",
        reflectance,
        used,
    )
    return DiffuseReflectance(reflectance.reshape(rows, columns, channels), used.reshape(rows, columns))


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _accumulate(observations, directions, normals, usable, shading, mean, reflectance, used):
    lights, pixels, channels = observations.shape
    block = 1024
    for start in numba.prange((pixels + block - 1) // block):
        first, last = start * block, min((start + 1) * block, pixels)
        weight = np.zeros(block, dtype=np.float32)
        for j in range(lights):
            x, y, z = directions[j]
            per_half = np.float32(1) / np.sqrt(max(x * x + y * y + (z + 1) * (z + 1), np.float32(1e-12)))
            for p in range(first, last):
                cosine = normals[p, 0] * x + normals[p, 1] * y + normals[p, 2] * z
                if usable[j, p] and cosine > COSINE_FLOOR:
                    if shading.shape[0] > 0:
                        half = max((cosine + normals[p, 2]) * per_half, np.float32(0))
                        cosine *= body_factor_scalar(shading[p, 0], shading[p, 1], shading[p, 2], cosine, half)
                        if not cosine > COSINE_FLOOR:
                            continue
                    factor = np.float32(1) / cosine if mean else cosine
                    weight[p - first] += np.float32(1) if mean else cosine * cosine
                    used[p] += 1
                    for k in range(channels):
                        reflectance[p, k] += factor * observations[j, p, k]
        for p in range(first, last):
            known = used[p] > 0
            for k in range(channels):
                reflectance[p, k] /= weight[p - first] if known else np.float32(1)
                known = known and np.isfinite(reflectance[p, k])
            if not known:
                reflectance[p, :] = 0
                used[p] = 0
