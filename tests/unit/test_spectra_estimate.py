"""The estimators: exact white, equality with their slow forms, and a stated outcome for every bad input."""

from dataclasses import replace

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused

from nishiki.colour import estimate as module
from nishiki.colour.colour import illuminant
from nishiki.colour.estimate import estimate_spectra, fit_estimator
from nishiki.colour.fitting import (
    LocalCorrection,
    ResponseSpace,
    compact_kernel,
    dark_weight,
    evaluate_correction,
    fit_correction,
    paper_map,
    place_centres,
    response_space,
    wiener_map,
)
from nishiki.colour.sampling import WAVELENGTHS_NM, channel_weights, principal_basis, under_one_lamp
from nishiki.colour.training import synthetic_reflectances
from nishiki.errors import UserError

LAMP = illuminant("A")
TRAINING = synthetic_reflectances(300, seed=1)
UNSEEN = synthetic_reflectances(120, seed=2)


def camera(channels: int) -> np.ndarray:
    """Gaussian sensitivities (N, 61) spread over 430-650 nm, overlapping as those of real cameras."""
    centres = np.linspace(650, 430, channels) if channels > 1 else np.array([560.0])
    return np.exp(-0.5 * ((WAVELENGTHS_NM - centres[:, None]) / max(35.0 * 3 / channels, 12.0)) ** 2)


@pytest.fixture(scope="module")
def local():
    return fit_estimator(TRAINING, LAMP, camera(3), centres=100)


def responses_of(spectra, channels=3):
    return spectra @ channel_weights(LAMP, camera(channels)).T


def as_correction(e):
    space = ResponseSpace(e.mean, e.whiten, e.low, e.high)
    correction = LocalCorrection(
        e.centres, e.weights, e.radius, e.variance, e.far_variance, e.gamut_distance, np.zeros(61)
    )
    return correction, space


def anchored(e, responses):
    """The estimator's linear part and white anchor, in float64."""
    fade = np.exp(-np.mean((responses - 1.0) ** 2, axis=1) / (2.0 * e.white_width**2))
    return responses @ e.linear.T + fade[:, None] * e.anchor


def trilinear(table, origin, step, point):
    """One interpolation, corner by corner."""
    position = np.clip((point - origin) / step, 0, np.array(table.shape[:3]) - 1)
    base = np.minimum(position.astype(int), np.array(table.shape[:3]) - 2)
    total = np.zeros(table.shape[3])
    for corner in np.ndindex(2, 2, 2):
        share = np.prod([f if c else 1 - f for c, f in zip(corner, position - base, strict=True)])
        total += share * table[tuple(base + corner)]
    return total


# White ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", module.METHODS)
@pytest.mark.parametrize("channels", [1, 2, 3, 4, 6, 16])
def test_perfect_white_returns_one(method, channels):
    e = fit_estimator(TRAINING, LAMP, camera(channels), method=method, centres=60)
    field = estimate_spectra(np.ones((2, 2, channels)), e)
    assert field.coefficients.shape == (2, 2, len(e.basis))
    assert field.coefficients.dtype == np.float32
    np.testing.assert_allclose(field.spectra(), 1.0, atol=1e-6)
    assert not np.any(field.flags & module.SpectralFlag.OUTSIDE_UNIT)


@pytest.mark.parametrize("lamp", ["A", "D65", "FL11"])
@pytest.mark.parametrize("bases", [1, 2, 3])
def test_paper_white_whatever_lamp_and_bases(lamp, bases):
    e = fit_estimator(TRAINING, illuminant(lamp), camera(3), method="paper", bases=bases)
    np.testing.assert_allclose(estimate_spectra(np.ones(3), e).spectra(), 1.0, atol=1e-6)


def test_white_anchor_is_local_and_unseen_by_the_camera():
    e = fit_estimator(TRAINING, LAMP, camera(3), method="paper")
    bare = fit_estimator(TRAINING, LAMP, camera(3), method="paper", white_width=0.0)
    far = responses_of(TRAINING[TRAINING.max(axis=1) < 0.6])
    np.testing.assert_allclose(estimate_spectra(far, e).spectra(), estimate_spectra(far, bare).spectra(), atol=1e-6)
    assert np.abs(estimate_spectra(np.ones(3), bare).spectra() - 1.0).max() > 1e-3  # what the anchor is for
    np.testing.assert_allclose(channel_weights(LAMP, camera(3)) @ e.basis[3], 0.0, atol=1e-12)


# The paper's form and Wiener's ---------------------------------------------------------------------------------------


def test_paper_is_the_matrix_inverse():
    e = fit_estimator(TRAINING, LAMP, camera(3), method="paper", white_width=0.0)
    vectors = principal_basis(TRAINING, 3)
    seen = responses_of(UNSEEN)
    system = channel_weights(LAMP, camera(3)) @ vectors.T  # Tominaga and Tanaka (2004), eq. 7
    expected = np.linalg.inv(system) @ seen.T
    np.testing.assert_allclose(estimate_spectra(seen, e).coefficients, expected.T, rtol=2e-5, atol=2e-6)
    singular = np.linalg.svd(system, compute_uv=False)
    assert e.condition == pytest.approx(singular[0] / singular[-1], rel=1e-10)


def test_paper_recovers_spectra_inside_its_basis():
    vectors = principal_basis(TRAINING, 3)
    inside = UNSEEN @ vectors.T @ vectors
    e = fit_estimator(TRAINING, LAMP, camera(3), method="paper", white_width=0.0)
    np.testing.assert_allclose(estimate_spectra(responses_of(inside), e).spectra(), inside, atol=2e-6)


def test_paper_with_fewer_bases_is_least_squares_and_with_more_is_refused():
    weights, vectors = channel_weights(LAMP, camera(5)), principal_basis(TRAINING, 3)
    sigma, cut = paper_map(weights, vectors, condition_limit=1e6)
    np.testing.assert_allclose(sigma, np.linalg.lstsq(weights @ vectors.T, np.eye(5), rcond=None)[0], atol=1e-10)
    assert not cut
    with pytest.raises(UserError, match=r"channels \(3\), found 4"):
        fit_estimator(TRAINING, LAMP, camera(3), method="paper", bases=4)


def test_wiener_is_ridge_regression_of_spectra_on_responses():
    weights, noise = channel_weights(LAMP, camera(3)), 0.02
    seen = TRAINING @ weights.T
    stacked = np.vstack([seen, noise * len(seen) ** 0.5 * np.eye(3)])
    expected = np.linalg.lstsq(stacked, np.vstack([TRAINING, np.zeros((3, 61))]), rcond=None)[0]
    np.testing.assert_allclose(wiener_map(weights, TRAINING, noise=noise), expected.T, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("exponent", [1.0, 8.0, 10.0, 12.0])
def test_inverse_against_fifty_digits(exponent):
    """Relative error of sigma at most 1e3 eps cond(H), up to cond(H) = 1e12 where the limit allows it."""
    rng = np.random.default_rng(3)
    left, right = (np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in range(2))
    system = left @ np.diag([1.0, 10.0 ** (-exponent / 2), 10.0**-exponent]) @ right
    weights = np.hstack([system, np.zeros((3, 58))])
    sigma, cut = paper_map(weights, np.eye(61)[:3], condition_limit=1e13)
    with mpmath.workdps(50):
        exact = np.array((mpmath.matrix(system.tolist()) ** -1).tolist(), dtype=float)
    assert not cut
    error = np.abs(sigma - exact).max() / np.abs(exact).max()
    assert error <= 1e3 * np.finfo(float).eps * 10.0**exponent


# A lamp that cannot tell the bases apart -----------------------------------------------------------------------------


@pytest.mark.parametrize("method", module.METHODS)
def test_narrow_band_lamp_gives_bounded_spectra(method):
    line = np.full(61, 1e-15)
    line[36] = 1.0  # 580 nm
    e = fit_estimator(TRAINING, line, camera(3), method=method, centres=60)
    assert e.condition > 1e8
    seen = UNSEEN @ channel_weights(line, camera(3)).T
    found = estimate_spectra(seen * (1 + 1e-4 * np.random.default_rng(0).standard_normal(seen.shape)), e)
    assert np.abs(found.spectra()).max() < 5.0  # unregularised: noise times cond(H)
    np.testing.assert_allclose(found.spectra()[:, 36], UNSEEN[:, 36], atol=0.03)  # what the lamp shows is right
    flagged = (found.flags & module.SpectralFlag.ILL_CONDITIONED) > 0
    assert flagged.all() if method == "paper" else not flagged.any()
    np.testing.assert_allclose(estimate_spectra(np.ones(3), e).spectra(), 1.0, atol=1e-5)


def test_identical_channels_are_no_harm():
    twice = np.vstack([camera(3), camera(3)[:1]])
    e, plain = (fit_estimator(TRAINING, LAMP, c, centres=60) for c in (twice, camera(3)))
    seen = responses_of(UNSEEN)
    error = [
        np.sqrt(np.mean((estimate_spectra(r, x).spectra() - UNSEEN) ** 2))
        for r, x in ((np.hstack([seen, seen[:, :1]]), e), (seen, plain))
    ]
    assert error[0] < 1.25 * error[1]


# The local correction against its slow forms -------------------------------------------------------------------------


def test_kernel_is_positive_definite_and_compact():
    points = np.random.default_rng(0).standard_normal((200, 3))
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    assert np.linalg.eigvalsh(compact_kernel(apart / 4.0)).min() > 0
    assert compact_kernel(np.array([0.0]))[0] == 1.0
    assert np.all(compact_kernel(np.array([1.0, 1.5, 1e9])) == 0.0)


def test_leave_one_out_error_equals_leaving_each_out():
    seen, data = responses_of(TRAINING[:60]), TRAINING[:60]
    space = response_space(seen, noise=0.005)
    residual = data - seen @ wiener_map(channel_weights(LAMP, camera(3)), data, noise=0.005).T
    fitted = fit_correction(residual, seen, space, centres=25, radius=6.0, ridge=0.3)
    centres = place_centres(space.coordinates(seen), 25)

    def design(r):
        z = space.coordinates(r)
        kernel = compact_kernel(np.linalg.norm(z[:, None] - centres[None], axis=2) / 6.0)
        return kernel * dark_weight(r)[:, None]

    smooth = compact_kernel(np.linalg.norm(centres[:, None] - centres[None], axis=2) / 6.0)
    penalty = 0.3 * np.mean(dark_weight(seen) ** 2) * smooth
    squares = []
    for out in range(60):
        kept = np.arange(60) != out
        rows = design(seen[kept])
        solution = np.linalg.solve(rows.T @ rows + penalty, rows.T @ residual[kept])
        squares.append(np.mean((residual[out] - design(seen[out : out + 1]) @ solution) ** 2))
    assert fitted.left_out.mean() == pytest.approx(np.mean(squares), rel=1e-3)


def test_table_kernel_equals_slow_interpolation(local):
    seen = np.vstack([responses_of(UNSEEN), np.random.default_rng(1).random((200, 3)) * 1.3])
    found = estimate_spectra(seen, local)
    space = ResponseSpace(local.mean, local.whiten, local.low, local.high)
    single = seen.astype(np.float32).astype(float)
    z = space.coordinates(single)
    rows = np.array([trilinear(local.table.astype(float), local.table_origin, local.table_step, p) for p in z])
    scale = space.taper(z) * dark_weight(single)
    expected = anchored(local, single) + scale[:, None] * rows[:, :-2]
    np.testing.assert_allclose(found.coefficients, expected, atol=1e-5)
    inside = scale > 0
    sigma = np.sqrt(rows[inside, -2] + local.noise_variance)
    np.testing.assert_allclose(found.sigma[inside], sigma, rtol=1e-4)


@pytest.mark.parametrize("channels", [1, 2, 3, 5, 16])
def test_centre_kernel_equals_plain_sum(channels):
    e = fit_estimator(TRAINING, LAMP, camera(channels), centres=80)
    e = replace(e, table=np.ascontiguousarray(e.table[:1, :1, :1]))
    seen = np.vstack([responses_of(UNSEEN, channels), np.random.default_rng(1).random((200, channels)) * 1.3])
    found = estimate_spectra(seen, e)
    single = seen.astype(np.float32).astype(float)
    correction, space = as_correction(e)
    values, variance, nearest = evaluate_correction(correction, space, single)
    scale = 1e-6 * (1.0 + np.abs(e.weights).sum(axis=0).max())  # float32 sums of weights of either sign
    np.testing.assert_allclose(found.coefficients, anchored(e, single) + values, atol=max(scale, 1e-5))
    inside = space.taper(space.coordinates(single)) > 0
    np.testing.assert_allclose(found.sigma[inside], np.sqrt(variance + e.noise_variance)[inside], rtol=2e-3)
    clear = inside & (np.abs(nearest - e.gamut_distance) > 1e-3)
    np.testing.assert_array_equal((found.flags[clear] & 2) > 0, nearest[clear] > e.gamut_distance)


def test_table_is_close_to_the_exact_sum(local):
    seen = responses_of(UNSEEN)
    exact = estimate_spectra(seen, replace(local, table=np.ascontiguousarray(local.table[:1, :1, :1]))).spectra()
    difference = estimate_spectra(seen, local).spectra() - exact
    error = np.sqrt(np.mean((exact - UNSEEN) ** 2))
    assert np.sqrt(np.mean(difference**2)) < 0.1 * error


@pytest.mark.slow
def test_local_beats_linear_on_unseen_spectra():
    training, unseen = synthetic_reflectances(1500, seed=1), synthetic_reflectances(500, seed=2)
    error = []
    for method in ("local", "wiener", "paper"):
        e = fit_estimator(training, LAMP, camera(3), method=method)
        error.append(np.sqrt(np.mean((estimate_spectra(responses_of(unseen), e).spectra() - unseen) ** 2)))
    assert error[0] < 0.85 * error[1]
    assert error[1] < error[2]


@pytest.mark.slow
def test_more_channels_see_more():
    errors = []
    for channels in (1, 3, 6, 16):
        e = fit_estimator(TRAINING, LAMP, camera(channels), noise=0.001, bases=None if channels < 6 else 14)
        found = estimate_spectra(responses_of(UNSEEN, channels), e).spectra()
        errors.append(np.sqrt(np.mean((found - UNSEEN) ** 2)))
    assert errors[0] > 1.5 * errors[1] > 1.5 * 1.5 * errors[2]
    assert errors[3] < errors[2]


@pytest.mark.slow
def test_expected_error_is_calibrated():
    e = fit_estimator(synthetic_reflectances(1000, seed=3), LAMP, camera(3))
    unseen = synthetic_reflectances(1000, seed=4)
    found = estimate_spectra(responses_of(unseen), e)
    actual = np.mean((found.spectra() - unseen) ** 2, axis=1)
    assert 0.8 < np.sqrt(actual.mean() / np.mean(found.sigma.astype(float) ** 2)) < 1.25
    order = np.argsort(found.sigma)
    assert np.sqrt(actual[order[500:]].mean()) > 1.3 * np.sqrt(actual[order[:500]].mean())  # it tells hard from easy


def test_error_of_each_band_is_calibrated():
    e = fit_estimator(synthetic_reflectances(1000, seed=3), LAMP, camera(3))
    unseen = synthetic_reflectances(1000, seed=4)
    found = estimate_spectra(responses_of(unseen), e)
    error, stated = found.spectra() - unseen, found.sigma[:, None] * e.profile
    np.testing.assert_allclose(np.sqrt(np.mean(error**2, axis=0) / np.mean(stated**2, axis=0)), 1, atol=0.3)
    assert e.profile[[0, -1]].min() > 1.5 > 1 > np.median(e.profile)  # the camera hardly sees the ends


@pytest.mark.slow
def test_a_second_lamp_lowers_the_error_with_and_without_noise():
    both = [(LAMP, camera(3)), (illuminant("D65"), camera(3))]
    lamps = np.repeat([lamp for lamp, _ in both], 3, axis=0)
    curves = under_one_lamp(lamps, np.concatenate([camera(3), camera(3)]))
    weights = np.concatenate([channel_weights(lamp, sensitivities) for lamp, sensitivities in both])
    np.testing.assert_allclose(channel_weights(**curves), weights, atol=1e-12)
    training, unseen = synthetic_reflectances(1500, seed=1), synthetic_reflectances(500, seed=2)
    noise = 0.003 * np.random.default_rng(0).standard_normal((500, 6))
    one = fit_estimator(training, LAMP, camera(3))
    two = fit_estimator(training, curves["illuminant"], curves["sensitivities"])

    def error(estimator, responses):
        return np.sqrt(np.mean((estimate_spectra(responses, estimator).spectra() - unseen) ** 2))

    exact = responses_of(unseen)
    assert error(two, unseen @ weights.T) < 0.75 * error(one, exact)
    assert error(two, unseen @ weights.T + noise) < 0.9 * error(one, exact + noise[:, :3])


# Outside the training set --------------------------------------------------------------------------------------------


def test_far_responses_fall_back_to_the_linear_map_smoothly(local):
    far = np.array([[3.0, 0.001, 0.001], [0.0, 4.0, 0.0], [0.001, 0.001, 9.0], [50.0, 50.0, 50.0]])
    found = estimate_spectra(far, local)
    np.testing.assert_allclose(found.coefficients, far @ local.linear.T, rtol=1e-5, atol=1e-4)
    assert np.all(found.flags & module.SpectralFlag.OUTSIDE_TRAINING)
    ray = np.linspace(0, 1, 4001)[:, None] * np.array([2.0, 0.02, 0.02])
    path = estimate_spectra(ray, local).spectra()
    assert np.abs(np.diff(path, axis=0)).max() < 0.02  # no jump on the way out


def test_training_responses_are_inside(local):
    assert (
        np.mean((estimate_spectra(responses_of(TRAINING), local).flags & module.SpectralFlag.OUTSIDE_TRAINING) > 0)
        < 0.02
    )


def test_zero_negative_and_non_finite_responses(local):
    bad = np.array([[0, 0, 0], [-0.01, 0.2, 0.2], [np.nan, 0.5, 0.5], [np.inf, 0, 0], [1e39, 1.0, 1.0]])
    found = estimate_spectra(bad, local)
    np.testing.assert_array_equal(found.coefficients[0], 0.0)
    assert found.flags[1] & module.SpectralFlag.NEGATIVE_RESPONSE
    for row in (2, 3, 4):
        assert found.flags[row] == module.SpectralFlag.NOT_FINITE
        np.testing.assert_array_equal(found.coefficients[row], 0.0)
    assert found.counts["not_finite"] == 3
    assert found.counts["negative_response"] == 1
    assert np.isfinite(found.sigma).all()
    huge = estimate_spectra(np.full((1, 3), 3e38), local)  # within float32: finite, and flagged for what it is
    assert np.isfinite(huge.coefficients).all()
    assert huge.flags[0] & module.SpectralFlag.OUTSIDE_TRAINING


@given(st.lists(st.floats(width=32, allow_nan=True, allow_infinity=True), min_size=3, max_size=3))
@settings(max_examples=200, deadline=None)
def test_nothing_unflagged_is_not_finite(values):
    local = _cached_local()
    found = estimate_spectra(np.array(values), local)
    assert np.isfinite(found.coefficients).all()
    assert np.isfinite(found.sigma).all()
    spectrum = found.spectra()
    if not found.flags:
        assert spectrum.min() >= -0.0101
        assert spectrum.max() <= 1.0101


_LOCAL = []


def _cached_local():
    if not _LOCAL:
        _LOCAL.append(fit_estimator(TRAINING, LAMP, camera(3), centres=100))
    return _LOCAL[0]


def test_flag_outside_unit_is_the_definition(local):
    rng = np.random.default_rng(4)
    found = estimate_spectra(rng.random((500, 3)) ** 2, local)
    spectra = found.spectra()
    low, high = spectra.min(axis=1), spectra.max(axis=1)
    clear = (np.abs(low + 0.01) > 1e-5) & (np.abs(high - 1.01) > 1e-5)
    expected = (low < -0.01) | (high > 1.01)
    assert expected.any()
    assert not expected.all()
    np.testing.assert_array_equal(((found.flags & module.SpectralFlag.OUTSIDE_UNIT) > 0)[clear], expected[clear])


# Interfaces ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", module.METHODS)
def test_round_trip_through_arrays(method, tmp_path):
    e = fit_estimator(TRAINING, LAMP, camera(3), method=method, centres=50)
    np.savez(tmp_path / "estimator.npz", **e.as_arrays())
    with np.load(tmp_path / "estimator.npz", allow_pickle=False) as arrays:
        again = module.SpectralEstimator.from_arrays(arrays)
    assert again.method == method
    assert isinstance(again.ill_conditioned, bool)
    seen = responses_of(UNSEEN)
    for name in ("coefficients", "sigma", "flags"):
        np.testing.assert_array_equal(*(getattr(estimate_spectra(seen, x), name) for x in (e, again)))


def test_threads_tiles_and_layout_change_nothing(local):
    image = np.random.default_rng(0).random((130, 170, 3))
    whole = estimate_spectra(image, local, threads=1)
    for other in (estimate_spectra(image, local, threads=5), estimate_spectra(np.asfortranarray(image), local)):
        np.testing.assert_array_equal(whole.coefficients, other.coefficients)
        np.testing.assert_array_equal(whole.flags, other.flags)
    tile = estimate_spectra(image[40:77, 5:9], local)
    np.testing.assert_array_equal(whole.coefficients[40:77, 5:9], tile.coefficients)
    assert estimate_spectra(np.empty((0, 3)), local).coefficients.shape == (0, 12)


def test_fit_is_deterministic():
    first, second = (fit_estimator(TRAINING, LAMP, camera(3), centres=50).as_arrays() for _ in range(2))
    for name, value in first.items():
        np.testing.assert_array_equal(value, second[name])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"method": "magic"}, "magic"),
        ({"noise": -1.0}, "noise"),
        ({"noise": np.nan}, "noise"),
        ({"centres": 0}, "centres"),
        ({"bases": 1}, "bases"),
    ],
)
def test_bad_settings_are_named(change, words):
    with pytest.raises(UserError, match=words):
        fit_estimator(TRAINING, LAMP, camera(3), **change)


def test_wrong_number_of_channels(local):
    with refused(UserError, "3", by="estimate_spectra"):
        estimate_spectra(np.ones((4, 4)), local)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_tiny_training_sets_work(count):
    e = fit_estimator(TRAINING[:count], LAMP, camera(3))
    found = estimate_spectra(responses_of(TRAINING[:count]), e)
    assert np.sqrt(np.mean((found.spectra() - TRAINING[:count]) ** 2, axis=1)).max() < 0.06
