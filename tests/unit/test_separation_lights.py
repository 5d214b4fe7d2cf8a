"""Light selection: each kernel against the obvious per-pixel form, known outcomes, extremes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused

from nishiki.errors import UserError
from nishiki.photometric import refit as selection
from nishiki.photometric.light_selection import pack_lights, select_diffuse, sorting_network, unpack_lights


def directions_of(count, lowest=0.3):
    """Lights spread evenly over a dome, by the golden angle."""
    k = np.arange(count) + 0.5
    z = lowest + (0.98 - lowest) * k / count
    angle, radius = k * np.pi * (3 - np.sqrt(5)), np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def scene(count, pixels, seed, spoilt=0.2, noise=1e-3):
    """Lambertian samples of tilted pixels, some with highlights and some in cast shadow; which are clean."""
    rng = np.random.default_rng(seed)
    lights = directions_of(count)
    tilt, turn = rng.uniform(0, 0.5, pixels), rng.uniform(0, 2 * np.pi, pixels)
    normals = np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], axis=1)
    clean = np.maximum(lights @ normals.T, 0) * rng.uniform(0.2, 0.9, pixels)
    stack = clean * (1 + noise * rng.standard_normal(clean.shape))
    kind = rng.uniform(size=clean.shape)
    bright, dark = kind < spoilt / 2, (kind > 1 - spoilt / 2)
    stack[bright] += rng.uniform(0.2, 2, bright.sum())
    stack[dark] *= 0.05
    return stack.astype(np.float32).reshape(count, 1, pixels), lights, normals, ~(bright | dark)


@pytest.mark.parametrize("size", [1, 2, 3, 5, 8, 12, 41, 96, 100])
def test_sorting_network_sorts(size):
    values = np.random.default_rng(size).standard_normal((size, 500))
    expected = np.sort(values, axis=0)
    for upper, lower in sorting_network(size):
        pair = np.sort(values[[upper, lower]], axis=0)
        values[[upper, lower]] = pair
    np.testing.assert_array_equal(values, expected)


@pytest.mark.parametrize(("size", "smallest"), [(1, 1), (5, 2), (12, 6), (41, 21), (96, 48), (100, 3)])
def test_sorting_network_of_the_smallest_values(size, smallest):
    network = sorting_network(size, smallest)
    values = np.random.default_rng(size).standard_normal((size, 500))
    expected = np.sort(values, axis=0)
    for upper, lower in network:
        values[[upper, lower]] = np.sort(values[[upper, lower]], axis=0)
    np.testing.assert_array_equal(values[:smallest], expected[:smallest])
    assert len(network) < len(sorting_network(size)) or size == 1


def test_sorting_network_sorts_every_zero_one_input():
    """A network that sorts all inputs of zeros and ones sorts everything (Knuth's principle)."""
    for size in range(1, 12):
        values = (np.arange(2**size)[None] >> np.arange(size)[:, None]) & 1
        expected = np.sort(values, axis=0)
        for upper, lower in sorting_network(size):
            values[[upper, lower]] = np.sort(values[[upper, lower]], axis=0)
        np.testing.assert_array_equal(values, expected)


@pytest.mark.slow
def test_thresholds_equal_the_paper_formula():
    stack, lights, _, _ = scene(9, 700, 1)
    valid = np.random.default_rng(2).uniform(size=stack.shape) > 0.1
    found = select_diffuse(stack, lights, method="threshold", valid=valid)
    mean = np.sum(stack * valid, axis=0, dtype=np.float64) / np.maximum(valid.sum(axis=0), 1)
    expected = valid & ~(stack > 1.2 * mean) & ~(stack < 0.1 * mean)
    np.testing.assert_array_equal(found.usable, expected)
    np.testing.assert_array_equal(found.highlights, (valid & (stack > 1.2 * mean)).sum(axis=0))
    np.testing.assert_array_equal(found.invalid, (~valid).sum(axis=0))
    total = found.lights_usable.astype(int) + found.highlights + found.shadows + found.invalid
    assert (total == 9).all()


@pytest.mark.slow
@pytest.mark.parametrize(("count", "keep"), [(5, (0.3, 0.7)), (12, (0.2, 0.8)), (41, (0.3, 0.7)), (96, (0.0, 0.5))])
def test_ranks_equal_a_sort_of_each_pixel(count, keep):
    stack, lights, _, _ = scene(count, 150, 3)
    valid = np.random.default_rng(4).uniform(size=stack.shape) > 0.15
    found = select_diffuse(stack, lights, method="trimmed", keep=keep, valid=valid).usable
    for p in range(stack.shape[2]):
        known = np.sort(stack[:, 0, p][valid[:, 0, p]])
        n = known.size
        first, last = int(np.floor(keep[0] * n + 0.5)), int(np.floor(keep[1] * n + 0.5)) - 1
        while last - first + 1 < 4 and (first > 0 or last < n - 1):
            first -= first > 0
            last += last - first + 1 < 4 and last < n - 1
        inside = valid[:, 0, p] & (stack[:, 0, p] >= known[first]) & (stack[:, 0, p] <= known[last])
        np.testing.assert_array_equal(found[:, 0, p], inside)


def slow_refit(values, lights, noise=0.003, starts=3, at_least=4):
    """The re-fit of one pixel in plain NumPy and double precision."""
    n, values = values.size, values.astype(np.float64) / values.max()

    def solve(mask):
        chosen = lights[mask]
        matrix = chosen.T @ chosen
        return np.linalg.solve(matrix + 1e-6 * np.trace(matrix) * np.eye(3), chosen.T @ values[mask])

    def keep(b):
        r = values - lights @ b
        distance = np.where(lights @ b > 0, np.where(r > 0, selection.ABOVE * r, -r), np.inf)
        size = min(max(at_least, int(np.ceil(selection.COVERAGE * n))), n)
        return distance, (distance <= np.sort(distance)[size - 1]) & np.isfinite(distance), size

    b = np.zeros(3)
    window, record = min(max(at_least, int(np.floor(selection.WINDOW * n + 0.5))), n), np.inf
    for s in range(starts):
        first = int(np.floor(s / (starts - 1) * (n - window) + 0.5))
        ranked = np.sort(values)
        mask = (values >= ranked[first]) & (values <= ranked[first + window - 1])
        for _ in range(selection.ROUNDS):
            b = solve(mask) if mask.sum() >= at_least else b
            distance, mask, size = keep(b)
        ratio = np.minimum(distance[mask] / np.linalg.norm(b), 10)
        quality = (np.mean(ratio**2) + noise**2) * size / mask.sum() if mask.sum() >= at_least else 3e38
        if quality < record:
            record, best = quality, b
    _, mask, _ = keep(best)
    r = values - lights @ best
    scale = np.sqrt(np.sum(r[mask] ** 2) / max(mask.sum() - 3, 1)) + noise * np.linalg.norm(best)
    for k in range(selection.ROUNDS + 1):
        r = values - lights @ best
        mask = (r <= selection.BRIGHTER * scale) & (r >= -selection.DARKER * scale) & (lights @ best > 0)
        best = solve(mask) if k < selection.ROUNDS and mask.sum() >= at_least else best
    return mask if mask.sum() >= at_least else np.ones(n, dtype=bool)


@pytest.mark.parametrize("count", [9, 41, 96])
def test_refit_equals_its_slow_form(count):
    stack, lights, _, _ = scene(count, 333, 5)
    found = select_diffuse(stack, lights).usable[:, 0]
    expected = np.stack([slow_refit(stack[:, 0, p], lights) for p in range(stack.shape[2])], axis=1)
    # Single precision moves samples that lie on a limit; nothing else may differ.
    assert np.mean(found == expected) > 0.998
    assert np.mean((found == expected).all(axis=0)) > 0.97


@pytest.mark.parametrize(("count", "spoilt"), [(9, 0.15), (20, 0.25), (96, 0.4)])
def test_refit_finds_the_spoilt_samples(count, spoilt):
    """Up to two fifths of many lights; of few lights, chance spoils half of some pixels: nothing can mend those."""
    stack, lights, _, clean = scene(count, 2000, 6, spoilt=spoilt)
    found = select_diffuse(stack, lights).usable[:, 0]
    assert np.mean(found[clean]) > 0.93
    assert np.mean(found[~clean]) < {9: 0.04, 20: 0.03, 96: 0.02}[count]


def test_refit_keeps_everything_of_a_clean_matt_surface():
    """Where thresholds throw valid samples of tilted facets away (the paper's figure 9), the re-fit does not."""
    stack, lights, _, _ = scene(12, 2000, 7, spoilt=0.0)
    assert np.mean(select_diffuse(stack, lights).usable) > 0.99
    assert np.mean(select_diffuse(stack, lights, method="threshold").usable) < 0.8


@pytest.mark.parametrize("method", ["refit", "trimmed", "threshold"])
def test_a_pixel_does_not_depend_on_the_tile(method):
    stack, lights, _, _ = scene(17, 1111, 8)
    whole = select_diffuse(stack, lights, method=method).usable
    parts = [select_diffuse(stack[:, :, a:b], lights, method=method).usable for a, b in ((0, 1), (1, 70), (70, 1111))]
    np.testing.assert_array_equal(whole, np.concatenate(parts, axis=2))


@pytest.mark.parametrize("method", ["refit", "trimmed", "threshold", "none"])
def test_invalid_and_not_finite_samples_are_never_usable(method):
    stack, lights, _, _ = scene(12, 300, 9)
    valid = np.random.default_rng(1).uniform(size=stack.shape) > 0.3
    stack[3, 0, ::7], stack[5, 0, ::11] = np.nan, np.inf
    found = select_diffuse(stack, lights, method=method, valid=valid)
    assert not found.usable[~valid | ~np.isfinite(stack)].any()
    np.testing.assert_array_equal(found.invalid, (~valid | ~np.isfinite(stack)).sum(axis=0))


@settings(max_examples=30, deadline=None)
@given(power=st.integers(-40, 40), seed=st.integers(0, 1000))
def test_selection_does_not_depend_on_the_radiometric_scale(power, seed):
    stack, lights, _, _ = scene(10, 40, seed)
    for method in ("refit", "trimmed"):
        one = select_diffuse(stack, lights, method=method).usable
        other = select_diffuse(stack * np.float32(2.0**power), lights, method=method).usable
        np.testing.assert_array_equal(one, other)


def test_black_and_fully_invalid_pixels_pass_through():
    lights = directions_of(8)
    stack = np.zeros((8, 1, 3), dtype=np.float32)
    valid = np.ones(stack.shape, dtype=bool)
    valid[:, 0, 2] = False
    found = select_diffuse(stack, lights, valid=valid)
    assert found.usable[:, 0, :2].all()
    assert not found.usable[:, 0, 2].any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"method": "magic"}, "magic"),
        ({"method": "threshold", "w1": 0.1, "w2": 0.2}, "w2 < w1"),
        ({"method": "trimmed", "keep": (0.7, 0.3)}, "low < high"),
        ({"min_lights": 2}, "min_lights"),
        ({"valid": np.ones((2, 2, 2), dtype=bool)}, "shape"),
    ],
)
def test_mistakes_are_named(change, message):
    stack, lights, _, _ = scene(6, 5, 1)
    with pytest.raises(UserError, match=message):
        select_diffuse(stack, lights, **change)


def test_wrong_directions_are_named():
    stack, lights, _, _ = scene(6, 5, 1)
    with pytest.raises(UserError, match=r"\(6, 3\)"):
        select_diffuse(stack, lights[:5])
    with pytest.raises(UserError, match="length 2"):
        select_diffuse(stack, lights * 2)
    with refused(UserError, "(1, 5)"):
        select_diffuse(stack[0], lights)


@pytest.mark.parametrize("lights", [1, 7, 8, 9, 41])
def test_chosen_lights_come_back_from_their_bits(lights):
    chosen = np.random.default_rng(lights).random((lights, 5, 6)) < 0.5
    packed = pack_lights(chosen)
    np.testing.assert_array_equal(np.moveaxis(packed, -1, 0), np.packbits(chosen, axis=0, bitorder="little"))
    np.testing.assert_array_equal(unpack_lights(np.ascontiguousarray(packed), lights), chosen)
