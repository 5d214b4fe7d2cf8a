"""Slopes inside a pixel, as the normals of its neighbours tell them: what blurs the gloss of a relief.

A pixel shows the mean of its facets' gloss, not the gloss of their mean. Where the normals change from pixel to pixel
they change inside the pixel too. A Gaussian lobe over Gaussian slopes is a wider Gaussian lobe, so that the mean has a
closed form (Toksvig 2005; Olano and Baker 2010): the lobe's variance plus the covariance of the slopes.
"""

import numpy as np

STEEPEST = 0.2  # least n_z from which a slope is formed


def slopes_of(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slopes (rows, columns, 2) float32, n_x / n_z and n_y / n_z, and where they are known, (rows, columns) bool.

    normals : (rows, columns, 3) float, unit vectors; others are unknown.
    """
    normals = np.asarray(normals, np.float32)
    known = np.abs(np.einsum("rck,rck->rc", normals, normals) - 1) < 0.02
    return normals[..., :2] / np.maximum(normals[..., 2:], np.float32(STEEPEST)), known


def slope_covariance(normals: np.ndarray) -> np.ndarray:
    """Covariance of the slopes within each pixel, for normals that change linearly between the pixels' centres.

    Parameters
    ----------
    normals : (rows, columns, 3) float, unit vectors; others (unknown) tell nothing of their neighbours.

    Returns
    -------
    (rows, columns, 3) float32: variance along x, covariance, variance along y of (n_x / n_z, n_y / n_z). Along each
    axis of the picture the slope runs from half way to one neighbour to half way to the other: with the differences a
    and b to them, (a^2 + b^2) / 24.
    """
    slopes, known = slopes_of(normals)
    covariance = np.zeros((*known.shape, 3), np.float32)
    pairs = (((slice(None, -1),), (slice(1, None),)), ((slice(None), slice(None, -1)), (slice(None), slice(1, None))))
    for first, second in pairs:  # neighbours down, then across
        step = (slopes[second] - slopes[first]) * (known[first] & known[second])[..., None]
        squares = products(step) / 24
        covariance[first] += squares
        covariance[second] += squares
    return covariance


def products(slopes: np.ndarray) -> np.ndarray:
    """(..., 3): xx, xy, yy of slopes (..., 2)."""
    x, y = slopes[..., 0], slopes[..., 1]
    return np.stack([x * x, x * y, y * y], axis=-1)
