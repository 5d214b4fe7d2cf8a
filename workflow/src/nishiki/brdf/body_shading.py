"""Body shading of a pixel: Lambert's cosine with the fall-off and the gloss skirt that the solver `lobe` fitted.

    E_k = rho_k c f,    f = max(a + b c + d x^8, 0),    c = max(n . l, 0),    x = max(n . h, 0)

h is the half vector of light and view. The map `shading` (rows, columns, 3) holds (a, b, d) of every pixel, scaled so
that f is 1 on average over the samples of the fit, weighted by c^2: rho_k stays about the reflectance of Lambert's law.
Lambert's law is (1, 0, 0). Where surroundings shade a pixel from one side, the map has two terms more, (a, b, d, e_x,
e_y), and e_x l_x + e_y l_y, the light's direction across the view, is added to the sum
(`nishiki.photometric.relighting`). Model: Shi, Tan, Matsushita and Ikeuchi (2014), with other terms
(`nishiki.photometric.lobe`).
"""

import numpy as np
from numba import njit

from nishiki.brdf.kernels import fresnel_scalar
from nishiki.brdf.torrance_sparrow import fresnel

LAMBERT = (1.0, 0.0, 0.0)


def transmittance(cosine: np.ndarray, refractive_index: float) -> np.ndarray:
    """Light that passes a smooth dielectric surface, relative to normal incidence: (1 - F(c)) / (1 - F(1)).

    The body of a varnished paint is lit through its surface and seen through it: its shading is c T(c) T(n . v), and
    its reflectance is that of light and view along the normal (B. Walter et al., EGSR 2007; F: Tominaga and Tanaka
    2004, eq. 12). The path of the light that the surface reflects back into the body does not depend on either angle.

    Parameters
    ----------
    cosine : (...,) float, of light or view and the normal, clipped to 0 ... 1.
    refractive_index : float, above 1.

    Returns
    -------
    (...,) float, 0 at grazing to 1 at normal incidence.
    """
    return (1 - fresnel(np.clip(cosine, 0, 1), refractive_index)) / (1 - fresnel(1.0, refractive_index))


@njit(cache=True, error_model="numpy", inline="always")
def transmittance_scalar(cosine, refractive_index):
    """`transmittance` of one sample, 0 <= cosine <= 1; compiled."""
    return (1.0 - fresnel_scalar(cosine, refractive_index)) / (1.0 - fresnel_scalar(1.0, refractive_index))


def body_factor(
    shading: np.ndarray | None, cosine: np.ndarray, half_cosine: np.ndarray, across: np.ndarray | None = None
) -> np.ndarray | float:
    """f of the body shading: what Lambert's cosine is multiplied by.

    Parameters
    ----------
    shading : (..., 3) float, (a, b, d) of each pixel, (..., 5), (a, b, d, e_x, e_y), or None for Lambert's law.
    cosine, half_cosine : (..., ) float, n . l and n . h, broadcast against the pixels.
    across : (..., 2) float, (l_x, l_y) of the unit vector to the light; for five terms.

    Returns
    -------
    (...,) float, zero or more; 1 where `shading` is None.
    """
    if shading is None:
        return 1.0
    a, b, d, *e = np.moveaxis(np.asarray(shading), -1, 0)
    factor = a + b * np.maximum(cosine, 0) + d * np.maximum(half_cosine, 0) ** 8
    if e:
        factor = factor + e[0] * across[..., 0] + e[1] * across[..., 1]
    return np.maximum(factor, 0)


@njit(cache=True, error_model="numpy", inline="always")
def body_factor_scalar(shading, cosine, half_cosine, light):
    """`body_factor` of one sample: shading (3,) or (5,), cosine and half_cosine >= 0, light (3,); compiled."""
    x2 = half_cosine * half_cosine
    x4 = x2 * x2
    factor = shading[0] + shading[1] * cosine + shading[2] * x4 * x4
    if shading.size > 3:
        factor += shading[3] * light[0] + shading[4] * light[1]
    return max(factor, 0.0)
