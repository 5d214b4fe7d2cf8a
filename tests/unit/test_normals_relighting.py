"""The fit for relighting: against SciPy, shadows and highlights, what it keeps, real lamps left out."""

import numpy as np
from refusals import refused
from scipy.optimize import least_squares

from nishiki.brdf.torrance_sparrow import body_factor
from nishiki.errors import UserError
from nishiki.photometric.relighting import KINK, NOISE, PRIOR, WIDTH, fit_relighting


def cone(count=12, seed=1):
    rng = np.random.default_rng(seed)
    lights = rng.normal(size=(count, 3)) * [0.25, 0.25, 0] + [0, 0, 1]
    return lights / np.linalg.norm(lights, axis=1, keepdims=True)


def scene(pixels=60, seed=2, b=-0.1, d=0.0):
    rng = np.random.default_rng(seed)
    lights = cone()
    normals = rng.normal(size=(pixels, 3)) * [0.4, 0.4, 0] + [0, 0, 1]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    rho = rng.uniform(0.2, 0.9, (pixels, 3))
    return lights, normals, rho, shade(normals, lights, b, d)[..., None] * rho


def shade(normals, lights, b, d):
    halves = lights + np.array([0, 0, 1])
    halves /= np.linalg.norm(halves, axis=1, keepdims=True)
    c, x = np.maximum(lights @ normals.T, 0), np.maximum(halves @ normals.T, 0)
    return c * (1 + b * c + d * x**8)


def fit(stack, lights, start, scatter=0.02, **changes):
    pixels = len(start)
    given = {
        "valid": np.ones((len(lights), 1, pixels), bool),
        "scatter": np.full((1, pixels), scatter),
        "reflectance": np.full((1, pixels, stack.shape[-1]), 7.0),
        "shading": np.tile(np.float32([1, 0, 0]), (1, pixels, 1)),
    } | changes
    return fit_relighting(stack[:, None].astype(np.float32), lights, start[None].astype(np.float32), **given)


def predicted(found, lights):
    normals = found["shading_normals"][0].astype(float)
    halves = lights + np.array([0, 0, 1])
    halves /= np.linalg.norm(halves, axis=1, keepdims=True)
    c, x = np.maximum(lights @ normals.T, 0), np.maximum(halves @ normals.T, 0)
    factor = body_factor(found["shading"][0], c, x, lights[:, None, :2])
    return (c * factor)[..., None] * found["reflectance"][0]


def test_lambert_is_found_exactly_and_scaled_to_one():
    lights, normals, rho, stack = scene(b=0.0)
    found = fit(stack, lights, normals)
    np.testing.assert_allclose(found["shading_normals"][0], normals, atol=2e-5)
    np.testing.assert_allclose(found["shading"][0], np.tile([1, 0, 0], (60, 1)), atol=2e-4)
    np.testing.assert_allclose(found["reflectance"][0], rho, rtol=2e-4)


def test_the_direction_is_the_minimum_of_cauchys_cost():
    """The same objective (scale of the last round) by SciPy's trust region from the same start."""
    lights, normals, _, stack = scene(pixels=8, b=-0.2)
    stack = stack + 0.01 * np.random.default_rng(5).normal(size=stack.shape)
    scatter = 0.05
    found = fit(stack, lights, normals, scatter)["shading_normals"][0]
    for p in range(8):
        level = stack[:, p].mean(-1)
        cosine = np.maximum(lights @ normals[p], 0)
        level = level / (cosine @ level / (cosine @ cosine))
        held = np.full(3, (scatter / WIDTH) ** 2 + PRIOR * len(lights) / 3)
        g = normals[p]
        for _ in range(30):  # the scale follows the residuals, as in the fit
            r = level - lights @ g
            scale = KINK * (1.4826 * np.median(np.abs(r)) * np.sqrt(len(r) / (len(r) - 2)) + NOISE)

            def residuals(g, scale=scale, level=level, held=held, p=p):
                robust = scale * np.sqrt(np.log1p(((level - lights @ g) / scale) ** 2))
                return np.concatenate([robust, np.sqrt(held) * (g - normals[p])])

            g = least_squares(residuals, g, xtol=1e-12, ftol=1e-12, gtol=1e-12).x
        assert np.degrees(np.arccos(min(found[p] @ g / np.linalg.norm(g), 1))) < 0.3


def test_shadows_and_highlights_do_not_spoil_the_prediction():
    lights, normals, _, stack = scene()
    spoilt = stack.copy()
    spoilt[2], spoilt[7] = 0.0, stack[7] + 0.8
    found = fit(spoilt, lights, normals)
    kept = np.setdiff1d(np.arange(12), [2, 7])
    error = np.abs(predicted(found, lights) - stack)[kept].mean()
    scaled = np.linalg.lstsq(lights, spoilt.mean(-1), rcond=None)[0]
    plain = np.abs(lights @ scaled - stack.mean(-1))[kept].mean()
    assert error < 0.2 * plain


def test_a_start_that_is_far_off_is_left_behind():
    lights, normals, _, stack = scene()
    wrong = normals * [-1, -1, 1]
    assert np.abs(predicted(fit(stack, lights, wrong, 0.05), lights) - stack).mean() < 0.02


def test_what_cannot_be_fitted_stays():
    lights, normals, _, stack = scene(pixels=6)
    dark = stack.copy()
    dark[:, 1] = 0.0
    valid = np.ones((len(lights), 1, 6), bool)
    valid[:, 0, 0] = False
    found = fit(dark, lights, normals, valid=valid)
    for p in (0, 1):
        np.testing.assert_array_equal(found["shading_normals"][0, p], normals[p].astype(np.float32))
        assert (found["reflectance"][0, p] == 7).all()
    assert all(np.isfinite(values).all() for values in found.values())
    assert (found["reflectance"][0, 2:] < 1).all()
    with refused(UserError, by="fit_relighting"):
        fit(stack, lights[:5], normals)


def test_black_pixels_are_quiet_in_several_threads(monkeypatch):
    """Warnings are errors in tests, and each thread has its own state of NumPy's."""
    lights, normals, _, stack = scene(2000)
    stack[:, ::7] = 0
    results = []
    for number in ("1", "2"):
        monkeypatch.setenv("NUMBA_NUM_THREADS", number)
        results.append(fit(stack, lights, normals))
    for name, values in results[0].items():
        np.testing.assert_array_equal(values, results[1][name])


def test_samples_that_are_not_valid_count_for_nothing():
    lights, normals, _, stack = scene()
    valid = np.ones((12, 1, 60), bool)
    valid[4] = False
    broken = stack.copy()
    broken[4] = 1e30
    np.testing.assert_array_equal(
        fit(broken, lights, normals, valid=valid)["reflectance"],
        fit(stack, lights, normals, valid=valid)["reflectance"],
    )


def test_directional_terms_are_the_least_squares_solution():
    """Shadows from one side, which the robust fit leaves out, are predicted; reference: NumPy along the same normal."""
    lights, normals, _, stack = scene(pixels=20)
    lights = cone(40, seed=7)
    side = np.random.default_rng(3).uniform(-1, 1, (20, 2))
    shaded = 1 / (1 + np.exp(-6 * (lights[:, :2] @ side.T + 0.3)))
    stack = (shade(normals, lights, -0.1, 0.0) * shaded)[..., None] * np.float64([0.5, 0.4, 0.3])
    plain, found = fit(stack, lights, normals), fit(stack, lights, normals, model="directional")
    assert found["shading"].shape == (1, 20, 5)
    np.testing.assert_array_equal(found["shading_normals"][0], normals.astype(np.float32))  # many lights: kept
    halves = lights + np.array([0, 0, 1])
    halves /= np.linalg.norm(halves, axis=1, keepdims=True)
    for p in range(20):
        c, x = np.maximum(lights @ normals[p], 0), np.maximum(halves @ normals[p], 0)
        basis = np.stack([c, c * c, c * x**8, c * lights[:, 0], c * lights[:, 1]], axis=1)
        level = stack[:, p].mean(-1)
        level *= (c @ c) / (c @ level)
        prior = PRIOR * len(lights) / 3 * np.diag([0.0, 1, 1, 1, 1])
        right = basis.T @ level
        terms = np.linalg.solve(basis.T @ basis + prior, right)
        ratio = found["shading"][0, p] / terms
        np.testing.assert_allclose(ratio, ratio[0], rtol=2e-3)
    error = [np.abs(predicted(maps, lights) - stack).mean() for maps in (found, plain)]
    assert error[0] < 0.8 * error[1]
