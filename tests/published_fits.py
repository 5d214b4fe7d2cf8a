"""The published fit of a scene from its brightest lights (Tominaga and Tanaka 2004, eq. 14-18), a baseline."""

from dataclasses import dataclass

import numpy as np

from nishiki.brdf import variable_projection as vp
from nishiki.brdf.fit import START_GAMMA, fit_lobe
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
    """`variable_projection.project_points` by scipy, one point after the other; the same outputs."""
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
