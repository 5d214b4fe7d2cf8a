"""Which weave of elliptical yarns explains the reflectances: every binding in turn, the best ones to the end.

A short fit on few samples ranks the bindings (plain, twills, satins with every step); the best are fitted again with
more samples and a finer surface. Yarns that are long in coming up can imitate a longer repeat, so what is known of
cloth has its weight: priors of the yarns (NAMES, CENTRE, SPREAD), and UNUSUAL for a repeat that is seldom woven.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from nishiki.brdf.cloth.interface import single
from nishiki.brdf.cloth.yarn_fit import MISS_OBLIQUE, Measured, normal_weights, refuse_black, solve_linear
from nishiki.errors import UserError
from nishiki.weave.yarn_weave import COARSE, POINTS_ACROSS, POINTS_ALONG, Binding, YarnWeave

# Logarithms, but for logits of shares and the arch. Priors are wide statements about cloth: weft yarns 1.2 as far apart
# as warp yarns, within a quarter; warp yarns nearly touch; sections half as thick as wide, within a factor of 1.5; a
# yarn changes sides within one spacing of the yarns that it crosses; filaments as in `brdf.cloth.yarn_facets`.
NAMES = (
    "spacing_ratio", "fill_warp", "fill_weft", "aspect_warp", "aspect_weft", "crimp", "bend", "arch",
    "rough_along_warp", "rough_across_warp", "rough_along_weft", "rough_across_weft", "gain", "soft",
)  # fmt: skip
CENTRE = np.array([
    np.log(1.2), 2.9, 2.2, np.log(0.55), np.log(0.55), -0.4, np.log(0.27), 0.01, np.log(0.12), np.log(0.28),
    np.log(0.12), np.log(0.28), 0.0, np.log(0.15),
])  # fmt: skip
SPREAD = np.array([0.25, 0.7, 0.7, 0.4, 0.4, 0.7, 0.12, 0.01, 0.5, 0.35, 0.5, 0.35, 0.07, 0.5])
LOGITS, ARCH = (1, 2, 5), 7
STEP = 0.03  # of the differences, in prior standard deviations: the horizons are smooth no finer
GAIN = 1e-3  # of the cost, below which a fit ends
REACH = 4.0  # prior standard deviations to either side that are searched
LAMBERT = 0.05  # standard deviation about 0 of the albedo of light that has passed through yarns
USUAL = {(2, 1), (3, 1), (4, 1), (5, 2), (8, 3)}  # harness and step that are woven most
UNUSUAL, RARE = 6.0, 10.0  # what other bindings, and twills of more than 4 yarns, have to gain in cost: odds 20, 150
LIKE = 6.0  # of the cost within which bindings are not told apart
HOPELESS = 12.0  # above the least cost: after LAST harnesses beyond it longer repeats are not tried
LAST = 3
SHORT, LONG = (60, 5), (100, 12)  # views of normal incidence, and steps of a fit
OBLIQUE = 24
STEEPEST_NORMAL, STEEPEST_OBLIQUE = np.radians(85.0), np.radians(70.0)  # at more, masking of single yarns decides
REFINED = 3
INFLATED = 1.5  # of the intervals, for the model's own error: without it 35 of 45 held the truth at 95 %
UNEXPLAINED = 0.6  # of the variation: beyond it the yarns explain less than two thirds of the variance
OPEN, NARROW = 0.7, 0.15  # not determined: more of the prior's spread is left, and of the value to either side


@dataclass(frozen=True)
class Samples:
    """Reflectances that a weave is fitted to: directions (n, 3), values (n, channels), inverse deviations (n,)."""

    incident: np.ndarray
    outgoing: np.ndarray
    values: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True)
class YarnFit:
    """Hold a fitted weave.

    x in the order of NAMES and its information matrix, coefficients (channels, 2) of body and Lambert term, cost with
    all priors; of the samples of normal incidence rms_rel, and variation: standard deviation of the values over their
    root mean square.
    """

    binding: Binding
    x: np.ndarray
    coefficients: np.ndarray
    information: np.ndarray
    cost: float
    rms_rel: float
    variation: float

    @property
    def explains(self) -> bool:
        """Whether the yarns explain most of how the reflectance varies with the view; else the weave is unknown."""
        return self.rms_rel < UNEXPLAINED * self.variation

    @property
    def weave(self) -> YarnWeave:
        """The weave."""
        return weave_of(self.x, self.binding)


def weave_of(x: np.ndarray, binding: Binding) -> YarnWeave:
    """Build the weave from parameters in the order of NAMES."""
    e = np.exp(x)
    share = 1 / (1 + np.exp(-x))
    return YarnWeave(
        binding=binding,
        spacing_ratio=float(e[0]),
        fill=share[1:3],
        aspect=e[3:5],
        crimp=float(share[5]),
        bend=float(e[6]),
        arch=float(x[7]),
        rough=e[8:12].reshape(2, 2),
        gain=float(e[12]),
        soft=float(e[13]),
    )


def is_usual(binding: Binding) -> bool:
    """Whether it is one of the weaves that are woven most."""
    return (binding.harness, binding.step) in USUAL


def samples_of(measured: Measured, *, views: int, oblique: int = OBLIQUE) -> Samples:
    """Evenly spread views of normal incidence and oblique pairs of a region, weighted as in `brdf.cloth`."""
    known = np.isfinite(measured.values).all(axis=1)
    normal = np.flatnonzero(known & measured.normal & (measured.outgoing[:, 2] > np.cos(STEEPEST_NORMAL)))
    if len(normal) < 8:
        raise UserError(
            f"weave: expected at least 8 views with the light along the normal, found {len(normal)}. Remedy: measure "
            "them, or set weave.yarns to false"
        )
    normal = normal[spread(measured.outgoing[normal], views)]
    under = measured.take(normal)
    refuse_black(under)
    weight = normal_weights(under)
    flat = np.cos(STEEPEST_OBLIQUE)
    aside = np.flatnonzero(
        known & ~measured.normal & (measured.incident[:, 2] > flat) & (measured.outgoing[:, 2] > flat)
    )
    if oblique and len(aside):
        pairs = np.concatenate([measured.incident[aside], measured.outgoing[aside]], axis=1)
        aside = aside[spread(pairs, oblique)]
        level = np.sqrt(np.average(under.grey**2, weights=under.outgoing[:, 2]))
        more = single(measured.grey[aside], np.full(len(aside), level), miss=MISS_OBLIQUE)
        weight = np.concatenate([weight, more])
        normal = np.concatenate([normal, aside])
    chosen = measured.take(normal)
    return Samples(chosen.incident, chosen.outgoing, chosen.values, weight)


def spread(points: np.ndarray, count: int) -> np.ndarray:
    """Rows of `count` of the points (n, 3) or pairs (n, 6), each the farthest from those before.

    Mirror images in the planes of weft and warp, and exchanged light and view, count as the same place.
    """
    mirrors = [np.tile([a, b, 1.0], points.shape[1] // 3) for a in (1, -1) for b in (1, -1)]
    turned = [points] if points.shape[1] == 3 else [points, np.roll(points, 3, axis=1)]
    chosen = [int(np.argmax(points[:, 2]))]
    distance = np.full(len(points), np.inf)
    while len(chosen) < min(count, len(points)):
        for mirror in mirrors:
            for same in turned:
                distance = np.minimum(distance, np.linalg.norm(points - same[chosen[-1]] * mirror, axis=1))
        chosen.append(int(np.argmax(distance)))
    return np.array(chosen)


def fit_binding(
    samples: Samples, binding: Binding, *, start=None, density=(POINTS_ACROSS, POINTS_ALONG), evaluations=10
) -> YarnFit:
    """Fit yarns of this binding to the samples; the linear parts are eliminated at every step."""
    from scipy.optimize import least_squares

    limits, channels = np.array([np.inf, LAMBERT]), samples.values.shape[1]
    lambert = np.full(len(samples.weight), 1 / np.pi)

    def solved(x):
        terms = weave_of(x, binding).parts(samples.incident, samples.outgoing, density)
        columns = np.stack([terms[:, 1], lambert], axis=1)
        c = solve_linear(terms[:, 0], columns, samples.values, samples.weight, limits)
        return terms[:, :1] + columns @ c.T - samples.values, c

    def residual(x):
        rest, c = solved(x)
        rest = rest * samples.weight[:, None] / np.sqrt(channels)
        return np.concatenate([rest.ravel(), (x - CENTRE) / SPREAD, (c / limits).ravel()])

    def slopes(x):
        here = residual(x)
        return np.stack([(residual(x + s) - here) / s.max() for s in np.diag(STEP * SPREAD)], axis=1)

    first = CENTRE if start is None else start
    bounds = CENTRE - REACH * SPREAD, CENTRE + REACH * SPREAD
    bounds[0][ARCH] = 0.0  # a float does not sag
    solution = least_squares(
        residual, first, jac=slopes, bounds=bounds, x_scale=SPREAD, max_nfev=evaluations, ftol=GAIN
    )
    rest, c = solved(solution.x)
    normal = samples.incident[:, 2] > 1 - 1e-4
    weight = samples.weight[normal, None]
    rms = np.sqrt(np.sum((weight * rest[normal]) ** 2) / np.sum((weight * samples.values[normal]) ** 2))
    rare = binding.weave == "twill" and binding.harness > 4
    grey = samples.values[normal].mean(axis=1)
    share = samples.weight[normal] ** 2 / np.sum(samples.weight[normal] ** 2)
    variation = np.sqrt(max(share @ grey**2 - (share @ grey) ** 2, 0.0) / (share @ grey**2))
    extra = 0.0 if is_usual(binding) else RARE if rare else UNUSUAL
    information = solution.jac.T @ solution.jac
    return YarnFit(binding, solution.x, c, information, float(2 * solution.cost) + extra, float(rms), float(variation))


@dataclass(frozen=True)
class YarnSearch:
    """Hold the result of a search."""

    best: YarnFit  # fitted to the end, a usual weave where the samples do not distinguish it from the best one
    alike: list[Binding]  # bindings that explain the samples about as well, the best first
    ranking: list[tuple[Binding, float]]  # (binding, cost of its short fit) of all


def search_yarns(measured: Measured, candidates: Iterable[Binding], *, oblique: int = OBLIQUE) -> YarnSearch:
    """Search the weave of elliptical yarns that explains a region best; candidates by rising harness."""
    few = samples_of(measured, views=SHORT[0], oblique=oblique)
    short: list[YarnFit] = []
    least, since = np.inf, 0
    by_harness: dict[int, list[Binding]] = {}
    for binding in candidates:
        by_harness.setdefault(binding.harness, []).append(binding)
    for same in by_harness.values():
        fits = [fit_binding(few, binding, density=COARSE, evaluations=SHORT[1]) for binding in same]
        short += fits
        cost = min(fit.cost for fit in fits)
        least, since = min(least, cost), since + 1 if cost > least + HOPELESS else 0
        if since == LAST:
            break
    short.sort(key=lambda fit: fit.cost)
    many = samples_of(measured, views=LONG[0], oblique=oblique)
    long = [fit_binding(many, fit.binding, start=fit.x, evaluations=LONG[1]) for fit in short[:REFINED]]
    long.sort(key=lambda fit: fit.cost)
    like = [fit for fit in long if fit.cost < long[0].cost + LIKE]
    best = next((fit for fit in like if is_usual(fit.binding)), long[0])
    refined = {fit.binding for fit in long}
    alike = [best.binding, *(fit.binding for fit in like if fit is not best)]
    alike += [f.binding for f in short if f.binding not in refined and f.cost < short[0].cost + LIKE]
    return YarnSearch(best, alike, [(fit.binding, fit.cost) for fit in short])


def parameters_of(fit: YarnFit, *, confidence: float) -> dict[str, dict]:
    """Report every number of the weave: value, low, high, determined.

    determined is False where the samples add little to the prior. Slopes are in degrees, over the surface visible from
    above.
    """
    from scipy.stats import norm

    reach = INFLATED * float(norm.ppf(0.5 + 0.5 * confidence))
    covariance = np.linalg.inv(fit.information)
    spread_of = np.sqrt(np.diag(covariance))
    out = {}
    here = fit.weave.slopes()
    steps = np.diag(STEP * SPREAD)
    there = [
        (weave_of(fit.x + s, fit.binding).slopes(), weave_of(fit.x - s, fit.binding).slopes(), 2 * s.max())
        for s in steps
    ]
    for name, value in here.items():
        gradient = np.array([(up[name] - down[name]) / width for up, down, width in there])
        deviation = float(np.sqrt(gradient @ covariance @ gradient))
        before = float(np.linalg.norm(gradient * SPREAD))
        out[name] = {
            "value": value,
            "low": max(value - reach * deviation, 0.0),
            "high": value + reach * deviation,
            "determined": fit.explains and bool(deviation < OPEN * before or reach * deviation < NARROW * value),
        }
    for k, name in enumerate(NAMES):
        form = (lambda v: 1 / (1 + np.exp(-v))) if k in LOGITS else (lambda v: v) if k == ARCH else np.exp
        x, deviation = fit.x[k], spread_of[k]
        value, low, high = (float(form(x + side * reach * deviation)) for side in (0, -1, 1))
        told = deviation < OPEN * SPREAD[k] or high - low < 2 * NARROW * value
        inside = abs(x - CENTRE[k]) < 0.999 * REACH * SPREAD[k] and (k != ARCH or x > 0)
        out[name] = {
            "value": value,
            "low": max(low, 0.0),
            "high": high,
            "determined": fit.explains and bool(told and inside),
        }
    return out
