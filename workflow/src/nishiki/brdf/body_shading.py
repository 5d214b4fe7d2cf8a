"""Body shading of a pixel: Lambert's cosine with the fall-off and the gloss skirt that the solver `lobe` fitted.

    E_k = rho_k c f,    f = max(a + b c + d x^8, 0),    c = max(n . l, 0),    x = max(n . h, 0)

h is the half vector of light and view. The map `shading` (rows, columns, 3) holds (a, b, d) of every pixel, scaled so
that f is 1 on average over the samples of the fit, weighted by c^2: rho_k stays about the reflectance of Lambert's law.
Lambert's law is (1, 0, 0). Model: Shi, Tan, Matsushita and Ikeuchi (2014), with other terms (`nishiki.normals.lobe`).
"""

import numpy as np
from numba import njit

LAMBERT = (1.0, 0.0, 0.0)


def body_factor(shading: np.ndarray | None, cosine: np.ndarray, half_cosine: np.ndarray) -> np.ndarray | float:
    """f of the body shading: what Lambert's cosine is multiplied by.

    Parameters
    ----------
    shading : (..., 3) float, (a, b, d) of each pixel, or None for Lambert's law.
    cosine, half_cosine : (..., ) float, n . l and n . h, broadcast against the pixels.

    Returns
    -------
    (...,) float, zero or more; 1 where `shading` is None.
    """
    if shading is None:
        return 1.0
    a, b, d = np.moveaxis(np.asarray(shading), -1, 0)
    return np.maximum(a + b * np.maximum(cosine, 0) + d * np.maximum(half_cosine, 0) ** 8, 0)


@njit(cache=True, error_model="numpy", inline="always")
def body_factor_scalar(a, b, d, cosine, half_cosine):
    """`body_factor` of one sample, cosine and half_cosine >= 0; compiled."""
    x2 = half_cosine * half_cosine
    x4 = x2 * x2
    return max(a + b * cosine + d * x4 * x4, 0.0)
