"""Sparse solving: the texel and the image domain, refinement of parameters, paper's counting."""

import numpy as np
import pytest
from texel_domain import keep_by_pursuit, keep_largest, largest, masked_operator

from nishiki.codec.allocate import principal_channels
from nishiki.codec.design import extent_of, view_matrix
from nishiki.codec.solve import Footprints, Operator, samples_of, solve
from nishiki.codec.tile_code import TileMaps, TileSurface, model_factors, predict_texels, refine, texel_weights
from nishiki.codec.transform import Block, plane_transform
from nishiki.colour.colour import encoding_slope


def block_of(views=6, size=16, wavelet="db2", lights=1):
    plane = plane_transform(wavelet, size, size, 3)
    return Block(plane, view_matrix("cosine", views), view_matrix("cosine", lights))


def smooth_block(rng, block, shape, count=40):
    """Samples of a few strong coefficients."""
    coefficients = np.zeros(shape)
    places = rng.choice(coefficients.size // 8, count, replace=False)
    coefficients.ravel()[places] = rng.choice([-1, 1], count) * rng.uniform(1, 3, count)
    return coefficients, block.inverse(coefficients)


def test_without_a_threshold_the_pictures_are_met():
    rng = np.random.default_rng(0)
    block, shape = block_of(views=4, size=8), (2, 1, 4, 8, 8)
    feet = Footprints.of(rng.integers(0, 4, 900), *rng.uniform(0, 7, (2, 900)).astype(np.float32), (4, 8, 8))
    data = rng.standard_normal((2, 900))
    found = solve(data, Operator.of_pixels(feet), block, shape, threshold=0.0, iterations=400)
    error = np.sum((data - feet.look_up(samples_of(block, found))) ** 2)
    texels, *_ = np.linalg.lstsq(_matrix(feet, 256), data.T, rcond=None)
    least = np.sum((data.T - _matrix(feet, 256) @ texels) ** 2)
    assert error == pytest.approx(least, rel=1e-3)


def _matrix(feet, texels):
    return np.stack([feet.look_up(row.reshape(1, *feet.shape))[0] for row in np.eye(texels)], axis=1)


def test_hidden_samples_cost_nothing():
    """A third of the samples is seen; the few coefficients that made them come back, also where nothing is seen."""
    rng = np.random.default_rng(1)
    block, shape = block_of(), (1, 1, 6, 16, 16)
    _, samples = smooth_block(rng, block, shape, count=12)
    visible = rng.random((6, 16, 16)) < 0.35
    operator = masked_operator(visible)
    data = operator.look(samples.reshape(1, 6, 16, 16))
    found = solve(data, operator, block, shape, threshold=0.2, iterations=300)
    assert np.count_nonzero(found) < 30
    np.testing.assert_allclose(samples_of(block, found), samples.reshape(1, 6, 16, 16), atol=0.05)
    direct = block.forward(np.where(visible, samples, 0))
    assert np.count_nonzero(np.abs(direct) > 0.2) > 3 * np.count_nonzero(found)


def test_nothing_seen_gives_nothing():
    operator = masked_operator(np.zeros((6, 16, 16), bool))
    found = solve(
        np.zeros((1, 6, 16, 16), np.float32), operator, block_of(), (1, 1, 6, 16, 16), threshold=0.1, iterations=5
    )
    assert not found.any()


@pytest.mark.parametrize("share", [2e-43, 1e-38, 1e-30])
def test_samples_of_next_to_no_weight_stay_finite(share):
    root, block = np.float32(np.sqrt(share)), block_of(views=1)
    operator = Operator(lambda v: v * root, lambda v: v * root, share)
    data = np.full((1, 1, 16, 16), root, np.float32)
    found = solve(data, operator, block, (1, 1, 1, 16, 16), threshold=0.1, iterations=60)
    assert np.isfinite(found).all()


def test_keeping_the_largest_loses_the_discarded_energy():
    rng = np.random.default_rng(2)
    blocks = [block_of(), block_of(views=7)]
    residuals = [rng.standard_normal((2, 1, views, 16, 16)) for views in (6, 7)]
    seen = [np.ones((1, views, 16, 16), bool) for views in (6, 7)]
    kept = keep_largest(residuals, seen, blocks, count=2000, rounds=0)
    assert sum(np.count_nonzero(c) for c in kept.coefficients) == 2000
    assert kept.error == pytest.approx(kept.discarded, rel=1e-9)
    single = keep_largest([r.astype(np.float32) for r in residuals], seen, blocks, count=2000, rounds=0)
    assert single.error == pytest.approx(single.discarded, rel=1e-5)
    everything = keep_largest(residuals, seen, blocks, count=10**7, rounds=0)
    assert everything.error < 1e-18


def test_rounds_of_filling_lower_the_error():
    rng = np.random.default_rng(3)
    block, shape = block_of(), (1, 1, 6, 16, 16)
    _, samples = smooth_block(rng, block, shape, count=60)
    seen = rng.random((1, 6, 16, 16)) < 0.4
    errors = [keep_largest([samples], [seen], [block], count=80, rounds=rounds).error for rounds in (0, 4, 12)]
    assert errors[0] > 1.3 * errors[1] > 1.3 * errors[2]


def test_pursuit_of_visible_samples_leaves_less_than_filling():
    rng = np.random.default_rng(8)
    blocks, sizes = [block_of(), block_of(views=7)], (6, 7)
    samples = [
        smooth_block(rng, b, (1, 1, n, 16, 16), count=80)[1].astype(np.float32)
        for b, n in zip(blocks, sizes, strict=True)
    ]
    samples = [values + 0.02 * rng.standard_normal(values.shape).astype(np.float32) for values in samples]
    seen = [rng.random((1, n, 16, 16)) < 0.5 for n in sizes]
    for count in (60, 120, 500):
        ours = keep_by_pursuit(samples, seen, blocks, count=count)
        assert sum(np.count_nonzero(c) for c in ours.coefficients) <= count
        error = sum(
            np.sum((values - b.inverse(c))[:, s] ** 2)
            for values, b, c, s in zip(samples, blocks, ours.coefficients, seen, strict=True)
        )
        assert ours.error == pytest.approx(error, rel=1e-4)
        assert ours.error < keep_largest(samples, seen, blocks, count=count, rounds=8).error


def test_threshold_of_counts():
    values = [np.array([3.0, -1.0]), np.array([2.0, 0.5])]
    assert largest(values, 2) == 2.0
    assert largest(values, 0) == np.inf
    assert largest(values, 9) == 0.0


def sphere_patch(size=12):
    i, j = np.meshgrid(np.linspace(-0.4, 0.4, size), np.linspace(-0.4, 0.4, size), indexing="ij")
    points = np.stack([j, -i, np.sqrt(1 - i**2 - j**2)], axis=-1).astype(np.float32)
    return TileSurface(points, points, np.ones((size, size), bool))


@pytest.mark.parametrize("encoding", ["linear", "srgb"])
def test_refined_parameters_make_the_pictures_right(encoding):
    from residual_source import scene_of

    rng = np.random.default_rng(4)
    surface, scene = sphere_patch(), scene_of(24)
    views = [0, 1, 2, 3, 21, 22, 23]
    centres, lamps = scene.centres[views], [scene.lamps[v] for v in views]
    truth = TileMaps(*(rng.uniform(0.1, 0.6, (12, 12, 3)).astype(np.float32) for _ in range(2)), np.full((12, 12), 0.2))
    truth = TileMaps(truth.kd, truth.ks * 0.3, truth.sigma.astype(np.float32))
    texels = predict_texels(truth.kd, truth.ks, truth.sigma, surface, centres, lamps, encoding)
    feet = Footprints.of(rng.integers(0, 7, 3000), *rng.uniform(0, 11, (2, 3000)).astype(np.float32), (7, 12, 12))
    values = feet.look_up(texels)
    blurred = TileMaps(np.full_like(truth.kd, truth.kd.mean()), np.float32(1.2) * truth.ks, truth.sigma)
    factors = model_factors(3, surface, centres, lamps)
    again = predict_texels(truth.kd, truth.ks, truth.sigma, surface, centres, lamps, "linear")
    lobe = factors.lobe(truth.sigma)
    built = factors.irradiance * np.moveaxis(truth.kd, -1, 0)[:, None] + lobe * np.moveaxis(truth.ks, -1, 0)[:, None]
    np.testing.assert_allclose(built, again, atol=2e-5)

    def error(maps):
        found = predict_texels(maps.kd, maps.ks, maps.sigma, surface, centres, lamps, encoding)
        return float(np.mean((feet.look_up(found) - values) ** 2))

    refined = refine(blurred, factors, feet, values, encoding, iterations=60)
    assert error(refined) < 0.02 * error(blurred)
    assert (refined.kd >= 0).all()
    weights = texel_weights(truth, factors, feet, encoding)
    for name, change in (("kd", 1e-2), ("ks", 1e-2)):
        moved = getattr(truth, name).copy()
        moved[5, 5, 1] += change
        changed = TileMaps(**{**truth.__dict__, name: moved})
        rise = error(changed) * values.size / change**2
        assert rise <= 1.1 * getattr(weights, name)[5, 5, 1]


def test_gloss_that_no_view_comes_near_does_not_grow():
    from residual_source import scene_of

    surface, scene = sphere_patch(), scene_of(24)
    views = [0, 1, 2, 3, 21, 22, 23]
    centres, lamps = scene.centres[views], [scene.lamps[v] for v in views]
    kd, ks = (np.full((12, 12, 3), value, np.float32) for value in (0.4, 0.3))
    factors = model_factors(3, surface, centres, lamps)
    least = float(factors.squared_angle[factors.strength > 0].min())
    maps = TileMaps(kd, ks, np.full((12, 12), np.sqrt(least / 600), np.float32))
    rng = np.random.default_rng(5)
    feet = Footprints.of(rng.integers(0, 7, 3000), *rng.uniform(0, 11, (2, 3000)).astype(np.float32), (7, 12, 12))
    texels = predict_texels(kd, ks, maps.sigma, surface, centres, lamps, "linear")
    values = feet.look_up(texels) + 0.1  # what the model has no term for
    assert 0 < factors.lobe(maps.sigma).max() < 1e-4
    refined = refine(maps, factors, feet, values, "linear", iterations=12)
    np.testing.assert_allclose(refined.ks, ks, atol=0.01)


def test_slope_of_the_encoding():
    from nishiki.colour.colour import encode

    at = np.array([0.001, 0.01, 0.2, 0.9])
    steps = (encode(at + 1e-7, "srgb") - encode(at - 1e-7, "srgb")) / 2e-7
    np.testing.assert_allclose(encoding_slope(at, "srgb"), steps, rtol=1e-5)
    assert (encoding_slope(at, "linear") == 1).all()


def test_colours_are_orthonormal_and_sorted():
    rng = np.random.default_rng(5)
    data = rng.standard_normal((3, 500)) * np.array([[0.1], [3.0], [1.0]])
    rows = principal_channels(data @ data.T)
    np.testing.assert_allclose(rows @ rows.T, np.eye(3), atol=1e-5)
    energy = np.sum((rows @ data) ** 2, axis=1)
    assert (np.diff(energy) < 0).all()
    np.testing.assert_array_equal(principal_channels(np.zeros((2, 2))), np.eye(2))


def test_extents():
    inside = np.zeros((64, 64), bool)
    inside[40:61, 3:9] = True
    seen = np.zeros(36, bool)
    seen[[34, 35, 0, 2]] = True
    extent = extent_of(seen, inside, full_turn=True, arcs=True)
    assert (extent.start, extent.length) == (34, 5)
    assert (extent.rows, extent.columns) == (32, 8)
    assert inside[extent.texels].sum() == inside.sum()
    np.testing.assert_array_equal(extent.observations(36, 2)[:6], [34, 35, 0, 1, 2, 70])
    whole = extent_of(seen, np.ones((20, 20), bool), full_turn=True, arcs=False)
    assert (whole.length, whole.rows, whole.columns) == (36, 20, 20)
    assert extent_of(np.zeros(4, bool), inside, full_turn=True, arcs=True).length == 0
