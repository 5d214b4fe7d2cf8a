"""The directions of a goniometer session."""

from __future__ import annotations

import numpy as np

OBLIQUE_DEG = (15.0, 30.0, 45.0, 60.0, 75.0)
AZIMUTHS_DEG = (0.0, 45.0, 90.0)  # of the lamp: weft, bias, warp


def unit(theta_deg, phi_deg) -> np.ndarray:
    """Unit vectors (..., 3) from polar angle and azimuth in degrees; exact on the axes and in the plane."""
    theta, phi = np.radians(np.asarray(theta_deg, float)), np.radians(np.asarray(phi_deg, float))
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0.0 * phi], axis=-1)


def quarter_views(polar_step: float = 3.0, azimuth_step: float = 5.0) -> np.ndarray:
    """(n, 2) polar angle and azimuth in degrees of views under normal incidence, in the quarter between weft and warp.

    Rings below 87°, both planes of symmetry included, the normal once; the ring at 87° every third azimuth. With the
    default steps 540 views.
    """
    azimuths = np.arange(0.0, 90.0 + 1e-9, azimuth_step)
    rings = np.arange(polar_step, 87.0 - 1e-9, polar_step)
    theta, phi = np.meshgrid(rings, azimuths, indexing="ij")
    full = np.column_stack([theta.ravel(), phi.ravel()])
    last = azimuths[::3]
    return np.concatenate([[[0.0, 0.0]], full, np.column_stack([np.full(len(last), 87.0), last])])


def hemisphere_views(polar_step: float = 6.0, azimuth_step: float = 15.0) -> np.ndarray:
    """(n, 2) degrees: the whole hemisphere, rings in the middle of equal steps of the polar angle (3°, 9° .. 87°)."""
    theta, phi = np.meshgrid(
        np.arange(0.5 * polar_step, 90.0, polar_step), np.arange(0.0, 360.0, azimuth_step), indexing="ij"
    )
    return np.column_stack([theta.ravel(), phi.ravel()])


def session(normal: np.ndarray, oblique: np.ndarray, *, incidences=OBLIQUE_DEG, azimuths=AZIMUTHS_DEG) -> np.ndarray:
    """(n, 4) theta_i, phi_i, theta_r, phi_r in degrees: views under normal incidence, then those of every lamp."""
    rows = [np.column_stack([np.zeros((len(normal), 2)), normal])]
    for phi in azimuths:
        for theta in incidences:
            rows.append(np.column_stack([np.tile([theta, phi], (len(oblique), 1)), oblique]))
    return np.concatenate(rows)
