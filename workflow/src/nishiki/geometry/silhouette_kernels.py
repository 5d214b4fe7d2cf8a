"""Numba kernel of silhouettes: how far each pixel's colour is from the background's."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def nearest_colour(lab, centres, inverses, lowest, out):
    """Smallest Mahalanobis distance of colours lab (n, 3) float32 to clusters, into out (n,) float32; at most out's
    value before.

    centres (k, 3), inverses (k, 3, 3), lowest (k,) float64: a cluster's colour may be scaled by lowest to 1, by the
    factor that fits best.
    """
    for n in range(lab.shape[0]):
        best = np.float64(out[n]) ** 2
        x, y, z = np.float64(lab[n, 0]), np.float64(lab[n, 1]), np.float64(lab[n, 2])
        for k in range(centres.shape[0]):
            m, c = inverses[k], centres[k]
            u = m[0, 0] * c[0] + m[0, 1] * c[1] + m[0, 2] * c[2]
            v = m[1, 0] * c[0] + m[1, 1] * c[1] + m[1, 2] * c[2]
            w = m[2, 0] * c[0] + m[2, 1] * c[1] + m[2, 2] * c[2]
            scale = (x * u + y * v + z * w) / (c[0] * u + c[1] * v + c[2] * w)
            scale = min(max(scale, lowest[k]), 1.0)
            a, b, d = x - scale * c[0], y - scale * c[1], z - scale * c[2]
            square = (
                m[0, 0] * a * a
                + m[1, 1] * b * b
                + m[2, 2] * d * d
                + 2.0 * (m[0, 1] * a * b + m[0, 2] * a * d + m[1, 2] * b * d)
            )
            best = min(best, max(square, 0.0))
        out[n] = np.sqrt(best)
