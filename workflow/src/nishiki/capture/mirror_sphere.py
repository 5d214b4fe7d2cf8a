"""Directions of lamps from the highlight on a mirror sphere."""

from __future__ import annotations

import numpy as np

HIGHLIGHT = 0.9  # of the brightest blurred value: the lamp's own image and not what else the sphere reflects


def direction_from_sphere(image: np.ndarray, centre: tuple[float, float], radius: float) -> np.ndarray:
    """Unit direction (3,) float64 to the lamp whose image is the brightest spot on a mirror sphere.

    image (rows, columns) of any scale; centre (row, column) and radius of the sphere's outline in pixels, seen from
    afar along z. The spot's centroid gives the normal n there and the mirror law the lamp: l = 2 (n . v) n - v with
    v = (0, 0, 1). ValueError where no spot lies on the sphere.
    """
    import cv2

    # Only the sphere's own square is looked at.
    top, left = (max(0, int(c - radius)) for c in centre)
    bottom, right = (int(c + radius) + 2 for c in centre)
    part = np.ascontiguousarray(image[top:bottom, left:right], dtype=np.float32)
    rows, columns = np.ogrid[top : top + part.shape[0], left : left + part.shape[1]]
    inside = np.hypot(rows - centre[0], columns - centre[1]) < 0.98 * radius
    if not inside.any():
        raise ValueError("the sphere lies outside the picture")
    smooth = cv2.GaussianBlur(part, (0, 0), max(0.5, 0.01 * radius))
    smooth = np.where(inside, smooth, -np.inf)
    peak = np.unravel_index(int(np.argmax(smooth)), smooth.shape)
    floor = float(np.median(smooth[inside]))
    if not smooth[peak] > floor:
        raise ValueError("no highlight on the sphere")
    bright = (smooth >= floor + HIGHLIGHT * (smooth[peak] - floor)).astype(np.uint8)
    _, labels = cv2.connectedComponents(bright)
    weight = np.where(labels == labels[peak], smooth - floor, 0.0)
    row, column = float((rows * weight).sum() / weight.sum()), float((columns * weight).sum() / weight.sum())
    x, y = (column - centre[1]) / radius, -(row - centre[0]) / radius
    z = np.sqrt(max(0.0, 1.0 - x * x - y * y))
    normal = np.array([x, y, z])
    return 2.0 * z * normal - np.array([0.0, 0.0, 1.0])


def mean_direction(directions: np.ndarray) -> tuple[np.ndarray, float]:
    """Mean unit direction (3,) of several spheres (spheres, 3), and the largest angle from it in radians."""
    total = directions.sum(axis=0)
    mean = total / np.linalg.norm(total)
    return mean, float(np.arccos(np.clip(directions @ mean, -1, 1)).max())
