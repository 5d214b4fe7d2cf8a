"""From the pixels of a photograph to the mean of a window or of the regions in view, with what it is worth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nishiki.goniometry.directions import unit

TILE = 4  # pixels: the noise of neighbours, and the texture of yarns, go together


@dataclass(frozen=True)
class Reading:
    """mean (channels,) float64 in the units of the pixels; noise (channels,): standard deviation of the mean; pixels:
    number that entered; saturated: share of the window's pixels."""

    mean: np.ndarray
    noise: np.ndarray
    pixels: int
    saturated: float


def read_window(linear: np.ndarray, usable: np.ndarray, saturated: np.ndarray) -> Reading:
    """Mean over the usable pixels of an image (rows, columns, channels) and its standard deviation.

    The scatter is that between tiles of TILE x TILE pixels, each weighted by its usable pixels: neighbours that vary
    together would otherwise pass for independent. Saturated pixels enter the mean; their share is told.
    """
    rows, columns, channels = linear.shape
    tile = (np.arange(rows) // TILE)[:, None] * (columns // TILE + 1) + np.arange(columns) // TILE
    chosen = usable.ravel()
    count = int(chosen.sum())
    if count == 0:
        return Reading(np.zeros(channels), np.zeros(channels), 0, 0.0)
    _, tile = np.unique(tile.ravel()[chosen], return_inverse=True)
    values = linear.reshape(-1, channels)[chosen].astype(np.float64)
    share = np.bincount(tile) / count
    sums = np.stack([np.bincount(tile, values[:, k]) for k in range(channels)], axis=1)
    mean = sums.sum(axis=0) / count
    tiles = len(share)
    if tiles > 1:
        scatter = ((sums / count - share[:, None] * mean) ** 2).sum(axis=0) * tiles / (tiles - 1)
    else:
        scatter = values.var(axis=0) / count
    return Reading(mean, np.sqrt(scatter), count, float(saturated.ravel()[chosen].mean()))


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
    rows, columns = (np.arange(n) - (n - 1) / 2 for n in shape)
    found = None
    for down, across in ((0, 0), (-1, -1), (-1, 1), (1, -1), (1, 1)):
        u, w = np.meshgrid(columns + across, -(rows + down))
        x, y = (scale * (to_cloth[k, 0] * u + to_cloth[k, 1] * w) for k in (0, 1))
        row = np.rint((labels.shape[0] - 1) / 2 - y).astype(np.int64)
        column = np.rint((labels.shape[1] - 1) / 2 + x).astype(np.int64)
        inside = (row >= 0) & (row < labels.shape[0]) & (column >= 0) & (column < labels.shape[1])
        here = np.where(inside, labels[np.where(inside, row, 0), np.where(inside, column, 0)], 0)
        found = here if found is None else np.where(found == here, found, 0)
    return found.astype(np.uint16)
