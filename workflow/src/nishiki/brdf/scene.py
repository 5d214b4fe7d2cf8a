"""One set of Torrance-Sparrow parameters for a scene or a region, from its specular profile (Tominaga and Tanaka 2004,
eq. 14-18, improved).

The profile z(phi) = beta D(phi; gamma) gathers all lights of all usable pixels (`specular_histogram`).  Normals that
are uncertain by sigma in each tangent direction blur the lobe: seen over the estimated phi it is the convolution of two
round Gaussians, of standard deviations s = gamma / sqrt(2 ln 2) and sigma,

    z(phi) = beta s^2 / (s^2 + sigma^2) exp(-phi^2 / (2 (s^2 + sigma^2))),

a lobe too wide and too low.  With sigma known for each row of the profile, beta and gamma are fitted through the
convolution (errors in variables), not to its result.
"""

from dataclasses import dataclass, replace

import numpy as np

from nishiki.brdf.flags import FitFlag
from nishiki.brdf.specular_histogram import SpecularHistogram, SpecularProfile
from nishiki.brdf.torrance_sparrow import GAMMA_PER_SIGMA
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
        return (alone,), _rss(y, first, alone)
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


def _rss(y, columns, strengths):
    """Residual sums of squares of one-column fits, from the residuals."""
    return np.sum((y[:, None] - columns * strengths) ** 2, axis=0)


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
