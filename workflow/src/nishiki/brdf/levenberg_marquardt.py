"""Levenberg-Marquardt, the published way to fit the Torrance-Sparrow model (Tominaga and Tanaka 2004, eq. 18): the
baseline.

It needs a start, and parameters of like size: here it works on the strengths and on log gamma, from a start that the
caller may choose.  scipy's `least_squares(method="lm")` is MINPACK's lmder (More, The Levenberg-Marquardt algorithm:
implementation and theory, 1978).
"""

import numpy as np

from nishiki.brdf import variable_projection as vp

START_GAMMA = 0.1
FARTHEST = 2000.0  # 2^-2000 is 0
_TWO_LN2 = 2.0 * np.log(2.0)


def _squared_ratio(phi, log_gamma):
    """(phi / gamma)^2, held where 2^-ratio is 0 or 1 in float64: the search may pass any width."""
    return np.minimum((phi / np.exp(np.clip(log_gamma, -50.0, 50.0))) ** 2, FARTHEST)


def fit_lobe(phi, amplitude, attenuation, *, start=(1.0, START_GAMMA)):
    """beta and gamma of one lobe from specular samples alone: minimise sum (amplitude - beta a D(phi; gamma))^2.

    phi (radians), amplitude, attenuation a: (samples,).  start: (beta, gamma).  Returns (beta, gamma, covariance of
    (beta, gamma), root mean square residual, converged); the covariance is infinite where it is not defined.
    """
    from scipy.optimize import least_squares

    def residual(p):
        return p[0] * attenuation * np.exp2(-_squared_ratio(phi, p[1])) - amplitude

    def jacobian(p):
        ratio2 = _squared_ratio(phi, p[1])
        s = attenuation * np.exp2(-ratio2)
        return np.stack([s, p[0] * s * _TWO_LN2 * ratio2], axis=1)

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
        ratio2 = _squared_ratio(phi, p[-1])
        return kd, ks, root_weights * attenuation * np.exp2(-ratio2), ratio2

    def residual(p):
        kd, ks, lobe, _ = parts(p)
        return (np.outer(root_weights * diffuse, kd) + np.outer(lobe, ks) - root_weights[:, None] * amplitude).ravel()

    def jacobian(p):
        _, ks, lobe, ratio2 = parts(p)
        blocks = [np.multiply.outer(c, columns).reshape(-1, channels) for c in (root_weights * diffuse, lobe)]
        return np.hstack([*blocks, np.outer(lobe * _TWO_LN2 * ratio2, ks).reshape(-1, 1)])

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
        reports[p, vp.CURVATURE] = _projected_curvature(solution.jac)
        reports[p, vp.NEAREST], reports[p, vp.LIT] = x.min(), np.sum(x < 2 * gamma)


def _projected_curvature(jacobian):
    """Squared length of the last column off the span of the others."""
    others, last = jacobian[:, :-1], jacobian[:, -1]
    rest = last - others @ np.linalg.lstsq(others, last, rcond=None)[0]
    return float(rest @ rest)
