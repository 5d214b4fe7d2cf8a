"""Shadowing and masking of a woven cross-section together: what is lit by the lamp and seen by the camera.

Angles lie in the section's plane, signed: positive towards the plane's axis (x for the weft section, y for the warp
section). A section is the same all along its yarns, so a direction in space sees it as its projection on the plane does
(`plane_angles`), exactly.
"""

import numpy as np
from numba import njit

from nishiki.weave.visibility import HALF_PI, share_of_slope, share_of_spread_slope, share_seen, side_lengths


def plane_angles(directions) -> tuple[np.ndarray, np.ndarray]:
    """Signed angles in the weft plane (x, z) and in the warp plane (y, z) of directions (..., 3), radians.

    A direction along the cloth and across the plane (z = 0 and no part in the plane) counts as +-0.
    """
    directions = np.asarray(directions, np.float64)
    z = directions[..., 2]
    return np.arctan2(directions[..., 0], z), np.arctan2(directions[..., 1], z)


def lit_and_visible(section, theta_i, theta_r) -> np.ndarray:
    """Share of the section's surface (by length) that is lit from theta_i and seen from theta_r; broadcast, 0 to 1.

    theta_i = 0 gives masking(theta_r): light along the normal reaches every point. Symmetric in its two angles, exact
    for the section (light and view directions at infinity), 0 where either is below the horizon.
    """
    theta_i, theta_r = np.broadcast_arrays(np.asarray(theta_i, np.float64), np.asarray(theta_r, np.float64))
    out = _pairs(section.shape, _flat(theta_i), _flat(theta_r))
    return out.reshape(theta_i.shape)


def visible_by_slope(section, theta_i, theta_r, slopes, *, spread: float = 0.0) -> np.ndarray:
    """Share of the facets of given slope that is lit from theta_i and seen from theta_r; all three broadcast, 0 to 1.

    slopes : signed angle of the facet's normal in the plane (radians), positive towards the axis, as the angles are.
    spread : standard deviation (radians) of the facets' slopes about the section's own, that of fibres on a yarn.
             0: facets are the section itself; then those of slope 0 <= |slope| < theta_a lie on arcs, theta_a on
             flanks, and slopes steeper than all of the section count as its steepest.
    A facet's own horizon is not part of it (the caller's dot products are), only what other points take away.
    """
    angles = (np.asarray(a, np.float64) for a in (theta_i, theta_r, slopes))
    theta_i, theta_r, slopes = np.broadcast_arrays(*angles)
    if not (np.isfinite(spread) and spread >= 0):
        raise ValueError(f"spread = {spread}: expected a finite angle >= 0")
    out = _slopes(section.shape, _flat(theta_i), _flat(theta_r), _flat(slopes), float(spread))
    return out.reshape(slopes.shape)


def _flat(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values).reshape(-1)


@njit(cache=True, nogil=True, error_model="numpy")
def _pairs(shape, theta_i, theta_r):
    out = np.empty(theta_i.size)
    for k in range(theta_i.size):
        out[k] = share_seen(shape, theta_i[k], theta_r[k])
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _slopes(shape, theta_i, theta_r, slopes, spread):
    out = np.empty(theta_i.size)
    for k in range(theta_i.size):
        if abs(theta_i[k]) > HALF_PI or abs(theta_r[k]) > HALF_PI:
            out[k] = 0.0
            continue
        lit, seen = side_lengths(shape, theta_i[k]), side_lengths(shape, theta_r[k])
        if spread > 0.0:
            out[k] = share_of_spread_slope(shape, lit, seen, slopes[k], spread)
        else:
            out[k] = share_of_slope(shape, lit, seen, slopes[k])
    return out
