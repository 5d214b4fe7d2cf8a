"""Normals by least squares and by the lobe model: against dense solutions, known fields, extremes, real objects."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nishiki.brdf.torrance_sparrow import body_factor
from nishiki.errors import UserError
from nishiki.photometric.body import diffuse_reflectance
from nishiki.photometric.flags import NO_ESTIMATE, NormalFlag
from nishiki.photometric.light_selection import select_diffuse
from nishiki.photometric.normal_kernels import AT_LEAST, PRIOR, WIDTH
from nishiki.photometric.solve import estimate_normals


def directions_of(count, lowest=0.3):
    """Lights spread evenly over a dome, by the golden angle."""
    k = np.arange(count) + 0.5
    z = lowest + (0.98 - lowest) * k / count
    angle, radius = k * np.pi * (3 - np.sqrt(5)), np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def tilted(pixels, seed, most=0.6):
    rng = np.random.default_rng(seed)
    tilt, turn = rng.uniform(0, most, pixels), rng.uniform(0, 2 * np.pi, pixels)
    return np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], axis=1)


def angle(found, truth):
    """Degrees between unit vectors, exact for small angles."""
    return np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(found - truth, axis=-1) / 2, 0, 1)))


def matt(count, pixels, seed, noise=0.0):
    lights, normals = directions_of(count), tilted(pixels, seed)
    albedo = np.random.default_rng(seed).uniform(0.1, 0.9, pixels)
    stack = np.maximum(lights @ normals.T, 0) * albedo
    stack = stack + noise * np.random.default_rng(seed + 1).standard_normal(stack.shape)
    return stack.astype(np.float32).reshape(count, 1, pixels), lights, normals, albedo


@pytest.mark.parametrize("solver", ["least_squares", "lobe"])
def test_matt_surfaces_are_exact(solver):
    stack, lights, normals, albedo = matt(24, 500, 1)
    field = estimate_normals(stack, lights, usable=stack > 0, solver=solver)
    assert angle(field.normals[0], normals).max() < 2e-3
    np.testing.assert_allclose(field.albedo[0], albedo, rtol=2e-4)
    assert (field.flags == 0).all()
    np.testing.assert_allclose(np.linalg.norm(field.normals, axis=-1), 1, atol=1e-6)


@pytest.mark.parametrize("kind", ["all", "usable", "light weights", "sample weights"])
def test_least_squares_equals_the_dense_solution(kind):
    rng = np.random.default_rng(4)
    lights = directions_of(19)
    stack = rng.uniform(0, 1, (19, 3, 50)).astype(np.float32)
    usable = rng.uniform(size=stack.shape) > 0.4 if kind != "all" else None
    weights = {"light weights": rng.uniform(0, 2, 19), "sample weights": rng.uniform(0, 2, stack.shape)}.get(kind)
    field = estimate_normals(stack, lights, usable=usable, weights=weights, solver="least_squares", max_condition=1e9)
    w = np.ones(stack.shape) if weights is None else np.float32(weights).reshape(19, *np.shape(weights)[1:] or (1, 1))
    w = w * (np.ones(stack.shape) if usable is None else usable)
    for r in range(3):
        for p in range(50):
            root = np.sqrt(w[:, r, p].astype(np.float64))
            b, *_ = np.linalg.lstsq(lights * root[:, None], stack[:, r, p] * root, rcond=None)
            matrix = (lights * w[:, r, p, None]).T @ lights
            np.testing.assert_allclose(field.normals[r, p], b / np.linalg.norm(b), atol=1e-6)
            np.testing.assert_allclose(field.albedo[r, p], np.linalg.norm(b), rtol=1e-6)
            np.testing.assert_allclose(field.condition[r, p], np.linalg.cond(matrix), rtol=1e-6)
            squares = np.sum(w[:, r, p] * (stack[:, r, p] - lights @ b) ** 2)
            np.testing.assert_allclose(field.residual[r, p], np.sqrt(squares / w[:, r, p].sum()), rtol=1e-5)
            assert field.lights_used[r, p] == np.count_nonzero(w[:, r, p])


def test_sigma_is_the_scatter_of_repeated_measurements():
    noise, trials = 0.01, 4000
    lights, normal = directions_of(16), np.array([0.3, -0.2, np.sqrt(0.87)])
    rng = np.random.default_rng(5)
    stack = 0.6 * (lights @ normal)[:, None] + noise * rng.standard_normal((16, trials))
    field = estimate_normals(stack.astype(np.float32)[:, None], lights, solver="least_squares")
    scatter = np.sqrt(np.mean(np.radians(angle(field.normals[0], normal)) ** 2))
    assert np.sqrt(np.mean(field.sigma[0] ** 2)) == pytest.approx(scatter, rel=0.05)


def lobe_scene(count, pixels, seed, b=0.15, d=0.3, exponent=8, noise=0.0):
    lights, normals = directions_of(count), tilted(pixels, seed, 0.5)
    halves = lights + np.array([0, 0, 1])
    halves /= np.linalg.norm(halves, axis=1, keepdims=True)
    c, x = np.maximum(lights @ normals.T, 0), np.maximum(halves @ normals.T, 0)
    stack = c * (0.5 + b * c + d * x**exponent)
    stack = stack + noise * np.random.default_rng(seed).standard_normal(stack.shape)
    return stack.astype(np.float32).reshape(count, 1, pixels), lights, halves, normals


@pytest.mark.parametrize("exponent", [4, 8, 16])
def test_the_lobe_removes_what_lambert_leaves(exponent):
    stack, lights, _, normals = lobe_scene(40, 300, 6, exponent=exponent)
    usable = select_diffuse(stack, lights).usable
    lambert = estimate_normals(stack, lights, usable=usable, solver="least_squares")
    lobe = estimate_normals(stack, lights, usable=usable, valid=stack > 0, solver="lobe")
    assert angle(lobe.normals[0], normals).mean() < 0.35 * angle(lambert.normals[0], normals).mean()


def test_the_body_shading_predicts_lights_that_were_left_out():
    """Truth has a fall-off and a skirt of another exponent; predictions with (a, b, d) beat Lambert's several times."""
    stack, lights, halves, _ = lobe_scene(41, 200, 12, b=-0.2, exponent=6)
    fit = np.arange(41) % 5 != 2
    usable = stack[fit] > 0.02
    found = estimate_normals(stack[fit], lights[fit], usable=usable, solver="lobe")
    lambert = estimate_normals(stack[fit], lights[fit], usable=usable, solver="least_squares")
    errors = {}
    for name, field in (("lobe", found), ("lambert", lambert)):
        rho = diffuse_reflectance(
            stack[fit][..., None], lights[fit], field.normals, usable=usable, shading=field.shading
        ).reflectance[0, :, 0]
        c, x = (np.maximum(vectors[~fit] @ field.normals[0].T, 0) for vectors in (lights, halves))
        shading = None if field.shading is None else field.shading[0]
        predicted = rho * c * body_factor(shading, c, x)
        errors[name] = np.abs(predicted - stack[~fit, 0]).mean()
    assert errors["lobe"] < 0.2 * errors["lambert"]
    assert lambert.shading is None
    # scaled to 1 over the samples of the fit, so that the reflectance stays near Lambert's
    c, x = (np.maximum(vectors[fit] @ found.normals[0].T, 0) for vectors in (lights, halves))
    used = usable[:, 0] * c**2
    mean = (used * body_factor(found.shading[0], c, x)).sum(0) / used.sum(0)
    np.testing.assert_allclose(np.median(mean), 1, atol=0.02)


def test_where_the_lobe_is_not_tried_the_body_shading_is_lamberts():
    stack, lights, _, _ = lobe_scene(5, 20, 3)
    field = estimate_normals(stack, lights, usable=stack > 0)
    assert (field.flags & NormalFlag.FALLBACK).any()
    assert (field.shading[(field.flags & NormalFlag.FALLBACK) != 0] == (1, 0, 0)).all()


def test_the_lobe_equals_a_general_optimiser():
    """Same penalised objective, minimised by SciPy from the Lambertian start, all samples kept."""
    from scipy.optimize import least_squares

    stack, lights, halves, _ = lobe_scene(24, 25, 7, noise=0.004)
    usable = stack > 0.05  # well above the noise: lit for certain
    start = estimate_normals(stack, lights, usable=usable, solver="least_squares")
    # A noise level above every residual keeps every lit sample in the second choice.
    field = estimate_normals(stack, lights, usable=usable, solver="lobe", noise=10.0)
    for p in range(25):
        data, keep = stack[:, 0, p] / start.albedo[0, p].astype(np.float64), usable[:, 0, p]
        n0 = start.normals[0, p].astype(np.float64)
        held = PRIOR * start.lights_used[0, p] / 3 + (start.residual[0, p] / start.albedo[0, p] / WIDTH) ** 2

        def unit(v):
            return v / np.linalg.norm(v)

        def cost(u, n0=n0, data=data, keep=keep, held=held):
            n = unit(n0 + u[0] * unit(np.cross(n0, [0, 1, 0])) + u[1] * unit(np.cross(n0, [1, 0, 0])))
            c, x = np.maximum(lights @ n, 0), np.maximum(halves @ n, 1e-3)
            r = (data - c * (u[2] + u[3] * c + u[4] * x**8))[keep]
            return np.concatenate([r, np.sqrt(held) * u[3:5]])

        best = least_squares(cost, [0, 0, 1, 0, 0], xtol=1e-14, ftol=1e-14, gtol=1e-14)
        n = unit(n0 + best.x[0] * unit(np.cross(n0, [0, 1, 0])) + best.x[1] * unit(np.cross(n0, [1, 0, 0])))
        assert angle(field.normals[0, p], n) < 0.06  # the step at which the descent ends: 1e-3 rad
        residual = np.sqrt(np.mean(best.fun[:-2] ** 2)) * start.albedo[0, p]
        assert field.residual[0, p] == pytest.approx(residual, rel=5e-3)


def test_what_cannot_be_estimated_is_flagged_and_finite():
    lights = np.concatenate([directions_of(6), [[0.6, 0, 0.8], [-0.6, 0, 0.8], [0, 0, 1]]])
    stack = np.full((9, 1, 6), 0.5, dtype=np.float32)
    usable = np.ones(stack.shape, dtype=bool)
    usable[2:, 0, 0] = False  # two lights
    usable[:6, 0, 1] = False  # three lights in the plane y = 0
    stack[:, 0, 2] = 0  # black
    usable[:, 0, 3] = False  # nothing
    usable[3:, 0, 4] = False  # exactly three lights
    stack[0, 0, 5] = np.nan
    for solver in ("least_squares", "lobe"):
        field = estimate_normals(stack, lights, usable=usable, solver=solver)
        flags = field.flags[0]
        assert flags[0] & NormalFlag.TOO_FEW_LIGHTS
        assert flags[1] & NormalFlag.COPLANAR_LIGHTS
        assert flags[2] & NormalFlag.NO_SIGNAL
        assert flags[3] & NormalFlag.TOO_FEW_LIGHTS
        assert flags[4] & NormalFlag.NO_REDUNDANCY
        assert not flags[4] & NO_ESTIMATE
        assert not flags[5] & NO_ESTIMATE
        assert field.lights_used[0, 5] <= 8
        np.testing.assert_array_equal(field.normals[0, :4], np.tile([0, 0, 1], (4, 1)))
        for name in ("normals", "albedo", "sigma", "condition", "residual"):
            assert np.isfinite(getattr(field, name)).all()
        assert (field.sigma[0, :5] == np.float32(np.pi / 2)).all()
        assert field.diagnostics["flagged_too_few_lights"] == 2


def test_a_bad_condition_is_flagged():
    lights = np.array([[0, 0, 1], [0.01, 0, 1], [0, 0.01, 1], [0.01, 0.01, 1]])
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    field = estimate_normals(np.full((4, 1, 1), 0.5, np.float32), lights, solver="least_squares", max_condition=1e4)
    assert field.flags[0, 0] & NormalFlag.ILL_CONDITIONED
    assert field.condition[0, 0] > 1e4


def test_few_lights_fall_back_on_lambert():
    stack, lights, _, _ = matt(AT_LEAST - 1, 50, 3)
    field = estimate_normals(stack, lights, solver="lobe")
    assert (field.flags & NormalFlag.FALLBACK).all()
    same = estimate_normals(stack, lights, solver="least_squares")
    np.testing.assert_array_equal(field.normals, same.normals)


@pytest.mark.parametrize("solver", ["least_squares", "lobe"])
def test_a_pixel_does_not_depend_on_the_tile(solver):
    stack, lights, _, _ = lobe_scene(20, 801, 8, noise=0.01)
    usable = select_diffuse(stack, lights).usable
    for mask in (usable, None):
        whole = estimate_normals(stack, lights, usable=mask, solver=solver)
        for a, b in ((0, 1), (1, 258), (258, 801)):
            part = estimate_normals(
                stack[:, :, a:b], lights, usable=None if mask is None else mask[:, :, a:b], solver=solver
            )
            for name in ("normals", "albedo", "sigma", "condition", "residual", "lights_used", "flags"):
                np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[:, a:b])


@settings(max_examples=40, deadline=None)
@given(power=st.floats(-6, 6), seed=st.integers(0, 99), solver=st.sampled_from(["least_squares", "lobe"]))
def test_twelve_orders_of_radiometric_scale(power, seed, solver):
    stack, lights, _, _ = lobe_scene(15, 20, seed, noise=0.003)
    one = estimate_normals(stack, lights, usable=stack > 0, solver=solver)
    scale = np.float32(10.0**power)
    other = estimate_normals(stack * scale, lights, usable=stack > 0, solver=solver)
    assert angle(other.normals, one.normals).max() < 0.02
    np.testing.assert_allclose(other.albedo, one.albedo * scale, rtol=1e-3)
    np.testing.assert_array_equal(other.flags, one.flags)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    lights=st.integers(3, 20),
    scale=st.sampled_from([1e-30, 1e-6, 1.0, 1e6, 1e15]),
    solver=st.sampled_from(["least_squares", "lobe"]),
)
def test_nothing_that_is_not_finite_leaves(seed, lights, scale, solver):
    """Any numbers, any lights in the upper half space, any mask: finite, of unit length, flagged where unknown."""
    rng = np.random.default_rng(seed)
    directions = rng.standard_normal((lights, 3))
    directions[:, 2] = np.abs(directions[:, 2])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    stack = (rng.standard_normal((lights, 2, 8)) ** 3 * scale).astype(np.float32)
    stack[rng.uniform(size=stack.shape) < 0.1] = rng.choice([np.nan, np.inf, 0.0])
    selection = select_diffuse(stack, directions)
    field = estimate_normals(stack, directions, usable=selection.usable, solver=solver)
    for name in ("normals", "albedo", "sigma", "condition", "residual"):
        assert np.isfinite(getattr(field, name)).all(), name
    np.testing.assert_allclose(np.linalg.norm(field.normals, axis=-1), 1, atol=1e-5)
    assert (field.albedo[field.valid] > 0).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"solver": "magic"}, "magic"),
        ({"weights": np.ones(5)}, r"\(5,\)"),
        ({"weights": -np.ones(9), "solver": "least_squares"}, "weights"),
        ({"weights": np.ones(9), "solver": "lobe"}, "weights"),
        ({"usable": np.ones((9, 1, 3), dtype=bool)}, r"\(9, 1, 4\)"),
    ],
)
def test_mistakes_are_named(change, message):
    stack, lights, _, _ = matt(9, 4, 1)
    with pytest.raises(UserError, match=message):
        estimate_normals(stack, lights, **change)


def diligent(folder):
    """Observations (lights, 1, pixels), directions and true normals of the pixels in the mask."""
    mask = cv2.imread(str(folder / "mask.png"), cv2.IMREAD_GRAYSCALE) > 0
    lights = np.loadtxt(folder / "light_directions.txt")
    scale = np.loadtxt(folder / "light_intensities.txt")
    grey = []
    for k in range(len(lights)):
        image = cv2.imread(str(folder / f"{k + 1:03d}.png"), cv2.IMREAD_UNCHANGED)[..., ::-1][mask] / 65535
        grey.append(np.clip((image / scale[k]) @ [0.2989, 0.5870, 0.1140], 0, 1))
    truth = np.load(folder / "normals_gt.npz")["normals"][mask]
    stack = np.array(grey, dtype=np.float32)[:, None]
    return stack, lights / np.linalg.norm(lights, axis=1, keepdims=True), truth


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize(("name", "plain", "best"), [("diligent_ball", 4.10, 1.75), ("diligent_cat", 8.41, 4.7)])
def test_real_objects(data, name, plain, best):
    stack, lights, truth = diligent(data / name)
    every = estimate_normals(stack, lights, solver="least_squares")
    assert angle(every.normals[0], truth).mean() == pytest.approx(plain, abs=0.02)
    selection = select_diffuse(stack, lights)
    robust = estimate_normals(stack, lights, usable=selection.usable, solver="least_squares")
    assert angle(robust.normals[0], truth).mean() <= {4.10: 2.0, 8.41: 6.6}[plain]
    default = estimate_normals(stack, lights, usable=selection.usable)
    assert angle(default.normals[0], truth).mean() <= best
    assert default.valid.all()
