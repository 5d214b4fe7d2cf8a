"""What a measurement counts: the solid angle of its view's cell, and how far a model is expected to miss it."""

import numpy as np

POINTS = 6000  # of the hemisphere whose nearest views are counted


def solid_angles(outgoing: np.ndarray, *, quarter: bool = False, points: int = POINTS) -> np.ndarray:
    """(n,) solid angle of the cell of each view (n, 3): the part of the hemisphere that is nearer to it than to others.

    By counting evenly spread points (a Fibonacci lattice), so good to 2 pi / points; a cell has at least half a point.
    quarter: views stand for their mirror images in the planes x = 0 and y = 0 too, as under normal incidence.
    Directions measured several times share their cell.
    """
    from scipy.spatial import cKDTree

    k = np.arange(points) + 0.5
    z, phi = 1 - k / points, k * (np.pi * (3 - np.sqrt(5)))
    r = np.sqrt(1 - z * z)
    lattice = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)
    views = np.array(outgoing, float)
    if quarter:
        views[:, :2], lattice[:, :2] = np.abs(views[:, :2]), np.abs(lattice[:, :2])
    distinct, which, times = np.unique(np.round(views, 9), axis=0, return_inverse=True, return_counts=True)
    nearest = cKDTree(distinct).query(lattice)[1]
    counts = np.maximum(np.bincount(nearest, minlength=len(distinct)), 0.5)
    which = which.reshape(-1)
    return 2 * np.pi / points * counts[which] / times[which]


def together(outgoing: np.ndarray, values: np.ndarray, solid: np.ndarray, *, miss: float, worth: float) -> np.ndarray:
    """Inverse standard deviations (n,) of views of one incidence that count by their cells.

    A model that misses the values (n,) by `miss` of their cosine-weighted root mean square gets the sum of squared
    residuals `worth`, or the number of views where that is less: neighbouring views miss alike, they are not
    independent.
    """
    weight = outgoing[:, 2] * solid
    return np.sqrt(weight / np.sum(weight * values**2) * min(worth, len(values))) / miss


def single(values: np.ndarray, level: np.ndarray, *, miss: float) -> np.ndarray:
    """Inverse standard deviations (n,) of single measurements: `miss` of the value and of its incidence's level."""
    return 1 / (miss * np.sqrt(values**2 + level**2))
