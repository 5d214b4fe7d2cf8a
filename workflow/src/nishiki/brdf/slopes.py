"""Convert lobes between models: widened by the slopes inside a pixel, and as renderers' Trowbridge-Reitz lobes.

A pixel shows the mean of its facets' gloss, not the gloss of their mean. Where the normals change from pixel to pixel
they change inside the pixel too. A Gaussian lobe over Gaussian slopes is a wider Gaussian lobe, so that the mean has a
closed form (Toksvig 2005; Olano and Baker 2010): the lobe's variance plus the covariance of the slopes.

For a half vector h, a direction d (light or view) and widths x, y along two tangents:

    D = 1 / (pi x y q^2),    q = (h_x / x)^2 + (h_y / y)^2 + h_z^2
    V = 1 / ((i_z + S(i)) (o_z + S(o)))       light and view masked separately (glTF 2.0, appendix B)
    V = 1 / (2 (o_z S(i) + i_z S(o)))         correlated by height (KHR_materials_anisotropy)
    S(d) = sqrt((x d_x)^2 + (y d_y)^2 + d_z^2)

Sources: Trowbridge and Reitz (1975), Average irregularity representation of a rough surface for ray reflection; Heitz
(2014), Understanding the masking-shadowing function in microfacet-based BRDFs.
"""

import numpy as np

STEEPEST = 0.2  # least n_z from which a slope is formed
GRAZING = 0.05  # cosine of 87 degrees to the camera: no surface seen more steeply is resolved


def slopes_of(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute slopes (rows, columns, 2) float32, n_x / n_z, n_y / n_z, and where they are known, (rows, columns) bool.

    normals : (rows, columns, 3) float, unit vectors; others are unknown.
    """
    normals = np.asarray(normals, np.float32)
    known = np.abs(np.einsum("rck,rck->rc", normals, normals) - 1) < 0.02
    return normals[..., :2] / np.maximum(normals[..., 2:], np.float32(STEEPEST)), known


def slope_covariance(normals: np.ndarray) -> np.ndarray:
    """Compute the slopes' covariance within each pixel, for normals that change linearly between pixel centres.

    Parameters
    ----------
    normals : (rows, columns, 3) float, unit vectors; others (unknown) tell nothing of their neighbours.

    Returns
    -------
    (rows, columns, 3) float32: variance along x, covariance, variance along y of (n_x / n_z, n_y / n_z). Along each
    axis of the picture the slope runs from half way to one neighbour to half way to the other: with the differences a
    and b to them, (a^2 + b^2) / 24.
    """
    slopes, known = slopes_of(normals)
    covariance = np.zeros((*known.shape, 3), np.float32)
    pairs = (((slice(None, -1),), (slice(1, None),)), ((slice(None), slice(None, -1)), (slice(None), slice(1, None))))
    for first, second in pairs:  # neighbours down, then across
        step = (slopes[second] - slopes[first]) * (known[first] & known[second])[..., None]
        squares = products(step) / 24
        covariance[first] += squares
        covariance[second] += squares
    return covariance


def products(slopes: np.ndarray) -> np.ndarray:
    """Multiply slopes (..., 2) into xx, xy, yy (..., 3)."""
    x, y = slopes[..., 0], slopes[..., 1]
    return np.stack([x * x, x * y, y * y], axis=-1)


def isotropic_lobe(
    cos_phi: np.ndarray | float, cos_i: np.ndarray | float, cos_r: np.ndarray | float, alpha: np.ndarray | float
) -> np.ndarray:
    """Compute D V, 1 / sr, with light and view masked separately.

    cos_phi, cos_i, cos_r : cosines of the normal with half vector, light and view; alpha : width, above 0, at most 1.
    """
    square = np.square(alpha)
    light, view = (np.sqrt(square + (1 - square) * np.square(c)) for c in (cos_i, cos_r))
    q = (1 - np.square(cos_phi)) / square + np.square(cos_phi)
    return _distribution(q, square) / np.maximum((cos_i + light) * (cos_r + view), 1e-9)


def anisotropic_lobe(h: np.ndarray, incident: np.ndarray, outgoing: np.ndarray, x: float, y: float) -> np.ndarray:
    """Compute D V, 1 / sr, of unit vectors (..., 3) above the horizon, masking correlated by height.

    x, y : widths along the axes, above 0. V is at most 1, as in KHR_materials_anisotropy.
    """
    light, view = (np.sqrt((x * d[..., 0]) ** 2 + (y * d[..., 1]) ** 2 + d[..., 2] ** 2) for d in (incident, outgoing))
    masked = np.abs(outgoing[..., 2]) * light + np.abs(incident[..., 2]) * view
    q = (h[..., 0] / x) ** 2 + (h[..., 1] / y) ** 2 + h[..., 2] ** 2
    return _distribution(q, x * y) * np.minimum(0.5 / np.maximum(masked, 1e-9), 1.0)


def widened_roughness(roughness: np.ndarray | float, variance: np.ndarray | float) -> np.ndarray:
    """Widen a lobe's roughness by facet slopes: alpha'^2 = alpha^2 + 2 variance, alpha = roughness^2, at most 1.

    variance : of the slopes along any one direction. Olano and Baker (2010), for Beckmann's lobe, whose slopes have the
    variance alpha^2 / 2. Slopes of Trowbridge and Reitz's have none that is finite: the same step stands in for it, and
    leaves the peak up to a quarter higher than the mean over the facets is.
    """
    return np.minimum(np.power(roughness, 4) + 2 * variance, 1) ** 0.25


def _distribution(q: np.ndarray, area: np.ndarray | float) -> np.ndarray:
    """Compute D from q and the product of both widths."""
    return 1 / (np.pi * area * q**2)
