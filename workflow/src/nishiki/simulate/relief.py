"""The height of the object: canvas weave under paint, or a tray of sphere caps."""

from __future__ import annotations

import math

import numba
import numpy as np

THREAD_MM = 1.15  # distance of neighbouring threads
WEAVE_MM = 0.055  # height of a thread's crest over its trough
HIDING_MM = 0.20  # paint of this thickness hides the weave to 1/e


@numba.njit(cache=True, parallel=True)
def _weave_under_paint(paint, step, thread, amplitude, hiding, out):
    rows, columns = paint.shape
    for i in numba.prange(rows):
        y = (i + 0.5) * step / thread
        for j in range(columns):
            x = (j + 0.5) * step / thread
            # Plain weave: warp and weft pass over each other in turn; a soft maximum joins their crests.
            warp = abs(math.sin(math.pi * x)) * (0.5 + 0.5 * math.sin(math.pi * y) * math.cos(math.pi * math.floor(x)))
            weft = abs(math.sin(math.pi * y)) * (0.5 - 0.5 * math.sin(math.pi * x) * math.cos(math.pi * math.floor(y)))
            weave = math.log(math.exp(6.0 * warp) + math.exp(6.0 * weft)) / 6.0
            thick = float(paint[i, j])
            out[i, j] = np.float32(thick + amplitude * weave * math.exp(-thick / hiding))


def weave_under_paint(paint_mm: np.ndarray, *, step_mm: float, scale: float = 1.0) -> np.ndarray:
    """Height (rows, columns) float32 in mm of canvas with paint of the given thickness on it.

    step_mm : distance of neighbouring samples. scale : size of the threads, 1 = 1.15 mm apart.
    """
    out = np.empty_like(paint_mm, dtype=np.float32)
    _weave_under_paint(paint_mm, step_mm, THREAD_MM * scale, WEAVE_MM * scale, HIDING_MM * scale, out)
    return out


@numba.njit(cache=True, parallel=True)
def _smooth(height, out):
    rows, columns = height.shape
    for i in numba.prange(rows):
        up, down = max(i - 1, 0), min(i + 1, rows - 1)
        for j in range(columns):
            left, right = max(j - 1, 0), min(j + 1, columns - 1)
            sides = height[up, j] + height[down, j] + height[i, left] + height[i, right]
            corners = height[up, left] + height[up, right] + height[down, left] + height[down, right]
            out[i, j] = np.float32(0.25) * height[i, j] + np.float32(0.125) * sides + np.float32(0.0625) * corners


def level_out(height_mm: np.ndarray) -> np.ndarray:
    """One pass of the 3×3 binomial filter: wet paint and varnish round off what is finer than a sample."""
    out = np.empty_like(height_mm)
    _smooth(height_mm, out)
    return out


@numba.njit(cache=True)
def slopes_at(height, i, j, step):
    """Slopes (dh/dx to the right, dh/dy upwards) by central differences; one-sided at the edges."""
    rows, columns = height.shape
    up, down = max(i - 1, 0), min(i + 1, rows - 1)
    left, right = max(j - 1, 0), min(j + 1, columns - 1)
    slope_x = (float(height[i, right]) - float(height[i, left])) / ((right - left) * step)
    slope_y = (float(height[up, j]) - float(height[down, j])) / ((down - up) * step)
    return slope_x, slope_y


@numba.njit(cache=True, parallel=True)
def _pixel_maps(height, step, s, normals, mean, steepest):
    rows, columns = mean.shape
    for row in numba.prange(rows):
        for column in range(columns):
            total_x, total_y, total_z, total_h, steep = 0.0, 0.0, 0.0, 0.0, 0.0
            for i in range(row * s, row * s + s):
                for j in range(column * s, column * s + s):
                    p, q = slopes_at(height, i, j, step)
                    inverse = 1.0 / math.sqrt(1.0 + p * p + q * q)
                    total_x -= p * inverse
                    total_y -= q * inverse
                    total_z += inverse
                    total_h += float(height[i, j])
                    steep = max(steep, p * p + q * q)
            length = math.sqrt(total_x * total_x + total_y * total_y + total_z * total_z)
            normals[row, column, 0] = total_x / length
            normals[row, column, 1] = total_y / length
            normals[row, column, 2] = total_z / length
            mean[row, column] = total_h / (s * s)
            steepest[row, column] = math.atan(math.sqrt(steep))


def pixel_maps(height_mm: np.ndarray, *, step_mm: float, supersampling: int):
    """Area averages on camera pixels: normals (rows, columns, 3), height (rows, columns) mm, steepest slope in radians.

    The normal of a pixel is the normalised mean of the unit normals of its samples. All float32.
    """
    s = supersampling
    shape = (height_mm.shape[0] // s, height_mm.shape[1] // s)
    normals = np.empty((*shape, 3), np.float32)
    mean, steepest = np.empty(shape, np.float32), np.empty(shape, np.float32)
    _pixel_maps(height_mm, step_mm, s, normals, mean, steepest)
    return normals, mean, steepest
