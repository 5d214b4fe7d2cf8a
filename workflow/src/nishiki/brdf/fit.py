"""Fit Lambert and one Torrance-Sparrow lobe to the observations of each point.

The strengths (K_s, K_d, or beta) enter linearly and the half width gamma does not: the strengths are eliminated and
log gamma is searched globally (variable projection). There is no start value to choose, and beta = 164 beside
gamma = 0.07 is no harder than beta = 1 beside gamma = 1. Fits over a whole scene are in `nishiki.brdf.scene`.
"""

from dataclasses import dataclass
from enum import IntFlag

import numpy as np

from nishiki.brdf import variable_projection as vp
from nishiki.errors import UserError


class FitFlag(IntFlag):
    """Bits of the `flags` of a fit."""

    NO_HIGHLIGHT = 1  # a lobe takes off no more than noise does: strength 0, width NaN
    AT_BOUND = 2  # the half width stands at the end of the range that was searched
    TOO_FEW = 4  # fewer observations than unknowns: strength 0, width NaN
    UNDETERMINED = (
        8  # fewer than two observations within two half widths, or a width known to worse than a factor e^0.5
    )
    NOT_FINITE = 16  # some observations were not finite and were left out


GAMMA_BOUNDS = (1e-3, 1.6)
SIGNIFICANCE = 8.0  # F ratio that a lobe must reach; chance alone passes 6 for 1 in 1000 points of 36 x 3 observations
UNDETERMINED_LOG_GAMMA = 0.5  # standard deviation, a factor of 1.6 either way


@dataclass(frozen=True)
class PointFits:
    """Lambert + one lobe at each point: I' = diffuse * q + specular * a * D(phi; gamma).

    Arrays have the float type of the fit.  Points whose flags contain NO_HIGHLIGHT or TOO_FEW have specular 0 and
    gamma NaN: they take these from their neighbours (Miyazaki et al. 2007) or from the scene.
    """

    gamma: np.ndarray  # (points,) half width at half maximum, radians
    specular: np.ndarray  # (points, channels) K_s or beta, >= 0
    diffuse: np.ndarray  # (points, channels) K_d, >= 0
    residual: np.ndarray  # (points,) root mean square of the weighted residuals, units of the observations
    sigma_log_gamma: np.ndarray  # (points,) standard deviation of log gamma, NaN where gamma is
    nearest: np.ndarray  # (points,) smallest phi among the observations used, radians; infinite where none was
    used: np.ndarray  # (points,) int32, observations used
    lit: np.ndarray  # (points,) int32, observations within two half widths
    flags: np.ndarray  # (points,) uint8, bits of FitFlag


def fit_torrance_sparrow(
    phi,
    amplitude,
    *,
    weights=None,
    attenuation=None,
    diffuse=None,
    gamma_bounds=GAMMA_BOUNDS,
) -> PointFits:
    """Fit K_d q + K_s a D(phi; gamma) to the observations of many points; K per channel, gamma per point.

    phi: (points, observations), angle(normal, half vector), radians, 0 .. pi.  amplitude: (points, observations,
    channels), observations relative to the white reference (or specular parts alone, with `diffuse` None).
    attenuation a: (points, observations), F G / cos theta_r (Tominaga and Tanaka 2004, eq. 10; K_s is then beta) or 1 /
    cos theta_r (Miyazaki et al. 2007, eq. 8); ones if None.  diffuse q: (points, observations), the Lambert term
    max(cos theta_i, 0); no diffuse term if None.
    weights: (points, observations), >= 0, inverse variances up to a factor; 0 leaves an observation out, as does any
    value that is not finite.  gamma_bounds: radians, the range searched.

    Fitted in float32 if amplitude is float32, else in float64.  Raises UserError for shapes that do not agree, negative
    weights, or bounds that are not 0 < low < high.
    """
    arrays = _prepared(phi, amplitude, attenuation, diffuse, weights)
    low, high = gamma_bounds
    if not 0 < low < high < np.inf:
        raise UserError(f"gamma_bounds: expected 0 < low < high in radians, found {gamma_bounds}; e.g. {GAMMA_BOUNDS}")
    strengths, reports = vp.project_points(*arrays, float(np.log(low)), float(np.log(high)))
    return _judged(arrays, strengths, reports, low, high)


def _prepared(
    phi, amplitude, attenuation, diffuse, weights
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Contiguous arrays of one float type, with the defaults filled in and the shapes checked."""
    amplitude = np.asarray(amplitude)
    real = np.float32 if amplitude.dtype == np.float32 else np.float64
    if amplitude.ndim != 3:
        raise UserError(f"amplitude: expected (points, observations, channels), found shape {amplitude.shape}")
    shape = amplitude.shape[:2]
    weights = np.ones(shape, real) if weights is None else weights
    attenuation = np.ones(shape, real) if attenuation is None else attenuation
    diffuse = np.zeros(shape, real) if diffuse is None else diffuse
    columns = []
    for name, array in (("phi", phi), ("attenuation", attenuation), ("diffuse", diffuse), ("weights", weights)):
        array = np.asarray(array)
        if array.shape != shape:
            raise UserError(f"{name}: expected shape {shape} as amplitude's first axes, found {array.shape}")
        columns.append(np.ascontiguousarray(array, real))
    if np.any(columns[3] < 0):
        raise UserError(f"weights: expected values >= 0, found {np.nanmin(columns[3])}; 0 leaves an observation out")
    angles, attenuation, diffuse, weights = columns
    return angles, np.ascontiguousarray(amplitude, real), attenuation, diffuse, weights


def _judged(arrays, strengths, reports, low, high) -> PointFits:
    """Derive flags and standard deviations from the solver's reports; set what is not supported to 'no highlight'."""
    _, amplitude, _, diffuse, weights = arrays
    channels = amplitude.shape[2]
    has_diffuse = np.any(diffuse != 0, axis=1)
    used, gamma = reports[:, vp.USED].astype(np.int32), reports[:, vp.GAMMA].copy()
    unknowns = channels * (1 + has_diffuse) + 1
    freedom = used * channels - unknowns
    rss, gained = reports[:, vp.RSS], reports[:, vp.RSS_DIFFUSE] - reports[:, vp.RSS]
    noise = rss / np.maximum(freedom, 1)
    rounding = (64 * np.finfo(amplitude.dtype).eps) ** 2 * used * channels
    few = (used < 2 + has_diffuse) | (freedom < 0)
    dark = ~few & ((gained <= rounding) | (gained < SIGNIFICANCE * (channels + 1) * noise))
    curvature = reports[:, vp.CURVATURE]
    sigma = np.sqrt(noise / np.where(curvature > 0, curvature, 1))
    sigma = np.where(curvature > 0, sigma, np.inf)
    lit = reports[:, vp.LIT].astype(np.int32)
    vague = (lit < 2) | (sigma > UNDETERMINED_LOG_GAMMA)
    edge = (gamma <= low * (1 + 1e-4)) | (gamma >= high * (1 - 1e-4))
    broken = ~(np.isfinite(rss) & np.isfinite(reports[:, vp.RSS_DIFFUSE]) & np.isfinite(strengths).all(axis=(1, 2)))
    few |= broken  # sums or strengths beyond the float type: nothing can be said of the point
    lost = few | dark
    flags = FitFlag.TOO_FEW * few | FitFlag.NO_HIGHLIGHT * dark
    flags = flags | np.where(lost, 0, FitFlag.UNDETERMINED * vague | FitFlag.AT_BOUND * edge)
    flags = flags | FitFlag.NOT_FINITE * (broken | (used < np.sum(weights > 0, axis=1)))
    specular, kd = strengths[..., 0].copy(), np.where(lost[:, None], strengths[..., 2], strengths[..., 1])
    specular[lost], gamma[lost], sigma = 0, np.nan, np.where(lost, np.nan, sigma)
    kd[broken] = 0
    squares = np.where(lost, reports[:, vp.RSS_DIFFUSE], rss)
    with np.errstate(over="ignore", invalid="ignore"):
        residual = reports[:, vp.SCALE] * np.sqrt(squares / np.maximum(used * channels, 1))
    residual[~np.isfinite(residual)] = 0
    nearest = np.where(reports[:, vp.NEAREST] < 1e14, reports[:, vp.NEAREST], np.inf)
    lit = np.where(lost, 0, lit)
    return PointFits(gamma, specular, kd, residual, sigma, nearest, used, lit, flags.astype(np.uint8))
