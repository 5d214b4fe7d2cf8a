"""The published fit of a scene (Tominaga and Tanaka 2004, eq. 14-18), the baseline: brightest light, smoothed normals,
thinned samples, Levenberg-Marquardt.

The search needs a start, and parameters of like size: it works on the strength and on log gamma.  scipy's
`least_squares(method="lm")` is MINPACK's lmder (More, The Levenberg-Marquardt algorithm: implementation and theory,
1978).
"""

import numpy as np

from nishiki.brdf.body_shading import body_factor
from nishiki.brdf.torrance_sparrow import attenuation, half_vector_geometry

STEEPEST = np.deg2rad(50.0)
START_GAMMA = 0.1
FARTHEST = 2000.0  # 2^-2000 is 0
TWO_LN2 = 2.0 * np.log(2.0)


def brightest_light_samples(
    observations,
    normals,
    diffuse_albedo,
    lights,
    *,
    usable=None,
    view=(0.0, 0.0, 1.0),
    refractive_index=1.45,
    smoothing=0.4,
    shading=None,
):
    """(phi, value, F G / cos_r) of the brightest light of each pixel less steep than 50 degrees; flat arrays.

    Arguments as `SpecularHistogram.add_tile`; smoothing: standard deviation in pixels of the Gaussian that smooths the
    normals, 0 for none (more than the scale of the relief makes every facet look like a rough one). The diffuse part
    albedo * cos theta_i is predicted with the normals as given.
    """
    from scipy.ndimage import gaussian_filter

    observations, normals = np.asarray(observations, float), np.asarray(normals, float)
    lights, view = np.asarray(lights, float), np.asarray(view, float)
    usable = np.ones(observations.shape, bool) if usable is None else usable
    brightest = np.argmax(np.where(usable, observations, -np.inf), axis=0)
    top = np.take_along_axis(observations, brightest[None], axis=0)[0]
    cosine = np.maximum(np.sum(normals * lights[brightest], axis=-1), 0)
    half_cosine = np.cos(half_vector_geometry(normals, lights[brightest], view).phi)
    value = top - diffuse_albedo * cosine * body_factor(shading, cosine, half_cosine)
    smooth = gaussian_filter(normals, (smoothing, smoothing, 0)) if smoothing > 0 else normals
    length = np.linalg.norm(smooth, axis=-1, keepdims=True)
    smooth = smooth / np.where(length > 0, length, 1)
    geometry = half_vector_geometry(smooth, lights[brightest], view)
    factor = attenuation(geometry, refractive_index)
    keep = usable.any(axis=0) & (smooth[..., 2] > np.cos(STEEPEST)) & (factor > 0) & np.isfinite(value + factor)
    return geometry.phi[keep], value[keep], factor[keep]


def thin(phi, *, bins=60, per_bin=50, seed=0):
    """Indices of at most `per_bin` samples in each of `bins` equal intervals of phi: a constant density over phi."""
    order = np.random.default_rng(seed).permutation(phi.size)
    top = phi.max(initial=0.0)
    index = np.minimum((phi[order] * (bins / top)).astype(int), bins - 1) if top > 0 else np.zeros(phi.size, int)
    ranked = np.argsort(index, kind="stable")
    start = np.searchsorted(index[ranked], np.arange(bins))
    rank = np.arange(phi.size) - start[index[ranked]]
    return np.sort(order[ranked[rank < per_bin]])


def squared_ratio(phi, log_gamma):
    """(phi / gamma)^2, held where 2^-ratio is 0 or 1 in float64: the search may pass any width."""
    return np.minimum((phi / np.exp(np.clip(log_gamma, -50.0, 50.0))) ** 2, FARTHEST)


def fit_lobe(phi, amplitude, attenuation, *, start=(1.0, START_GAMMA)):
    """beta and gamma of one lobe from specular samples alone: minimise sum (amplitude - beta a D(phi; gamma))^2.

    phi (radians), amplitude, attenuation a: (samples,).  start: (beta, gamma).  Returns (beta, gamma, covariance of
    (beta, gamma), root mean square residual, converged); the covariance is infinite where it is not defined.
    """
    from scipy.optimize import least_squares

    def residual(p):
        return p[0] * attenuation * np.exp2(-squared_ratio(phi, p[1])) - amplitude

    def jacobian(p):
        ratio2 = squared_ratio(phi, p[1])
        s = attenuation * np.exp2(-ratio2)
        return np.stack([s, p[0] * s * TWO_LN2 * ratio2], axis=1)

    first = np.array([start[0], np.log(start[1])], float)
    with np.errstate(over="ignore", under="ignore"):
        found = least_squares(residual, first, jac=jacobian, method="lm")
    beta, gamma = found.x[0], float(np.exp(np.clip(found.x[1], -50.0, 50.0)))
    variance = 2 * found.cost / max(phi.size - 2, 1)
    normal = found.jac.T @ found.jac
    scale = np.sqrt(np.diag(normal))
    if np.all(scale > 0) and np.linalg.cond(normal / np.outer(scale, scale)) < 1e14:
        covariance = variance * np.linalg.inv(normal / np.outer(scale, scale)) / np.outer(scale, scale)
    else:
        covariance = np.full((2, 2), np.inf)
    to_gamma = np.array([1.0, gamma])
    covariance = covariance * np.outer(to_gamma, to_gamma)
    # where the search ran off to no width, or to one so large that none is told, it stops: that is no convergence
    converged = bool(found.success and np.isfinite(covariance).all() and 1e-6 < gamma < 10)
    return float(beta), gamma, covariance, float(np.sqrt(2 * found.cost / phi.size)), converged
