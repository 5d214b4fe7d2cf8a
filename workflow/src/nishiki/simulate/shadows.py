"""Cast shadows of a height field under a lamp of finite size."""

import math

import numba
import numpy as np

from nishiki.threads import over_rows


@numba.njit(cache=True)
def height_between(height, y, x):
    """Bilinear height at fractional sample coordinates inside the field."""
    i, j = int(y), int(x)
    i, j = min(i, height.shape[0] - 2), min(j, height.shape[1] - 2)
    fy, fx = y - i, x - j
    top = np.float64(height[i, j]) * (1.0 - fx) + np.float64(height[i, j + 1]) * fx
    bottom = np.float64(height[i + 1, j]) * (1.0 - fx) + np.float64(height[i + 1, j + 1]) * fx
    return top * (1.0 - fy) + bottom * fy


@numba.njit(cache=True)
def horizon_slope(height, i, j, ux, uy, step, ceiling, least):
    """Largest slope (rise over run) under which sample (i, j) sees the field towards (ux, uy), at least `least`.

    ux, uy : unit direction on the picture, x right, y up. step : mm between samples. ceiling : highest point of the
    field, mm. The march takes one sample distance a step and stops where even the highest point could not rise above
    the slope found so far.
    """
    start = np.float64(height[i, j])
    best = least
    y, x, run = np.float64(i), np.float64(j), 0.0
    last_row, last_column = height.shape[0] - 1.0, height.shape[1] - 1.0
    while True:
        y -= uy
        x += ux
        run += step
        if y < 0.0 or x < 0.0 or y > last_row or x > last_column or ceiling - start <= best * run:
            return best
        slope = (height_between(height, y, x) - start) / run
        if slope > best:
            best = slope


@numba.njit(cache=True)
def lit_share(elevation, horizon, radius):
    """Share of a lamp's disc (angular radius, centre at `elevation`) above a straight edge at `horizon`, radians."""
    if radius <= 0.0:
        return 1.0 if elevation > horizon else 0.0
    z = (elevation - horizon) / radius
    if z >= 1.0:
        return 1.0
    if z <= -1.0:
        return 0.0
    return 0.5 + (math.asin(z) + z * math.sqrt(1.0 - z * z)) / math.pi


@numba.njit(cache=True)
def visible_share(height, i, j, lx, ly, lz, step, ceiling, radius):
    """Share of the lamp that sample (i, j) sees past the relief; (lx, ly, lz) is the unit direction to its centre."""
    flat = math.sqrt(lx * lx + ly * ly)
    elevation = math.atan2(lz, flat)
    if flat < 1e-9 or elevation - radius >= 1.5:
        return 1.0
    least = math.tan(max(elevation - radius, 0.0))  # relief below the lamp's lower rim hides nothing
    slope = horizon_slope(height, i, j, lx / flat, ly / flat, step, ceiling, least)
    if slope <= least:
        return 1.0 if elevation > radius else lit_share(elevation, 0.0, radius)
    return lit_share(elevation, math.atan(slope), radius)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _shadow_map(start, stop, height, light, step, ceiling, radius, out):
    for i in range(start, stop):
        for j in range(height.shape[1]):
            out[i, j] = visible_share(height, i, j, light[0], light[1], light[2], step, ceiling, radius)


def shadow_map(height_mm: np.ndarray, light: np.ndarray, *, step_mm: float, angular_radius: float) -> np.ndarray:
    """Share (rows, columns) float32 of a distant lamp that each sample sees past the relief, self-shadow apart."""
    out = np.empty(height_mm.shape, np.float32)
    light = np.asarray(light, float)
    over_rows(_shadow_map, len(out), height_mm, light, step_mm, float(height_mm.max()), angular_radius, out)
    return out
