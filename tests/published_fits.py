"""The published fit of a scene from its brightest lights (Tominaga and Tanaka 2004, eq. 14-18), a baseline."""

from dataclasses import dataclass

import numpy as np

from nishiki.brdf.fit import fit_lobe
from nishiki.brdf.scene import brightest_light_samples, thin


@dataclass(frozen=True)
class BrightestLightFit:
    """beta (relative to the white reference) and gamma (radians) with what they rest on."""

    beta: float
    gamma: float
    refractive_index: float
    covariance: np.ndarray  # (2, 2) of (beta, gamma), infinite where not defined
    residual: float  # root mean square over the thinned samples, relative to the white reference
    phi: np.ndarray  # (samples,) thinned samples: angle(normal, half vector), radians
    value: np.ndarray  # (samples,) observation minus predicted diffuse
    converged: bool


def fit_brightest_light(
    observations, normals, diffuse_albedo, lights, *, refractive_index=1.45, start=(1.0, 0.1), seed=0, **settings
) -> BrightestLightFit:
    """beta and gamma of a scene as published: `brightest_light_samples`, `thin`, Levenberg-Marquardt from `start`."""
    samples = brightest_light_samples(
        observations, normals, diffuse_albedo, lights, refractive_index=refractive_index, **settings
    )
    kept = thin(samples[0], seed=seed)
    phi, value, factor = (s[kept] for s in samples)
    if phi.size < 3:
        nothing = np.full((2, 2), np.inf)
        return BrightestLightFit(0.0, start[1], refractive_index, nothing, 0.0, phi, value, False)
    beta, gamma, covariance, residual, converged = fit_lobe(phi, value, factor, start=start)
    return BrightestLightFit(beta, gamma, refractive_index, covariance, residual, phi, value, converged)
