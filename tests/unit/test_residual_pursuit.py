"""Pursuit of the coefficients that are worth their bits: curvatures, costs, and what the solver finds."""

import numpy as np
import pytest

from nishiki.codec.design import view_matrix
from nishiki.codec.entropy import Model, bands_of, encode, train
from nishiki.codec.rate import bits_of, expected_bits, magnitudes, neighbourhoods
from nishiki.codec.solve import (
    Footprints,
    Operator,
    Pursuit,
    choose,
    curvatures,
    pursue,
    samples_of,
    settle,
    solve,
    transfers,
)
from nishiki.codec.transform import Block, plane_transform


def block_of(views=4, size=16, wavelet="bior4.4", levels=3, lights=1):
    plane = plane_transform(wavelet, size, size, levels)
    return Block(plane, view_matrix("db2", views), view_matrix("cosine", lights))


def pixels_of(rng, counts, size):
    """Footprints of so many pixels in each observation."""
    observation = np.repeat(np.arange(len(counts)), counts)
    s, t = rng.uniform(0, size - 1, (2, len(observation))).astype(np.float32)
    return Footprints.of(observation, s, t, (len(counts), size, size))


def flat(_):
    return np.float32(1)


def test_transfer_of_a_look_up_is_its_mean_over_places_and_frequencies():
    plane = plane_transform("haar", 16, 16, 2)
    at, frequency = np.meshgrid((np.arange(200) + 0.5) / 200, (np.arange(2000) + 0.5) / 2000, indexing="ij")
    for place, (low, high) in ((12, (np.pi / 2, np.pi)), (5, (np.pi / 4, np.pi / 2))):
        passed = np.abs(1 - at + at * np.exp(1j * (low + (high - low) * frequency))) ** 2
        assert transfers(plane)[0, place] == pytest.approx(passed.mean(), rel=1e-4)
    assert transfers(plane)[0, 0] == 1


@pytest.mark.parametrize("wavelet", ["sym4", "bior4.4"])
def test_curvatures_are_what_a_coefficient_does_to_the_pictures(wavelet):
    rng = np.random.default_rng(0)
    block, size = block_of(views=2, lights=2, wavelet=wavelet), 16
    feet = pixels_of(rng, (3000, 1500, 400, 3000), size)
    found = curvatures(block, feet.density())
    assert found.shape == (2, 2, size, size)
    exact = np.empty(found.shape)
    for place in np.ndindex(found.shape):
        one = np.zeros((1, *found.shape), np.float32)
        one[0][place] = 1
        exact[place] = np.sum(feet.look_up(samples_of(block, one)).astype(float) ** 2)
    ratio = found / exact
    assert 0.8 < np.median(ratio) < 1.25
    assert np.quantile(ratio, 0.05) > 0.6
    assert np.quantile(ratio, 0.95) < 1.8


def test_a_solution_that_is_exact_up_to_rounding_can_be_settled_again():
    # One coefficient: from the second time on gradients are rounding, and with some data a direction becomes zero.
    block, shape = block_of(views=2, size=8, levels=1), (1, 1, 2, 8, 8)
    for seed in (78, 552, 850, 1650):
        rng = np.random.default_rng(seed)
        operator = Operator.of_pixels(pixels_of(rng, (40, 40), 8))
        chosen, held = np.zeros(shape, np.uint8), np.zeros(shape, np.float32)
        chosen.reshape(-1)[rng.integers(chosen.size)] = 1
        data = rng.normal(0, 1, (1, 80)).astype(np.float32)
        first = settle(held, chosen, data, operator, block, Pursuit())
        for _ in range(3):
            again = settle(held, chosen, data, operator, block, Pursuit())
        assert np.isfinite(held).all()
        assert np.sum(again**2) <= 1.0001 * np.sum(first**2)


def test_curvatures_where_nothing_is_seen():
    assert not curvatures(block_of(), np.zeros((4, 16, 16), np.float32)).any()


def slow_amounts(values, bands):
    """What each place gathers from its neighbours, written down from its own point of view."""
    out = np.zeros(values.shape, np.int64)
    channels, frequencies = values.shape[:2]
    for b, (top, left, height, width, _, orientation, parent) in enumerate(bands):
        sisters = range(b - orientation + 1, b - orientation + 4) if orientation else ()
        children = [m for m in range(len(bands)) if bands[m, 6] == b]

        def at(c, k, i, j, band=(top, left, height, width)):
            inside = 0 <= i < band[2] and 0 <= j < band[3]
            return int(values[c, k, band[0] + i, band[1] + j]) if inside else 0

        for c, k, i, j in np.ndindex(channels, frequencies, height, width):
            cross = [(i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)]
            total = 6 * sum(at(c, k, *p) for p in cross)
            total += 3 * sum(at(c, k, i + d, j + e) for d in (-1, 1) for e in (-1, 1))
            total += 2 * sum(at(c, k, i + d, j + e) for d, e in ((2, 0), (-2, 0), (0, 2), (0, -2)))
            beside = [(c, f) for f in (k - 1, k + 1) if 0 <= f < frequencies]
            for weight, places in ((3, beside), (2, [(d, k) for d in range(channels) if d != c])):
                total += weight * sum(2 * at(d, f, i, j) + sum(at(d, f, *p) for p in cross) for d, f in places)
            total += sum(3 * at(c, k, i, j, bands[m, :4]) for m in sisters if m != b)
            for m in children:
                total += 2 * sum(at(c, k, 2 * i + d, 2 * j + e, bands[m, :4]) for d in (0, 1) for e in (0, 1))
            if parent >= 0:
                total += 4 * at(c, k, i // 2, j // 2, bands[parent, :4])
            out[c, k, top + i, left + j] = total
    return out


def test_neighbourhoods_are_those_of_the_definition():
    rng = np.random.default_rng(1)
    values = (rng.random((2, 3, 16, 24)) < 0.1) * rng.integers(1, 16, (2, 3, 16, 24))
    bands = bands_of(16, 24, 2)
    found = np.zeros(values.shape, np.int32)
    neighbourhoods(values.astype(np.uint8), bands, found)
    np.testing.assert_array_equal(found, slow_amounts(values, bands))


def test_magnitudes_are_in_steps():
    out = magnitudes(np.array([0, 0.1, -0.6, 1.6, -9, 1000], np.float32), 1.0)
    np.testing.assert_array_equal(out, [0, 1, 1, 2, 9, 15])


def test_bits_of_counts():
    tally = np.zeros((8, 24, 2), np.int64)
    tally[1, 0], tally[1, 5] = (10**6, 10**3), (100, 900)
    found = bits_of(tally)
    assert found[1, 0] == pytest.approx(np.log2(1000) + 3.5, abs=0.02)
    assert found[1, 5] == 1
    assert np.isfinite(found).all()


def test_expected_bits_tell_what_the_coder_needs():
    """Lone coefficients cost more than those in company, and by about what the coder takes for them."""
    rng = np.random.default_rng(2)
    shape, levels = (1, 1, 8, 32, 32), 3
    company = np.zeros(shape, np.float32)
    company[0, 0, :3, 16:22, 2:8] = rng.choice([-1.2, 1.2], (3, 6, 6))
    lone = np.zeros(shape, np.float32)
    lone.ravel()[rng.choice(lone.size, 60, replace=False)] = 1.2
    values = company + lone
    bits = expected_bits(values, 1.0, levels)
    assert bits[company != 0].mean() < 0.7 * bits[(lone != 0) & (company == 0)].mean()

    def coded(block):
        integers = np.rint(block[:, 0]).astype(np.int32)
        model = train([encode(integers, levels, Model.initial())] * 20)
        return 8 * len(encode(integers, levels, model).data)

    assert bits[values != 0].sum() == pytest.approx(coded(values), rel=0.3)


def test_choices():
    """Every coefficient is judged at its own best value; the last choice only removes."""
    rng = np.random.default_rng(3)
    held, gradient, cost = rng.standard_normal((3, 2, 50)).astype(np.float32)
    curvature, cost = rng.uniform(0.1, 2, 50).astype(np.float32), np.abs(cost) + 0.1
    chosen = (rng.random((2, 50)) < 0.5).astype(np.uint8)
    for adding in (True, False):
        mine, taken = held.copy(), chosen.copy()
        best = held + gradient / curvature if adding else held
        worth = (curvature * best**2 > np.float32(0.4) * cost) & ((chosen == 1) | adding)
        choose(mine, gradient if adding else None, curvature, cost, taken, np.float32(0.4))
        np.testing.assert_array_equal(taken, worth)
        np.testing.assert_array_equal(mine, np.where(worth, held, 0))


def error_of(data, feet, block, found):
    return np.sum((data - feet.look_up(samples_of(block, found))).astype(np.float64) ** 2)


def test_the_few_coefficients_that_made_the_pictures_come_back():
    rng = np.random.default_rng(4)
    block, shape = block_of(), (2, 1, 4, 16, 16)
    feet = pixels_of(rng, (700, 700, 250, 700), 16)
    truth = np.zeros(shape, np.float32)
    places = rng.choice(truth.size // 4, 25, replace=False)
    truth.ravel()[places] = rng.choice([-1, 1], 25) * rng.uniform(1, 3, 25)
    data = feet.look_up(samples_of(block, truth))
    found = pursue(
        data, Operator.of_pixels(feet), block, curvatures(block, feet.density()), price=0.02, bits=flat,
        effort=Pursuit(rounds=8, inner=10, ridge=0.0),
    )  # fmt: skip
    assert error_of(data, feet, block, found) < 1e-3 * np.sum(data**2)
    assert np.count_nonzero(found) < 40
    np.testing.assert_allclose(found[truth != 0], truth[truth != 0], rtol=0.1)


def test_unequal_views_are_served_better_than_by_one_step_length():
    """At the same number of coefficients and the same work, less is left than by iterative thresholding."""
    rng = np.random.default_rng(5)
    block, shape = block_of(views=8, size=32), (1, 1, 8, 32, 32)
    feet = pixels_of(rng, (4000, 1500, 700, 300, 200, 300, 900, 4000), 32)
    i, j = np.meshgrid(np.linspace(0, 3, 32), np.linspace(0, 3, 32), indexing="ij")
    scene = np.stack([np.sin(3 * i + 0.3 * v) * np.cos(2 * j) + np.tanh(8 * (j - 1.5)) for v in range(8)])
    data = (feet.look_up(scene[None]) + 0.02 * rng.standard_normal((1, len(feet.corner)))).astype(np.float32)
    operator = Operator.of_pixels(feet)
    curvature = curvatures(block, feet.density())
    ours = pursue(data, operator, block, curvature, price=0.03, bits=flat, effort=Pursuit(rounds=5, inner=4))
    count = np.count_nonzero(ours)
    thresholds = np.geomspace(0.02, 1, 12)
    others = [solve(data, operator, block, shape, threshold=t, iterations=35) for t in thresholds]
    least = min(error_of(data, feet, block, o) for o in others if np.count_nonzero(o) <= 1.1 * count)
    assert error_of(data, feet, block, ours) < 0.7 * least


def test_a_solution_can_be_gone_on_from():
    """Three choices from the solution at another price reach the objective of eight from nothing."""
    rng = np.random.default_rng(7)
    block, shape = block_of(views=8, size=32), (1, 1, 8, 32, 32)
    feet = pixels_of(rng, (2000,) * 8, 32)
    data = feet.look_up(rng.standard_normal((1, 8, 32, 32)).cumsum(axis=2).cumsum(axis=3).astype(np.float32) / 30)
    arguments = (data, Operator.of_pixels(feet), block, curvatures(block, feet.density()))

    def objective(found):
        return error_of(data, feet, block, found) + 0.01 * np.count_nonzero(found)

    others = {"bits": flat, "effort": Pursuit()}
    cold = pursue(*arguments, price=0.01, **others)
    earlier = pursue(*arguments, price=0.013, **others)
    resumed = pursue(*arguments, price=0.01, start=earlier, **others)
    assert objective(resumed) < objective(cold)
    nothing = pursue(*arguments, price=0.01, start=np.zeros(shape, np.float32), **others)
    np.testing.assert_array_equal(nothing, cold)


def test_nothing_to_do():
    block = block_of()
    feet = Footprints.of(np.zeros(0, int), *np.zeros((2, 0), np.float32), (4, 16, 16))
    found = pursue(
        np.zeros((1, 0), np.float32), Operator.of_pixels(feet), block, curvatures(block, feet.density()),
        price=0.1, bits=flat, effort=Pursuit(),
    )  # fmt: skip
    assert not found.any()
    feet = pixels_of(np.random.default_rng(6), (50, 0, 0, 50), 16)
    data = np.zeros((1, 100), np.float32)
    arguments = (data, Operator.of_pixels(feet), block, curvatures(block, feet.density()))
    assert not pursue(*arguments, price=0.1, bits=flat, effort=Pursuit()).any()
    data += 1
    assert not pursue(*arguments, price=0.1, bits=flat, effort=Pursuit(rounds=0)).any()
    assert error_of(data, feet, block, pursue(*arguments, price=0.01, bits=flat, effort=Pursuit())) < 10
