"""The working grid and what comes onto it; bases and the system matrix."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused

from nishiki.colour.sampling import WAVELENGTHS_NM, channel_weights, principal_basis, resample
from nishiki.colour.training import synthetic_reflectances
from nishiki.errors import UserError


def test_weights_integrate_as_trapezoids():
    lamp, line = np.ones(61), WAVELENGTHS_NM / 700
    weights = channel_weights(lamp, line[None])[0]
    assert weights @ lamp == pytest.approx(1, abs=1e-14)
    assert weights @ line == pytest.approx(np.trapezoid(line * line) / np.trapezoid(line), rel=1e-14)


@pytest.mark.parametrize(
    "grid", [np.arange(380.0, 781.0, 10.0), np.linspace(395.0, 705.0, 17), np.arange(400.0, 701.0)]
)
def test_linear_resampling_equals_numpy(grid):
    values = np.random.default_rng(0).random((3, grid.size))
    expected = np.array([np.interp(WAVELENGTHS_NM, grid, row) for row in values])
    np.testing.assert_allclose(resample(grid, values), expected, atol=1e-14)
    np.testing.assert_allclose(resample(grid[::-1], values[:, ::-1]), expected, atol=1e-14)


@pytest.mark.parametrize(
    ("grid", "values", "words"),
    [
        (np.arange(420.0, 701.0, 10), None, "lamp.csv.*400-700.*420-700"),
        (np.arange(400.0, 681.0, 10), None, "400-680"),
        (np.array([400.0, 500.0, 500.0, 700.0]), None, "500 nm .* 500"),
        (np.array([400.0, 600.0, 500.0, 700.0]), None, "600 nm .* 500"),
        (np.array([400.0, 700.0]), np.array([1.0, np.nan]), "1 NaN"),
        (np.array([400.0, 700.0]), np.array([1.0, 1.0, 1.0]), r"lamp\.csv"),
        (np.array([400.0]), np.array([1.0]), "2"),
    ],
)
def test_unusable_curves_are_named(grid, values, words):
    with pytest.raises(UserError, match=words):
        resample(grid, np.ones(grid.size) if values is None else values, name="lamp.csv")


def test_tolerance_repeats_the_end_value_and_can_be_forbidden():
    grid = np.arange(405.0, 701.0, 5.0)
    values = np.linspace(2.0, 1.0, grid.size)
    assert resample(grid, values)[0] == 2.0  # repeated, not extrapolated by slope
    with pytest.raises(UserError, match="405-700"):
        resample(grid, values, tolerance_nm=0.0)


def test_principal_basis_is_orthonormal_ordered_and_least_squares_optimal():
    data = synthetic_reflectances(200, seed=3)
    basis = principal_basis(data, 5)
    np.testing.assert_allclose(basis @ basis.T, np.eye(5), atol=1e-12)
    assert np.all(np.diff(np.linalg.norm(data @ basis.T, axis=0)) <= 0)
    assert np.all(basis.sum(axis=1) >= 0)
    lost = np.sum((data - data @ basis.T @ basis) ** 2)
    eigenvalues = np.linalg.eigvalsh(data.T @ data)[::-1]
    assert lost == pytest.approx(eigenvalues[5:].sum(), rel=1e-8)


@pytest.mark.parametrize("count", [0, 62, 201])
def test_impossible_number_of_bases(count):
    with refused(UserError, by="principal_basis"):
        principal_basis(synthetic_reflectances(200), count)


def test_weights_of_the_bases_are_the_sums_of_equation_7():
    rng = np.random.default_rng(5)
    lamp, camera, basis = rng.random(61) + 0.1, rng.random((4, 61)), rng.standard_normal((3, 61))
    step = np.where(np.isin(np.arange(61), (0, 60)), 2.5, 5.0)
    expected = np.zeros((4, 3))
    for i in range(4):
        white = sum(lamp[b] * camera[i, b] * step[b] for b in range(61))
        for k in range(3):
            expected[i, k] = sum(lamp[b] * basis[k, b] * camera[i, b] * step[b] for b in range(61)) / white
    np.testing.assert_allclose(channel_weights(lamp, camera) @ basis.T, expected, rtol=1e-12)


@given(exponent=st.floats(-12, 12), channel=st.integers(0, 2))
@settings(max_examples=30, deadline=None)
def test_lamp_power_and_channel_gain_cancel(exponent, channel):
    rng = np.random.default_rng(6)
    lamp, camera = rng.random(61) + 0.1, rng.random((3, 61))
    reference = channel_weights(lamp, camera)
    np.testing.assert_allclose(reference.sum(axis=1), 1.0, rtol=1e-13)
    np.testing.assert_allclose(channel_weights(lamp * 10.0**exponent, camera), reference, rtol=1e-12)
    gained = camera.copy()
    gained[channel] *= 10.0 ** (exponent / 2)
    np.testing.assert_allclose(channel_weights(lamp, gained), reference, rtol=1e-12)


def test_blind_channels_and_bad_lamps_are_named():
    lamp, camera = np.ones(61), np.ones((3, 61))
    with pytest.raises(UserError, match="channel 1 "):
        channel_weights(lamp, camera * np.array([1, 0, 1])[:, None])
    with pytest.raises(UserError, match="power >= 0"):
        channel_weights(-lamp, camera)
    with pytest.raises(UserError, match="61 bands"):
        channel_weights(np.ones(31), camera)
    with pytest.raises(UserError, match="finite"):
        channel_weights(lamp * np.nan, camera)
