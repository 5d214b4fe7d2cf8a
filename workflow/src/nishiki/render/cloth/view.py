"""Cameras that look at a scene."""

from __future__ import annotations

import numpy as np

from nishiki.geometry.camera import Camera, look_at


def around(target, *, elevation: float, azimuth: float, distance: float) -> np.ndarray:
    """A place (3,) about a target: azimuth from z (to the viewer) towards x (right), elevation above the floor."""
    level = np.cos(elevation)
    towards = np.array([level * np.sin(azimuth), np.sin(elevation), level * np.cos(azimuth)])
    return np.asarray(target, np.float64) + distance * towards


def framed(
    points: np.ndarray,
    *,
    elevation: float,
    azimuth: float,
    rows: int,
    columns: int,
    distance: float,
    margin: float = 1.12,
) -> Camera:
    """A camera that holds all points (n, 3) in its picture, centred; distance: from their middle, in their extents."""
    low, high = points.min(axis=0), points.max(axis=0)
    middle, extent = (low + high) / 2, float(np.linalg.norm(high - low))
    eye = around(middle, elevation=elevation, azimuth=azimuth, distance=distance * extent)
    target, size = middle, {"rows": rows, "columns": columns}
    for _ in range(3):  # the middle of what is seen is not the middle of the points: a few steps settle it
        camera = look_at(eye, target, field_of_view=0.5, **size)
        seen = (points - eye) @ camera.rotation.T
        plane = seen[:, :2] / seen[:, 2:]
        centre = (plane.min(axis=0) + plane.max(axis=0)) / 2
        depth = float((target - eye) @ camera.rotation[2])
        target = target + depth * (centre[0] * camera.rotation[0] + centre[1] * camera.rotation[1])
    half = np.abs(plane - centre).max(axis=0)
    high = margin * max(half[1], half[0] * rows / columns)
    return look_at(eye, target, field_of_view=float(2 * np.arctan(high)), **size)
