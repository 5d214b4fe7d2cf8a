"""Reflection models of a cloth, and the goniometer's readings, at grazing directions, extreme widths and scales."""

import mpmath
import numpy as np
import pytest
from benchmarks.cloth_peers import AshikhminShirley, Ggx, Ward, fit_peer
from benchmarks.cloth_references import read_facets
from exact_dye import exact_dye
from hypothesis import strategies as st
from stability.cases import case, powers_of_ten, relative, worst_over

from nishiki.brdf.cloth.interface import LEAST_COSINE
from nishiki.brdf.cloth.normal_incidence import GreatCircleBard, LinearBard, great_circle_view, linear_view
from nishiki.brdf.cloth.yarn_facets import CENTRE, SPREAD, shape_of, without_correction
from nishiki.brdf.cloth.yarn_fit import Measured, fit_yarn_facets
from nishiki.errors import UserError
from nishiki.goniometry.directions import unit
from nishiki.goniometry.hemisphere import interpolate, spread
from nishiki.goniometry.interpolation import coefficients, evaluate
from nishiki.goniometry.readings import assign_boards, average_repeats, read_window, reflectance

HALF_PI = np.pi / 2
ONE = np.ones(1)
BELOW_HALF_PI = tuple(HALF_PI - d for d in (1e-4, 1e-8, 1e-12, 2e-16, 0))
THETAS = (0.0, 1e-300, 1e-12, 1e-8, 1e-4, 0.3, 0.8, 1.2, 1.5, *BELOW_HALF_PI)
PHIS = (0.0, 1e-300, 1e-16, 0.5, HALF_PI, np.pi - 1e-16, np.pi, np.pi + 1e-9, 4.0, 2 * np.pi, -1e-300)
LOWEST = (5e-324, 1e-310, 1e-300, 1e-200, 1e-100, 1e-30, 1e-10, 0.0, -5e-324)
GRAZING = st.one_of(st.floats(0, HALF_PI), powers_of_ten(-15, 0).map(lambda d: HALF_PI - d), powers_of_ten(-15, 0))


def extreme_directions(count, rng):
    """Unit vectors (count, 3) at, near and beyond the normal, the horizon and the axes."""
    found = unit(rng.choice((*THETAS, HALF_PI + 1e-9, 2.0, np.pi), count), rng.choice(PHIS, count))
    flat = (rng.random(count) < 0.3) & (np.hypot(found[:, 0], found[:, 1]) > 1 - 1e-15)
    found[flat, 2] = rng.choice(LOWEST, flat.sum())
    return found


def broken_values(model, seed, count=600):
    """Values that are not finite, negative, or not 0 below the horizon."""
    rng = np.random.default_rng(seed)
    incident, outgoing = extreme_directions(count, rng), extreme_directions(count, rng)
    outgoing[::4] = incident[::4] * [-1, -1, 1]
    outgoing[1::9] = incident[1::9]
    found = model.evaluate(incident, outgoing)
    below = (incident[:, 2] <= 0) | (outgoing[:, 2] <= 0)
    wrong = int((~np.isfinite(found)).sum() + (found < 0).sum() + np.count_nonzero(found[below]))
    if getattr(model, "RECIPROCAL", False):
        swapped = model.evaluate(outgoing, incident)
        wrong += int((np.abs(found - swapped) > 1e-9 * np.maximum(np.abs(found), 1e-290)).sum())
    return wrong


def table(scale=1.0, nt=31, around=72):
    theta, phi = np.meshgrid(np.linspace(0, HALF_PI, nt), np.arange(around) * 2 * np.pi / around, indexing="ij")
    lobe = np.exp(-((np.tan(0.5 * theta) / 0.3) ** 2) * (1 + np.cos(phi) ** 2))
    return scale * (0.05 + lobe)[..., None]


def basic(values):
    spline = coefficients(values)
    return lambda views: evaluate(spline, np.asarray(views, float))


def normal_readings(scale=1.0):
    """Views (n, 3) and reflectances (n, 1) of a gloss lit along the normal."""
    views = spread(200)
    views = views[views[:, 2] > 0.1]
    return views, scale * (0.1 + np.exp(-(np.arccos(views[:, 2]) ** 2) / 0.1))[:, None]


def measured(scale=1.0):
    views, values = normal_readings(scale)
    lamps = np.concatenate([np.tile([0.0, 0.0, 1.0], (len(views), 1)), np.tile(unit(0.7, 0.3), (20, 1))])
    views, values = np.concatenate([views, views[:20]]), np.concatenate([values, 2 * values[:20]])
    return Measured(lamps, views, values, lamps[:, 2] > 0.99, True)


@case(
    "Every model of a cloth at grazing light and view",
    hazard="1 / cos, 1 / cos^2; half vectors of 0 / 0 where light and view are opposite along the horizon",
    treatment=f"directions nearer to the horizon than a cosine of {LEAST_COSINE:g} count as that near",
    outcome="finite, never negative, 0 below the horizon, reciprocal where the model is",
    bound=0,
    unit="values",
)
def test_models_at_the_horizon():
    shape = shape_of(CENTRE)
    models = [
        LinearBard.of(table()), GreatCircleBard.of(table(), diffuse=0.05), read_facets(basic(table())),
        without_correction(shape, 0.3 * ONE, 0.1 * ONE), Ward(ONE, ONE, 0.1, 0.4), Ggx(ONE, ONE, 0.1, 0.4, 1.5),
        AshikhminShirley(ONE, ONE, 10.0, 400.0, 0.05),
    ]  # fmt: skip
    models.append(exact_dye(models[5], [0.3]))
    return sum(broken_values(model, seed) for seed, model in enumerate(models))


@case(
    "Roughness towards 0 and towards infinity",
    hazard="a lobe of width 1e-300 is 0 / 0; products of widths underflow",
    treatment="widths from 1e-6 to 1e6 (slopes), exponents to 1e12; beyond is refused with a remedy",
    outcome="finite, never negative, reciprocal inside; exit status 2 outside",
    bound=0,
    unit="values",
)
def test_roughness_of_peers():
    wrong = 0
    for k, a in enumerate((1e-6, 1e-3, 0.3, 1.0, 1e3, 1e6)):
        for b in (a, 0.3):
            wrong += broken_values(Ward(ONE, ONE, a, b), k)
            wrong += sum(broken_values(Ggx(ONE, ONE, a, b, n), k) for n in (1.0, 1 + 1e-12, 1.5, 1e6))
            wrong += sum(broken_values(AshikhminShirley(ONE, ONE, a * a, b, r), k) for r in (0.0, 0.05, 1.0))
    for bad in (0.0, -1.0, 1e-300, 1e300, np.nan, np.inf):
        for make in (
            lambda v: Ward(ONE, ONE, v, 0.3), lambda v: Ggx(ONE, ONE, 0.3, v, 1.5),
            lambda v: Ggx(ONE, ONE, 0.3, 0.3, 0.5 * -abs(v)), lambda v: AshikhminShirley(ONE, ONE, -abs(v) - 1, v, 0.1),
        ):  # fmt: skip
            try:
                make(bad)
                wrong += 1
            except UserError:
                continue
    return wrong


def _exact_half(incident, outgoing):
    i, o = ([mpmath.mpf(float(v)) for v in d] for d in (incident, outgoing))
    total = [a + b for a, b in zip(i, o, strict=True)]
    length = mpmath.sqrt(sum(t * t for t in total))
    return i, o, [t / length for t in total], length / 2


def _exact_fresnel(c, n):
    g = mpmath.sqrt(n * n + c * c - 1)
    return ((g - c) / (g + c)) ** 2 / 2 * (1 + ((c * (g + c) - 1) / (c * (g - c) + 1)) ** 2)


def _peer_error(theta_i, phi_i, theta_r, phi_r, ax, ay):
    incident, outgoing = unit(theta_i, phi_i), unit(theta_r, phi_r)
    if min(incident[2], outgoing[2]) < LEAST_COSINE:
        return 0.0
    with mpmath.workdps(50):
        i, o, h, d = _exact_half(incident, outgoing)
        slope2 = ((h[0] / ax) ** 2 + (h[1] / ay) ** 2) / h[2] ** 2
        ward = mpmath.exp(-slope2) / (4 * mpmath.pi * ax * ay * d**2 * h[2] ** 4)
        ellipse = (h[0] / ax) ** 2 + (h[1] / ay) ** 2 + h[2] ** 2
        density = 1 / (mpmath.pi * ax * ay * ellipse**2)
        s = [mpmath.sqrt((ax * w[0]) ** 2 + (ay * w[1]) ** 2 + w[2] ** 2) for w in (i, o)]
        ggx = _exact_fresnel(d, mpmath.mpf(1.5)) * density / (2 * (i[2] * s[1] + o[2] * s[0]))
        exact = [ward, ggx]
    found = [m.evaluate(incident, outgoing)[0] for m in (Ward(0 * ONE, ONE, ax, ay), Ggx(0 * ONE, ONE, ax, ay, 1.5))]
    worst = 0.0
    for a, b in zip(found, exact, strict=True):
        # the half vector is known to a rounding, which the narrow width magnifies
        sensitivity = 1 + float(slope2) ** 0.5 / min(ax, ay) if b is ward else 1 + 1 / min(ax, ay)
        if b > 1e-290:
            worst = max(worst, float(abs(a - b) / b) / sensitivity)
    return worst


@case(
    "Ward and GGX from 1e-4 to 100 rough, down to the horizon",
    hazard="1 / (cos_i cos_r), squares of narrow slopes",
    treatment="cosines are cancelled before anything is divided",
    reference="mpmath, 50 digits",
    outcome="exact to the rounding of the half vector over the width",
    bound=2e-13,
    unit="relative, over the sensitivity to the half vector",
)
def test_peers_against_high_precision():
    angle = st.floats(0, 6.28)
    width = powers_of_ten(-4, 2)
    return worst_over(_peer_error, GRAZING, angle, GRAZING, angle, width, width, examples=200)


def _great_circle_error(theta_i, phi_i, theta_r, offset):
    incident, outgoing = unit(theta_i, phi_i), unit(theta_r, phi_i + offset)
    found = great_circle_view(incident, outgoing)
    if not (incident[2] > 0 and outgoing[2] > 0):
        return 0.0
    with mpmath.workdps(60):
        i, o = ([mpmath.mpf(float(v)) for v in d] for d in (incident, outgoing))
        across = mpmath.sqrt(i[0] ** 2 + i[1] ** 2)
        x, y = (-i[0] / across, -i[1] / across) if across > 0 else (mpmath.mpf(1), mpmath.mpf(0))
        along, side = x * o[0] + y * o[1], x * o[1] - y * o[0]
        length = mpmath.sqrt(side**2 + o[2] ** 2)
        beta, theta = mpmath.atan2(length, along), mpmath.atan2(across, i[2])
        half = mpmath.pi / 2
        rest = half - theta
        turned = half * beta / rest if beta <= rest else (half * beta + mpmath.pi * theta) / (half + theta)
        exact = [
            mpmath.cos(turned) * x - mpmath.sin(turned) * side / length * y,
            mpmath.cos(turned) * y + mpmath.sin(turned) * side / length * x,
            mpmath.sin(turned) * o[2] / length,
        ]
        # how far a rounding of the view's azimuth and of theta_i moves the result
        sensitivity = 1 + 1 / float(length) + float(turned) / max(float(rest), 1e-16)
        apart = max(abs(float(e - f)) for e, f in zip(exact, found, strict=True))
    return max(apart / sensitivity, abs(np.linalg.norm(found) - 1), -float(found[2]))


@case(
    "BARD: light at the horizon, view along the mirror direction",
    hazard="beta -> 0, V parallel to R_xy, theta_i -> pi/2: beta0 / beta is unbounded, its direction 0 / 0",
    treatment="the part of V off R_xy is built by components across it, so it is perpendicular to the last bit",
    reference="mpmath, 60 digits",
    outcome="a unit vector on or above the horizon, exact to the rounding of the input",
    bound=2e-14,
    unit="absolute, over the sensitivity to the input",
)
def test_great_circle():
    near = powers_of_ten(-17, -1).map(lambda d: np.pi + d)
    offset = st.one_of(st.floats(0, 6.28), near, st.just(np.pi), st.just(0.0))
    return worst_over(_great_circle_error, GRAZING, st.floats(0, 6.28), GRAZING, offset, examples=300)


def _linear_error(theta_i, phi_i, theta_r):
    """In the plane of incidence on the mirror's side the linear form is the great circle."""
    incident, outgoing = unit(theta_i, phi_i), unit(theta_r, phi_i + np.pi)
    if not (incident[2] > 0 and outgoing[2] > 0):
        return 0.0
    found = linear_view(incident, outgoing)
    sensitivity = 1 + 1 / max(outgoing[2], 1e-16) + 1 / max(incident[2], 1e-16)
    return np.abs(found - great_circle_view(incident, outgoing)).max() / sensitivity


@case(
    "BARD, printed form: views that sink to the mirror direction",
    hazard="beta0 / beta overflows at theta_i = pi/2",
    treatment="elevation and azimuth are divided by beta first: both quotients are bounded",
    reference="the great circle, which it equals in the plane of incidence",
    outcome="finite and equal",
    bound=1e-14,
    unit="absolute, over the sensitivity to the input",
)
def test_linear_form():
    return worst_over(_linear_error, GRAZING, st.floats(0, 6.28), GRAZING, examples=200)


@case(
    "BARD: light along the normal",
    hazard="the direction of R_xy is undefined, or has lost its digits (theta_i of 1e-323)",
    treatment="any direction does below 1e-290: beta0 = beta",
    outcome="the identity",
    bound=1e-12,
    unit="absolute",
)
def test_identity():
    rng = np.random.default_rng(0)
    views = extreme_directions(500, rng)
    views = views[views[:, 2] > 0]
    worst = 0.0
    for tiny, aside in ((0.0, 0.0), (5e-324, 1e-323), (1e-300, -1e-300), (1e-160, 1e-161)):
        incident = np.array([tiny, aside, 1.0])
        worst = max(worst, np.abs(great_circle_view(incident, views) - views).max())
        worst = max(worst, np.abs(linear_view(incident, views) - views).max())
    return worst


@pytest.mark.slow
@case(
    "Table of normal incidence that is 0, a spike, or 1e-12 to 1e12 times as large",
    hazard="logarithm of 0; floors of 1e-12 in the density of facets",
    treatment="floors are relative to the largest value",
    reference="the same at scale 1",
    outcome="finite; times the scale",
    bound=1e-10,
)
def test_tables_of_any_scale():
    views = spread(60)
    incident, outgoing = views, views[::-1]
    worst = 0.0
    for make in (LinearBard.of, GreatCircleBard.of, lambda values: read_facets(basic(values))):
        plain = make(table()).evaluate(incident, outgoing)
        for scale in (1e-200, 1e-12, 1e-6, 1e6, 1e12, 1e200):
            found = make(table(scale)).evaluate(incident, outgoing)
            worst = max(worst, np.abs(found / scale / plain - 1).max())
        spike = np.zeros((31, 72, 1))
        for top in (0.0, 1.0):
            spike[0] = top
            worst = np.inf if not np.isfinite(make(spike).evaluate(incident, outgoing)).all() else worst
    return worst


def _yarn_values(*signs):
    x = CENTRE + 6 * SPREAD * np.array(signs)
    return broken_values(without_correction(shape_of(x), 0.3 * ONE, 0.1 * ONE), 3, count=120)


@case(
    "Yarn facets at the corners of their priors",
    hazard="slopes, powers and widths six prior deviations off: incomplete beta functions at their ends",
    treatment="the fit is bounded there; quantiles are clipped below 1",
    outcome="finite, never negative, reciprocal",
    bound=0,
    unit="values",
)
def test_yarns_at_the_bounds():
    return worst_over(_yarn_values, *[st.floats(-1, 1)] * CENTRE.size, examples=25)


@case(
    "Ward, GGX and Ashikhmin-Shirley fitted to reflectances times 1e-12 to 1e12",
    hazard="thresholds that are not relative",
    treatment="weights are relative to the values, strengths are eliminated",
    reference="the same at scale 1",
    outcome="the same shape; strengths times the scale",
    bound=1e-8,
)
def test_peer_fits_scale():
    worst = 0.0
    for kind in ("ward", "ggx", "ashikhmin_shirley"):
        plain = fit_peer(kind, measured(), np.arange(len(measured().grey)))
        for scale in (1e-12, 1e12):
            found = fit_peer(kind, measured(scale), plain.used)
            worst = max(worst, np.abs(found.fit.x - plain.fit.x).max())
            worst = max(worst, relative(found.fit.coefficients / scale, plain.fit.coefficients))
    return worst


@case(
    "A cloth of which nothing, one value, or only black was measured",
    hazard="weights of 1 / 0",
    treatment="refused with a remedy where no reflectance is above 0",
    outcome="exit status 2, or a finite model",
    bound=0,
    unit="wrong outcomes",
)
def test_fits_of_nothing():
    wrong = 0
    few, black = measured(), measured(0.0)
    for kind in ("ward", "ggx", "ashikhmin_shirley"):
        one = fit_peer(kind, few, np.arange(1)).brdf
        wrong += not np.isfinite(one.evaluate(few.incident, few.outgoing)).all()
        for rows, of in ((np.arange(50), black), (np.arange(0), few)):
            try:
                fit_peer(kind, of, rows)
                wrong += 1
            except UserError:
                continue
    for of in (black, measured(-1.0), measured(np.nan)):
        try:
            fit_yarn_facets(of, np.arange(len(of.grey)))
            wrong += 1
        except UserError:
            continue
    return wrong


@case(
    "Views at normal incidence with values that are 0, negative or missing",
    hazard="logarithm of what is not positive",
    treatment="such views are left out; too few, or all in one line, are refused with a remedy",
    reference="the hemisphere without these views",
    outcome="the same hemisphere",
    bound=1e-12,
)
def test_views_without_a_logarithm():
    views, values = normal_readings()
    kept = np.ones(len(views), bool)
    kept[3:8] = False
    broken = values.copy()
    broken[3:8, 0] = [0.0, -1.0, np.nan, np.inf, -0.0]
    worst = 0.0
    plain = interpolate(views[kept], values[kept], 0 * values[kept])
    found = interpolate(views, broken, 0 * values)
    worst = max(worst, relative(found.basic.values, plain.basic.values))
    for bad in (0 * values, -values, np.nan * values):
        try:
            interpolate(views, bad, 0 * values)
            worst = np.inf
        except UserError:
            continue
    return worst


@pytest.mark.slow
@case(
    "Hemisphere from values times 1e-12 to 1e12, from equal values, from noise of any size",
    hazard="smoothing chosen by absolute errors",
    treatment="everything works on logarithms",
    reference="the same at scale 1",
    outcome="times the scale; constant where the values are",
    bound=1e-9,
)
def test_hemisphere_scale():
    views, values = normal_readings()
    worst = 0.0
    plain = interpolate(views, values, 0 * values).basic.values
    for scale in (1e-12, 1e12):
        found = interpolate(views, values * scale, 0 * values).basic.values
        worst = max(worst, np.abs(found / scale / plain - 1).max())
    flat = interpolate(views, np.full_like(values, 0.3), 0 * values).basic.values
    noisy = interpolate(views, values, 1e10 * values).basic.values
    worst = max(worst, np.abs(flat / 0.3 - 1).max(), 0.0 if np.isfinite(noisy).all() else np.inf)
    return worst


@case(
    "White board that gives no light, subnormal light, or was lit at the horizon",
    hazard="0 / 0; a factor of 1e16 between a grazed board and the sample",
    treatment="no light, or a quotient beyond float64, gives 0 (not valid); grazed boards serve no other incidence",
    outcome="finite; exit status 2 where only grazed boards are left",
    bound=0,
    unit="wrong outcomes",
)
def test_boards_without_light():
    white = np.array([0.0, -1.0, 1e-320, np.nan, np.inf, 1.0])
    values, noise = reflectance(np.ones(6), np.ones(6), white, np.ones(6), np.full(6, 0.9))
    wrong = int((~np.isfinite(values)).sum() + (~np.isfinite(noise)).sum() + np.count_nonzero(values[:5]))
    boards = assign_boards(np.array([[45.0, 0, 0, 0]]), np.array([[90.0, 0, 0, 0], [91, 0, 0, 0], [60, 0, 0, 0]]))
    wrong += boards[0].which.tolist() != [2] or not 0 < boards[0].factors[0] < 2
    try:
        assign_boards(np.array([[45.0, 0, 0, 0]]), np.array([[90.0, 0, 0, 0], [91, 0, 0, 0]]))
        wrong += 1
    except UserError:
        pass
    return wrong


@case(
    "Repeated measurements of which some are not valid",
    hazard="0 times NaN in a weighted mean",
    treatment="what is not valid is taken out before it is weighted",
    outcome="the mean of the valid ones; 0 and not valid where there is none",
    bound=1e-12,
)
def test_repeats():
    values = np.array([1.0, np.nan, 3.0, np.inf]).reshape(4, 1, 1)
    angles = np.zeros((4, 4))
    angles[3] = 30.0
    valid = np.array([[1], [0], [1], [0]], bool)
    found = average_repeats(angles, values, np.abs(values), valid, np.ones(4))
    if found.valid.tolist() != [[True], [False]]:
        return np.inf
    return max(relative(found.values.ravel(), [2.0, 0.0]), relative(found.noise.ravel(), [np.sqrt(2.5), 0.0]))


@case(
    "Window with no usable pixel, one pixel, one tile",
    hazard="mean and scatter of nothing",
    treatment="0 with 0 pixels, which makes the reading invalid; one pixel has no scatter",
    outcome="finite",
    bound=0,
    unit="wrong outcomes",
)
def test_windows():
    wrong = 0
    for pixels in (0, 1, 16):
        usable = np.zeros(64, bool)
        usable[:pixels] = True
        image = np.where(usable[:, None], 2.0, np.nan).reshape(8, 8, 1)
        found = read_window(image, usable.reshape(8, 8), np.zeros((8, 8), bool))
        wrong += not (np.isfinite(found.mean).all() and np.isfinite(found.noise).all() and found.pixels == pixels)
        wrong += found.mean[0] != (2.0 if pixels else 0.0)
    return wrong
