"""parameters.json: the reflection parameters of each region, as plain numbers."""

import numpy as np

from nishiki.brdf.scene import TorranceSparrowFit


def described(fit: TorranceSparrowFit) -> dict:
    """One region's parameters, their standard errors and the profile that they were fitted to."""
    finite = bool(np.isfinite(fit.covariance).all())
    profile = fit.profile
    return {
        "beta": fit.beta.tolist(),
        "gamma": fit.gamma.tolist(),
        "refractive_index": fit.refractive_index,
        "standard_errors": np.sqrt(np.diag(fit.covariance)).tolist() if finite else None,
        "residual": fit.residual,
        "samples": fit.samples,
        "rejected": fit.rejected,
        "flags": [flag.name for flag in fit.flags],
        "profile": {
            "phi": profile.phi.tolist(),
            "value": profile.value.tolist(),
            "count": profile.count.tolist(),
            "fitted": fit.fitted.tolist(),
        },
    }


def gloss_table(parameters: dict) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """beta (regions, lobes), gamma (regions, lobes) in radians, refractive index (regions,) of a parameters.json."""
    regions = parameters["regions"]
    beta = np.array([region["beta"] for region in regions], dtype=np.float64)
    gamma = np.array([region["gamma"] for region in regions], dtype=np.float64)
    return beta, gamma, np.array([region["refractive_index"] for region in regions], dtype=np.float64)
