"""Slopes inside a pixel, as the normals of its neighbours tell them: what blurs the gloss of a relief.

A pixel shows the mean of its facets' gloss, not the gloss of their mean. Where the normals change from pixel to pixel
they change inside the pixel too. A Gaussian lobe over Gaussian slopes is a wider Gaussian lobe, so that the mean has a
closed form (Toksvig 2005; Olano and Baker 2010): the lobe's variance plus the covariance of the slopes.
"""

import numpy as np

STEEPEST = 0.2  # least n_z from which a slope is formed


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
    normals = np.asarray(normals, np.float32)
    known = np.abs(np.einsum("rck,rck->rc", normals, normals) - 1) < 0.02
    slopes = normals[..., :2] / np.maximum(normals[..., 2:], np.float32(STEEPEST))
    covariance = np.zeros(normals.shape, np.float32)
    pairs = (((slice(None, -1),), (slice(1, None),)), ((slice(None), slice(None, -1)), (slice(None), slice(1, None))))
    for first, second in pairs:  # neighbours down, then across
        step = (slopes[second] - slopes[first]) * (known[first] & known[second])[..., None]
        squares = np.stack([step[..., 0] ** 2, step[..., 0] * step[..., 1], step[..., 1] ** 2], axis=-1) / 24
        covariance[first] += squares
        covariance[second] += squares
    return covariance
