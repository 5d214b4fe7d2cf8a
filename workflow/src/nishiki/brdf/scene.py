"""Fit one set of Torrance-Sparrow parameters to a scene or a region, and read and write `parameters.json`.

The method is that of Tominaga and Tanaka (2004, eq. 14-18), improved.  The profile z(phi) = beta D(phi; gamma) gathers
all lights of all usable pixels (`specular_histogram`).  Normals that are uncertain by sigma in each tangent direction
blur the lobe: seen over the estimated phi it is the convolution of two round Gaussians, of standard deviations s =
gamma / sqrt(2 ln 2) and sigma,

    z(phi) = beta s^2 / (s^2 + sigma^2) exp(-phi^2 / (2 (s^2 + sigma^2))),

a lobe too wide and too low.  With sigma known for each row of the profile, beta and gamma are fitted through the
convolution (errors in variables), not to its result.
"""

from dataclasses import dataclass, replace

import numpy as np

from nishiki.artifacts.limits import at_end
from nishiki.brdf.fit import FitFlag
from nishiki.brdf.gloss_profile import GlossProfile, SpecularHistogram, SpecularProfile
from nishiki.brdf.torrance_sparrow import GAMMA_PER_SIGMA, attenuation, body_factor, half_vector_geometry
from nishiki.errors import UserError

GAMMA_BOUNDS = (1e-3, 1.6)
ZOOMS, NODES = 14, 9
_SIGNIFICANCE = 12.0
_ONE_SUFFICES = 1e-3  # a residual of this part of the profile is within the width of its rows
_APART = 1.3  # two lobes closer in width than this are one


@dataclass(frozen=True)
class TorranceSparrowFit:
    """Gloss of a scene: sum over the lobes of beta D(phi; gamma), times F G / cos theta_r.

    beta and gamma hold one entry a lobe, the strongest at phi = 0 first.  Where flags contain NO_HIGHLIGHT or TOO_FEW
    beta is 0 and gamma the upper bound of the search (a finite lobe of no strength).
    """

    beta: np.ndarray  # (lobes,) relative to the white reference
    gamma: np.ndarray  # (lobes,) half widths, radians
    refractive_index: float
    covariance: np.ndarray  # (2 lobes, 2 lobes), of (beta..., gamma...); infinite where not defined
    residual: float  # weighted root mean square of (observed - fitted) profile, relative to the white reference
    samples: int  # observations in the profile
    rejected: float  # weight of the outliers left out, as a part of all
    profile: SpecularProfile  # what was fitted
    fitted: np.ndarray  # (rows,) the fit at the profile's phi, blur by the normals included
    flags: FitFlag


def fit_scene(
    histogram: SpecularHistogram, *, lobes="auto", normal_noise=True, reject=6.0, gamma_bounds=GAMMA_BOUNDS
) -> tuple[TorranceSparrowFit, ...]:
    """Torrance-Sparrow parameters of each region of the histogram, one entry a region.

    lobes: 1 (the model of Tominaga and Tanaka (2004), eq. 10), 2 (a narrow and a wide lobe, for varnish with long
    tails), or "auto": 2 where a second lobe of another width is significant (F ratio above 12) and both are determined;
    regions with one lobe get a second of strength 0 where another region has two.  normal_noise: undo
    the blur by uncertain normals, with the sigma that was given to the histogram.  reject: outlier fence, see
    `SpecularHistogram.profile`; where the lobe proves narrower than the normals are certain, its samples are themselves
    rare and nothing is rejected.  gamma_bounds: radians.
    """
    if lobes not in (1, 2, "auto"):
        raise UserError(f"lobes: expected 1, 2 or 'auto', found {lobes!r}")
    low, high = gamma_bounds
    if not 0 < low < high < np.inf:
        raise UserError(f"gamma_bounds: expected 0 < low < high in radians, found {gamma_bounds}; e.g. {GAMMA_BOUNDS}")
    fits = []
    for region in range(histogram.weights.shape[0]):
        profile = histogram.profile(region=region, reject=reject)
        sigma = profile.sigma if normal_noise else np.zeros_like(profile.sigma)
        settings = {"lobes": lobes, "gamma_bounds": gamma_bounds}
        fit = fit_profile(profile, sigma, histogram.refractive_index, **settings)
        blurred = bool(np.any(GAMMA_PER_SIGMA * profile.sigma > np.min(fit.gamma)))
        if np.isfinite(reject) and profile.phi.size and (blurred or FitFlag.NO_HIGHLIGHT in fit.flags):
            profile = histogram.profile(region=region, reject=np.inf)
            sigma = profile.sigma if normal_noise else np.zeros_like(profile.sigma)
            fit = fit_profile(profile, sigma, histogram.refractive_index, **settings)
        fits.append(fit)
    most = max((fit.beta.size for fit in fits), default=1)
    return tuple(_padded(fit, most) for fit in fits)


def _padded(fit, lobes):
    """The fit with lobes of strength 0 added, so that all regions have as many; the covariance of those is 0."""
    k, missing = fit.beta.size, lobes - fit.beta.size
    if missing == 0:
        return fit
    covariance = np.zeros((2 * lobes, 2 * lobes))
    rows = np.r_[0:k, lobes : lobes + k]
    covariance[np.ix_(rows, rows)] = fit.covariance
    beta, gamma = np.pad(fit.beta, (0, missing)), np.pad(fit.gamma, (0, missing), mode="edge")
    return replace(fit, beta=beta, gamma=gamma, covariance=covariance)


def fit_profile(profile: SpecularProfile, sigma, refractive_index, *, lobes="auto", gamma_bounds=GAMMA_BOUNDS):
    """Variable projection on a profile: strengths eliminated (>= 0), half widths by a global grid and zooms into it."""
    if lobes == "auto":
        settings = {"gamma_bounds": gamma_bounds}
        one = fit_profile(profile, sigma, refractive_index, lobes=1, **settings)
        size = np.sqrt(np.average(profile.value**2, weights=profile.weight)) if profile.phi.size else 0.0
        if one.flags & (FitFlag.NO_HIGHLIGHT | FitFlag.TOO_FEW) or one.residual < _ONE_SUFFICES * size:
            return one
        two = fit_profile(profile, sigma, refractive_index, lobes=2, **settings)
        ratio = ((one.residual / max(two.residual, 1e-300)) ** 2 - 1) / 2 * max(profile.phi.size - 4, 1)
        apart = two.gamma.max() > _APART * two.gamma.min()
        return two if two.flags == 0 and apart and ratio > _SIGNIFICANCE else one
    count = int(profile.count.sum())
    if profile.phi.size < 2 * lobes + 1:
        return _nothing(profile, refractive_index, lobes, gamma_bounds[1], count, FitFlag.TOO_FEW)
    scale = np.max(abs(profile.value)) or 1.0
    value, root = profile.value / scale, np.sqrt(profile.weight / profile.weight.sum())
    log_gamma, beta, rss = _search(profile.phi, value * root, root, sigma, np.log(gamma_bounds), lobes)
    total = np.sum((value * root) ** 2)
    freedom = max(profile.phi.size - 2 * lobes, 1)
    gain = total - rss
    if beta.max() <= 0 or gain < _SIGNIFICANCE * rss / freedom or gain <= 1e-24 * total:
        return _nothing(profile, refractive_index, lobes, gamma_bounds[1], count, FitFlag.NO_HIGHLIGHT)
    order = np.argsort(-beta)
    beta, gamma = beta[order] * scale, np.exp(log_gamma[order])
    fitted = _columns(profile.phi, sigma, np.log(gamma)) @ beta
    covariance = _covariance(profile.phi, sigma, root, beta, gamma, rss * scale**2 / freedom)
    deviation = np.sqrt(np.diag(covariance)[lobes:]) / gamma
    flags = FitFlag(0)
    lit = np.sum(profile.phi < 2 * gamma[0])
    if lit < 2 or not np.all(deviation[beta > 0] < 0.5):
        flags |= FitFlag.UNDETERMINED
    live = gamma[beta > 0]
    if np.any(live <= gamma_bounds[0] * 1.0001) or np.any(live >= gamma_bounds[1] * 0.9999):
        flags |= FitFlag.AT_BOUND
    residual = float(np.sqrt(np.sum((root * (fitted - profile.value)) ** 2)))
    rejected = float(np.sum(profile.rejected * profile.weight) / np.sum(profile.weight))
    return TorranceSparrowFit(
        beta, gamma, refractive_index, covariance, residual, count, rejected, profile, fitted, flags
    )


def _columns(phi, sigma, log_gamma):
    """Blurred lobes of strength 1: phi, sigma (rows,); log_gamma (..., ) -> (rows, ...)."""
    s2 = (np.exp(log_gamma) / GAMMA_PER_SIGMA) ** 2
    phi, sigma = (np.reshape(a, (-1,) + (1,) * np.ndim(log_gamma)) for a in (phi, sigma))
    blurred = s2 + sigma**2
    with np.errstate(under="ignore"):
        return s2 / blurred * np.exp(-(phi**2) / (2 * blurred))


def _search(phi, y, root, sigma, log_bounds, lobes):
    """Half widths of least squares: the best node of a grid, then of ever finer grids about it."""
    low, high = log_bounds
    nodes = np.linspace(low, high, int(np.ceil((high - low) / 0.15)) + 1)
    centre, reach = None, nodes[1] - nodes[0]
    for _ in range(ZOOMS + 1):
        axes = [nodes] * lobes if centre is None else [np.linspace(c - reach, c + reach, NODES) for c in centre]
        axes = [np.unique(np.clip(axis, low, high)) for axis in axes]
        columns = [_columns(phi, sigma, axis) * root[:, None] for axis in axes]
        strengths, rss = _least_squares(columns, y)
        best = np.unravel_index(np.argmin(rss), rss.shape)
        if centre is not None:
            reach *= 3 / (NODES - 1)
        centre = np.array([axis[k] for axis, k in zip(axes, best, strict=True)])
    # the sum of squares from the residuals themselves: no cancellation
    beta = np.array([s[best] for s in strengths])
    rest = y - np.stack([c[:, k] for c, k in zip(columns, best, strict=True)], axis=1) @ beta
    return centre, beta, float(rest @ rest)


def _least_squares(columns, y):
    """Non-negative strengths and residual sum of squares for every combination of one column from each set."""
    first = columns[0]
    aa, ay = np.sum(first**2, axis=0), first.T @ y
    alone = np.maximum(ay, 0) / np.where(aa > 0, aa, 1)
    if len(columns) == 1:
        return (alone,), np.sum((y[:, None] - first * alone) ** 2, axis=0)
    second = columns[1]
    bb, by, ab = np.sum(second**2, axis=0)[None, :], (second.T @ y)[None, :], first.T @ second
    aa, ay = aa[:, None], ay[:, None]
    det = aa * bb - ab * ab
    regular = det > 1e-10 * aa * bb
    det = np.where(regular, det, 1)
    s, t = (bb * ay - ab * by) / det, (aa * by - ab * ay) / det
    inside = regular & (s >= 0) & (t >= 0)
    s1 = np.maximum(ay, 0) / np.where(aa > 0, aa, 1) + np.zeros_like(ab)
    t1 = np.maximum(by, 0) / np.where(bb > 0, bb, 1) + np.zeros_like(ab)
    first_wins = s1 * ay >= t1 * by
    s = np.where(inside, s, np.where(first_wins, s1, 0))
    t = np.where(inside, t, np.where(first_wins, 0, t1))
    return (s, t), float(y @ y) - s * ay - t * by


def _covariance(phi, sigma, root, beta, gamma, variance):
    """Covariance of (beta..., gamma...) from the Jacobian of the profile, infinite if it is singular."""
    step = 1e-5
    columns = _columns(phi, sigma, np.log(gamma))
    slopes = (_columns(phi, sigma, np.log(gamma) + step) - _columns(phi, sigma, np.log(gamma) - step)) / (2 * step)
    jacobian = root[:, None] * np.hstack([columns, slopes * (beta / gamma)])
    length = np.sqrt(np.sum(jacobian**2, axis=0))
    if np.all(length > 0) and np.linalg.cond(jacobian / length) < 1e8:
        unit = jacobian / length
        return variance * np.linalg.inv(unit.T @ unit) / np.outer(length, length)
    return np.full((2 * beta.size, 2 * beta.size), np.inf)


def _nothing(profile, refractive_index, lobes, gamma, count, flag):
    """A scene without a lobe."""
    residual = float(np.sqrt(np.average(profile.value**2, weights=profile.weight))) if profile.phi.size else 0.0
    return TorranceSparrowFit(
        np.zeros(lobes), np.full(lobes, gamma), refractive_index, np.full((2 * lobes, 2 * lobes), np.inf),
        residual, count, 0.0, profile, np.zeros_like(profile.value), flag,
    )  # fmt: skip


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


NO_GLOSS = "no gloss: Lambert"


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
        "profile": described_profile(profile, fit.fitted),
    }


def described_profile(profile: SpecularProfile, fitted: np.ndarray) -> dict[str, list]:
    """Angles, values and counts of a profile, and what the fit (rows,) has in their place."""
    values = {name: getattr(profile, name).tolist() for name in ("phi", "value", "count")}
    return {**values, "fitted": fitted.tolist()}


def described_ladder(
    beta: np.ndarray, gamma: np.ndarray, lobes: np.ndarray, profile: SpecularProfile, refractive_index: float
) -> dict:
    """Likewise for lobes of given widths (`nishiki.brdf.gloss_profile`): those of some strength, strongest first.

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
        "profile": described_profile(profile, fitted),
    }


def without_gloss(refractive_index: float, samples: int) -> dict:
    """A region that is Lambert alone: a lobe of strength 0, nothing fitted; samples: that were looked at."""
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
    """The regions with lobes of strength 0 added, so that all have as many."""
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
    """Half widths of fitted lobes that stand at the end of the range that was searched or on offer, in words."""
    texts = []
    for number, region in enumerate(regions):
        name = f"region {number}" if len(regions) > 1 else "whole scene"
        texts += [f"{each}, {name}" for each in region.get("at_bounds", [])]
        if "AT_BOUND" not in region["flags"] or region.get("at_bounds"):
            continue
        for lobe, (beta, gamma) in enumerate(zip(region["beta"], region["gamma"], strict=True), 1):
            end = at_end(gamma, *GAMMA_BOUNDS) if beta > 0 else ""
            if end:
                texts.append(f"half width of lobe {lobe}, {name}: {np.degrees(gamma):.3g} degrees, the {end} end")
    return texts


def is_facets(parameters: dict) -> bool:
    """Whether the lobes are those of the facets alone, so that the slopes inside a pixel widen them; the published fit
    sees both as one."""
    return parameters["method"] != "paper"


def gloss_table(parameters: dict | None) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """beta (regions, lobes), gamma (regions, lobes) in radians, refractive index (regions,) of a parameters.json, and
    the share of the surface's loss that the body's light suffers (`transmittance`). None: a painting without a fit,
    one region without gloss."""
    if parameters is None:
        return np.zeros((1, 1)), np.full((1, 1), 0.5), np.full(1, 1.45), 0.0
    regions = parameters["regions"]
    beta = np.array([region["beta"] for region in regions], dtype=np.float64)
    gamma = np.array([region["gamma"] for region in regions], dtype=np.float64)
    index = np.array([region["refractive_index"] for region in regions], dtype=np.float64)
    return beta, gamma, index, float(parameters["transmission"])
