"""The published fit of a scene from its brightest lights (Tominaga and Tanaka 2004, eq. 14-18), a baseline."""

from dataclasses import dataclass

import numpy as np
import point_fits as vp

from nishiki.brdf.gloss_profile import GlossProfile, SpecularHistogram, specular_samples
from nishiki.brdf.torrance_sparrow import attenuation, body_factor, half_vector_geometry

START_GAMMA = 0.1


def histogram_of(
    observations, normals, diffuse_albedo, lights, *, sigma=0.0, regions=None, gloss=None
) -> SpecularHistogram:
    """Gather every observation (light, row, column) of a picture, relative to the white reference; NaN is left out.

    normals (row, column, 3); diffuse_albedo (row, column); lights (light, 3); sigma (row, column), deviation of the
    normals per tangent axis, radians; regions: integers (row, column), -1 leaves a pixel out, None is one region;
    gloss: whose transmission and index count, None: Lambert's law.
    """
    gloss = GlossProfile(np.zeros(1), np.ones(1), transmission=0.0) if gloss is None else gloss
    regions = np.zeros(np.shape(diffuse_albedo), int) if regions is None else regions
    sigma = np.broadcast_to(sigma, regions.shape)
    histogram = SpecularHistogram.empty(regions=int(regions.max()) + 1)
    for region in np.unique(regions[regions >= 0]):
        here = regions == region
        samples = specular_samples(
            observations[:, here, None], lights, normals[here], diffuse_albedo[here, None], gloss, valid=True
        )
        histogram = histogram.add_samples(*samples, sigma=sigma[here], region=region)
    return histogram


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


def squared_ratio(phi, log_gamma):
    """(phi / gamma)^2 of any width, held where 2^-ratio is 0 or 1."""
    return np.minimum((phi / np.exp(np.clip(log_gamma, -50.0, 50.0))) ** 2, 2000.0)


def point_problem(phi, amplitude, attenuation, diffuse, root_weights):
    """(residual, jacobian, start) of one point: unknowns K_d per channel, K_s per channel, log gamma.

    The start is what the data suggest without a search: the median of amplitude / q as K_d, the largest rest divided by
    its a as K_s, and START_GAMMA.
    """
    channels = amplitude.shape[1]
    lambert = np.any(diffuse != 0)
    columns = np.eye(channels)

    def parts(p):
        kd, ks = p[:channels], p[channels : 2 * channels]
        ratio2 = squared_ratio(phi, p[-1])
        return kd, ks, root_weights * attenuation * np.exp2(-ratio2), ratio2

    def residual(p):
        kd, ks, lobe, _ = parts(p)
        return (np.outer(root_weights * diffuse, kd) + np.outer(lobe, ks) - root_weights[:, None] * amplitude).ravel()

    def jacobian(p):
        _, ks, lobe, ratio2 = parts(p)
        blocks = [np.multiply.outer(c, columns).reshape(-1, channels) for c in (root_weights * diffuse, lobe)]
        return np.hstack([*blocks, np.outer(lobe * 2 * np.log(2) * ratio2, ks).reshape(-1, 1)])

    facing = diffuse > 0
    kd = np.median(amplitude[facing] / diffuse[facing, None], axis=0) if lambert else np.zeros(channels)
    rest = (amplitude - np.outer(diffuse, kd)) / np.where(attenuation > 0, attenuation, np.inf)[:, None]
    ks = np.maximum(rest.max(axis=0), 1e-12)
    return residual, jacobian, np.concatenate([kd, ks, [np.log(START_GAMMA)]])


def fit_points(phi, amplitude, attenuation, diffuse, weights, strengths, reports, *, analytic=True):
    """`point_fits.project_points` by scipy, one point after the other; writes the same outputs."""
    from scipy.optimize import least_squares

    for p in range(amplitude.shape[0]):
        good = np.isfinite(amplitude[p]).all(axis=1) & (weights[p] > 0)
        good &= np.isfinite(phi[p] + attenuation[p] + diffuse[p] + weights[p])
        x, y, a, q, w = (np.asarray(m[p][good], float) for m in (phi, amplitude, attenuation, diffuse, weights))
        channels = y.shape[1]
        reports[p, vp.USED], reports[p, vp.SCALE], reports[p, vp.GAMMA] = good.sum(), 1, np.nan
        if good.sum() * channels < 2 * channels + 1:
            continue
        residual, jacobian, start = point_problem(x, y, a, q, np.sqrt(w))
        with np.errstate(over="ignore", under="ignore"):
            solution = least_squares(residual, start, jac=jacobian if analytic else "2-point", method="lm")
        strengths[p, :, 0], strengths[p, :, 1] = solution.x[channels : 2 * channels], solution.x[:channels]
        gamma = np.exp(np.clip(solution.x[-1], -80, 80))
        basis = np.sqrt(w) * q
        best = np.maximum(basis @ (np.sqrt(w)[:, None] * y) / max(basis @ basis, 1e-300), 0)
        reports[p, vp.GAMMA], reports[p, vp.RSS] = gamma, 2 * solution.cost
        reports[p, vp.RSS_DIFFUSE] = np.sum(w[:, None] * (y - np.outer(q, best)) ** 2)
        others, last = solution.jac[:, :-1], solution.jac[:, -1]
        rest = last - others @ np.linalg.lstsq(others, last, rcond=None)[0]
        reports[p, vp.CURVATURE] = float(rest @ rest)
        reports[p, vp.NEAREST], reports[p, vp.LIT] = x.min(), np.sum(x < 2 * gamma)


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
        return np.stack([s, p[0] * s * 2 * np.log(2) * ratio2], axis=1)

    first = np.array([start[0], np.log(start[1])], float)
    with np.errstate(over="ignore", under="ignore"):
        solution = least_squares(residual, first, jac=jacobian, method="lm")
    beta, gamma = solution.x[0], float(np.exp(np.clip(solution.x[1], -50.0, 50.0)))
    variance = 2 * solution.cost / max(phi.size - 2, 1)
    normal = solution.jac.T @ solution.jac
    scale = np.sqrt(np.diag(normal))
    if np.all(scale > 0) and np.linalg.cond(normal / np.outer(scale, scale)) < 1e14:
        covariance = variance * np.linalg.inv(normal / np.outer(scale, scale)) / np.outer(scale, scale)
    else:
        covariance = np.full((2, 2), np.inf)
    to_gamma = np.array([1.0, gamma])
    covariance = covariance * np.outer(to_gamma, to_gamma)
    # where the search ran off to no width, or to one so large that none is told, it stops: that is no convergence
    converged = bool(solution.success and np.isfinite(covariance).all() and 1e-6 < gamma < 10)
    return float(beta), gamma, covariance, float(np.sqrt(2 * solution.cost / phi.size)), converged


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

    Arguments as `histogram_of`; smoothing: standard deviation in pixels of the Gaussian that smooths the
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
    keep = usable.any(axis=0) & (smooth[..., 2] > np.cos(np.deg2rad(50.0))) & (factor > 0) & np.isfinite(value + factor)
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
