"""Bands of rows: the tiles in which a plane is read, and those that hold nothing of the object."""

import numpy as np


def rows_of_band(lights: int, rows: int, columns: int, channels: int, tile_mib: int) -> int:
    """Rows of a band whose float32 observations fit into tile_mib MiB: a multiple of 8, at least 8."""
    fit = (tile_mib << 20) // max(1, lights * columns * channels * 4)
    return int(min(max(8, fit // 8 * 8), -(-rows // 8) * 8))


def bands_with_object(mask: np.ndarray, band_rows: int) -> tuple[int, ...]:
    """Numbers of the bands in which the mask (rows, columns) has a pixel; the others are neither kept nor read."""
    starts = range(0, len(mask), band_rows)
    return tuple(number for number, start in enumerate(starts) if mask[start : start + band_rows].any())
