"""Find the weave of elliptical yarns that explains the reflectances: each binding in turn, the best to the end.

A short fit on few samples ranks the bindings (plain, twills, satins with every step); the best are fitted again with
more samples and a finer surface. Yarns that are long in coming up can imitate a longer repeat, so what is known of
cloth has its weight: priors of the yarns (NAMES, CENTRE, SPREAD), and UNUSUAL for a repeat that is seldom woven.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import groupby

import numpy as np

from nishiki.brdf.cloth.yarn_fit import EVEN, FACETS, Measured, normal_weights, refuse_black, solve_linear
from nishiki.errors import UserError
from nishiki.weave.yarn_weave import COARSE, PLAIN, POINTS, Binding, InterlacedYarns, YarnWeave, horizons_of

# Logarithms, but for logits of shares and the arch. Priors are wide statements about cloth: weft yarns 1.2 as far apart
# as warp yarns, within a quarter; warp yarns nearly touch; sections half as thick as wide, within a factor of 1.5; a
# yarn changes sides within one spacing of the yarns that it crosses; its sections stand mostly across its way;
# filaments as in `brdf.cloth.yarn_facets`.
NAMES = (
    "spacing_ratio", "fill_warp", "fill_weft", "aspect_warp", "aspect_weft", "crimp", "bend", "arch", "upright",
    "rough_along_warp", "rough_across_warp", "rough_along_weft", "rough_across_weft", "gain", "tail",
)  # fmt: skip
CENTRE = np.array([
    np.log(1.2), 2.9, 2.2, np.log(0.55), np.log(0.55), -0.4, np.log(0.6), 0.0, 1.1, np.log(0.12), np.log(0.28),
    np.log(0.12), np.log(0.28), 0.0, 0.0,
])  # fmt: skip
SPREAD = np.array([0.25, 0.7, 0.7, 0.4, 0.4, 0.7, 0.2, 0.015, 1.5, *FACETS])
LOGITS, ARCH = (1, 2, 5, 8, 14), 7
GEOMETRY = 9  # the first ones, which the surface depends on
COUNTED = 0.02  # relative error of a ratio of spacings from counted threads
STEP = 0.03  # of the differences, in prior standard deviations: the horizons are smooth no finer
GAIN = 1e-3  # of the cost, below which a fit ends
REACH = 4.0  # prior standard deviations to either side that are searched
USUAL = {  # woven most: plain, twills of three and four, satins of five and eight, either side up
    PLAIN, *(Binding(*one) for one in ((2, 1), (1, 2), (3, 1), (1, 3), (2, 2))),
    *(Binding(*one) for one in ((4, 1, 2), (1, 4, 2), (7, 1, 3), (1, 7, 3))),
}  # fmt: skip
UNUSUAL, RARE = 6.0, 10.0  # what bindings known from cloth, and all others, have to gain in cost: odds 20, 150
LIKE = 6.0  # of the cost within which bindings are not told apart
LAST = 3  # harnesses in a row that cost 2 LIKE more than the least: longer repeats are not tried
FIRST, SHORT, NEXT, LONG = 2, (60, 4), 6, (100, 25)  # steps of a fit, beside views of normal incidence
STEEPEST = np.radians(85.0)  # views at more are left out: masking of single yarns decides
REFINED = 2, 5, 3  # bindings that are fitted on: of a harness after FIRST steps, of all after SHORT and after NEXT
UNEXPLAINED = 0.6  # of the variation: beyond it the yarns explain less than two thirds of the variance
OPEN, NARROW = 0.7, 0.15  # not determined: more of the prior's spread is left, and of the value to either side


@dataclass(frozen=True)
class ReflectanceSamples:
    """Reflectances at normal incidence that a weave is fitted to.

    Directions (n, 3), values (n, channels), inverse deviations (n,).
    """

    incident: np.ndarray
    outgoing: np.ndarray
    values: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True)
class BindingFit:
    """A fitted weave.

    x in the order of NAMES and its information matrix, coefficients (channels, 2) of body and Lambert term, cost with
    all priors; of the samples rms_rel, and variation: standard deviation of the values over their
    root mean square; spacing_ratio: as given, see `prior_of`.
    """

    binding: Binding
    x: np.ndarray
    coefficients: np.ndarray
    information: np.ndarray
    cost: float
    rms_rel: float
    variation: float
    spacing_ratio: float | None = None

    @property
    def explains(self) -> bool:
        """Test if the yarns explain most of how the reflectance varies with the view; else the weave is unknown."""
        return self.rms_rel < UNEXPLAINED * self.variation

    @property
    def weave(self) -> YarnWeave:
        """The weave."""
        return weave_of(self.x, self.binding)

    @property
    def brdf(self) -> InterlacedYarns:
        """The weave with the interior of its fibres."""
        body, lambert = self.coefficients.T
        return InterlacedYarns(self.weave, body.copy(), lambert.copy(), np.ones((2, 8)))


def weave_of(x: np.ndarray, binding: Binding) -> YarnWeave:
    """Build the weave from parameters in the order of NAMES."""
    e, share = np.exp(x), 1 / (1 + np.exp(-x))
    numbers = {"spacing_ratio": e[0], "crimp": share[5], "bend": e[6], "arch": x[7], "upright": share[8], "gain": e[13]}
    scalars = {name: float(value) for name, value in (numbers | {"tail": share[14]}).items()}
    return YarnWeave(binding=binding, fill=share[1:3], aspect=e[3:5], rough=e[9:13].reshape(2, 2), **scalars)


def prior_of(binding: Binding, spacing_ratio: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Return centre and spread of the yarns' parameters for a binding, in the order of NAMES.

    Where the weft lies on top, warp and weft are exchanged; spacing_ratio: where the threads were counted.
    """
    centre, spread = CENTRE.copy(), SPREAD.copy()
    if binding.under > binding.over:
        centre = CENTRE[[0, 2, 1, 4, 3, 5, 6, 7, 8, 11, 12, 9, 10, 13, 14]]
        centre[[0, 5]] *= -1
    if spacing_ratio is not None:
        centre[0], spread[0] = np.log(spacing_ratio), COUNTED
    return centre, spread


def prior_cost(binding: Binding) -> float:
    """Return the cost that a binding has to gain, for it is woven less than others."""
    if binding in USUAL:
        return 0.0
    over, under = binding.over, binding.under
    one_sided = min(over, under) == 1 and (binding.weave == "satin" or binding.harness == 4)
    of_pairs = binding.weave in ("rib", "basket") and max(over, binding.together) == 2
    return UNUSUAL if one_sided or of_pairs or (over == under == 3 and binding.weave == "twill") else RARE


def samples_of(measured: Measured, *, views: int) -> ReflectanceSamples:
    """Choose evenly spread views of normal incidence of a region, weighted as in `brdf.cloth`."""
    known = np.isfinite(measured.values).all(axis=1)
    normal = np.flatnonzero(known & measured.normal & (measured.outgoing[:, 2] > np.cos(STEEPEST)))
    if len(normal) < 8:
        raise UserError(
            f"weave: expected at least 8 views with the light along the normal, found {len(normal)}. Remedy: measure "
            "them, or take the stage from the products"
        )
    chosen = measured.take(normal[spread(measured.outgoing[normal], views)])
    refuse_black(chosen)
    return ReflectanceSamples(chosen.incident, chosen.outgoing, chosen.values, normal_weights(chosen))


def spread(views: np.ndarray, count: int) -> np.ndarray:
    """Choose `count` rows of the views (n, 3), each farthest from those before; mirror images are the same place."""
    folded = np.abs(views)
    chosen = [int(np.argmax(views[:, 2]))]
    distance = np.full(len(views), np.inf)
    while len(chosen) < min(count, len(views)):
        distance = np.minimum(distance, np.linalg.norm(folded - folded[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(distance)))
    return np.array(chosen)


def fit_binding(
    samples: ReflectanceSamples,
    binding: Binding,
    *,
    spacing_ratio: float | None = None,
    start=None,
    density=POINTS,
    evaluations=10,
) -> BindingFit:
    """Fit yarns of this binding to the samples; the linear parts are eliminated at every step."""
    from scipy.optimize import least_squares

    limits, channels = np.array([np.inf, EVEN]), samples.values.shape[1]
    lambert, needed = np.full(len(samples.weight), 1 / np.pi), horizons_of(samples.incident, samples.outgoing)

    @lru_cache(maxsize=GEOMETRY + 1)  # those of one matrix of slopes
    def points_at(*geometry: float):
        return weave_of(np.array([*geometry, *CENTRE[GEOMETRY:]]), binding).points(density, needed)

    def solve_body(x):
        points = points_at(*x[:GEOMETRY].tolist())
        terms = weave_of(x, binding).parts(samples.incident, samples.outgoing, points)
        mirror, columns = terms[:, 0] + terms[:, 2], np.stack([terms[:, 1] + terms[:, 3], lambert], axis=1)
        c = solve_linear(mirror, columns, samples.values, samples.weight, limits)
        return mirror[:, None] + columns @ c.T - samples.values, c

    centre, width = prior_of(binding, spacing_ratio)

    def residual(x):
        rest, c = solve_body(x)
        rest = rest * samples.weight[:, None] / np.sqrt(channels)
        return np.concatenate([rest.ravel(), (x - centre) / width, (c / limits).ravel()])

    taken: list[np.ndarray] = []

    def slopes(x):
        if len(taken) < max(evaluations - 1, 1):  # after the last step no step follows
            here = residual(x)
            taken.append(np.stack([(residual(x + s) - here) / s.max() for s in np.diag(STEP * SPREAD)], axis=1))
        return taken[-1]

    first = centre if start is None else start
    bounds = centre - REACH * width, centre + REACH * width
    bounds[0][ARCH] = 0.0  # a float does not sag
    solution = least_squares(residual, first, jac=slopes, bounds=bounds, x_scale=width, max_nfev=evaluations, ftol=GAIN)
    rest, c = solve_body(solution.x)
    weight = samples.weight[:, None]
    rms = np.sqrt(np.sum((weight * rest) ** 2) / np.sum((weight * samples.values) ** 2))
    grey = samples.values.mean(axis=1)
    share = samples.weight**2 / np.sum(samples.weight**2)
    variation = np.sqrt(max(share @ grey**2 - (share @ grey) ** 2, 0.0) / (share @ grey**2))
    information, cost = solution.jac.T @ solution.jac, float(2 * solution.cost) + prior_cost(binding)
    return BindingFit(binding, solution.x, c, information, cost, float(rms), float(variation), spacing_ratio)


@dataclass(frozen=True)
class YarnSearch:
    """The result of a search."""

    best: BindingFit  # fitted to the end, a usual weave where the samples do not distinguish it from the best one
    alike: list[Binding]  # bindings that explain the samples about as well, the best first
    ranking: list[tuple[Binding, float]]  # (binding, cost of its short fit) of all
    fits: list[BindingFit]  # all that were fitted to the end


def search_yarns(
    measured: Measured, candidates: Iterable[Binding], *, spacing_ratio: float | None = None
) -> YarnSearch:
    """Find the weave of elliptical yarns that explains a region best; candidates by rising harness.

    spacing_ratio: of weft yarns over warp yarns, where the threads were counted.
    """
    few, many = (samples_of(measured, views=views) for views, _ in (SHORT, LONG))
    fit = partial(fit_binding, few, spacing_ratio=spacing_ratio, density=COARSE)
    short: list[BindingFit] = []
    least, since = np.inf, 0
    for _, same in groupby(candidates, key=lambda one: one.harness):
        fits = sorted((fit(one, evaluations=FIRST) for one in same), key=lambda one: one.cost)
        fits[: REFINED[0]] = [fit(one.binding, start=one.x, evaluations=SHORT[1]) for one in fits[: REFINED[0]]]
        short += fits
        cost = min(one.cost for one in fits)
        least, since = min(least, cost), since + 1 if cost > least + 2 * LIKE else 0
        if since == LAST:
            break
    short.sort(key=lambda one: one.cost)
    short[: REFINED[1]] = [fit(one.binding, start=one.x, evaluations=NEXT) for one in short[: REFINED[1]]]
    short.sort(key=lambda one: one.cost)
    fit = partial(fit_binding, many, spacing_ratio=spacing_ratio, evaluations=LONG[1])
    long = [fit(one.binding, start=one.x) for one in short[: REFINED[2]]]
    long.sort(key=lambda one: one.cost)
    like = [one for one in long if one.cost < long[0].cost + LIKE]
    best = next((one for one in like if one.binding in USUAL), long[0])
    refined = {one.binding for one in long}
    alike = [best.binding, *(one.binding for one in like if one is not best)]
    alike += [f.binding for f in short if f.binding not in refined and f.cost < short[0].cost + LIKE]
    return YarnSearch(best, alike, [(one.binding, one.cost) for one in short], long)


def estimate(fit: BindingFit) -> dict[str, tuple[float, float, float]]:
    """Estimate every number of a fit: middle, standard deviation, and that of the prior.

    Slopes and the weft's share as they are, the others as in NAMES.
    """
    covariance, steps = np.linalg.inv(fit.information), np.diag(STEP * SPREAD)[:GEOMETRY]
    ends = [[[*weave_of(x, fit.binding).slopes().values()] for x in (fit.x + s, fit.x - s)] for s in steps]
    gradients = -np.diff(ends, axis=1)[:, 0] / (2 * STEP)  # (GEOMETRY, numbers), for the prior's deviations
    spread, own = SPREAD[:GEOMETRY], covariance[:GEOMETRY, :GEOMETRY]
    out = {}
    for (name, value), gradient in zip(fit.weave.slopes().items(), gradients.T, strict=True):
        deviation = np.sqrt(gradient / spread @ own @ (gradient / spread))
        out[name] = (value, float(deviation), float(np.linalg.norm(gradient)))
    deviations = np.sqrt(np.diag(covariance))
    return out | {name: (float(fit.x[k]), float(deviations[k]), float(SPREAD[k])) for k, name in enumerate(NAMES)}


def mixed_quantile(share: float, middle: np.ndarray, deviation: np.ndarray, odds: np.ndarray) -> float:
    """Find the quantile of a mixture of normal distributions: middle, deviation and odds (n,) of each."""
    from scipy.optimize import brentq
    from scipy.stats import norm

    deviation = np.maximum(deviation, 1e-9)  # 0 of a hidden family's share of the surface, which no parameter moves
    ends = np.min(middle - 9 * deviation), np.max(middle + 9 * deviation)
    return float(brentq(lambda v: odds @ (norm.cdf((v - middle) / deviation) - share), *ends))


def parameters_of(search: YarnSearch, *, confidence: float) -> dict[str, dict]:
    """Report every number of the weave: value, low, high, determined.

    The interval is that of the mixture of all bindings that the samples do not distinguish, each with the odds of its
    cost. determined is False where the samples add little to the prior. Slopes are in degrees, over the surface
    visible from above.
    """
    from scipy.special import expit
    from scipy.stats import norm

    best, least = search.best, min(fit.cost for fit in search.fits)
    likely = [best, *(fit for fit in search.fits if fit is not best and fit.cost < least + LIKE)]
    odds = np.exp(0.5 * (least - np.array([fit.cost for fit in likely])))
    estimates = [estimate(fit) for fit in likely]
    centre, width = prior_of(best.binding, best.spacing_ratio)
    out = {}
    for name in estimates[0]:
        middle, deviation, before = np.array([each[name] for each in estimates]).T
        ends = [mixed_quantile(0.5 + 0.5 * side * confidence, middle, deviation, odds) for side in (-1, 1)]
        low, high = min(ends[0], middle[0]), max(ends[1], middle[0])
        told = high - low < 2 * OPEN * before[0] * norm.ppf(0.5 + 0.5 * confidence)
        form, inside = float, True
        if name in NAMES:
            k = NAMES.index(name)
            form = expit if k in LOGITS else float if k == ARCH else np.exp
            inside = abs(middle[0] - centre[k]) < 0.999 * REACH * width[k] and (k != ARCH or middle[0] > 0)
        value, low, high = (float(form(v)) for v in (middle[0], low, high))
        determined = best.explains and bool((told or high - low < 2 * NARROW * value) and inside)
        out[name] = {"value": value, "low": max(low, 0.0), "high": high, "determined": determined}
    return out
