"""The lobe of Trowbridge and Reitz with Smith's masking, as the materials of glTF, USD and MaterialX have it.

For a half vector h, a direction d (light or view) and widths x, y along two tangents:

    D = 1 / (pi x y q^2),    q = (h_x / x)^2 + (h_y / y)^2 + h_z^2
    V = 1 / ((i_z + S(i)) (o_z + S(o)))       light and view masked separately (glTF 2.0, appendix B)
    V = 1 / (2 (o_z S(i) + i_z S(o)))         correlated by height (KHR_materials_anisotropy)
    S(d) = sqrt((x d_x)^2 + (y d_y)^2 + d_z^2)

Sources: Trowbridge and Reitz (1975), Average irregularity representation of a rough surface for ray reflection; Heitz
(2014), Understanding the masking-shadowing function in microfacet-based BRDFs.
"""

import numpy as np


def isotropic_lobe(
    cos_phi: np.ndarray | float, cos_i: np.ndarray | float, cos_r: np.ndarray | float, alpha: np.ndarray | float
) -> np.ndarray:
    """D V, 1 / sr, with light and view masked separately.

    cos_phi, cos_i, cos_r : cosines of the normal with half vector, light and view; alpha : width, above 0, at most 1.
    """
    square = np.square(alpha)
    light, view = (np.sqrt(square + (1 - square) * np.square(c)) for c in (cos_i, cos_r))
    q = (1 - np.square(cos_phi)) / square + np.square(cos_phi)
    return _distribution(q, square) / np.maximum((cos_i + light) * (cos_r + view), 1e-9)


def anisotropic_lobe(h: np.ndarray, incident: np.ndarray, outgoing: np.ndarray, x: float, y: float) -> np.ndarray:
    """D V, 1 / sr, of unit vectors (..., 3) above the horizon, masking correlated by height.

    x, y : widths along the axes, above 0. V is at most 1, as in KHR_materials_anisotropy.
    """
    light, view = (np.sqrt((x * d[..., 0]) ** 2 + (y * d[..., 1]) ** 2 + d[..., 2] ** 2) for d in (incident, outgoing))
    masked = np.abs(outgoing[..., 2]) * light + np.abs(incident[..., 2]) * view
    q = (h[..., 0] / x) ** 2 + (h[..., 1] / y) ** 2 + h[..., 2] ** 2
    return _distribution(q, x * y) * np.minimum(0.5 / np.maximum(masked, 1e-9), 1.0)


def widened_roughness(roughness: np.ndarray | float, variance: np.ndarray | float) -> np.ndarray:
    """Roughness of a lobe over facets of other slopes: alpha'^2 = alpha^2 + 2 variance, alpha = roughness^2, at most 1.

    variance : of the slopes along any one direction. Olano and Baker (2010), for Beckmann's lobe, whose slopes have the
    variance alpha^2 / 2. Slopes of Trowbridge and Reitz's have none that is finite: the same step stands in for it, and
    leaves the peak up to a quarter higher than the mean over the facets is.
    """
    return np.minimum(np.power(roughness, 4) + 2 * variance, 1) ** 0.25


def _distribution(q: np.ndarray, area: np.ndarray | float) -> np.ndarray:
    """D of q and of the product of both widths."""
    return 1 / (np.pi * area * q**2)
