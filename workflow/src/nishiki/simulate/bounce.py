"""One bounce of diffuse light between parts of the relief."""

import math

import numba
import numpy as np

from nishiki.threads import over_rows

DIRECTIONS = 16
REACH_PIXELS = 8


def _neighbours(pitch: float) -> tuple[np.ndarray, np.ndarray]:
    """Row and column offsets (directions, rings, 2) and, likewise, distance mm and area on the plane over π, mm²."""
    ring = np.arange(1, REACH_PIXELS + 1)
    turn = 2.0 * math.pi / DIRECTIONS
    angle = turn * (np.arange(DIRECTIONS)[:, None] + 0.5)
    offsets = np.floor(np.stack([-ring * np.sin(angle), ring * np.cos(angle)], axis=-1) + 0.5).astype(np.int64)
    run = pitch * np.hypot(offsets[..., 0], offsets[..., 1])
    # The area of a ring's sector about the rounded place: r · Δφ · Δr.
    area = np.broadcast_to(ring * turn * pitch * pitch, run.shape) / math.pi
    return offsets, np.stack([run, area], axis=-1)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _gather(start, stop, height, slope_x, slope_y, irradiance, pitch, offsets, sizes, out):
    rows, columns = height.shape
    for i in range(start, stop):
        for j in range(columns):
            p, q, here = slope_x[i, j] * pitch, slope_y[i, j] * pitch, np.float64(height[i, j])
            total = 0.0
            for direction in range(offsets.shape[0]):
                horizon = -1e30
                for ring in range(offsets.shape[1]):
                    down, right = offsets[direction, ring, 0], offsets[direction, ring, 1]
                    row, column = i + down, j + right
                    if row < 0 or column < 0 or row >= rows or column >= columns:
                        break
                    run = sizes[direction, ring, 0]
                    rise = np.float64(height[row, column]) - here
                    if rise <= horizon * run:
                        continue  # hidden behind something nearer
                    horizon = rise / run
                    arriving = rise - p * right + q * down
                    if arriving <= 0.0:
                        continue  # below the own tangent plane
                    # cosθ cosθ′ dA/(π r²): the area on the plane over n_z′ cancels the length of the other normal.
                    leaving = (slope_x[row, column] * right - slope_y[row, column] * down) * pitch - rise
                    if leaving > 0.0:
                        square = run * run + rise * rise
                        total += (
                            irradiance[row, column] * arriving * leaving * sizes[direction, ring, 1] / (square * square)
                        )
            out[i, j] = total / math.sqrt(1.0 + slope_x[i, j] ** 2 + slope_y[i, j] ** 2)


def bounced_irradiance(
    irradiance: np.ndarray, height_mm: np.ndarray, slope_x: np.ndarray, slope_y: np.ndarray, *, pitch_mm: float
) -> np.ndarray:
    """Irradiance (rows, columns) float32 that reaches each pixel from its surroundings if those were perfectly white.

    A quadrature of the one-bounce integral on camera pixels: 16 directions, 8 rings, with occlusion by whatever rises
    higher on the way. irradiance : direct, any scale. slope_x, slope_y : dh/dx to the right and dh/dy upwards.
    Relief finer than a pixel, farther than 8 pixels, and further bounces are left out.
    """
    out = np.empty(irradiance.shape, np.float32)
    offsets, sizes = _neighbours(pitch_mm)
    over_rows(_gather, len(out), height_mm, slope_x, slope_y, irradiance, pitch_mm, offsets, sizes, out)
    return out
