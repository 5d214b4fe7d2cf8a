"""The published fit of a scene (Tominaga and Tanaka 2004, eq. 14-18), the baseline: brightest light, smoothed normals,
thinned samples."""

import numpy as np

from nishiki.brdf.body_shading import body_factor
from nishiki.brdf.torrance_sparrow import attenuation, half_vector_geometry

STEEPEST = np.deg2rad(50.0)


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
    value = top - diffuse_albedo * cosine * body_factor(shading, cosine, half_cosine, lights[brightest][..., :2])
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
