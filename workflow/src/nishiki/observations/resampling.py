"""Codes of photographs changed so that they stay codes: moved, or without the light of the room."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nishiki.formats.images import Region
from nishiki.observations.linearise import straight_scale

FINE_CODES = 1 << 16  # steps of linear light in a table from light to 8-bit codes: 20 of the smallest sRGB step
ROWS = 256  # that are computed at a time
MOST_CHANNELS = 4  # that OpenCV resamples at a time
REACH = 4  # pixels, of the kernel of Lanczos


def region_behind(matrix: np.ndarray, region: Region, rows: int, columns: int) -> Region:
    """The part of a photograph of these rows and columns that a region needs after it is moved by matrix (2, 3)."""
    row, column, height, width = region
    corners = matrix[:, :2] @ np.array([[0, width, 0, width], [0, 0, height, height]]) + matrix[:, 2:]
    reach = REACH + 1  # and of the mark around saturated pixels, which is interpolated
    low = np.floor(corners.min(axis=1)).astype(int) - reach + (column, row)
    high = np.ceil(corners.max(axis=1)).astype(int) + reach + (column, row)
    left, top = np.clip(low, 0, (columns - 1, rows - 1))
    right, bottom = np.clip(high, (left + 1, top + 1), (columns, rows))
    return int(top), int(left), int(bottom - top), int(right - left)


def move_codes(
    codes: np.ndarray, matrix: np.ndarray, shape: Sequence[int], saturated: np.number, clip: np.number
) -> np.ndarray:
    """Resample codes (rows, columns, channels) to the place that they have in the first photograph, by Lanczos' kernel.

    Parameters
    ----------
    codes : (rows, columns, channels) uint8, uint16 or float32
    matrix : (2, 3) float64
        Column and row in `codes` of a column and row of the result.
    shape : sequence of int
        Rows and columns of the result.
    saturated, clip : numpy.number
        Codes from which, and up to which, a sample is unusable.

    Returns
    -------
    (*shape, channels) of the same type
        A pixel is saturated in all channels where one within the reach of the kernel is so in any, and at `clip` in all
        where the nearest one is, or none: what must not be used before may not be used after.
    """
    import cv2

    size = (int(shape[1]), int(shape[0]))

    def warp(picture: np.ndarray, method: int, border: int = cv2.BORDER_REPLICATE) -> np.ndarray:
        flags = method | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(picture, matrix, size, flags=flags, borderMode=border, borderValue=1)

    hot = (codes >= saturated).any(axis=2).astype(np.uint8)
    cold = (codes <= clip).all(axis=2).astype(np.uint8)
    parts = [codes[:, :, k : k + MOST_CHANNELS] for k in range(0, codes.shape[2], MOST_CHANNELS)]
    warped = (warp(np.ascontiguousarray(part), cv2.INTER_LANCZOS4) for part in parts)
    moved = np.concatenate([part.reshape(*size[::-1], -1) for part in warped], axis=2)
    if hot.any():
        reach = warp(cv2.dilate(hot, np.ones((2 * REACH - 1,) * 2, np.uint8)) * np.uint8(255), cv2.INTER_LINEAR)
        moved[reach > 0] = saturated
    moved[warp(cold, cv2.INTER_NEAREST, cv2.BORDER_CONSTANT) > 0] = clip
    return moved


def subtract_light(codes: np.ndarray, light: np.ndarray, table: np.ndarray, saturated: np.number) -> np.ndarray:
    """Subtract linear light (rows, columns, channels), a fraction of full scale, from codes of the same shape.

    table: linear value by code, rising; two zeros for float codes. Saturated codes stay as they are. What would be
    negative becomes code 0, which tells only that there was no more light than that.
    """
    if codes.dtype.kind == "f":
        return np.where(codes >= saturated, codes, np.maximum(codes - light, 0)).astype(codes.dtype)
    out, middles = np.empty_like(codes), (table[1:] + table[:-1]) / 2
    coded = np.searchsorted(middles, np.linspace(0, table[-1], FINE_CODES)) if len(table) < FINE_CODES else None
    scale = straight_scale(table, codes.dtype)
    for top in range(0, len(codes), ROWS):
        part = codes[top : top + ROWS]
        linear = np.clip(table[part] - light[top : top + ROWS], 0, table[-1])
        if coded is not None:
            fresh = coded[np.rint(linear * ((FINE_CODES - 1) / table[-1])).astype(np.int64)]
        else:
            fresh = np.rint(linear / scale) if scale > 0 else np.searchsorted(middles, linear)
        out[top : top + ROWS] = np.where(part >= saturated, part, fresh.astype(codes.dtype))
    return out
