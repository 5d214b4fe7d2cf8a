"""Describe the gloss of a scene or its regions for `parameters.json`; the fit is in `nishiki.brdf.gloss_profile`."""

import numpy as np

from nishiki.brdf.fit import GAMMA_BOUNDS
from nishiki.brdf.gloss_profile import GlossProfile, SpecularProfile

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


def parameters_at_bounds(regions: list[dict]) -> list[str]:
    """Half widths of fitted lobes that stand at the end of the range on offer, in words."""
    names = [f"region {number}" if len(regions) > 1 else "whole scene" for number in range(len(regions))]
    pairs = zip(names, regions, strict=True)
    return [f"{each}, {name}" for name, region in pairs for each in region.get("at_bounds", [])]


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
