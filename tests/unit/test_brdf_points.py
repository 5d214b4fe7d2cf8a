"""Fits at many points: against slow references, from data of the model itself, and where nothing can be fitted."""

import numpy as np
import point_fits as vp
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from point_fits import FitFlag, fit_torrance_sparrow
from published_fits import fit_lobe, fit_points
from scipy.optimize import minimize_scalar, nnls

from nishiki.errors import UserError

OBSERVATIONS, CHANNELS = 36, 3


def problem(points, *, gamma=None, strength=(1.0, 30.0), noise=0.0, seed=0, near=0.0, dtype=np.float64):
    """Points of the model itself: 36 directions, six of them near the highlight."""
    rng = np.random.default_rng(seed)
    phi = rng.uniform(near, 1.2, (points, OBSERVATIONS))
    gamma = np.exp(rng.uniform(np.log(0.03), np.log(0.5), points)) if gamma is None else np.full(points, gamma)
    phi[:, :6] = near + gamma[:, None] * rng.uniform(0, 2, (points, 6))
    attenuation, diffuse = rng.uniform(0.02, 0.1, phi.shape), rng.uniform(0.1, 1, phi.shape)
    specular = rng.uniform(*strength, (points, 1)) * rng.uniform(0.8, 1.2, (points, CHANNELS))
    albedo = rng.uniform(0.05, 0.9, (points, CHANNELS))
    lobe = attenuation * np.exp2(-((phi / gamma[:, None]) ** 2))
    values = albedo[:, None] * diffuse[..., None] + specular[:, None] * lobe[..., None]
    values += noise * rng.normal(size=values.shape)
    arrays = [a.astype(dtype) for a in (phi, values, attenuation, diffuse)]
    return arrays, gamma, specular, albedo


def fitted(arrays, **settings):
    phi, values, attenuation, diffuse = arrays
    return fit_torrance_sparrow(phi, values, attenuation=attenuation, diffuse=diffuse, **settings)


def slow_fit(phi, values, attenuation, diffuse, weights):
    """The obvious way: scipy's non-negative least squares at each of many half widths, then Brent."""

    def cost(log_gamma):
        lobe = attenuation * np.exp2(-((phi / np.exp(log_gamma)) ** 2))
        matrix = np.sqrt(weights)[:, None] * np.stack([lobe, diffuse], axis=1)
        return sum(nnls(matrix, np.sqrt(weights) * values[:, c])[1] ** 2 for c in range(values.shape[1]))

    nodes = np.linspace(np.log(1e-3), np.log(1.6), 90)
    best = nodes[np.argmin([cost(t) for t in nodes])]
    step = nodes[1] - nodes[0]
    found = minimize_scalar(cost, bounds=(best - step, best + step), method="bounded", options={"xatol": 1e-10})
    return np.exp(found.x), found.fun


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_equals_the_slow_reference(noise):
    arrays, *_ = problem(12, noise=noise, seed=4)
    weights = np.random.default_rng(5).uniform(0.2, 2, arrays[0].shape)
    fit = fitted(arrays, weights=weights)
    for p in range(12):
        gamma, cost = slow_fit(*(a[p] for a in arrays), weights[p])
        assert fit.gamma[p] == pytest.approx(gamma, rel=1e-5)
        mine = fit.residual[p] ** 2 * OBSERVATIONS * CHANNELS
        assert mine <= cost * (1 + 1e-9) + 1e-20


def test_noise_free_data_are_recovered_in_both_precisions():
    for dtype, tolerance in ((np.float64, 1e-9), (np.float32, 2e-3)):
        arrays, gamma, specular, albedo = problem(3000, dtype=dtype)
        fit = fitted(arrays)
        good = fit.flags == 0
        assert fit.gamma.dtype == dtype
        assert good.mean() > 0.99
        assert np.max(abs(fit.gamma / gamma - 1)[good]) < tolerance
        assert np.max(abs(fit.specular / specular - 1)[good]) < tolerance
        assert np.max(abs(fit.diffuse / albedo - 1)[good]) < tolerance


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(("beta", "gamma"), [(164.0, 0.07), (1.0, 0.003), (1e6, 0.003), (1e-2, 1.0), (164.0, 0.3)])
def test_stiff_strength_and_width(beta, gamma, dtype):
    """beta gamma badly scaled: within 1 % (in fact 1e-4) whatever their ratio, down to 0.003 rad."""
    arrays, *_ = problem(200, gamma=gamma, dtype=np.float64)
    phi, _, attenuation, diffuse = arrays
    values = (beta * attenuation * np.exp2(-((phi / gamma) ** 2)) + 0.4 * diffuse)[..., None] * np.ones(CHANNELS)
    fit = fitted([a.astype(dtype) for a in (phi, values, attenuation, diffuse)])
    tolerance = 1e-7 if dtype == np.float64 else 5e-3
    assert np.all(fit.flags & ~np.uint8(FitFlag.UNDETERMINED) == 0)
    assert np.max(abs(fit.gamma / gamma - 1)) < tolerance
    assert np.max(abs(fit.specular / beta - 1)) < tolerance


@given(st.floats(np.log(0.003), np.log(1.0)), st.floats(-3, 3), st.integers(0, 1000))
@settings(max_examples=60, deadline=None)
def test_recovered_within_one_percent_over_the_whole_range(log_gamma, decade, seed):
    strength = 10.0**decade
    arrays, gamma, specular, _ = problem(4, gamma=np.exp(log_gamma), strength=(strength, strength), seed=seed)
    fit = fitted(arrays)
    sure = fit.flags == 0
    assert np.all(abs(fit.gamma / gamma - 1)[sure] < 0.01)
    assert np.all(abs(fit.specular / specular - 1)[sure] < 0.01)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_twelve_orders_of_radiometric_scale_change_nothing_but_the_strengths(dtype):
    arrays, *_ = problem(50, noise=0.01, dtype=dtype)
    phi, values, attenuation, diffuse = arrays
    one = fitted(arrays)
    for scale in (2.0**-20, 2.0**20):  # powers of two: the equivariance is exact but for the scaling's own rounding
        other = fitted((phi, values * dtype(scale), attenuation, diffuse))
        np.testing.assert_allclose(other.gamma, one.gamma, rtol=2e-3 if dtype == np.float32 else 1e-7)
        np.testing.assert_allclose(other.specular, one.specular * scale, rtol=5e-3 if dtype == np.float32 else 1e-6)
        np.testing.assert_array_equal(other.flags, one.flags)
        np.testing.assert_allclose(
            fitted((phi, values, attenuation * dtype(scale), diffuse)).specular * scale, one.specular, rtol=5e-3
        )


def test_no_observed_highlight_is_flagged_and_leaves_the_diffuse_part():
    for noise in (0.0, 0.01):
        arrays, _, _, albedo = problem(400, strength=(0.0, 1e-30), noise=noise)
        fit = fitted(arrays)
        dark = (fit.flags & FitFlag.NO_HIGHLIGHT) > 0
        assert dark.mean() > 0.97
        assert np.all(fit.specular[dark] == 0)
        assert np.all(np.isnan(fit.gamma[dark]))
        np.testing.assert_allclose(fit.diffuse[dark], albedo[dark], atol=4 * noise / np.sqrt(5) + 1e-12)


def test_a_lobe_between_the_observations_is_not_called_known():
    """One observation inside a lobe of 0.01 rad, the others at 0.3 rad and more: its width cannot be known."""
    rng = np.random.default_rng(0)
    phi = rng.uniform(0.3, 1.2, (50, OBSERVATIONS))
    phi[:, 0] = 0.004
    ones = np.ones_like(phi)
    values = (np.exp2(-((phi / 0.01) ** 2)) * 0.5)[..., None] + 1e-3 * rng.normal(size=(50, OBSERVATIONS, 3))
    fit = fit_torrance_sparrow(phi, values + 0.3 * ones[..., None], diffuse=ones)
    assert np.all(fit.flags & FitFlag.UNDETERMINED)


def test_too_few_observations_and_bad_values():
    arrays, *_ = problem(4)
    phi, values, attenuation, diffuse = (a.copy() for a in arrays)
    weights = np.ones_like(phi)
    weights[0, 2:] = 0
    weights[1] = 0
    values[2, 3, 1], phi[2, 8], attenuation[2, 9] = np.nan, np.inf, np.nan
    fit = fitted((phi, values, attenuation, diffuse), weights=weights)
    assert np.all(fit.flags[:2] & FitFlag.TOO_FEW)
    assert np.all(fit.used == [2, 0, 33, 36])
    assert fit.flags[2] == FitFlag.NOT_FINITE
    assert np.isfinite(fit.specular).all()
    assert np.isfinite(fit.diffuse).all()
    keep = np.setdiff1d(np.arange(OBSERVATIONS), [3, 8, 9])
    alone = fitted([a[2:3][:, keep] for a in arrays])
    assert alone.gamma[0] == pytest.approx(fit.gamma[2], rel=1e-9)


def test_roughness_to_zero_and_to_infinity_ends_at_the_bounds():
    arrays, *_ = problem(20, gamma=30.0)  # D = 1 wherever it is seen
    assert np.all(fitted(arrays).flags & (FitFlag.AT_BOUND | FitFlag.NO_HIGHLIGHT | FitFlag.UNDETERMINED))
    phi, values, attenuation, diffuse = problem(20, gamma=1e-4)[0]
    fit = fitted((phi, values, attenuation, diffuse))
    assert np.all(fit.flags & FitFlag.AT_BOUND)
    assert np.isfinite(fit.specular).all()


def test_non_negative_strengths_and_no_diffuse_term():
    arrays, gamma, specular, _ = problem(100, noise=0.02, strength=(0.0, 2.0))
    fit = fitted(arrays)
    assert np.all(fit.specular >= 0)
    assert np.all(fit.diffuse >= 0)
    phi, _, attenuation, _ = arrays
    values = specular[:, None] * (attenuation * np.exp2(-((phi / gamma[:, None]) ** 2)))[..., None]
    alone = fit_torrance_sparrow(phi, values, attenuation=attenuation)
    np.testing.assert_allclose(alone.gamma, gamma, rtol=1e-8)
    np.testing.assert_array_equal(alone.diffuse, 0)


@pytest.mark.parametrize("channels", [1, 3, 8])
@pytest.mark.parametrize("observations", [5, 16, 41, 96])
def test_any_number_of_observations_and_channels(observations, channels):
    rng = np.random.default_rng(observations)
    phi, q = rng.uniform(0, 0.4, (6, observations)), rng.uniform(0.2, 1, (6, observations))
    values = 0.3 * q[..., None] + (np.exp2(-((phi / 0.2) ** 2)))[..., None] * rng.uniform(1, 2, channels)
    fit = fit_torrance_sparrow(phi, values, diffuse=q)
    np.testing.assert_allclose(fit.gamma, 0.2, rtol=1e-8)


def test_standard_deviation_of_the_width_is_the_scatter_of_repeated_fits():
    arrays, *_ = problem(1, gamma=0.1, strength=(10.0, 10.0))
    rng = np.random.default_rng(1)
    many = [np.repeat(a, 3000, axis=0) for a in arrays]
    many[1] = many[1] + 0.01 * rng.normal(size=many[1].shape)
    fit = fitted(many)
    assert np.median(fit.sigma_log_gamma) == pytest.approx(np.std(np.log(fit.gamma)), rel=0.1)


def test_levenberg_marquardt_agrees_where_it_converges():
    arrays, gamma, *_ = problem(20, gamma=0.12, noise=0.002, seed=2)
    fit, strengths, reports = fitted(arrays), np.zeros((20, 3, 2)), np.zeros((20, vp.REPORT))
    fit_points(*arrays, np.ones_like(arrays[0]), strengths, reports)
    close = abs(reports[:, vp.GAMMA] / gamma - 1) < 0.2
    assert close.mean() > 0.8
    np.testing.assert_allclose(reports[close, vp.GAMMA], fit.gamma[close], rtol=1e-4)
    np.testing.assert_allclose(strengths[close, :, 0], fit.specular[close], rtol=1e-3)


@pytest.mark.parametrize("start", [(1.0, 0.1), (1.0, 1.0), (1000.0, 0.02)])
def test_projection_needs_no_start_where_levenberg_marquardt_depends_on_it(start):
    phi = np.linspace(0, 1.2, 400)
    values = 164 * np.exp2(-((phi / 0.07) ** 2))
    fit = fit_torrance_sparrow(phi[None], values[None, :, None])
    assert fit.gamma[0] == pytest.approx(0.07, rel=1e-9)
    assert fit.specular[0, 0] == pytest.approx(164, rel=1e-9)
    beta, gamma, covariance, _, _ = fit_lobe(phi, values, np.ones_like(phi), start=start)
    assert np.isfinite([beta, gamma]).all()
    assert covariance.shape == (2, 2)


def test_messages_name_what_is_wrong():
    phi, values = np.zeros((2, 3)), np.ones((2, 3, 1))
    for arguments, word in (
        ({"weights": -np.ones((2, 3))}, "weights"),
        ({"diffuse": np.ones((3, 2))}, "diffuse"),
        ({"gamma_bounds": (0.5, 0.1)}, "gamma_bounds"),
    ):
        with pytest.raises(UserError, match=word):
            fit_torrance_sparrow(phi, values, **arguments)
    with pytest.raises(UserError, match="amplitude"):
        fit_torrance_sparrow(phi, phi)
