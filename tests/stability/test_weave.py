"""The weave's masking and its fit at grazing directions, degenerate sections, extreme lobes and scales."""

import mpmath
import numpy as np
from hypothesis import strategies as st
from stability.cases import case, powers_of_ten, worst_over
from weave_rays import masking

from nishiki.errors import UserError
from nishiki.weave.fit import make_plane
from nishiki.weave.model import PAPER, SHADED, lobe_integral, plane_rows
from nishiki.weave.search import bounds, costs, strengths
from nishiki.weave.section import WarpSection, WeftSection, facing_length

HALF_PI = np.pi / 2
ONE = np.ones(1)
GRAZING = st.one_of(st.floats(0, HALF_PI), powers_of_ten(-15, 0).map(lambda d: HALF_PI - d), powers_of_ten(-15, 0))


def _facing_error(theta_a, flank, theta):
    """Against the derivation in high precision, from the floats as they are; relative to the hump's side."""
    length, radius = flank, (1 - flank) / theta_a
    with mpmath.workdps(60):
        a, side, r, half = (mpmath.mpf(v) for v in (theta_a, length, radius, HALF_PI))
        t = half - mpmath.mpf(theta)
        if t > a:
            exact = r * a + side
        elif t < 0:
            exact = mpmath.mpf(0)
        else:
            shade = side * mpmath.sin(a - t) + r * (1 - mpmath.cos(a - t))
            reach = mpmath.sin(a + t)
            if shade <= side * reach:
                exact = r * a + side - (shade / reach if reach > 0 else 0)
            else:
                rise = mpmath.sin(t) * (side * mpmath.cos(a) + r * mpmath.sin(a)) / r
                exact = r * min(max(2 * mpmath.asin(mpmath.sqrt(min(rise, 1))) - t, 0), a)
    return abs(float(exact - facing_length(theta_a, length, radius, theta)))


@case(
    "Masking at grazing view, down to 1e-15 of a right angle",
    hazard="1 - cos of small angles, differences of nearly equal arcs",
    treatment="half-angle forms; the flank's end and the arc's beginning agree",
    reference="mpmath, 60 digits",
    outcome="exact to rounding for every steepness and flank",
    bound=1e-7,
    unit="of a hump's side (square root of a rounding where two branches meet)",
)
def test_masking_against_high_precision():
    return worst_over(_facing_error, st.floats(1e-3, HALF_PI - 1e-3), st.floats(0, 0.999), GRAZING, examples=300)


def _section_error(theta_a, length, radius, flat, yarns, contact):
    """How far G rises, leaves 0 .. 1, or is not 1 along the normal."""
    if length + radius <= 0:
        return 0.0
    worst = 0.0
    angles = np.concatenate([np.linspace(0, HALF_PI, 200), HALF_PI - np.logspace(-15, -1, 60)])
    angles.sort()
    for section in (WarpSection(theta_a, length, radius, flat), WeftSection(theta_a, length, radius, yarns, contact)):
        g = masking(section, angles)
        if not np.isfinite(g).all() or (g < 0).any() or (g > 1).any():
            return np.inf
        worst = max(worst, abs(g[0] - 1), np.diff(g).max(), abs(masking(section, HALF_PI + 1e-9)))
    return worst


@case(
    "Sections without flank, without arc, with one yarn or a thousand, flat or steep",
    hazard="division by a radius or a length of 0; lengths of 1e-9 beside 1e9",
    treatment="0 / 0 branches are taken by their limits",
    outcome="G is 1 along the normal, never rises, stays in 0 .. 1, is 0 below the horizon",
    bound=1e-6,
    unit="of G",
)
def test_degenerate_sections():
    size = st.one_of(st.just(0.0), powers_of_ten(-9, 9))
    steep = st.one_of(st.floats(1e-6, HALF_PI - 1e-6), powers_of_ten(-6, 0))
    yarns = st.one_of(st.just(1.0), st.floats(1, 1000))
    return worst_over(_section_error, steep, size, size, size, yarns, st.floats(1e-6, HALF_PI), examples=150)


def _lobe_error(low, width_of, exponent):
    high = min(low + width_of, HALF_PI)
    width = 10.0**exponent
    with mpmath.workdps(60):
        a, b, w = mpmath.mpf(low), mpmath.mpf(high), mpmath.mpf(width)
        exact = mpmath.sqrt(mpmath.pi) / 2 * w * (mpmath.erf(b / w) - mpmath.erf(a / w))
        whole = float(mpmath.sqrt(mpmath.pi) * w)
    found = lobe_integral(low, high, width)
    if found < 0:
        return np.inf
    return abs(found - float(exact)) / whole


@case(
    "Integral of a lobe far out in its tail",
    hazard="difference of two antiderivatives that have reached their limits: a negative reflectance",
    treatment="on one side of the middle the difference of two tails (erfc, arctangent of the reciprocal)",
    reference="mpmath, 60 digits",
    outcome="never negative; exact to rounding of the whole lobe",
    bound=1e-14,
    unit="of the whole lobe",
)
def test_lobe_integrals():
    width = st.floats(-6, 1)
    return worst_over(_lobe_error, st.floats(-HALF_PI, HALF_PI), powers_of_ten(-9, 0), width, examples=300)


def _tail_error(share, exponent):
    """Relative error far out, where the integral is a small part of the lobe."""
    width = 10.0**exponent
    low = min(share * width, 1.4)
    high = min(low * 1.5, 1.5)
    with mpmath.workdps(80):
        a, b, w = mpmath.mpf(low), mpmath.mpf(high), mpmath.mpf(width)
        exact = mpmath.sqrt(mpmath.pi) / 2 * w * (mpmath.erfc(a / w) - mpmath.erfc(b / w))
    return abs(lobe_integral(low, high, width) / float(exact) - 1) if exact > 1e-280 else 0.0


@case(
    "The same, relative to the tail itself",
    hazard="all digits of a small integral lost",
    treatment="as above",
    reference="mpmath, 80 digits",
    outcome="right to the bound for lobes as wide as the fit allows (0.02 to 3)",
    bound=1e-9,
)
def test_lobe_tails():
    return worst_over(_tail_error, st.floats(2, 25), st.floats(-1.7, 0), examples=60)


def _strengths_error(seed, angle, scale):
    """Against exact two-column least squares in 50 digits; columns at an angle to each other."""
    rng = np.random.default_rng(seed)
    a = rng.uniform(0, 1, 12)
    b = a + angle * rng.uniform(-1, 1, 12)
    y = scale * np.abs(rng.normal(size=12))
    gloss, body = strengths(a, b, y)
    with mpmath.workdps(50):
        ma, mb, my = ([mpmath.mpf(float(v)) for v in of] for of in (a, b, y))

        def cost(u, v):
            return sum((u * p + v * q - t) ** 2 for p, q, t in zip(ma, mb, my, strict=True))

        def dot(p, q):
            return sum(x * z for x, z in zip(p, q, strict=True))

        aa, bb, ab, ay, by = dot(ma, ma), dot(mb, mb), dot(ma, mb), dot(ma, my), dot(mb, my)
        det = aa * bb - ab * ab
        choices = [(max(ay / aa, 0), mpmath.mpf(0)), (mpmath.mpf(0), max(by / bb, 0))]
        if det > 0:
            both = ((ay * bb - by * ab) / det, (by * aa - ay * ab) / det)
            choices += [both] if min(both) >= 0 else []
        best = min(cost(*pair) for pair in choices)
        excess = cost(mpmath.mpf(float(gloss)), mpmath.mpf(float(body))) - best
        return float(excess / dot(my, my)) if gloss >= 0 and body >= 0 else np.inf


@case(
    "Gloss and body that look alike, in units from 1e-12 to 1e12",
    hazard="determinant of two nearly collinear columns",
    treatment="below 1e-13 of the product the better column alone; strengths never negative",
    reference="non-negative least squares in mpmath, 50 digits",
    outcome="the sum of squares is the least that exists",
    bound=1e-10,
    unit="excess, of the data's sum of squares",
)
def test_strengths():
    scales = powers_of_ten(-12, 0), powers_of_ten(-12, 12)
    return worst_over(_strengths_error, st.integers(0, 1000), *scales, examples=120)


@case(
    "Sum of squares of the weave fit under reflectances times 2^-40 to 2^40",
    hazard="thresholds that are not relative",
    treatment="strengths are eliminated; weights are relative to the values",
    reference="the same at scale 1",
    outcome="the same bits",
    bound=0,
    unit="values that differ",
)
def test_weave_scale():
    angles = np.radians(np.arange(-80, 81, 5.0))
    values = 0.1 + np.exp(-((angles / 0.3) ** 2))
    low, high = bounds()
    points = np.random.default_rng(0).uniform(low, high, (60, low.size))
    rows = np.concatenate([plane_rows(k, angles) for k in (0, 1)])
    differ, plain = 0, None
    for exponent in (0, -40, -10, 10, 40):
        scale = 2.0**exponent
        planes = [make_plane(angles, values * scale), make_plane(angles, 1.5 * values * scale)]
        y, weight = np.concatenate([p.mean for p in planes]), 1 / np.concatenate([p.sigma for p in planes])
        found = np.stack([costs(points, (rows, y, weight, kind)) for kind in (PAPER, SHADED)])
        plain = found if plain is None else plain
        differ += int((found != plain).sum() + (~np.isfinite(found)).sum())
    return differ


@case(
    "Planes of a cloth with too little in them",
    hazard="weights of 1 / 0 where all reflectances are 0",
    treatment="refused with a remedy",
    outcome="exit status 2",
    bound=0,
    unit="planes that passed",
)
def test_empty_planes():
    angles = np.radians(np.arange(-40, 41, 5.0))
    passed = 0
    hopeless = (
        (angles, np.zeros(17)), (angles, np.full(17, -1.0)), (angles[:3], np.ones(3)), (angles, np.full(17, np.nan)),
        (np.full(17, HALF_PI), np.ones(17)), (np.full(17, np.nan), np.ones(17)), (angles[:0], np.ones(0)),
    )  # fmt: skip
    for theta, values in hopeless:
        try:
            make_plane(theta, values)
            passed += 1
        except UserError:
            continue
    return passed
