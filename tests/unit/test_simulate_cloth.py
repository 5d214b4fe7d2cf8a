"""The simulated cloth: yarns, rays, facets, and the BRDF against a plain path tracer."""

import math
from dataclasses import replace

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused

from nishiki.errors import UserError
from nishiki.simulate.cloth.geometry import (
    SAMPLES,
    centre_line,
    escapes,
    first_hit,
    inside,
    make_descent,
    weave_pattern,
)
from nishiki.simulate.cloth.reflectance import make_cloth, trace, trace_reach, turned_frame
from nishiki.simulate.cloth.settings import hemisphere_views, make_settings, quarter_views, session, unit
from nishiki.simulate.reflection import body, fresnel, in_frame, reflect_filament

QUALITY = {"candidates": 30_000, "chains": 12_000}


@pytest.fixture(scope="module")
def satin():
    return make_cloth(make_settings("satin", dye="crimson", repeats=1), **QUALITY)


@pytest.mark.parametrize(
    ("weave", "harness", "step"), [("plain", 2, 1), ("twill", 4, 1), ("satin", 5, 2), ("satin", 8, 3)]
)
def test_every_yarn_is_bound_once_a_repeat(weave, harness, step):
    up = weave_pattern(weave, harness, step)
    bound = 1 if harness > 2 else harness // 2
    np.testing.assert_array_equal((~up).sum(axis=0), bound)
    np.testing.assert_array_equal((~up).sum(axis=1), bound)
    weft = weave_pattern(weave, harness, step, face="weft")
    assert weft.sum() == (~up).sum()
    if weave == "satin":  # no two bindings touch, not even over the edge of the repeat
        for axis in (0, 1):
            assert not (~up & np.roll(~up, 1, axis=axis)).any()
        for turn in (1, -1):
            assert not (~up & np.roll(np.roll(~up, 1, axis=0), turn, axis=1)).any()


def test_impossible_cloths_are_explained():
    with refused(UserError, by="weave_pattern"):
        weave_pattern("satin", 6, 2)
    with refused(UserError, "velvet"):
        replace(make_settings("satin"), weave="velvet")
    with refused(UserError, "both"):
        replace(make_settings("satin"), face="both")
    with pytest.raises(UserError, match="bend"):
        make_settings("satin", bend=2.0)
    with pytest.raises(UserError, match=r"\(channels\)"):
        replace(make_settings("satin"), channels=("grey",))
    with refused(UserError, "6", by="make_settings"):
        make_settings("satin", harness=6)


@given(
    width=st.floats(0.01, 10.0),
    height=st.floats(0.001, 10.0),
    bend=st.floats(0.0, 1.0),
)
def test_a_descent_is_made_of_arcs_and_a_straight_part_of_the_right_size(width, height, bend):
    d = make_descent(width=width, height=height, bend=bend)
    across = 2.0 * d.radius * math.sin(d.angle) + d.straight * math.cos(d.angle)
    down = 2.0 * d.radius * (1.0 - math.cos(d.angle)) + d.straight * math.sin(d.angle)
    assert across == pytest.approx(width, rel=1e-9)
    assert down == pytest.approx(height, rel=1e-9)


@pytest.mark.parametrize("on_top", [[1, 0], [1, 1, 1, 1, 0], [0, 0, 1, 1, 0, 1], [1, 1, 1, 1, 1]])
def test_centre_lines_are_smooth_and_pass_over_and_under(on_top):
    z, slope, _ = centre_line(np.array(on_top, bool), spacing=0.2, amplitude=0.03, bend=0.7, rest=0.1, arch=0.1)
    step = 0.2 / SAMPLES
    numeric = (np.roll(z, -1) - np.roll(z, 1)) / (2.0 * step)
    assert np.abs(numeric - slope).max() < 0.03  # an arc's curvature times a step
    assert np.abs(np.diff(np.append(z, z[0]))).max() < 1.2 * step
    middle = SAMPLES // 2 + SAMPLES * np.arange(len(on_top))
    up = np.array(on_top, bool)
    assert (z[middle][up] >= 0.03 - 1e-12).all()
    np.testing.assert_allclose(z[middle][~up], -0.03)


def _inside_slowly(solids, x, y, z):
    """The definition, yarn by yarn and period by period."""
    for yarns, v, along in ((solids.warp, x, y), (solids.weft, y, x)):
        count = len(yarns.shape)
        samples = np.arange(yarns.path.shape[1] + 1) * (yarns.length / yarns.path.shape[1])
        for k in range(count):
            offset, a, b = yarns.shape[k]
            for period in (-1, 0, 1):
                u = v - (k + 0.5) * yarns.spacing - offset - period * count * yarns.spacing
                path = np.vstack([yarns.path[k], yarns.path[k][:1]])
                centre, roll = (np.interp(along % yarns.length, samples, path[:, c]) for c in (0, 2))
                if abs(u) < a and ((z - centre - roll * u) / b) ** 2 + (abs(u) / a) ** yarns.exponent < 1.0:
                    return (1 + k) if yarns is solids.warp else (-1 - k)
    return 0


@pytest.mark.slow
def test_points_in_yarns_against_the_definition(satin):
    solids = satin.solids
    random = np.random.default_rng(1)
    size = np.array([solids.weft.length, solids.warp.length])
    place = random.uniform(-0.4, 1.4, (1500, 2)) * size
    height = random.uniform(*solids.numbers[2:4], 1500)
    found = np.array([inside(*p, z, solids.numbers) for p, z in zip(place, height, strict=True)])
    expected = np.array([_inside_slowly(solids, *(p % size), z) for p, z in zip(place, height, strict=True)])
    assert np.mean(found != expected) <= 0.002  # |u|^e is interpolated: points within 1e-6 of a surface may differ
    assert 0.2 < np.mean(expected != 0) < 0.8


@numba.njit
def _march(x, y, z, dx, dy, dz, numbers, step):
    low, high = numbers[2], numbers[3]
    t = 0.0
    while low <= z + t * dz <= high:
        if inside(x + t * dx, y + t * dy, z + t * dz, numbers) != 0:
            return t
        t += step
    return -1.0


def test_rays_against_short_even_steps(satin):
    solids = satin.solids
    numbers, random = solids.numbers, np.random.default_rng(2)
    size = np.array([solids.weft.length, solids.warp.length])
    wrong = far = 0
    for _ in range(600):
        d = random.standard_normal(3)
        d /= np.linalg.norm(d)
        x, y = random.uniform(0.0, 1.0, 2) * size
        z = random.uniform(numbers[2], numbers[3])
        if inside(x, y, z, numbers) != 0 or abs(d[2]) < 0.02:
            continue
        expected = _march(x, y, z, *d, numbers, numbers[4] / 40.0)
        t, which = first_hit(x, y, z, *d, numbers, solids.free)
        if d[2] > 0.0:
            assert escapes(x, y, z, *d, numbers, solids.free) == (t < 0.0)
        wrong += (t < 0.0) != (expected < 0.0)
        if t >= 0.0 and expected >= 0.0:
            assert which != 0
            far += abs(t - expected) > 0.05 * numbers[4]
    assert wrong <= 3
    assert far <= 3


@pytest.mark.slow
def test_what_is_told_to_be_free_is_free(satin):
    solids, random = satin.solids, np.random.default_rng(4)
    levels, rows, columns = solids.free.shape
    low, high = solids.numbers[2:4]
    sizes = np.array([solids.weft.length / columns, solids.warp.length / rows, (high - low) / levels])
    place = np.argwhere(solids.free > 0.2 * sizes.min())
    assert len(place) > 1000
    for k, j, i in place[random.integers(len(place), size=400)]:
        start = (np.array([i, j, k]) + random.uniform(0.0, 1.0, 3)) * sizes + [0.0, 0.0, low]
        away = random.standard_normal((40, 3))
        away *= solids.free[k, j, i] / np.linalg.norm(away, axis=1, keepdims=True)
        assert all(inside(*p, solids.numbers) == 0 for p in start + away)


@settings(max_examples=40, deadline=None)
@given(
    angles=st.tuples(*[st.floats(0.0, 89.9), st.floats(0.0, 360.0)] * 2),
    along=st.floats(0.03, 1.0),
    across=st.floats(0.03, 1.0),
)
def test_facets_are_reciprocal_and_finite(angles, along, across):
    i, o = unit(*angles[:2]), unit(*angles[2:])
    cloth = along, across, 1.5
    there, back = reflect_filament(tuple(i), tuple(o), cloth), reflect_filament(tuple(o), tuple(i), cloth)
    assert math.isfinite(there)
    assert there >= 0.0
    assert there == pytest.approx(back, rel=1e-9)
    assert body(i[2], o[2], 1.5) == pytest.approx(body(o[2], i[2], 1.5), rel=1e-12)


@pytest.mark.parametrize("angles", [(0, 0, 0, 0), (30, 10, 40, 200), (70, 0, 75, 180), (80, 0, 10, 90)])
def test_facets_are_normally_distributed_slopes(angles):
    """Against the density of slopes and Smith's integral over it, with the Jacobian of reflection written out."""
    along, across, index = 0.2, 0.4, 1.5
    i, o = unit(*angles[:2]), unit(*angles[2:])
    h = (i + o) / np.linalg.norm(i + o)
    slopes = -h[:2] / h[2]
    deviation = np.array([along, across]) / math.sqrt(2.0)
    density = math.prod(
        math.exp(-0.5 * (m / s) ** 2) / (s * math.sqrt(2 * math.pi)) for m, s in zip(slopes, deviation, strict=True)
    )
    by_solid_angle = density / h[2] ** 4  # of normals, over the projected area

    def smith(d):
        sine = math.hypot(d[0], d[1])
        if sine == 0.0:
            return 0.0
        s = math.hypot(d[0] * deviation[0], d[1] * deviation[1]) / sine
        m = np.linspace(d[2] / sine, d[2] / sine + 12 * s, 200_001)
        p = np.exp(-0.5 * (m / s) ** 2) / (s * math.sqrt(2 * math.pi))
        return float(np.trapezoid((m * sine - d[2]) * p, m)) / d[2]

    masked = 1.0 / (1.0 + smith(i) + smith(o))
    expected = fresnel(float(i @ h), index) * by_solid_angle * masked / (4.0 * i[2] * o[2])
    assert reflect_filament(tuple(i), tuple(o), (along, across, index)) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("theta", [0.0, 40.0, 75.0])
def test_filaments_reflect_no_more_than_they_get(theta):
    z = (np.arange(400) + 0.5) / 400
    phi = (np.arange(400) + 0.5) * (2.0 * math.pi / 400)
    i = unit(theta, 25.0)
    total = 0.0
    for cosine in z:
        sine = math.sqrt(1.0 - cosine * cosine)
        for turn in phi[::4]:
            o = sine * math.cos(turn), sine * math.sin(turn), cosine
            total += cosine * (reflect_filament(tuple(i), o, (0.12, 0.3, 1.57)) + body(i[2], cosine, 1.57))
    assert 0.3 < total * (2.0 * math.pi / (400 * 100)) <= 1.0


@pytest.mark.slow
@pytest.mark.parametrize("direction", [(0.0, 0.0), (50.0, 0.0), (50.0, 90.0), (75.0, 30.0)])
def test_points_stand_for_all_that_is_seen(satin, direction):
    """∫ V (n·d)⁺ dS is the cell's area times cosθ wherever no ray passes the cloth."""
    cloth, d = satin, unit(*direction)
    seen = float((trace_reach(cloth, d[None]).lit[0] * cloth.points.area).sum())
    solids, random = cloth.solids, np.random.default_rng(3)
    start = random.uniform(0.0, 1.0, (4000, 2)) * [solids.weft.length, solids.warp.length]
    high = solids.numbers[3]
    met = [first_hit(x, y, high, *-d, solids.numbers, solids.free)[1] != 0 for x, y in start]
    assert seen / (solids.area * d[2]) == pytest.approx(np.mean(met), abs=0.012)


@numba.njit
def _path_traced(i, o, paths, bounces, numbers, free, twist, surface, dye, size, random):
    """Sum and sum of squares, over paths from the camera, of the BRDF's first channel."""
    f = np.empty(6)
    total = squares = 0.0
    for _ in range(paths):
        x, y, z = random.random() * size[0], random.random() * size[1], numbers[3]
        dx, dy, dz = -o[0], -o[1], -o[2]
        passed, value = 1.0, 0.0
        for _step in range(bounces + 1):
            t, which = first_hit(x, y, z, dx, dy, dz, numbers, free)
            if which == 0:
                break
            x, y, z = x + t * dx, y + t * dy, z + t * dz
            turned_frame(x, y, z, which, numbers, twist, f)
            x, y, z = x + 2e-4 * f[0], y + 2e-4 * f[1], z + 2e-4 * f[2]
            k = 0 if which > 0 else 1
            vx, vy, vz = in_frame(-dx, -dy, -dz, f)
            if vz <= 0.0:
                break
            lx, ly, lz = in_frame(i[0], i[1], i[2], f)
            if lz > 0.0 and escapes(x, y, z, i[0], i[1], i[2], numbers, free):
                mirror = reflect_filament((lx, ly, lz), (vx, vy, vz), surface[k])
                value += passed * lz / i[2] * (mirror + dye[k, 0] * body(lz, vz, surface[k, 2]))
            r, turn = math.sqrt(random.random()), 2.0 * math.pi * random.random()
            lx, ly = r * math.cos(turn), r * math.sin(turn)
            lz = math.sqrt(1.0 - r * r)
            mirror = reflect_filament((lx, ly, lz), (vx, vy, vz), surface[k])
            passed *= math.pi * (mirror + dye[k, 0] * body(lz, vz, surface[k, 2]))
            bx, by, bz = f[1] * f[5] - f[2] * f[4], f[2] * f[3] - f[0] * f[5], f[0] * f[4] - f[1] * f[3]
            dx = lx * f[3] + ly * bx + lz * f[0]
            dy = lx * f[4] + ly * by + lz * f[1]
            dz = lx * f[5] + ly * bz + lz * f[2]
        total += value
        squares += value * value
    return total, squares


@pytest.mark.slow
@pytest.mark.parametrize("bounces", [0, 2])
def test_brdf_against_a_path_tracer_from_the_camera(bounces):
    cloth = make_cloth(make_settings("twill", dye="raw", repeats=1), candidates=150_000, chains=40_000, bounces=bounces)
    solids, paths = cloth.solids, 60_000
    size = np.array([solids.weft.length, solids.warp.length])
    pairs = [(0, 0, 20, 30), (45, 0, 30, 200), (60, 90, 60, 270), (30, 45, 70, 100)]
    angles = np.array(pairs, float)
    found = trace(cloth, unit(angles[:, 0], angles[:, 1]), unit(angles[:, 2], angles[:, 3]))[:, 0]
    for value, row in zip(found, angles, strict=True):
        total, squares = _path_traced(
            unit(*row[:2]), unit(*row[2:]), paths, bounces, solids.numbers, solids.free, np.zeros(2),
            cloth.surface, cloth.dye, size, np.random.default_rng(7),
        )  # fmt: skip
        mean = total / paths
        error = math.sqrt(max(squares / paths - mean * mean, 0.0) / paths)
        assert error < 0.02 * mean
        assert abs(value - mean) < 4.0 * error + 0.008 * mean


@pytest.mark.slow
def test_brdf_is_reciprocal_and_the_same_each_time(satin):
    angles = session(quarter_views(30.0, 45.0), hemisphere_views(30.0, 90.0), incidences=(40.0,), azimuths=(0.0, 60.0))
    i, o = unit(angles[:, 0], angles[:, 1]), unit(angles[:, 2], angles[:, 3])
    there, back = trace(satin, i, o), trace(satin, o, i)
    assert (there > 0.0).all()
    np.testing.assert_allclose(there, back, rtol=2e-4)  # float32 sums in another order
    np.testing.assert_array_equal(there, trace(satin.settings, i, o, **QUALITY))
    assert np.abs(there - trace(replace(satin.settings, seed=9), i, o, **QUALITY)).max() > 1e-4


def test_below_the_horizon_nothing_is_seen(satin):
    below = np.array([[0.0, 0.6, -0.8], [1.0, 0.0, 0.0]])
    np.testing.assert_array_equal(trace(satin, below, [0.0, 0.0, 1.0]), 0.0)
    np.testing.assert_array_equal(trace(satin, [0.0, 0.0, 1.0], below), 0.0)


def _albedo(cloth, theta):
    views = hemisphere_views(15.0, 40.0)
    edge = np.radians(7.5)
    polar = np.radians(views[:, 0])
    weights = np.cos(polar) * (np.cos(polar - edge) - np.cos(polar + edge)) * np.radians(40.0)
    return float((trace(cloth, unit(theta, 30.0), unit(views[:, 0], views[:, 1]))[:, 0] * weights).sum())


@pytest.mark.slow
def test_albedo_stays_below_one_and_grows_with_every_bounce():
    """Bodies that absorb little, hardly any mirror reflection: what is missing is on its way or went through."""
    white = make_settings("satin", repeats=1, index=1.05)
    white = replace(white, warp=replace(white.warp, dye=(1.0,) * 3), weft=replace(white.weft, dye=(1.0,) * 3))
    for theta in (0.0, 60.0):
        albedo = [
            _albedo(make_cloth(white, candidates=10_000, chains=10_000 * (bounces > 0), bounces=bounces), theta)
            for bounces in range(4)
        ]
        assert (np.diff(albedo) > 0.0).all()
        assert 0.45 < albedo[0] < albedo[-1] <= 1.0
        assert np.diff(albedo)[-1] < 0.5 * np.diff(albedo)[0]


def test_satin_shines_along_the_weft_plane_farther_than_along_the_warp(satin):
    """Sections of the warp are round: under normal incidence their facets send light far into the weft plane, while
    the long floats, level along the warp, do not send it into the warp plane."""
    black = make_cloth(make_settings("satin", dye="black", repeats=1), **QUALITY)
    weft, warp = (trace(black, unit(0, 0), unit(np.array([50.0, 60.0, 70.0]), phi))[:, 0].mean() for phi in (0.0, 90.0))
    assert weft > 1.8 * warp
