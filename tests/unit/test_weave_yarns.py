"""Interlaced elliptical yarns: bindings, the surface and what of it is seen, the search for the weave."""

from dataclasses import replace

import numpy as np
import pytest
from numba import njit
from refusals import refused

from nishiki.brdf.cloth.interface import hemisphere
from nishiki.brdf.cloth.models import BEST, fit_models, left_out_error
from nishiki.brdf.cloth.store import load_brdf, save_brdf
from nishiki.brdf.cloth.yarn_facets import beckmann_shadow, facet_reflection
from nishiki.brdf.cloth.yarn_fit import Measured, refit_facets
from nishiki.errors import UserError
from nishiki.goniometry.directions import unit
from nishiki.lanes import LANES, store
from nishiki.weave import yarn_weave
from nishiki.weave.yarn_search import (
    CENTRE,
    NAMES,
    YarnSearch,
    fit_binding,
    mixed_quantile,
    parameters_of,
    samples_of,
    search_yarns,
    spread,
    weave_of,
)
from nishiki.weave.yarn_weave import COARSE, Binding, InterlacedYarns, bindings, yarn_at


@njit
def let_through(points, towards, soft):
    """Share of each point's surroundings that lets a direction through."""
    out = np.empty(points.shape[1])
    for p in range(0, out.size, LANES):
        store(out, p, yarn_weave._let_through(points, p, yarn_weave._azimuth(towards), soft))
    return out


SATIN, PLAIN, TWILL = Binding(4, 1, 2), Binding(1, 1), Binding(2, 1)


def yarns(binding=SATIN, **changes):
    x = CENTRE.copy()
    for name, value in changes.items():
        x[NAMES.index(name)] = value
    return weave_of(x, binding)


def test_bindings_are_all_regular_weaves_without_mirror_images():
    every = bindings("unknown", 8)
    assert every[0] == PLAIN
    assert len(set(every)) == len(every)
    patterns = set()
    for binding in every:
        pattern = binding.pattern()
        assert pattern.mean() == pytest.approx(binding.over / binding.harness)
        wide = np.tile(pattern, (24 // len(pattern), 24))[:, :24]
        same = {
            np.roll(wide[:, ::side], (a, b), (0, 1)).tobytes() for side in (1, -1) for a in range(8) for b in range(8)
        }
        assert not same & patterns, binding
        patterns.add(wide.tobytes())
    found = {(b.over, b.under, b.step) for b in every if b.weave == "satin" and b.under == 1}
    assert found == {(4, 1, 2), (6, 1, 2), (6, 1, 3), (7, 1, 3)}
    assert {(2, 2), (3, 3), (1, 2), (2, 1)} <= {(b.over, b.under) for b in every if b.weave == "twill"}
    assert sum(b.weave == "basket" for b in every) == 2
    assert sum(b.weave == "rib" for b in every) == 4
    assert bindings("satin", harness=6) == []
    assert bindings("plain") == [PLAIN]
    assert {b.weave for b in bindings("unknown", harness=5)} == {"twill", "satin"}


EVERY_KIND = [PLAIN, Binding(3, 1), Binding(2, 2), Binding(1, 2), SATIN, Binding(2, 2, 2), Binding(1, 1, 1, 2),
              Binding(2, 2, 2, 2)]  # fmt: skip


@pytest.mark.parametrize("binding", EVERY_KIND, ids=str)
def test_the_surface_repeats_with_the_step_of_the_binding(binding):
    surface = yarns(binding).surface(20)
    height = surface.height[:-1, :-1]
    moved = np.roll(np.roll(height, 20 * binding.together, axis=1), 20 * binding.step, axis=0)
    np.testing.assert_allclose(moved, height, atol=1e-9)
    np.testing.assert_array_equal(np.sum(~surface.pattern, axis=0), binding.under)
    rows, columns = np.indices(surface.pattern.shape) * 20 + 10
    np.testing.assert_array_equal(surface.is_warp[rows, columns], surface.pattern)  # where yarns cross
    assert surface.is_warp.mean() == pytest.approx(binding.over / binding.harness, abs=0.15)


@pytest.mark.parametrize("binding", EVERY_KIND, ids=str)
def test_slopes_are_those_of_the_heights(binding):
    form, step = yarns(binding, arch=0.02).form, 1e-6
    places = np.random.default_rng(3).uniform(-4, 4, (200, 2))
    for kind in (0, 1):
        for x, y in places:
            height, along_x, along_y = yarn_at(x, y, form, kind)
            if height <= yarn_at(x, y, form, 1 - kind)[0] or max(abs(along_x), abs(along_y)) > 3:
                continue  # hidden: there the surface may fold under a bend
            left, right = (yarn_at(x + s, y, form, kind)[0] for s in (-step, step))
            low, high = (yarn_at(x, y + s, form, kind)[0] for s in (-step, step))
            assert (right - left) / (2 * step) == pytest.approx(along_x, abs=2e-3)
            assert (high - low) / (2 * step) == pytest.approx(along_y, abs=2e-3)


@pytest.mark.parametrize("binding", [SATIN, TWILL, Binding(2, 2)], ids=str)
def test_the_top_of_an_upright_yarn_lies_half_its_thickness_above_its_middle_all_along(binding):
    weave = replace(yarns(binding), upright=1.0)
    form, seen = weave.form, 0
    for y in np.linspace(0, binding.harness * weave.spacing_ratio, 200):
        height, _, slope = yarn_at(0.0, y, form, 0)
        if height > yarn_at(0.0, y, form, 1)[0]:
            size = np.hypot(1, slope)
            below = y + form.half_thickness[0] * slope / size
            middle, its_slope, _ = yarn_weave._way(below, 0, form, 0)
            assert middle == pytest.approx(height - form.half_thickness[0] / size, abs=1e-5)
            assert its_slope == pytest.approx(slope, abs=1e-4)
            seen += 1
    assert seen > 60


@pytest.mark.parametrize("binding", EVERY_KIND, ids=str)
def test_yarns_touch_where_they_cross(binding):
    """At a crossing the middles of both yarns lie as far from each other as they are thick together."""
    weave = yarns(binding)
    form, pattern = weave.form, binding.pattern()
    apart = []
    for row, column in np.ndindex(*pattern.shape):
        warp, weft = (yarn_at(float(column), row * weave.spacing_ratio, form, kind)[0] for kind in (0, 1))
        middles = warp - form.half_thickness[0] - (weft - form.half_thickness[1])
        assert (middles > 0) == pattern[row, column]
        apart.append(abs(middles) / form.half_thickness.sum())
    assert max(apart) == pytest.approx(1, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("theta_deg", [0, 30, 60, 75, 85])
@pytest.mark.parametrize("binding", [PLAIN, TWILL, SATIN, Binding(7, 1, 3)])
def test_what_is_seen_fills_the_view_from_everywhere(binding, theta_deg):
    """The visible surface, projected towards any direction, covers the cloth's own projection exactly once."""
    points, _ = yarns(binding).points(9600)
    for phi_deg in (0, 40, 90):
        towards = unit(np.radians(theta_deg), np.radians(phi_deg))
        cosine = towards @ points[:3]
        seen = let_through(points, towards, 0.01)
        assert np.sum(points[9] * seen * np.maximum(cosine, 0)) / towards[2] == pytest.approx(1, abs=0.05)


def test_reflection_is_reciprocal_and_dark_below_the_horizon():
    rng = np.random.default_rng(0)
    i, o = rng.normal(size=(2, 50, 3))
    i, o = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (i, o))
    weave = yarns()
    there, back = weave.parts(i, o, weave.points()), weave.parts(o, i, weave.points())
    np.testing.assert_allclose(there, back, rtol=1e-9)
    assert np.all(there[(i[:, 2] <= 0) | (o[:, 2] <= 0)] == 0)
    assert np.all(np.isfinite(there))


def test_masking_of_beckmann_facets_is_smith_s():
    """Against the integral in closed form (Walter et al. 2007, eq. 14), whose rational form is good to 0.35 % of G."""
    from scipy.special import erf

    for rough in (0.05, 0.15, 0.3, 0.8):
        for theta in np.radians([5.0, 40.0, 70.0, 85.0]):
            cosine, reach = np.cos(theta), np.hypot(np.cos(theta), rough * np.sin(theta))
            a = 1 / (rough * np.tan(theta))
            exact = 0.5 * (erf(a) - 1) + np.exp(-a * a) / (2 * a * np.sqrt(np.pi))
            over, under = beckmann_shadow(cosine, reach)
            assert 1 / (1 + over / under) == pytest.approx(1 / (1 + exact), rel=4e-3)


@pytest.mark.parametrize("tail", [0.0, 0.4, 1.0])
def test_facets_of_every_tail_reflect_as_much_as_their_masking_lets_through(tail):
    """Seen along the normal, facets of a mirror send out what Smith's masking leaves: a little less than all."""
    views, projected = hemisphere(200, 64)
    axes, up = tuple(np.eye(3)[[2, 0, 1]]), np.array([0.0, 0.0, 1.0])
    half = views + up
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    towards = zip(views, half, strict=True)
    given = [facet_reflection(axes, up, v, tuple(h), 1.0, v[2], (0.1, 0.2), tail) for v, h in towards]
    total = projected @ (0.5 * np.array(given) / views[:, 2])
    assert 0.95 < total <= 1.001  # long tails reflect a few per cent to below the horizon


def test_interlaced_yarns_are_stored_and_reciprocal(tmp_path):
    weave = InterlacedYarns(yarns(Binding(2, 2)), np.array([0.1, 0.2]), np.array([0.0, 0.01]), np.ones((2, 8)))
    rng = np.random.default_rng(4)
    i, o = unit(rng.uniform(0, 1.4, (2, 40)), rng.uniform(0, 6.28, (2, 40)))
    values = weave.evaluate(i, o)
    np.testing.assert_allclose(weave.evaluate(o, i), values, rtol=1e-9)
    save_brdf(tmp_path / "yarns.npz", weave)
    again = load_brdf(tmp_path / "yarns.npz")
    assert again.shape.binding == Binding(2, 2)
    np.testing.assert_array_equal(again.evaluate(i, o), values)


@pytest.mark.slow
def test_woven_light_is_predicted_better_by_its_yarns_than_by_facets():
    """What `auto` compares: both fitted along the normal alone, both asked for the oblique measurements."""
    truth = yarns(TWILL, aspect_warp=np.log(0.7), rough_across_warp=np.log(0.24))
    measured = measured_of(truth)
    best = search_yarns(measured, [PLAIN, TWILL]).best
    found = best.brdf, {"rms_rel_normal": best.rms_rel}
    basic = lambda views: truth_of(truth, views), None
    fitted = fit_models(measured, basic, BEST, oblique=8, yarns=found)
    errors = {name: left_out_error(measured, fit) for name, fit in fitted.items()}
    assert errors["yarns"] < 0.6 * errors["yarn_facets"]
    with refused(UserError, "yarn_facets", by="fit_models"):
        fit_models(measured, basic, ["yarns"])


def test_oblique_images_refine_the_facets_of_yarns_and_are_ignored_where_they_contradict_each_other():
    truth = yarns(TWILL)
    wrong = replace(truth, rough=truth.rough * [[0.8, 1.3], [1.3, 0.8]], tail=0.9)
    start = InterlacedYarns(wrong, np.array([0.04]), np.array([0.0]), np.ones((2, 8)))
    measured = measured_of(truth)
    oblique = np.flatnonzero(~measured.normal)
    images, judged = oblique[::4], oblique[1::4]
    chosen = measured.take(np.concatenate([np.flatnonzero(measured.normal), images]))
    rest = measured.take(judged)

    def error(brdf):
        return np.linalg.norm(brdf.evaluate(rest.incident, rest.outgoing) - rest.values)

    refined = refit_facets(start, chosen)
    assert error(refined) < 0.5 * error(start)
    np.testing.assert_array_equal(refined.shape.form.half_width, start.shape.form.half_width)
    right = InterlacedYarns(truth, np.array([0.05]), np.array([0.0]), np.ones((2, 8)))
    noisy = replace(chosen, values=chosen.values.copy())
    signs = np.random.default_rng(5).permutation(np.arange(len(images)) % 2 * 2 - 1)
    noisy.values[~noisy.normal] *= 1 + 0.4 * signs[:, None]
    assert refit_facets(right, noisy) is right
    assert refit_facets(right, measured.take(np.flatnonzero(measured.normal))) is right


def test_few_points_reflect_as_many_do():
    i, o = unit(np.radians([0.0, 45, 75, 75]), np.radians([0.0, 0, 0, 90])), unit(np.radians(50.0), np.radians(200.0))
    for binding in (PLAIN, SATIN):
        weave = yarns(binding)
        few, many = (weave.parts(i, np.tile(o, (4, 1)), weave.points(density)) for density in (COARSE, 20000))
        np.testing.assert_allclose(few.sum(axis=1), many.sum(axis=1), rtol=0.05)


def test_spread_samples_lie_far_from_each_other_and_from_mirror_images():
    theta, phi = np.meshgrid(np.radians(np.arange(5, 86, 10)), np.radians(np.arange(0, 360, 15)))
    views = unit(theta.ravel(), phi.ravel())
    chosen = np.abs(views[spread(views, 12)])
    distance = np.linalg.norm(chosen[:, None] - chosen, axis=-1) + 9 * np.eye(12)
    assert distance.min() > 0.25


def truth_of(weave, views, body=0.05):
    flat = np.ascontiguousarray(views.reshape(-1, 3))
    terms = weave.parts(np.tile([0, 0, 1.0], (len(flat), 1)), flat, weave.points(2400))
    return (terms[:, :1] + terms[:, 2:3] + body * (terms[:, 1:2] + terms[:, 3:])).reshape(*views.shape[:-1], 1)


def measured_of(weave, *, body=0.05, normal_only=False):
    theta, phi = np.meshgrid(np.radians(np.arange(4, 85, 8)), np.radians(np.arange(0, 91, 15)))
    views = np.concatenate([[[0, 0, 1.0]], unit(theta.ravel(), phi.ravel())])
    light = np.tile([0, 0, 1.0], (len(views), 1))
    if not normal_only:
        theta, phi = np.meshgrid(np.radians([10, 35, 60]), np.radians(np.arange(0, 360, 30)))
        aside = unit(theta.ravel(), phi.ravel())
        for lamp in unit(np.radians([30.0, 60.0]), np.radians([0.0, 90.0])):
            views, light = np.concatenate([views, aside]), np.concatenate([light, np.tile(lamp, (len(aside), 1))])
    terms = weave.parts(light, views, weave.points(2400))
    values = terms[:, :1] + terms[:, 2:3] + body * (terms[:, 1:2] + terms[:, 3:])
    return Measured(light, views, values, light[:, 2] > 0.9999, True)


@pytest.mark.slow
@pytest.mark.parametrize(
    "binding",
    [*(pytest.param(one, marks=pytest.mark.long) for one in (PLAIN, TWILL, Binding(2, 2))), SATIN],
    ids=str,
)
def test_search_finds_the_weave_and_its_yarns(binding):
    truth = yarns(binding, aspect_warp=np.log(0.7), rough_across_warp=np.log(0.24), crimp=0.1)
    search = search_yarns(measured_of(truth), dict.fromkeys([PLAIN, TWILL, SATIN, binding]))
    assert search.best.binding == binding
    assert search.alike == [binding]
    assert search.best.rms_rel < 0.03
    parameters = parameters_of(search, confidence=0.95)
    slopes = truth.slopes()
    for name in ("mean_slope_weft", "p90_slope_weft", "mean_slope_warp", "weft_share"):
        assert parameters[name]["value"] == pytest.approx(slopes[name], rel=0.1), name
        assert parameters[name]["low"] <= parameters[name]["value"] <= parameters[name]["high"]
    assert parameters["aspect_warp"]["value"] == pytest.approx(0.7, rel=0.1)
    assert parameters["aspect_warp"]["determined"]


def test_quantiles_of_bindings_are_those_of_their_mixture():
    """Against draws: a likely narrow estimate beside an unlikely wide one, and equal ones far apart."""
    rng = np.random.default_rng(0)
    for middle, deviation, odds in (([1.0, 1.2], [0.1, 0.5], [1.0, 0.25]), ([0.0, 9.0], [1.0, 1.0], [2.0, 2.0])):
        which = rng.choice(2, 200_000, p=np.array(odds) / sum(odds))
        draws = rng.normal(np.array(middle)[which], np.array(deviation)[which])
        for share in (0.025, 0.3, 0.975):
            found = mixed_quantile(share, *map(np.array, (middle, deviation, odds)))
            assert np.mean(draws < found) == pytest.approx(share, abs=2e-3)
    for middle, share, expected in (([3.0], 0.025, 3.0), ([0.0, 9.0], 0.3, 0.0), ([0.0, 9.0], 0.975, 9.0)):
        one = np.ones(len(middle))
        assert mixed_quantile(share, np.array(middle), 0 * one, one) == pytest.approx(expected, abs=1e-7)


@pytest.mark.slow
def test_counted_threads_hold_the_spacings_that_the_yarns_alone_leave_open():
    measured = measured_of(yarns(spacing_ratio=np.log(2.0)), normal_only=True)
    samples = samples_of(measured, views=30)
    alone, counted = (
        fit_binding(samples, SATIN, spacing_ratio=ratio, density=COARSE, evaluations=4) for ratio in (None, 2.0)
    )
    errors = [abs(fit.weave.spacing_ratio / 2.0 - 1) for fit in (alone, counted)]
    assert errors[1] < 0.03 < errors[0]
    told = parameters_of(YarnSearch(counted, [SATIN], [], [counted]), confidence=0.95)["spacing_ratio"]
    assert told["low"] < 2.0 < told["high"] < 1.2 * told["low"]


@pytest.mark.slow
def test_a_matt_cloth_tells_nothing_of_its_weave():
    matt = measured_of(yarns(), body=0.0)
    flat = Measured(matt.incident, matt.outgoing, np.full_like(matt.values, 0.1), matt.normal, True)
    flat.values[:] *= 1 + 0.02 * np.random.default_rng(0).standard_normal(flat.values.shape)
    search = search_yarns(flat, [PLAIN, SATIN])
    assert not search.best.explains
    assert not any(number["determined"] for number in parameters_of(search, confidence=0.95).values())


def test_too_few_views_are_refused():
    few = measured_of(yarns(), normal_only=True).take(np.arange(5))
    with refused(UserError, "8", by="samples_of"):
        search_yarns(few, [SATIN])
