"""Describe the gloss of a scene or its regions for `parameters.json`; the fit is in `nishiki.brdf.gloss_profile`."""

import numpy as np

from nishiki.brdf.gloss_profile import GlossProfile, SpecularProfile

GAMMA_BOUNDS = (1e-3, 1.6)  # radians, half widths
NO_GLOSS = "no gloss: Lambert"


def describe_ladder(
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
    """Describe a region that is Lambert alone: a lobe of strength 0, nothing fitted; samples: the number examined."""
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


def pad_lobes(regions: list[dict]) -> list[dict]:
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
    """Describe the half widths of fitted lobes that stand at the end of the range on offer."""
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


ALIKE = 0.25  # relative rms difference of two lobes; parts of one finish differed by up to 0.14, two finishes by 0.67
ANGLES = np.linspace(0, 0.8, 200)  # between normal and half vector, radians, at which lobes are compared


def join_regions(scenes: list[list[dict]]) -> tuple[list[dict], list[list[int]]]:
    """Join the regions of several scenes of one object: those whose gloss agrees become one.

    Lobes have widths of one ladder, so that the mean of their strengths, weighted by samples, is the mean of the gloss.
    Returns the joined regions, those with most samples first, and the number among them of each scene's regions.
    """
    order = [(scene, number) for scene, regions in enumerate(scenes) for number in range(len(regions))]
    groups: list[list[dict]] = []
    firsts: list[tuple[dict, np.ndarray]] = []  # of each group, with its gloss at ANGLES
    numbers = [[0] * len(regions) for regions in scenes]
    for scene, number in sorted(order, key=lambda place: -scenes[place[0]][place[1]]["samples"]):
        region = scenes[scene][number]
        own, place = GlossProfile(np.array(region["beta"]), np.array(region["gamma"])).value(ANGLES), len(groups)
        for k, (first, gloss) in enumerate(firsts):
            # over the solid angle
            alike = np.square(gloss - own) @ ANGLES <= ALIKE**2 / 2 * (np.square(gloss) + np.square(own)) @ ANGLES
            alike &= abs(first["transmission"] - region["transmission"]) <= ALIKE
            if alike and first["refractive_index"] == region["refractive_index"]:
                place = k
                break
        else:
            groups.append([])
            firsts.append((region, own))
        groups[place].append(region)
        numbers[scene][number] = place
    return pad_lobes([_pool(group) for group in groups]) if groups else [], numbers


def _pool(group: list[dict]) -> dict:
    """Join regions that agree; the profile is that of the first."""
    weight = np.array([max(region["samples"], 1) for region in group], float)
    weight /= weight.sum()
    beta: dict[float, float] = {}
    for share, region in zip(weight, group, strict=True):
        for strength, gamma in zip(region["beta"], region["gamma"], strict=True):
            beta[gamma] = beta.get(gamma, 0.0) + float(share * strength)
    gammas = sorted((gamma for gamma in beta if beta[gamma] > 0), key=lambda gamma: -beta[gamma])
    gammas = gammas or group[0]["gamma"][:1]
    return {
        **group[0],
        "beta": [beta[gamma] for gamma in gammas],
        "gamma": gammas,
        "samples": sum(region["samples"] for region in group),
        **{
            name: float(weight @ [region[name] for region in group])
            for name in ("transmission", "residual", "rejected")
        },
    }
