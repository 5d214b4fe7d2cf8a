"""The model at each texel by itself: Lambert weighted by cos(theta_r), and one lobe by variable projection.

`first_fit` finds what the observations of a texel say alone, with how well they say it; `strengths` then solves for K_d
and K_s at a given sigma with a prior for K_s from the neighbours (`nishiki.brdf.texels.neighbours`).  Uncertainties are
relative: how much information the texel has, in units of 1 / noise^2, noise being the scene's (see `noise_of`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from nishiki.brdf.fit import fit_torrance_sparrow
from nishiki.brdf.flags import FitFlag
from nishiki.brdf.texels.stack import Observed

WIDTH_OF_SIGMA = float(np.sqrt(2 * np.log(2)))  # half width at half maximum = WIDTH_OF_SIGMA sigma
SIGMA_BOUNDS = (0.02, 1.2)  # radians
LOST = FitFlag.NO_HIGHLIGHT | FitFlag.TOO_FEW | FitFlag.UNDETERMINED | FitFlag.AT_BOUND


@dataclass(frozen=True)
class FirstFit:
    """What each point's own observations say; arrays (points,) or (points, channels), float32.

    log_sigma is usable where information > 0 (a highlight was observed and its width is determined): the inverse
    variance of log_sigma.  residual: root mean square, weighted.  flags: bits of FitFlag.
    """

    kd: np.ndarray
    ks: np.ndarray
    log_sigma: np.ndarray
    information: np.ndarray
    residual: np.ndarray
    flags: np.ndarray


def first_fit(
    total: Observed, specular: Observed | None = None, *, method: str = "projection", threads: int = 1
) -> FirstFit:
    """Fit each texel alone.  total: observations of Lambert + lobe; where `specular` (the same slots) is given, `total`
    holds the diffuse component, and the two terms are fitted apart (Miyazaki et al. 2007, sections 3.1, 3.2).

    method: "projection", or "levenberg_marquardt" (the paper's, slow).
    """
    data, basis = (total, total.diffuse) if specular is None else (specular, None)
    low, high = (bound * WIDTH_OF_SIGMA for bound in SIGMA_BOUNDS)
    fit = fit_torrance_sparrow(
        data.alpha,
        data.values,
        weights=data.weights,
        attenuation=data.attenuation,
        diffuse=basis,
        gamma_bounds=(low, high),
        method=method,
        threads=threads,
    )
    known = ((fit.flags & LOST) == 0) & np.isfinite(fit.gamma) & (fit.sigma_log_gamma > 0)
    log_sigma = np.log(np.where(known, fit.gamma / WIDTH_OF_SIGMA, 1)).astype(np.float32)
    information = np.where(known, 1 / np.where(known, fit.sigma_log_gamma, 1) ** 2, 0).astype(np.float32)
    kd = fit.diffuse if specular is None else lambert(total)
    return FirstFit(kd, fit.specular, log_sigma, information, fit.residual, fit.flags)


def lambert(data: Observed) -> np.ndarray:
    """K_d (points, channels) float32 of the Lambert term alone: least squares weighted by cos(theta_r), Miyazaki et al.
    (2007), section 3.1."""
    weighted = data.weights * data.diffuse
    top = np.einsum("ps,psc->pc", weighted, data.values)
    below = np.einsum("ps,ps->p", weighted, data.diffuse)[:, None]
    return np.maximum(np.where(below > 0, top / np.where(below > 0, below, 1), 0), 0).astype(np.float32)


@dataclass(frozen=True)
class Strengths:
    """K_d and K_s (points, channels) at given sigma; information (points,): what the data alone say of K_s; residual
    (points,): root mean square of the weighted residuals of the observations that K_s follows from."""

    kd: np.ndarray
    ks: np.ndarray
    information: np.ndarray
    residual: np.ndarray


def strengths(
    total: Observed,
    sigma: np.ndarray,
    prior: np.ndarray,
    precision: np.ndarray | float,
    specular: Observed | None = None,
) -> Strengths:
    """Non-negative K_d and K_s of every texel at its sigma (points,), K_s drawn towards prior (points, channels).

    Minimises sum w (y - K_d q - K_s s)^2 + precision (K_s - prior)^2 for each channel, K_d >= 0 and K_s >= 0, s the
    lobe at sigma.  A texel whose observations are far from the mirror direction has no information on K_s and takes the
    prior; one that was seen there and shows nothing gets K_s near 0.
    """
    points, channels = len(total.texel), total.values.shape[2]
    kd, ks = (np.zeros((points, channels), np.float32) for _ in range(2))
    information, residual = (np.zeros(points, np.float32) for _ in range(2))
    pull = np.broadcast_to(np.asarray(precision, np.float32), (points,))
    data = total if specular is None else specular
    diffuse = total.diffuse if specular is None else np.zeros_like(total.diffuse)
    _solve(data.values, diffuse, data.attenuation, data.alpha, data.weights, np.ascontiguousarray(sigma, np.float32),
           np.ascontiguousarray(prior, np.float32), np.ascontiguousarray(pull), kd, ks, information,
           residual)  # fmt: skip
    if specular is not None:
        kd = lambert(total)
    return Strengths(kd, ks, information, residual)


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(values, diffuse, attenuation, alpha, weights, sigma, prior, pull, kd, ks, information, residual):
    points, slots, channels = values.shape
    u, v = np.empty(channels), np.empty(channels)
    for p in range(points):
        a = b = d = 0.0
        u[:] = 0.0
        v[:] = 0.0
        rate = 0.5 / (np.float64(sigma[p]) * np.float64(sigma[p]))
        for o in range(slots):
            w = np.float64(weights[p, o])
            if not w > 0.0:
                continue
            q = np.float64(diffuse[p, o])
            s = np.float64(attenuation[p, o]) * np.exp(-rate * np.float64(alpha[p, o]) * np.float64(alpha[p, o]))
            a += w * s * s
            b += w * s * q
            d += w * q * q
            for c in range(channels):
                u[c] += w * s * values[p, o, c]
                v[c] += w * q * values[p, o, c]
        information[p] = max(a - b * b / d, 0.0) if d > 0.0 else a
        for c in range(channels):
            k, m = _pair(a + pull[p], b, d, u[c] + pull[p] * prior[p, c], v[c])
            ks[p, c], kd[p, c] = k, m
        squares, count = 0.0, 0
        for o in range(slots):
            w = np.float64(weights[p, o])
            if not w > 0.0:
                continue
            s = np.float64(attenuation[p, o]) * np.exp(-rate * np.float64(alpha[p, o]) * np.float64(alpha[p, o]))
            for c in range(channels):
                left = values[p, o, c] - kd[p, c] * np.float64(diffuse[p, o]) - ks[p, c] * s
                squares += w * left * left
            count += channels
        residual[p] = np.sqrt(squares / max(count, 1))


@njit(cache=True, error_model="numpy")
def _pair(a, b, d, u, v):
    """Least squares in two non-negative unknowns: (of u, of v); 0 where a column is empty."""
    det = a * d - b * b
    if det > 1e-12 * a * d:
        k, m = (d * u - b * v) / det, (a * v - b * u) / det
        if k >= 0.0 and m >= 0.0:
            return k, m
    k = max(u, 0.0) / a if a > 0.0 else 0.0
    m = max(v, 0.0) / d if d > 0.0 else 0.0
    return (k, 0.0) if k * u > m * v else (0.0, m)


def noise_of(residuals: np.ndarray) -> float:
    """The scene's noise (of the weighted observations): the median of the texels' root mean square residuals."""
    good = residuals[np.isfinite(residuals) & (residuals > 0)]
    return float(np.median(good)) if good.size else 1.0
