"""Convert angles of the goniometer to unit vectors, and mirror directions in the symmetry planes of a weave."""

from typing import Literal

import numpy as np


def unit(theta: np.ndarray | float, phi: np.ndarray | float) -> np.ndarray:
    """Compute unit vectors (..., 3) float64 away from the cloth; theta from the normal, phi from the weft, radians."""
    theta, phi = np.broadcast_arrays(np.asarray(theta, np.float64), np.asarray(phi, np.float64))
    across = np.sin(theta)
    return np.stack([across * np.cos(phi), across * np.sin(phi), np.cos(theta)], axis=-1)


def angles(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute theta in [0, pi] and phi in [0, 2 pi) of unit vectors (..., 3); phi is 0 along the normal.

    theta = atan2(hypot(x, y), z), which keeps its digits near the normal, where acos(z) loses half of them.
    """
    d = np.asarray(directions, np.float64)
    theta = np.arctan2(np.hypot(d[..., 0], d[..., 1]), d[..., 2])
    phi = np.arctan2(d[..., 1], d[..., 0]) % (2 * np.pi)
    return theta, np.where(phi >= 2 * np.pi, 0.0, phi)


def between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Compute the angle (...) in [0, pi] between unit vectors (..., 3), exact for small ones too."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    return 2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))


def disc(directions: np.ndarray) -> np.ndarray:
    """Map directions to places (..., 2) on the azimuthal equidistant disc: normal at (0, 0), horizon at distance 1.

    Continuous over the normal and round the azimuth, where theta and phi are not.
    """
    theta, phi = angles(directions)
    radius = theta / (np.pi / 2)
    return np.stack([radius * np.cos(phi), radius * np.sin(phi)], axis=-1)


Symmetry = Literal["unknown", "quarter", "half", "none"]
IMAGES: dict[Symmetry, tuple[tuple[int, int], ...]] = {
    "quarter": ((1, 1), (-1, 1), (1, -1), (-1, -1)),  # mirror planes through weft and normal, warp and normal
    "half": ((1, 1), (-1, -1)),  # a half turn about the normal: what a twill's diagonal leaves
    "none": ((1, 1),),
}
ON_PLANE = 1e-9  # sine


def images(symmetry: Symmetry) -> np.ndarray:
    """Return matrices (k, 3, 3) float64 to the directions with the same reflectance, the first the identity."""
    return np.array([np.diag([x, y, 1.0]) for x, y in IMAGES[symmetry]])


def reduce_pairs(incident: np.ndarray, outgoing: np.ndarray, symmetry: Symmetry) -> tuple[np.ndarray, np.ndarray]:
    """Bring each pair (n, 3), (n, 3) to the representative of its symmetric pairs.

    quarter: light with x >= 0 and y >= 0; half: light with y > 0, or y = 0 and x >= 0. Where the light does not tell
    (it lies in a symmetry plane, or along the normal) the view does.
    """
    incident, outgoing = (np.asarray(d, np.float64) for d in (incident, outgoing))
    if symmetry == "quarter":
        sign = np.ones_like(incident)
        for axis in (0, 1):
            deciding = np.where(np.abs(incident[:, axis]) > ON_PLANE, incident[:, axis], outgoing[:, axis])
            sign[:, axis] = np.where(deciding < 0, -1.0, 1.0)
        return incident * sign, outgoing * sign
    if symmetry == "half":
        across = np.hypot(incident[:, 0], incident[:, 1]) > ON_PLANE
        x, y = (np.where(across, incident[:, a], outgoing[:, a]) for a in (0, 1))
        turned = (y < -ON_PLANE) | ((np.abs(y) <= ON_PLANE) & (x < 0))
        sign = np.where(turned[:, None], np.array([-1.0, -1.0, 1.0]), 1.0)
        return incident * sign, outgoing * sign
    return incident, outgoing


def departure(incident: np.ndarray, outgoing: np.ndarray, values: np.ndarray, symmetry: Symmetry) -> tuple[float, int]:
    """Measure the contradiction between measurements that the symmetry makes equal.

    Return the root mean square of their logarithms about the mean of each, and their number. values (n, channels) > 0;
    (0, 0) where no direction has an image.
    """
    if len(values) == 0 or symmetry == "none":
        return 0.0, 0
    pairs = np.round(np.concatenate(reduce_pairs(incident, outgoing, symmetry), axis=1), 5) + 0.0
    _, group = np.unique(pairs, axis=0, return_inverse=True)
    group = group.ravel()
    count = np.bincount(group)
    logs = np.log(values)
    means = np.stack([np.bincount(group, logs[:, k]) for k in range(logs.shape[1])], axis=1) / count[:, None]
    several = count[group] > 1
    if not several.any():
        return 0.0, 0
    freedom = several.sum() - (count > 1).sum()
    return float(np.sqrt(((logs - means[group])[several] ** 2).mean(axis=1).sum() / freedom)), int(several.sum())
