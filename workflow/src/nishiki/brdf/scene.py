"""Samples of the published fit of a scene's gloss, and `parameters.json`: the gloss of a scene or its regions.

The published fit is that of Tominaga and Tanaka (2004, eq. 14-18); the default's is in `nishiki.brdf.gloss_profile`.
"""

import numpy as np

from nishiki.brdf.fit import GAMMA_BOUNDS
from nishiki.brdf.gloss_profile import GlossProfile, SpecularProfile
from nishiki.brdf.torrance_sparrow import attenuation, body_factor, half_vector_geometry

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
    """Choose at most `per_bin` samples in each of `bins` equal intervals of phi: a constant density over phi."""
    order = np.random.default_rng(seed).permutation(phi.size)
    top = phi.max(initial=0.0)
    index = np.minimum((phi[order] * (bins / top)).astype(int), bins - 1) if top > 0 else np.zeros(phi.size, int)
    ranked = np.argsort(index, kind="stable")
    start = np.searchsorted(index[ranked], np.arange(bins))
    rank = np.arange(phi.size) - start[index[ranked]]
    return np.sort(order[ranked[rank < per_bin]])


NO_GLOSS = "no gloss: Lambert"


def described_ladder(
    beta: np.ndarray, gamma: np.ndarray, lobes: np.ndarray, profile: SpecularProfile, refractive_index: float
) -> dict:
    """Describe lobes of given widths (`nishiki.brdf.gloss_profile`): those of some strength, strongest first.

    beta, gamma : (lobes,); lobes : (rows, lobes) of the profile for strengths of 1. A region without any is Lambert's.
    """
    order = [k for k in np.argsort(-beta, kind="stable") if beta[k] > 0]
    if not order:
        return without_gloss(refractive_index, int(profile.count.sum()))
    fitted = lobes @ beta
    weight = profile.weight / max(float(profile.weight.sum()), np.finfo(float).tiny)
    ends = GlossProfile(beta, gamma).ends()
    return {
        "beta": beta[order].tolist(),
        "gamma": gamma[order].tolist(),
        "refractive_index": refractive_index,
        "standard_errors": None,
        "residual": float(np.sqrt(weight @ (profile.value - fitted) ** 2)),
        "samples": int(profile.count.sum()),
        "rejected": float(weight @ profile.rejected),
        "flags": ["AT_BOUND"] * bool(ends),
        "at_bounds": ends,
        "profile": {
            **{name: getattr(profile, name).tolist() for name in ("phi", "value", "count")},
            "fitted": fitted.tolist(),
        },
    }


def without_gloss(refractive_index: float, samples: int) -> dict:
    """Describe a region that is Lambert alone: a lobe of strength 0, nothing fitted; samples: that were looked at."""
    return {
        "beta": [0.0],
        "gamma": [GAMMA_BOUNDS[1]],
        "refractive_index": refractive_index,
        "standard_errors": None,
        "residual": 0.0,
        "samples": samples,
        "rejected": 0.0,
        "flags": [NO_GLOSS],
        "profile": {"phi": [], "value": [], "count": [], "fitted": []},
    }


def of_equal_lobes(regions: list[dict]) -> list[dict]:
    """Add lobes of strength 0 to the regions, so that all have as many."""
    most = max(len(region["beta"]) for region in regions)
    return [
        {
            **region,
            "beta": region["beta"] + [0.0] * (most - len(region["beta"])),
            "gamma": region["gamma"] + region["gamma"][-1:] * (most - len(region["gamma"])),
        }
        for region in regions
    ]


def described_brightest(
    phi: np.ndarray, value: np.ndarray, attenuation: np.ndarray, fitted: tuple, index: float
) -> dict:
    """Likewise for the published fit: thinned samples (phi, value, F G / cos_r) and (beta, gamma, covariance, ...)."""
    beta, gamma, covariance, residual, converged = fitted
    order = np.argsort(phi)[:: max(1, phi.size // 500)]
    lobe = value[order] / attenuation[order]
    finite = bool(np.isfinite(covariance).all())
    return {
        "beta": [float(beta)],
        "gamma": [float(gamma)],
        "refractive_index": index,
        "standard_errors": np.sqrt(np.diag(covariance)).tolist() if finite else None,
        "residual": float(residual),
        "samples": int(phi.size),
        "rejected": 0.0,
        "flags": [] if converged else ["NOT_CONVERGED"],
        "profile": {
            "phi": phi[order].tolist(),
            "value": lobe.tolist(),
            "count": [1] * len(order),
            "fitted": (beta * np.exp2(-((phi[order] / gamma) ** 2))).tolist(),
        },
    }


def parameters_at_bounds(regions: list[dict]) -> list[str]:
    """Half widths of fitted lobes that stand at the end of the range on offer, in words."""
    names = [f"region {number}" if len(regions) > 1 else "whole scene" for number in range(len(regions))]
    pairs = zip(names, regions, strict=True)
    return [f"{each}, {name}" for name, region in pairs for each in region.get("at_bounds", [])]


def is_facets(parameters: dict) -> bool:
    """Return whether the lobes are of the facets alone, so that slopes inside a pixel widen them."""
    return parameters["method"] != "paper"


def gloss_table(parameters: dict | None) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return beta, gamma (regions, lobes; radians), refractive index and transmission (regions,) of a parameters.json.

    Transmission is the share of the surface's loss that the body's light suffers (`transmittance`). None: a painting
    without a fit, one region without gloss.
    """
    if parameters is None:
        return np.zeros((1, 1)), np.full((1, 1), 0.5), np.full(1, 1.45), np.zeros(1)
    regions = parameters["regions"]
    beta = np.array([region["beta"] for region in regions], dtype=np.float64)
    gamma = np.array([region["gamma"] for region in regions], dtype=np.float64)
    index = np.array([region["refractive_index"] for region in regions], dtype=np.float64)
    return beta, gamma, index, np.array([region["transmission"] for region in regions], dtype=np.float64)
