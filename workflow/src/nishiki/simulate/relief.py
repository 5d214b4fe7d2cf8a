"""The height of the object: canvas weave under paint, or a tray of sphere caps."""

from __future__ import annotations

import numba
import numpy as np

THREAD_MM = 1.15  # distance of neighbouring threads
WEAVE_MM = 0.055  # height of a thread's crest over its trough
HIDING_MM = 0.20  # paint of this thickness hides the weave to 1/e
_BAND = 256  # rows at a time, for the memory of the intermediate arrays


def weave_under_paint(paint_mm: np.ndarray, *, step_mm: float, scale: float = 1.0) -> np.ndarray:
    """Height (rows, columns) float32 in mm of canvas with paint of the given thickness on it.

    step_mm : distance of neighbouring samples. scale : size of the threads, 1 = 1.15 mm apart. Plain weave: warp and
    weft pass over each other in turn; a soft maximum joins their crests.
    """
    out = np.empty(paint_mm.shape, np.float32)
    x = (np.arange(paint_mm.shape[1]) + 0.5)[None, :] * step_mm / (THREAD_MM * scale)
    along, sign_x = np.sin(np.pi * x), np.cos(np.pi * np.floor(x))
    for start in range(0, len(out), _BAND):
        band = slice(start, start + _BAND)
        y = (np.arange(len(out))[band] + 0.5)[:, None] * step_mm / (THREAD_MM * scale)
        across, sign_y = np.sin(np.pi * y), np.cos(np.pi * np.floor(y))
        warp = np.abs(along) * (0.5 + 0.5 * across * sign_x)
        weft = np.abs(across) * (0.5 - 0.5 * along * sign_y)
        weave = np.logaddexp(6.0 * warp, 6.0 * weft) / 6.0
        out[band] = paint_mm[band] + WEAVE_MM * scale * weave * np.exp(-paint_mm[band] / (HIDING_MM * scale))
    return out


def level_out(height_mm: np.ndarray) -> np.ndarray:
    """One pass of the 3×3 binomial filter: wet paint and varnish round off what is finer than a sample."""
    out = np.empty_like(height_mm)
    quarter, half = np.float32(0.25), np.float32(0.5)
    for start in range(0, len(out), _BAND):
        stop = min(start + _BAND, len(out))
        rows = np.clip(np.arange(start - 1, stop + 1), 0, len(out) - 1)
        part = height_mm[rows]
        part = half * part[1:-1] + quarter * (part[:-2] + part[2:])
        part = np.pad(part, ((0, 0), (1, 1)), mode="edge")
        out[start:stop] = half * part[:, 1:-1] + quarter * (part[:, :-2] + part[:, 2:])
    return out


@numba.njit(cache=True)
def slopes_at(height, i, j, step):
    """Slopes (dh/dx to the right, dh/dy upwards) by central differences; one-sided at the edges."""
    rows, columns = height.shape
    up, down = max(i - 1, 0), min(i + 1, rows - 1)
    left, right = max(j - 1, 0), min(j + 1, columns - 1)
    slope_x = (np.float64(height[i, right]) - np.float64(height[i, left])) / ((right - left) * step)
    slope_y = (np.float64(height[up, j]) - np.float64(height[down, j])) / ((down - up) * step)
    return slope_x, slope_y


def slopes_of_rows(height_mm: np.ndarray, start: int, stop: int, step_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Slopes of rows start..stop as `slopes_at` gives them, float64, for whole rows at once."""
    count = len(height_mm)
    rows = np.arange(start, stop)
    up, down = np.maximum(rows - 1, 0), np.minimum(rows + 1, count - 1)
    slope_y = (height_mm[up].astype(float) - height_mm[down]) / ((down - up) * step_mm)[:, None]
    slope_x = np.gradient(height_mm[start:stop].astype(float), step_mm, axis=1)
    return slope_x, slope_y


def pixel_maps(height_mm: np.ndarray, *, step_mm: float, supersampling: int):
    """Area averages on camera pixels: normals (rows, columns, 3), height (rows, columns) mm, steepest slope in radians.

    The normal of a pixel is the normalised mean of the unit normals of its samples. All float32.
    """
    s = supersampling
    rows, columns = height_mm.shape[0] // s, height_mm.shape[1] // s
    normals = np.empty((rows, columns, 3), np.float32)
    mean, steepest = np.empty((rows, columns), np.float32), np.empty((rows, columns), np.float32)
    for start in range(0, rows, _BAND):
        stop = min(start + _BAND, rows)
        blocks = (stop - start, s, columns, s)
        p, q = slopes_of_rows(height_mm, start * s, stop * s, step_mm)
        square = p * p + q * q
        inverse = 1.0 / np.sqrt(1.0 + square)
        total = np.stack([(v * inverse).reshape(blocks).mean(axis=(1, 3)) for v in (-p, -q, np.ones_like(p))], axis=-1)
        normals[start:stop] = total / np.linalg.norm(total, axis=-1, keepdims=True)
        mean[start:stop] = height_mm[start * s : stop * s].reshape(blocks).mean(axis=(1, 3), dtype=float)
        steepest[start:stop] = np.arctan(np.sqrt(square.reshape(blocks).max(axis=(1, 3))))
    return normals, mean, steepest
