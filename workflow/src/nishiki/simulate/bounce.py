"""One bounce of diffuse light between parts of the relief."""

import math

import numba
import numpy as np

DIRECTIONS = 8
REACH_PIXELS = 8


@numba.njit(cache=True, parallel=True)
def _gather(height, slope_x, slope_y, irradiance, pitch, out):
    rows, columns = height.shape
    turn = 2.0 * math.pi / DIRECTIONS
    for i in numba.prange(rows):
        for j in range(columns):
            p, q = float(slope_x[i, j]), float(slope_y[i, j])
            inverse = 1.0 / math.sqrt(1.0 + p * p + q * q)
            here = float(height[i, j])
            total = 0.0
            for direction in range(DIRECTIONS):
                ux, uy = math.cos(turn * (direction + 0.5)), math.sin(turn * (direction + 0.5))
                horizon = p * ux + q * uy  # what lies below the own tangent plane is behind the surface
                for ring in range(1, REACH_PIXELS + 1):
                    row, column = math.floor(i - ring * uy + 0.5), math.floor(j + ring * ux + 0.5)
                    if row < 0 or column < 0 or row >= rows or column >= columns:
                        break
                    dx, dy = (column - j) * pitch, (i - row) * pitch
                    run = math.sqrt(dx * dx + dy * dy)
                    rise = float(height[row, column]) - here
                    if rise <= horizon * run:
                        continue
                    horizon = rise / run
                    p2, q2 = float(slope_x[row, column]), float(slope_y[row, column])
                    # cos·cos′·dA/(π r²); the area on the plane over n_z′ = √(1+p²+q²) cancels the length of n′.
                    leaving = p2 * dx + q2 * dy - rise
                    arriving = (rise - p * dx - q * dy) * inverse
                    if leaving <= 0.0 or arriving <= 0.0:
                        continue
                    square = run * run + rise * rise
                    area = ring * turn * pitch * pitch
                    total += float(irradiance[row, column]) * arriving * leaving * area / (math.pi * square * square)
            out[i, j] = total


def bounced_irradiance(
    irradiance: np.ndarray, height_mm: np.ndarray, slope_x: np.ndarray, slope_y: np.ndarray, *, pitch_mm: float
) -> np.ndarray:
    """Irradiance (rows, columns) float32 that reaches each pixel from its surroundings if those were perfectly white.

    A quadrature of the one-bounce integral on camera pixels: 8 directions, 8 rings, with occlusion by whatever rises
    higher on the way. irradiance : direct, any scale. slope_x, slope_y : dh/dx to the right and dh/dy upwards.
    Relief finer than a pixel, farther than 8 pixels, and further bounces are left out.
    """
    out = np.empty(irradiance.shape, np.float32)
    _gather(height_mm, slope_x, slope_y, irradiance, pitch_mm, out)
    return out
