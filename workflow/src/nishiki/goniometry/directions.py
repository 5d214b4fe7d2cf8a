"""Directions of the goniometer: angles to unit vectors and back, in the cloth's frame (x weft, y warp, z normal)."""

from __future__ import annotations

import numpy as np


def unit(theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Unit vectors (..., 3) float64 away from the cloth; theta: from the normal, phi: from the weft, radians."""
    theta, phi = np.broadcast_arrays(np.asarray(theta, np.float64), np.asarray(phi, np.float64))
    across = np.sin(theta)
    return np.stack([across * np.cos(phi), across * np.sin(phi), np.cos(theta)], axis=-1)


def angles(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """theta in [0, pi] and phi in [0, 2 pi) of unit vectors (..., 3); phi is 0 along the normal.

    theta = atan2(hypot(x, y), z), which keeps its digits near the normal, where acos(z) loses half of them.
    """
    d = np.asarray(directions, np.float64)
    theta = np.arctan2(np.hypot(d[..., 0], d[..., 1]), d[..., 2])
    phi = np.arctan2(d[..., 1], d[..., 0]) % (2 * np.pi)
    return theta, np.where(phi >= 2 * np.pi, 0.0, phi)


def between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle (...) in [0, pi] between unit vectors (..., 3), exact for small ones too."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    return 2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))


def disc(directions: np.ndarray) -> np.ndarray:
    """Places (..., 2) on the azimuthal equidistant disc: the normal at (0, 0), the horizon at distance 1.

    Continuous over the normal and round the azimuth, where theta and phi are not.
    """
    theta, phi = angles(directions)
    radius = theta / (np.pi / 2)
    return np.stack([radius * np.cos(phi), radius * np.sin(phi)], axis=-1)
