"""Facets on yarns: the kernel against the plain formula, humps against brute force, the fit against known shapes."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.cloth_references import REFERENCES, fit_reference
from refusals import refused

from nishiki.brdf.cloth.interface import (
    directional_albedo,
    gloss_of,
    hemisphere,
    prediction_error,
    reciprocity_error,
    single,
    solid_angles,
    together,
)
from nishiki.brdf.cloth.models import BEST, MODELS, fit_models
from nishiki.brdf.cloth.store import load_brdf, save_brdf
from nishiki.brdf.cloth.yarn_facets import (
    CENTRE,
    HALF_PI,
    NAMES,
    SIDE_ACROSS,
    SIDE_ALONG,
    SPREAD,
    WEFT,
    hump,
    hump_limits,
    interpolate_correction,
    shape_of,
    without_correction,
)
from nishiki.brdf.cloth.yarn_fit import Measured, choose_oblique, fit_normal, fit_shape, fit_yarn_facets, likeness
from nishiki.brdf.torrance_sparrow import fresnel
from nishiki.errors import UserError
from nishiki.goniometry.directions import angles
from nishiki.goniometry.hemisphere import complete
from nishiki.goniometry.table import ReflectanceSet

RNG = np.random.default_rng(5)


def direction(theta_deg, phi_deg):
    t, p = np.radians(np.broadcast_arrays(np.asarray(theta_deg, float), np.asarray(phi_deg, float)))
    return np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=-1)


def some_directions(n):
    return direction(np.degrees(np.arccos(np.sqrt(RNG.uniform(1e-4, 1, n)))), RNG.uniform(0, 360, n))


def plain_sum(shape, i, o):
    """The module's formula, facet by facet."""
    limits = shape.limits()
    angles = np.linspace(0, HALF_PI, limits.shape[2])
    total = np.zeros(4)
    h = (i + o) / np.linalg.norm(i + o)
    atoms = np.concatenate([shape.atoms(0), shape.atoms(1)])
    for number, atom in enumerate(atoms):
        n, along, across = atom[:3], atom[3:6], atom[6:9]
        family = int(number >= len(atoms) // 2)
        if n @ i <= 0 or n @ o <= 0:
            continue
        seen = 1.0
        for axis, tilt in ((0, atom[10]), (1, atom[11])):
            for side in (1, -1):
                found = [
                    np.interp(np.arctan2(abs(d[axis]), d[2]), angles, limits[family, axis])
                    for d in (i, o)
                    if (d[axis] >= 0) == (side > 0)
                ]
                if found and min(found) < HALF_PI:
                    u = np.clip(0.5 + (min(found) - side * tilt) / (4 * shape.softness), 0, 1)
                    seen *= u * u * (3 - 2 * u)
        a, b = shape.rough[family]
        e = (h @ along / a) ** 2 + (h @ across / b) ** 2 + (h @ n) ** 2
        density = 1 / (np.pi * a * b * e * e)
        masks = [
            np.sqrt(1 + ((a * (d @ along)) ** 2 + (b * (d @ across)) ** 2) / (d @ n) ** 2) / 2 - 0.5 for d in (i, o)
        ]
        mirror = fresnel(i @ h, shape.index) * density / (1 + sum(masks)) / (4 * (n @ i) * (n @ o))
        body = (1 - fresnel(n @ i, shape.index)) * (1 - fresnel(n @ o, shape.index)) / np.pi
        both = atom[9] * seen * (n @ i) * (n @ o) / (i[2] * o[2])
        total[2 * family : 2 * family + 2] += both * np.array([mirror, body])
    return total


def test_kernel_is_the_plain_formula():
    model = without_correction(replace(shape_of(CENTRE), softness=0.2), [0.1], [0.0])
    incident, outgoing = some_directions(8), some_directions(8)
    expected = [plain_sum(model.shape, i, o) for i, o in zip(incident, outgoing, strict=True)]
    assert np.allclose(model.parts(incident, outgoing), expected, rtol=1e-10, atol=1e-14)


def test_facets_are_the_whole_plane_and_their_frames_are_orthonormal():
    atoms = np.concatenate([shape_of(CENTRE).atoms(family) for family in (0, 1)])
    assert np.sum(atoms[:, 9] * atoms[:, 2]) == pytest.approx(1)
    frames = atoms[:, :9].reshape(-1, 3, 3)
    assert np.allclose(frames @ np.swapaxes(frames, 1, 2), np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    ("power", "side"), [(2.0, SIDE_ACROSS), (1.0, SIDE_ACROSS), (2.0, SIDE_ALONG), (5.0, SIDE_ALONG), (0.8, SIDE_ALONG)]
)
def test_humps_are_the_integral_of_their_slopes(power, side):
    share = np.linspace(0, 0.97, 4000)
    t, x, z = hump(0.7, power, side, share)
    assert np.allclose(np.diff(z), -(t[1:] + t[:-1]) / 2 * np.diff(x), atol=2e-6)
    weight = np.exp(-((t / 0.7) ** power)) if side == SIDE_ALONG else (1 + (t / 0.7) ** power) ** (-3 / power)
    gained = np.concatenate([[0], np.cumsum((weight[1:] + weight[:-1]) / 2 * np.diff(t))])
    assert np.allclose(gained / gained[-1], share / share[-1], atol=2e-3)


def test_power_two_across_is_an_ellipse():
    t, x, z = hump(0.7, 2.0, SIDE_ACROSS, np.linspace(0, 0.999, 50))
    height = z + 0.7 / 2  # half axes 1/2 and s/2
    assert np.allclose((x / 0.5) ** 2 + (height / 0.35) ** 2, 1, atol=1e-9)
    assert np.all(np.diff(t) > 0)


@pytest.mark.parametrize(
    ("power", "side"), [(2.0, SIDE_ACROSS), (1.2, SIDE_ACROSS), (2.0, SIDE_ALONG), (6.0, SIDE_ALONG)]
)
def test_limits_against_rays_over_an_explicit_train(power, side):
    slope, spacing = 0.8, 1.15
    share = np.sin(np.linspace(0, 0.985 * HALF_PI, 3000))
    t, x, z = hump(slope, power, side, share)
    t, x, z = np.r_[-t[:0:-1], t], np.r_[-x[:0:-1], x], np.r_[z[:0:-1], z]
    limits = hump_limits(slope, power, side, spacing)
    for k in (8, 20, 32, 44, 56, 62):
        angle = k / 64 * HALF_PI
        rise = np.cos(angle) / np.sin(angle)
        horizon = max((z - rise * (x + n * spacing)).max() for n in (1, 2, 3))
        reached = z - rise * x >= horizon
        facing = t > -rise  # the rest turns away by itself
        if reached[facing].all():
            assert limits[k] == pytest.approx(HALF_PI)
        else:
            assert np.tan(limits[k]) == pytest.approx(t[facing & reached].max(), rel=0.04, abs=0.01)


def test_model_is_reciprocal_finite_and_keeps_energy(tmp_path):
    model = without_correction(shape_of(CENTRE), [0.8, 0.1], [0.0, 0.01])
    model = replace(model, correction=RNG.uniform(0.7, 1.3, (16, 72)))
    assert reciprocity_error(model) < 1e-12
    assert np.all(model.evaluate(direction(20, 0), direction([90.001, 140], 0)) == 0)
    grazing = direction([0, 60, 89.99, 90 - 1e-9], 30)
    assert np.all(np.isfinite(model.evaluate(grazing[:, None], grazing[None])))
    assert directional_albedo(model, direction([0, 50, 80], 20)).max() < 1
    save_brdf(tmp_path / "yarns.npz", model)
    again = load_brdf(tmp_path / "yarns.npz")
    assert np.array_equal(again.evaluate(grazing, grazing[::-1]), model.evaluate(grazing, grazing[::-1]))
    black = gloss_of(model)
    assert np.all(black.body == 0)
    assert np.all(black.evaluate(grazing[0], grazing[1]) <= model.evaluate(grazing[0], grazing[1]))


def test_extreme_shapes_stay_finite():
    views = direction([0, 60, 89.9], 77)
    for low in (-6, 6):
        for k in range(len(NAMES)):
            x = CENTRE.copy()
            x[k] += low * SPREAD[k]
            assert np.all(
                np.isfinite(without_correction(shape_of(x), [0.5], [0.0]).evaluate(views[:, None], views[None]))
            )


def test_correction_is_periodic_and_constant_beyond_45_degrees():
    table = RNG.uniform(0.5, 2, (16, 72))
    assert interpolate_correction(table, direction(30.0, 0.0)) == pytest.approx(
        interpolate_correction(table, direction(30.0, 360.0 - 1e-9))
    )
    assert interpolate_correction(table, direction(50.0, 10.0)) == pytest.approx(
        interpolate_correction(table, direction(80.0, 10.0))
    )
    assert interpolate_correction(table, direction(3.0 * 5, 5.0 * 7)) == pytest.approx(table[5, 7])


def test_solid_angles_sum_to_the_hemisphere_and_follow_the_cells():
    theta, phi = np.meshgrid(np.arange(3, 90, 6.0), np.arange(0, 360, 15.0), indexing="ij")
    solid = solid_angles(direction(theta.ravel(), phi.ravel()), points=60000)
    cells = np.radians(15) * (np.cos(np.radians(theta - 3)) - np.cos(np.radians(theta + 3))).ravel()
    assert solid.sum() == pytest.approx(2 * np.pi)
    assert np.median(np.abs(solid / cells - 1)) < 0.08
    quarter = direction([10, 50, 80], [0, 45, 90])
    assert solid_angles(quarter, quarter=True).sum() == pytest.approx(2 * np.pi)
    twice = solid_angles(np.concatenate([quarter, quarter]))
    assert np.allclose(twice[:3], twice[3:])


def test_weights_say_what_a_miss_costs():
    views, values = some_directions(200), RNG.uniform(1, 2, 200)
    weight = together(views, values, np.ones(200), miss=0.05, worth=40)
    assert np.sum((weight * 0.05 * values) ** 2) == pytest.approx(40)
    few = together(views[:9], values[:9], np.ones(9), miss=0.05, worth=40)
    assert np.sum((few * 0.05 * values[:9]) ** 2) == pytest.approx(9)
    assert single(np.array([3.0]), np.array([4.0]), miss=0.1) == pytest.approx(2.0)


def test_variable_projection_finds_shape_and_strengths():
    t = np.linspace(0, 1, 60)
    values = np.stack([0.5 + 2 * np.exp(-t / 0.2), 0.1 + 3 * np.exp(-t / 0.2)], axis=1)

    def parts(x):
        return np.zeros(60), np.stack([np.ones(60), np.exp(-t / np.exp(x[0]))], axis=1)

    fit = fit_shape(
        parts, values, np.full(60, 1e3), centre=np.zeros(1), spread=np.full(1, 2.0), limits=np.full(2, np.inf)
    )
    assert np.exp(fit.x[0]) == pytest.approx(0.2, rel=1e-4)
    assert np.allclose(fit.coefficients, [[0.5, 2], [0.1, 3]], rtol=1e-3)
    assert fit.at_bounds == ()
    narrow = {"centre": np.zeros(1), "spread": np.full(1, 0.1), "limits": np.full(2, np.inf)}
    assert fit_shape(parts, values, np.full(60, 1e3), **narrow).at_bounds == (0,)  # -1.6 wanted, -0.6 allowed


def a_cloth():
    """A shape off the prior's centre, and measurements of it: 240 of normal incidence, 3 oblique incidences."""
    x = CENTRE + SPREAD * np.tile([0.5, -0.5], CENTRE.size)[: CENTRE.size]
    truth = without_correction(shape_of(x), [0.05], [0.0])
    quarter = direction(*(a.ravel() for a in np.meshgrid(np.arange(0, 88, 6.0), np.arange(0, 91, 6.0), indexing="ij")))
    around = hemisphere(6, 16)[0]
    light = [direction(t, p) for t, p in ((30, 0), (60, 45), (60, 90))]
    incident = np.concatenate([np.tile([0.0, 0, 1], (len(quarter), 1)), *(np.tile(d, (len(around), 1)) for d in light)])
    outgoing = np.concatenate([quarter, *[around] * 3])
    measured, _ = complete(ReflectanceSet.of(incident, outgoing, truth.evaluate(incident, outgoing)))
    return truth, measured


@pytest.fixture(scope="module")
def cloth():
    return a_cloth()


@pytest.fixture(scope="module")
def first(cloth):
    data = Measured.of(cloth[1])
    return fit_normal(data.take(data.normal), evaluations=12)


def test_likeness_counts_mirror_images_and_exchanged_light_and_view_as_the_same_place():
    light, view = direction(30, 20), direction(60, 110)
    incident = np.stack([light, view, light * [-1, 1, 1], light, direction(30, 100)])
    outgoing = np.stack([view, light, view * [-1, 1, 1], direction(60, 130), direction(60, 190)])
    near = likeness(incident, outgoing)
    np.testing.assert_allclose(near[0, :3], 1, atol=1e-6)
    assert 0.2 < near[0, 3] < 0.9
    assert near[0, 4] < 0.2
    np.testing.assert_allclose(near, near.T, atol=1e-9)
    assert np.linalg.eigvalsh(near[2:, 2:]).min() > 0


def test_oblique_choice_is_apart_telling_and_recorded(cloth, first):
    data = Measured.of(cloth[1])
    rows = np.flatnonzero(~data.normal)
    chosen = choose_oblique(first, data.incident[rows], data.outgoing[rows], 12)
    assert len(set(chosen.tolist())) == len(chosen) == 12
    assert np.degrees(angles(data.outgoing[rows][chosen])[0]).max() <= 80
    assert len(np.unique(np.round(data.incident[rows][chosen], 6), axis=0)) == 3  # some of every light
    near = likeness(data.incident[rows][chosen], data.outgoing[rows][chosen])
    assert near[~np.eye(12, dtype=bool)].max() < 0.9
    assert len(choose_oblique(first, data.incident[rows], data.outgoing[rows], 0)) == 0


@pytest.mark.slow
def test_known_yarns_are_predicted_from_normal_incidence_and_better_with_oblique_images(cloth, first):
    truth, measured = cloth
    data = Measured.of(measured)
    normal, oblique = np.flatnonzero(data.normal), np.flatnonzero(~data.normal)
    views = hemisphere(10, 24)[0]
    light = direction(60, 20)

    def error(brdf):
        return prediction_error(views, truth.evaluate(light, views), brdf.evaluate(light, views)).rms_rel

    alone = fit_yarn_facets(data, normal, basic=measured.basic.evaluate, first=first)
    assert alone.rms_rel < 0.02
    assert error(alone.brdf) < 0.2
    chosen = oblique[choose_oblique(first, data.incident[oblique], data.outgoing[oblique], 15)]
    more = fit_yarn_facets(data, np.concatenate([normal, chosen]), basic=measured.basic.evaluate, first=first)
    assert error(more.brdf) < 0.06
    assert error(more.brdf) < error(alone.brdf)
    assert np.array_equal(more.used, np.concatenate([normal, chosen]))
    assert np.all(np.diag(more.fit.information) >= 1 / SPREAD**2 * 0.99)
    assert np.all(more.spread <= SPREAD * 1.01)


@pytest.mark.slow
def test_all_models_are_fitted_on_what_they_may_use(cloth):
    _, measured = cloth
    data = Measured.of(measured)
    basic = (measured.basic.evaluate, measured.basic.values[0])
    fitted = fit_models(data, basic, [name for name in MODELS if name not in BEST], oblique=6)
    fitted |= {name: fit_reference(name, data, basic) for name in REFERENCES}
    normal = np.flatnonzero(data.normal)
    for name in ("bard_linear", "bard_great_circle", "facets"):
        assert np.array_equal(fitted[name].used, normal)
    assert len(fitted["bard_scaled"].used) == len(measured)
    views = data.outgoing[normal][angles(data.outgoing[normal])[0] < 1.3]
    seen = data.values[normal][angles(data.outgoing[normal])[0] < 1.3]
    for name in ("bard_great_circle", "facets"):
        assert np.allclose(fitted[name].brdf.evaluate(np.array([0, 0, 1.0]), views), seen, rtol=0.06)
    assert reciprocity_error(fitted["facets"].brdf) < 1e-9
    assert reciprocity_error(fitted["bard_great_circle"].brdf) > 0.05


def test_what_cannot_be_fitted_is_said(cloth):
    _, measured = cloth
    data = Measured.of(measured)
    oblique = np.flatnonzero(~data.normal)
    with refused(UserError, "yarn_facets", 0):
        fit_yarn_facets(data, oblique)
    with refused(UserError, "bard_linear"):
        fit_models(data, None, ["bard_linear"])
    assert without_correction(shape_of(CENTRE), 0.1, 0.0).channels == 1
    assert WEFT == 1
