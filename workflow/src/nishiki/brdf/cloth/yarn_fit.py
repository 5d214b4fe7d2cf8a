"""Fit yarn facets to measurements, and choose the oblique images that improve them most.

A model is, in each channel, fixed(x) + columns(x) c with shape parameters x shared by the channels and c >= 0.  For
any x the c are a small non-negative least-squares problem, so only x is searched (Golub and Pereyra, Separable
nonlinear least squares, 2003), by a trust-region Levenberg-Marquardt on the projected residual.  Priors are Gaussian
in x: they decide what the measurements leave open, and shift what these tell by less than its uncertainty.

Yarn facets: first the shape is fitted to normal incidence (its prior says what that leaves open), then to both.  What
the shape's facets still miss at normal incidence is read off them as the facet reading does, at the half vector's tilt
theta_r / 2: a factor c(h) of the mirror reflection at every incidence (h alone, so it stays reciprocal), held to 1
where the body outshines the mirror reflection. What the model then misses at the oblique images is carried over to the
directions around them (`fit_ratio`).

Choice of oblique images: the fit to normal incidence leaves an uncertainty of the parameters (its information matrix),
which makes errors of predictions that go together; beside it a model has errors of its own, alike in directions close
to each other (MISS_OBLIQUE, ERROR_REACH). Each step takes the image after which the expected squared error, summed over
all candidates with the cosine of the view and relative to each incidence's level, is least (I-optimal design; Fedorov,
Theory of optimal experiments, 1972), and conditions both on it. No measured value enters, so the choice can be made
before the images are taken.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from nishiki.brdf.cloth.interface import hemisphere, incidences, single, solid_angles, together
from nishiki.brdf.cloth.yarn_facets import (
    CENTRE,
    SPREAD,
    YarnFacets,
    fit_ratio,
    interpolate_correction,
    places_of,
    shape_of,
    shape_parts,
    without_correction,
)
from nishiki.errors import UserError
from nishiki.goniometry.directions import angles

STEP = 1e-4  # of the finite differences, in units of a parameter's scale: parameters are logarithms
REACH = 6.0  # prior standard deviations to either side within which a parameter is searched

Parts = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]  # x -> fixed (n,), columns (n, k)


@dataclass(frozen=True)
class ShapeFit:
    """The most probable shape and its linear coefficients."""

    x: np.ndarray  # (parameters,)
    coefficients: np.ndarray  # (channels, k), >= 0
    information: np.ndarray  # (parameters, parameters) of the measurements and the prior
    cost: float  # sum of squares of residuals and priors
    misfit: float  # of the residuals alone
    evaluations: int
    at_bounds: tuple[int, ...] = ()  # parameters that ended `REACH` prior standard deviations away
    # (n, channels) weighted residuals, each as if its measurement had not been fitted, by its leverage
    left_out: np.ndarray = field(default_factory=lambda: np.empty((0, 1)))


def solve_linear(fixed, columns, values, weight, limits) -> np.ndarray:
    """Solve for the coefficients (channels, k) >= 0 of columns (n, k) in values (n, channels) less fixed (n,).

    weight (n,): inverse standard deviations; limits (k,): prior standard deviation of each coefficient about 0,
    infinite where none.
    """
    from scipy.optimize import nnls

    ridge = np.diag(1 / np.asarray(limits, float))
    design = np.vstack([columns * weight[:, None], ridge])
    zeros = np.zeros(len(ridge))
    return np.array([nnls(design, np.concatenate([(y - fixed) * weight, zeros]))[0] for y in values.T])


def fit_shape(
    parts: Parts,
    values: np.ndarray,
    weight: np.ndarray,
    *,
    centre: np.ndarray,
    spread: np.ndarray,
    limits: np.ndarray,
    start: np.ndarray | None = None,
    evaluations: int = 20,
) -> ShapeFit:
    """Fit x and c to values (n, channels) with inverse standard deviations weight (n,); channels count as one together.

    centre, spread (parameters,): prior mean and standard deviation; limits (k,) as in `solve_linear`; start: first x
    (default: the centre); evaluations: most steps of the search.
    """
    from scipy.optimize import least_squares

    channels = values.shape[1]
    low, high = centre - REACH * spread, centre + REACH * spread

    def solve_body(x):
        fixed, columns = parts(x)
        c = solve_linear(fixed, columns, values, weight, limits)
        return (fixed[:, None] + columns @ c.T - values) * weight[:, None] / np.sqrt(channels), c

    def residual(x):
        rest, c = solve_body(x)
        return np.concatenate([rest.ravel(), (x - centre) / spread, (c / limits).ravel()])

    first = np.clip(np.array(centre if start is None else start, float), low, high)
    solution = least_squares(residual, first, x_scale=spread, bounds=(low, high), diff_step=STEP, max_nfev=evaluations)
    rest, c = solve_body(solution.x)
    information = solution.jac.T @ solution.jac
    leverage = np.sum(solution.jac * np.linalg.solve(information, solution.jac.T).T, axis=1)[: rest.size]
    return ShapeFit(
        x=solution.x,
        coefficients=c,
        information=information,
        cost=float(2 * solution.cost),
        misfit=float(np.sum(rest * rest)),
        evaluations=int(solution.nfev),
        at_bounds=tuple(np.flatnonzero(np.abs(solution.x - centre) >= 0.999 * REACH * spread).tolist()),
        left_out=rest / (1 - leverage.reshape(rest.shape)),
    )


NORMAL = np.array([0.0, 0.0, 1.0])
MISS = 0.06  # relative deviation that the model is expected to have at normal incidence
WORTH = 40.0  # independent measurements that all views of normal incidence together stand for
MISS_OBLIQUE = 0.12  # of a single oblique measurement
MISS_AFTER = 0.24  # of one where the facets of yarns are fitted again
LAMBERT = 0.003  # standard deviation of the Lambert term's albedo about 0
EVEN = 0.05  # of that of interlaced yarns, which let light pass
FACETS = np.array([0.5, 0.35, 0.5, 0.35, 0.07, 2.5])  # prior deviations of what `refit_facets` fits
FEWEST = 8  # measurements along the normal
TILTS, TURNS = 16, 72  # grid of the correction
FLOOR = 0.05  # share of the whole below which a mirror reflection is not corrected
MOST = 2.5  # largest factor of the correction


@dataclass(frozen=True)
class Measured:
    """Measurements of one region: directions (n, 3), values (n, channels) 1 / sr, and which are of normal incidence."""

    incident: np.ndarray
    outgoing: np.ndarray
    values: np.ndarray
    normal: np.ndarray  # (n,) bool
    quarter: bool  # two mirror planes

    @classmethod
    def of(cls, measured, region: int = 0) -> "Measured":
        """Convert a `goniometry.table.ReflectanceSet`; invalid rows stay, with a value of NaN."""
        values = np.where(measured.valid[:, region, None], measured.values[:, region], np.nan)
        quarter = measured.symmetry == "quarter"
        return cls(measured.incident, measured.outgoing, values, measured.normal_incidence, quarter)

    def take(self, rows: np.ndarray) -> "Measured":
        """Select some of the measurements."""
        parts = (self.incident, self.outgoing, self.values, self.normal)
        incident, outgoing, values, normal = (np.ascontiguousarray(part[rows]) for part in parts)
        return Measured(incident, outgoing, values, normal, self.quarter)

    @property
    def grey(self) -> np.ndarray:
        """(n,) mean over the channels."""
        return self.values.mean(axis=1)


def refuse_black(measured: Measured) -> None:
    """Raise a UserError where no reflectance is above 0, or there is none at all: weights are relative to them."""
    if not (len(measured.grey) and np.mean(measured.grey) > 0):
        raise UserError(
            f"reflection of the cloth: expected reflectances whose mean is above 0, found {len(measured.grey)} of mean "
            f"{np.mean(measured.grey) if len(measured.grey) else 0:g}. Remedy: expose longer; see reflectance's report"
        )


@dataclass(frozen=True)
class YarnFit:
    """The BRDF and facts about its fit."""

    brdf: YarnFacets
    fit: ShapeFit
    used: np.ndarray  # rows of the measurements
    rms_rel: float  # cosine-weighted relative deviation at normal incidence, without the correction
    spread: np.ndarray  # (parameters,) standard deviations of what was fitted, prior included


def parts_of(incident: np.ndarray, outgoing: np.ndarray):
    """Compute the parts for `fit_shape`: mirror reflection, then columns of body and Lambert term."""
    lambert = np.full(len(incident), 1 / np.pi)

    def parts(x):
        terms = shape_parts(shape_of(x), incident, outgoing)
        return terms[:, 0] + terms[:, 2], np.stack([terms[:, 1] + terms[:, 3], lambert], axis=1)

    return parts


def normal_weights(measured: Measured) -> np.ndarray:
    """Compute inverse standard deviations (n,) of measurements that are all of normal incidence."""
    solid = solid_angles(measured.outgoing, quarter=measured.quarter)
    return together(measured.outgoing, measured.grey, solid, miss=MISS, worth=WORTH)


def levels(brdf, incident: np.ndarray) -> np.ndarray:
    """Predict the cosine-weighted root mean square (n,) over all views of each of the incidences (n, 3)."""
    views, projected = hemisphere(10, 24)
    out = np.empty(len(incident))
    for _, _, rows in incidences(incident):
        values = brdf.evaluate(incident[rows[0]], views).mean(axis=-1)
        out[rows] = np.sqrt(projected @ values**2 / projected.sum())
    return out


def fit_normal(measured: Measured, *, evaluations: int = 20) -> ShapeFit:
    """Fit the shape to normal incidence alone; every row has to be of it. UserError where all are black."""
    refuse_black(measured)
    weight = normal_weights(measured)
    limits = np.array([np.inf, LAMBERT])
    parts = parts_of(measured.incident, measured.outgoing)
    return fit_shape(
        parts, measured.values, weight, centre=CENTRE, spread=SPREAD, limits=limits, evaluations=evaluations
    )


def fit_yarn_facets(
    measured: Measured, rows: np.ndarray, *, basic=None, first: ShapeFit | None = None, evaluations: int = 20
) -> YarnFit:
    """Fit the BRDF to the rows given, of normal incidence and oblique.

    basic: function of views (..., 3) giving the measured reflectance at normal incidence (..., channels), for the
    correction (default: none); first: what `fit_normal` found, to start from (default: it is called).
    """
    rows = np.asarray(rows)[np.isfinite(measured.values[rows]).all(axis=1)]
    chosen = measured.take(rows)
    if chosen.normal.sum() < FEWEST:
        raise UserError(
            f"yarn_facets: expected at least {FEWEST} measurements lit along the normal, found {chosen.normal.sum()}. "
            "Remedy: photograph the cloth lit along its normal"
        )
    under = chosen.take(chosen.normal)
    refuse_black(under)
    fit = first or fit_normal(under, evaluations=evaluations)
    oblique = np.flatnonzero(~chosen.normal)
    if oblique.size:
        weight = np.empty(len(rows))
        weight[chosen.normal] = normal_weights(under)
        level = levels(brdf_of(fit), chosen.incident[oblique])
        weight[oblique] = single(chosen.grey[oblique], level, miss=MISS_OBLIQUE)
        known = {"centre": CENTRE, "spread": SPREAD, "limits": np.array([np.inf, LAMBERT])}
        parts = parts_of(chosen.incident, chosen.outgoing)
        fit = fit_shape(parts, chosen.values, weight, **known, start=fit.x, evaluations=evaluations)
    brdf = brdf_of(fit)
    error = brdf.evaluate(under.incident, under.outgoing).mean(axis=1) - under.grey
    weight = normal_weights(under)
    rms = np.sqrt(np.sum((weight * error) ** 2) / np.sum((weight * under.grey) ** 2))
    spread = np.sqrt(np.diag(np.linalg.inv(fit.information)))
    return YarnFit(match_measurements(brdf, chosen, basic), fit, rows, float(rms), spread)


def match_measurements(brdf: YarnFacets, chosen: Measured, basic, *, share: float = 1.0) -> YarnFacets:
    """Correct a model to measurements: its mirror reflection at normal incidence, all of it at oblique images.

    chosen: what the fit used; basic: see `fit_yarn_facets`; share: of the logarithm of c(h).
    """
    if basic is not None:
        steepest = float(angles(chosen.outgoing[chosen.normal])[0].max())
        brdf = replace(brdf, correction=correction(brdf, basic, steepest=steepest) ** share)
    images = chosen.take(~chosen.normal)
    if not len(images.grey):
        return brdf
    modelled = brdf.evaluate(images.incident, images.outgoing).mean(axis=1)
    places = places_of(images.incident, images.outgoing)
    weights = fit_ratio(places, images.grey, modelled, chosen.quarter)
    return replace(brdf, images=places, image_weights=weights, quarter=chosen.quarter)


def refit_facets(brdf: Any, chosen: Measured) -> Any:
    """Fit roughness, tail, gain and albedos of interlaced yarns to oblique images as well; their geometry stays.

    brdf: an `InterlacedYarns`; it is returned where the images, each left out in turn, are met no better. chosen: with
    measurements of normal incidence.
    """
    shape, images = brdf.shape, ~chosen.normal
    if not images.any():
        return brdf
    weight = np.empty(len(images))
    weight[~images] = normal_weights(chosen.take(~images))
    level = levels(brdf, chosen.incident[images])
    weight[images] = single(chosen.grey[images], level, miss=MISS_AFTER)
    lambert = np.full(len(images), 1 / np.pi)

    def shape_at(x):
        tail = float(1 / (1 + np.exp(-x[5])))
        return replace(shape, rough=np.exp(x[:4]).reshape(2, 2), gain=float(np.exp(x[4])), tail=tail)

    def parts(x):
        terms = shape_at(x).parts(chosen.incident, chosen.outgoing, brdf.points)
        return terms[:, 0] + terms[:, 2], np.stack([terms[:, 1] + terms[:, 3], lambert], axis=1)

    centre = np.concatenate([np.log([*shape.rough.ravel(), shape.gain]), [np.log(shape.tail / (1 - shape.tail))]])
    limits = np.array([np.inf, EVEN])
    fit = fit_shape(parts, chosen.values, weight, centre=centre, spread=FACETS, limits=limits)
    before = (brdf.evaluate(chosen.incident, chosen.outgoing) - chosen.values) * weight[:, None]
    if np.sum(fit.left_out[images] ** 2) * before.shape[1] >= np.sum(before[images] ** 2):
        return brdf
    body, lambert_albedo = fit.coefficients.T
    return replace(brdf, shape=shape_at(fit.x), body=body.copy(), lambert=lambert_albedo.copy())


def brdf_of(fit: ShapeFit) -> YarnFacets:
    """Make the BRDF of a fit, without a correction."""
    return without_correction(shape_of(fit.x), fit.coefficients[:, 0], fit.coefficients[:, 1])


def correction(brdf: YarnFacets, basic, *, steepest: float) -> np.ndarray:
    """Compute the factor c(h) (TILTS, TURNS) from the BRDF's mirror reflection to that measured at normal incidence.

    steepest: largest polar angle measured, radians; views beyond it take its factor.
    """
    tilt, turn = np.linspace(0, np.pi / 4, TILTS), np.arange(TURNS) * (2 * np.pi / TURNS)
    theta, phi = np.meshgrid(np.minimum(2 * tilt, steepest), turn, indexing="ij")
    view = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    modelled = brdf.evaluate(NORMAL, view)
    parts = brdf.parts(NORMAL, view)
    half = view + NORMAL
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    mirror = (parts[..., 0] + parts[..., 2]) * interpolate_correction(brdf.correction, half)
    missing = (basic(view) - modelled).mean(axis=-1)
    floor = (FLOOR * modelled.mean(axis=-1)) ** 2
    return np.clip(1 + mirror * missing / (mirror**2 + floor), 1 / MOST, MOST)


STEEPEST = np.radians(80.0)  # views beyond are left out: a goniometer's cosines are least certain there
CANDIDATES = 700  # evenly thinned from all: their covariance is a full matrix
ERROR_REACH = 0.7  # distance of pairs of unit vectors (light, view) at which these errors have nothing in common
NOISE = 0.03, 0.01  # of a measurement, of the value and of its incidence's level
SLOPE_STEP = 0.02  # of central differences, in units of the search


def choose_oblique(fit: ShapeFit, incident: np.ndarray, outgoing: np.ndarray, count: int) -> np.ndarray:
    """Choose up to `count` of the candidates (n, 3), (n, 3) by index, the most informative first."""
    allowed = np.flatnonzero((angles(outgoing)[0] <= STEEPEST) & (angles(incident)[0] <= STEEPEST))
    if count == 0 or allowed.size == 0:
        return np.empty(0, int)
    pool = max(CANDIDATES, count)
    if allowed.size > pool:
        allowed = allowed[np.linspace(0, allowed.size - 1, pool).astype(int)]
    incident, outgoing = (np.ascontiguousarray(d[allowed]) for d in (incident, outgoing))
    brdf = brdf_of(fit)
    values, level = brdf.evaluate(incident, outgoing).mean(axis=1), levels(brdf, incident)
    slopes, size = _slopes(fit, incident, outgoing), fit.x.size
    # the body's albedo is eliminated from the fit; here it counts as known within a factor of 2.7
    parameters = np.zeros((size + 1, size + 1))
    parameters[:size, :size], parameters[size, size] = np.linalg.inv(fit.information), 1.0
    own = MISS_OBLIQUE**2 * np.outer(values, values) * likeness(incident, outgoing)
    covariance = slopes @ parameters @ slopes.T + own
    noise = (NOISE[0] * values) ** 2 + (NOISE[1] * level) ** 2
    weight = outgoing[:, 2] / level**2
    chosen: list[int] = []
    open_ = np.ones(allowed.size, bool)
    for _ in range(min(count, allowed.size)):
        gain = weight @ covariance**2 / (np.diag(covariance) + noise)
        best = int(np.argmax(np.where(open_, gain, -1.0)))
        chosen.append(best)
        open_[best] = False
        column = covariance[:, best].copy()
        covariance -= np.outer(column, column) / (column[best] + noise[best])
    return allowed[np.array(chosen)]


def likeness(incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
    """Correlate a model's errors at pairs of directions (n, 3): (n, n).

    Wendland's function of their distance, the least over mirror images in the planes of weft and warp and over the
    exchange of light and view.
    """
    pairs = np.concatenate([incident, outgoing], axis=1)
    nearest = np.full((len(pairs), len(pairs)), np.inf)
    for x in (1.0, -1.0):
        for y in (1.0, -1.0):
            for same in (pairs, np.roll(pairs, 3, axis=1)):
                product = (pairs * np.tile([x, y, 1.0], 2)) @ same.T
                np.minimum(nearest, 4.0 - 2.0 * product, out=nearest)  # of unit vectors: squared distance of the pairs
    reach = np.minimum(np.sqrt(np.maximum(nearest, 0.0)) / ERROR_REACH, 1.0)
    return (1.0 - reach) ** 4 * (4.0 * reach + 1.0)


def _slopes(fit: ShapeFit, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
    """Differentiate the predicted mean over channels: (n, parameters + 1), the last by the log of the body's albedo."""
    body = max(float(fit.coefficients[:, 0].mean()), 0.003)
    columns = []

    def value(x):
        parts = shape_parts(shape_of(x), incident, outgoing)
        return parts[:, 0] + parts[:, 2] + body * (parts[:, 1] + parts[:, 3]), parts

    for k in range(fit.x.size):
        step = np.zeros(fit.x.size)
        step[k] = SLOPE_STEP
        columns.append((value(fit.x + step)[0] - value(fit.x - step)[0]) / (2 * SLOPE_STEP))
    parts = value(fit.x)[1]
    return np.stack([*columns, body * (parts[:, 1] + parts[:, 3])], axis=1)
