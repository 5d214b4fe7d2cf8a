"""From the pixels of a photograph to the mean of a window or of the regions in view, with what it is worth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from nishiki.goniometry.directions import unit

TILE = 4  # pixels: the noise of neighbours, and the texture of yarns, go together


@dataclass(frozen=True)
class WindowSample:
    """mean (channels,) float64 in the units of the pixels; noise (channels,): standard deviation of the mean; pixels:
    number that entered; saturated: share of the window's pixels."""

    mean: np.ndarray
    noise: np.ndarray
    pixels: int
    saturated: float


def read_window(linear: np.ndarray, usable: np.ndarray, saturated: np.ndarray) -> WindowSample:
    """Mean over the usable pixels of an image (rows, columns, channels) and its standard deviation.

    The scatter is that between tiles of TILE x TILE pixels, each weighted by its usable pixels: neighbours that vary
    together would otherwise pass for independent. Saturated pixels enter the mean; their share is told.
    """
    rows, columns, channels = linear.shape
    tile = (np.arange(rows) // TILE)[:, None] * (columns // TILE + 1) + np.arange(columns) // TILE
    chosen = usable.ravel()
    count = int(chosen.sum())
    if count == 0:
        return WindowSample(np.zeros(channels), np.zeros(channels), 0, 0.0)
    tile = tile.ravel()[chosen]
    values = linear.reshape(-1, channels)[chosen].astype(np.float64)
    share = np.bincount(tile) / count
    kept = share > 0
    sums = np.stack([np.bincount(tile, values[:, k])[kept] for k in range(channels)], axis=1)
    share = share[kept]
    mean = sums.sum(axis=0) / count
    tiles = len(share)
    if tiles > 1:
        scatter = ((sums / count - share[:, None] * mean) ** 2).sum(axis=0) * tiles / (tiles - 1)
    else:
        scatter = values.var(axis=0) / count
    return WindowSample(mean, np.sqrt(scatter), count, float(saturated.ravel()[chosen].mean()))


def central_window(shape: tuple[int, int], side: int) -> np.ndarray:
    """(rows, columns) bool: the square of this side in the middle."""
    inside = np.zeros(shape, bool)
    (top, height), (left, width) = (((n - min(n, side)) // 2, min(n, side)) for n in shape)
    inside[top : top + height, left : left + width] = True
    return inside


def axes_of(theta_r: float, phi_r: float, upright: str) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors to the right and up in a photograph taken from this direction (radians), in the cloth's frame.

    upright 'cloth': the warp (y) points up as far as it can; 'arm': the plane through normal and camera is vertical,
    the far side of the cloth on top, as on a camera arm before a turning table.
    """
    view = unit(theta_r, phi_r)
    if upright == "arm":
        up = -unit(theta_r + np.pi / 2, phi_r)
    else:
        up = np.array([0.0, 1.0, 0.0]) - view[1] * view
        up = up / np.linalg.norm(up)
    return np.cross(up, view), up


def regions_in_view(
    labels: np.ndarray,
    shape: tuple[int, int],
    *,
    theta_r: float,
    phi_r: float,
    upright: str,
    scale: float = 1.0,
) -> np.ndarray:
    """Labels (rows, columns) uint16 of a photograph of this shape taken from (theta_r, phi_r), by parallel projection.

    labels: of the cloth seen along its normal, warp up, its middle where the axes of the goniometer meet, in the
    middle of every photograph; scale: size of the photograph's pixel over that of the label picture's. A pixel has a
    label only where its centre and its corners, a whole pixel out, fall on that label: borders belong to none.
    """
    right, up = axes_of(theta_r, phi_r, upright)
    to_cloth = np.linalg.inv(np.array([right[:2], up[:2]]))  # (right, up) of the picture to (weft, warp) of the cloth
    projected = np.empty(shape, np.uint16)
    _project(np.ascontiguousarray(labels, np.uint16), scale * to_cloth, projected)
    return projected


@njit(cache=True, nogil=True, error_model="numpy")
def _project(labels, to_cloth, out):
    """Fill out (rows, columns) with the label that a pixel and its four corners fall on, 0 where they differ."""
    rows, columns = out.shape
    for row in range(rows):
        for column in range(columns):
            u, w = column - (columns - 1) / 2, (rows - 1) / 2 - row
            label = _label_at(labels, to_cloth, u, w)
            for across in (-1, 1):
                for up in (-1, 1):
                    if label != 0 and _label_at(labels, to_cloth, u + across, w + up) != label:
                        label = 0
            out[row, column] = label


@njit(cache=True, nogil=True, error_model="numpy")
def _label_at(labels, to_cloth, u, w):
    """Label at a place of the picture, in its pixels to the right and up from the middle; 0 outside the labels."""
    rows, columns = labels.shape
    row = np.floor((rows - 1) / 2 - (to_cloth[1, 0] * u + to_cloth[1, 1] * w) + 0.5)
    column = np.floor((columns - 1) / 2 + to_cloth[0, 0] * u + to_cloth[0, 1] * w + 0.5)
    if 0 <= row < rows and 0 <= column < columns:
        return np.int64(labels[int(row), int(column)])
    return np.int64(0)
