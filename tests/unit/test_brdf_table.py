"""Fits to tables of measured reflectance."""

import numpy as np
import pytest
import reflectance_table as rt
from scipy.optimize import least_squares

from nishiki.brdf.torrance_sparrow import attenuation, facet_distribution, half_vector_geometry
from nishiki.errors import UserError

UP = np.array([0.0, 0.0, 1.0])


GAUSS = {"distribution": "torrance_sparrow"}


def table(*, beta=(6.0,), gamma=(0.15,), index=1.5, bands=5, samples=400, seed=0, exponent=0.0):
    rng = np.random.default_rng(seed)
    theta_i, theta_r = rng.uniform(0, 1.4, samples), rng.uniform(0, 1.4, samples)
    azimuth = np.where(rng.uniform(size=samples) < 0.5, np.pi, rng.uniform(0, 2 * np.pi, samples))
    lights, views = rt.directions(theta_i, np.zeros(samples)), rt.directions(theta_r, azimuth)
    g = half_vector_geometry(UP, lights, views)
    lobes = sum(b * facet_distribution(g.phi, w) for b, w in zip(beta, gamma, strict=True))
    gloss = lobes * attenuation(g, index) / (np.pi * g.cos_i)
    albedo = rng.uniform(0.05, 0.8, bands)
    body = (g.cos_i * g.cos_r) ** exponent
    return lights, views, albedo / np.pi * body[:, None] + gloss[:, None], albedo


@pytest.mark.parametrize(("beta", "gamma"), [(6.0, 0.15), (164.0, 0.07), (0.5, 0.4)])
def test_one_lobe_is_recovered(beta, gamma):
    lights, views, brdf, albedo = table(beta=(beta,), gamma=(gamma,))
    fit = rt.fit_reflectance_table(lights, views, brdf, lobes=1, **GAUSS)
    assert fit.body_exponent < 1e-3
    assert fit.at_bound == ()
    assert fit.beta[0] == pytest.approx(beta, rel=2e-3)
    assert fit.gamma[0] == pytest.approx(gamma, rel=1e-3)
    assert fit.refractive_index == pytest.approx(1.5, abs=2e-3)
    np.testing.assert_allclose(fit.diffuse, albedo, rtol=1e-3)
    assert fit.r2_mean > 1 - 1e-6
    fixed = rt.fit_reflectance_table(lights, views, brdf, lobes=1, refractive_index=1.5, shared_from="mean", **GAUSS)
    assert fixed.refractive_index == 1.5
    assert fixed.beta[0] == pytest.approx(beta, rel=1e-3)


def test_two_lobes_are_recovered():
    lights, views, brdf, _ = table(beta=(20.0, 2.0), gamma=(0.06, 0.3), samples=900)
    fit = rt.fit_reflectance_table(lights, views, brdf, **GAUSS)
    np.testing.assert_allclose(fit.gamma, (0.06, 0.3), rtol=0.01)
    np.testing.assert_allclose(fit.beta, (20, 2), rtol=0.02)


def test_incidences_left_out_choose_no_more_than_they_can_tell():
    lights, views, _, _ = table(samples=600)
    lights = np.round(np.degrees(np.arccos(lights[:, 2])), -1)
    lights = rt.directions(np.radians(np.clip(lights, 10, 80)), np.zeros(600))
    g = half_vector_geometry(UP, lights, views)
    gloss = 6.0 * facet_distribution(g.phi, 0.15) * attenuation(g, 1.45) / (np.pi * g.cos_i)
    noisy = (0.1 + gloss[:, None]) * np.exp(0.3 * np.random.default_rng(4).normal(size=(600, 5)))
    fit, unseen = rt.chosen_by_incidences(lights, views, noisy, **GAUSS)
    assert len(fit.gamma) == 1
    assert fit.gamma[0] == pytest.approx(0.15, rel=0.1)
    assert 1.3 <= fit.refractive_index <= 2
    assert unseen == pytest.approx(fit.r2_mean, abs=0.02)
    full = rt.fit_reflectance_table(lights, views, noisy, **GAUSS)
    assert full.r2_mean >= fit.r2_mean - 1e-6


@pytest.mark.parametrize("exponent", [0.0, 0.3])
@pytest.mark.parametrize("distribution", ["torrance_sparrow", "ggx"])
def test_reaches_the_minimum_that_a_plain_solver_reaches(distribution, exponent):
    lights, views, brdf, _ = table(exponent=exponent)
    brdf = brdf * np.exp(0.2 * np.random.default_rng(1).normal(size=brdf.shape))
    fit = rt.fit_reflectance_table(lights, views, brdf, lobes=1, distribution=distribution)
    lobe = rt._Lobes(lights, views, 1, distribution, None, None)
    weight = (lights[:, 2] * views[:, 2])[:, None]

    def residual(p):
        body, gloss = weight ** p[-1], lobe.evaluate(p[5:])[0][:, None]
        return (np.cbrt(weight * (np.exp(p[:5]) * body + gloss)) - np.cbrt(weight * brdf)).ravel()

    start = np.concatenate([np.log(fit.diffuse / np.pi), [np.log(0.1), 0.0, np.log(0.4), 0.1]])
    bounds = np.array([[-np.inf, np.inf]] * 8 + [[0.0, 2.0]]).T
    cost = 2 * least_squares(residual, start, x_scale="jac", bounds=bounds).cost
    mine = np.sum((np.cbrt(weight * fit.predicted) - np.cbrt(weight * brdf)) ** 2)
    assert mine <= cost * (1 + 1e-5)


def test_derivatives_of_the_lobes():
    lights, views, _, _ = table(samples=50)
    for distribution in ("torrance_sparrow", "ggx"):
        lobe = rt._Lobes(lights, views, 2, distribution, None, 0.0)
        theta = np.array([-2.0, -1.0, 0.5, -0.3, -0.7])
        _, columns = lobe.evaluate(theta)
        for k, step in enumerate(np.eye(5) * 1e-6):
            slope = (lobe.evaluate(theta + step)[0] - lobe.evaluate(theta - step)[0]) / 2e-6
            np.testing.assert_allclose(columns[:, k], slope, rtol=1e-4, atol=1e-8)


@pytest.mark.parametrize("exponent", [0.15, 0.6])
@pytest.mark.parametrize("lobes", [1, 2])
def test_the_exponent_of_the_body_is_recovered(exponent, lobes):
    widths = {1: ((6.0,), (0.15,)), 2: ((20.0, 2.0), (0.06, 0.3))}[lobes]
    lights, views, brdf, albedo = table(beta=widths[0], gamma=widths[1], samples=900, exponent=exponent)
    fit = rt.fit_reflectance_table(lights, views, brdf, lobes=lobes, **GAUSS)
    assert fit.body_exponent == pytest.approx(exponent, abs=5e-3)
    np.testing.assert_allclose(fit.diffuse, albedo, rtol=1e-2)
    np.testing.assert_allclose(fit.gamma, widths[1], rtol=0.02)
    lambert = rt.fit_reflectance_table(lights, views, brdf, lobes=lobes, body_exponent=0.0, **GAUSS)
    assert lambert.body_exponent == 0.0
    assert lambert.r2_bands < fit.r2_bands


def test_the_albedo_of_the_body_along_the_normal():
    """2 / (2 + a) of rho_d: the integral of cos^a / pi cos over the hemisphere, by sums."""
    theta = (np.arange(20000) + 0.5) * (np.pi / 2 / 20000)
    for a in (0.0, 0.4, 2.0):
        total = np.sum(np.cos(theta) ** (a + 1) * np.sin(theta)) * 2 * (np.pi / 2 / 20000)
        assert total == pytest.approx(2 / (2 + a), rel=1e-6)


@pytest.mark.parametrize("settings", [{}, GAUSS, {"lobes": 1, "refractive_index": 1.5}, {"body_exponent": 0.0}])
def test_predictions_at_the_directions_of_the_fit_are_the_fit(settings):
    lights, views, brdf, _ = table(exponent=0.2)
    fit = rt.fit_reflectance_table(lights, views, brdf, **settings)
    np.testing.assert_allclose(rt.predict_reflectances(fit, lights, views), fit.predicted, rtol=1e-9)


def test_parameters_that_end_at_a_bound_are_named():
    """A metal-like index, a body darker to the horizon than the model goes, and a mirror."""
    lights, views, brdf, _ = table(index=9.0)
    fit = rt.fit_reflectance_table(lights, views, brdf, lobes=1, **GAUSS)
    assert fit.refractive_index == pytest.approx(2.0)
    assert fit.at_bound == ("refractive_index at 2",)
    held = rt.fit_reflectance_table(lights, views, brdf, lobes=1, refractive_index=9.0, **GAUSS)
    assert held.at_bound == ()
    lights, views, brdf, _ = table(exponent=2.6)
    fit = rt.fit_reflectance_table(lights, views, brdf, lobes=1, **GAUSS)
    assert fit.body_exponent == 2.0
    assert "body_exponent at 2" in fit.at_bound
    lights, views, brdf, _ = table(gamma=(2e-4,), beta=(1e3,))
    lights, views = np.vstack([lights, lights]), np.vstack([views, lights * [-1, -1, 1]])  # half of them mirrored
    g = half_vector_geometry(UP, lights, views)
    gloss = 50 * facet_distribution(g.phi, 5e-4) * attenuation(g, 1.5) / (np.pi * g.cos_i)
    fit = rt.fit_reflectance_table(lights, views, 0.1 + gloss[:, None] + np.zeros(3), lobes=1, **GAUSS)
    assert any(text.startswith("gamma 1 at 0.001") for text in fit.at_bound)


def test_half_width_of_ggx():
    lights, views, _, _ = table(samples=5)
    lobe = rt._Lobes(lights, views, 1, "ggx", None, 0.0)
    half = lobe.half_width(np.array([0.2]))[0]
    assert (np.cos(half) ** 2 + np.sin(half) ** 2 / 0.04) ** -2 == pytest.approx(0.5)


def test_r2_by_hand_and_its_scale():
    measured, predicted, weight = np.array([1.0, 8.0, 27.0]), np.array([1.0, 8.0, 64.0]), np.ones(3)
    assert rt.r2_cube_root(measured, predicted, weight) == pytest.approx(1 - 1 / 2)
    one = rt.r2_cube_root(measured * 1e-6, predicted * 1e-6, weight)
    assert one == pytest.approx(0.5)


def test_scale_equivariance():
    lights, views, brdf, _ = table()
    one = rt.fit_reflectance_table(lights, views, brdf, lobes=1)
    for scale in (1e-6, 1e6):
        other = rt.fit_reflectance_table(lights, views, brdf * scale, lobes=1)
        assert other.beta[0] == pytest.approx(one.beta[0] * scale, rel=1e-2)
        assert other.gamma[0] == pytest.approx(one.gamma[0], rel=1e-3)


def test_messages():
    lights, views, brdf, _ = table(samples=20)
    bad = brdf.copy()
    bad[7, 0] = np.nan
    for arguments, settings, word in (
        ((lights, views, bad), {}, "row 7"),
        ((lights, -views, brdf), {}, "horizon"),
        ((lights[:3], views, brdf), {}, "samples, 3"),
        ((lights, views, brdf), {"lobes": 3}, "lobes"),
        ((lights, views, brdf), {"distribution": "phong"}, "distribution"),
    ):
        with pytest.raises(UserError, match=word):
            rt.fit_reflectance_table(*arguments, **settings)


@pytest.mark.data
@pytest.mark.parametrize(("name", "one_lobe"), [("garnet_red", 0.965), ("krylon_blue", 0.945)])
def test_measured_paints(data, name, one_lobe):
    rows = [r for r in (data / "cornell_brdf" / f"{name}.brdf").read_text().splitlines() if r and r[0] != "#"]
    values = np.array([r.split() for r in rows[3:] if len(r.split()) == 35], float)
    lights, views = (rt.directions(values[:, k], values[:, k + 1]) for k in (0, 2))
    brdf = values[:, 4:]
    one = rt.fit_reflectance_table(lights, views, brdf, lobes=1, body_exponent=0.0, **GAUSS)
    bent = rt.fit_reflectance_table(lights, views, brdf, lobes=1, **GAUSS)
    two = rt.fit_reflectance_table(lights, views, brdf)
    assert one.r2_mean >= one_lobe
    assert bent.r2_mean > one.r2_mean + 0.001
    assert two.r2_mean > bent.r2_mean
    assert two.r2_bands >= one_lobe + 0.007
    assert two.at_bound == ()
    # Fitted to every second sample, the exponent predicts the others better than Lambert does.
    scores = []
    for exponent in (0.0, None):
        half = rt.fit_reflectance_table(lights[::2], views[::2], brdf[::2], body_exponent=exponent)
        predicted = rt.predict_reflectances(half, lights[1::2], views[1::2])
        scores.append(rt.r2_cube_root(brdf[1::2], predicted, lights[1::2, 2] * views[1::2, 2]))
    assert scores[1] > scores[0]
