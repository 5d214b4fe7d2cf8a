"""The compiled kernels against slow, obvious references; the radiometric functions against known values."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nishiki.colour import colour
from nishiki.formats.coding import LINEAR, SRGB
from nishiki.formats.problems import CaptureError
from nishiki.observations.kernels import block_levels, count_outliers, decode_codes
from nishiki.observations.linearise import (
    block_edges,
    blocks_around,
    cells,
    check_linearity,
    code_table,
    count_unusable,
    edges_between,
    on_one_grid,
    positions,
    saturation_code,
    to_luma,
)
from nishiki.observations.reference import white_field

RNG = np.random.default_rng(7)


@given(st.integers(1, 5000), st.integers(1, 64))
def test_blocks_cover_the_picture_and_cells_agree_with_positions(length, block):
    edges = block_edges(length, block)
    assert edges[0] == 0
    assert edges[-1] == length
    assert (np.diff(edges) > 0).all()
    assert np.diff(edges).max() <= max(1.5 * block, block + 1)
    start, stop = length // 3, length // 3 + max(1, length // 2)
    lower, weight = positions(edges, start, stop)
    between = cells(edges, start, stop)
    assert between[0] == 0
    assert between[-1] == stop - start
    assert len(between) - 1 == max(1, len(edges) - 2)
    expected = np.concatenate([np.full(b - a, c) for c, (a, b) in enumerate(itertools.pairwise(between))])
    np.testing.assert_array_equal(lower, expected)
    if len(edges) > 2:
        centres = (edges[:-1] + edges[1:] - 1) / 2
        np.testing.assert_allclose(centres[lower] + weight * np.diff(centres)[lower], np.arange(start, stop), rtol=1e-5)


@given(st.integers(1, 400), st.integers(1, 64), st.integers(0, 20), st.data())
def test_blocks_around_the_object_keep_the_interpolation_of_the_whole(length, block, margin, data):
    inside = np.zeros(length, bool)
    inside[data.draw(st.lists(st.integers(0, length - 1), min_size=1, max_size=3))] = True
    start, stop = blocks_around(inside, block, margin)
    set_at, whole = np.flatnonzero(inside), block_edges(length, block)
    assert start <= max(set_at[0] - margin, 0)
    assert stop >= min(set_at[-1] + 1 + margin, length)
    edges = edges_between(length, block, start, stop)
    np.testing.assert_array_equal(edges + start, whole[np.searchsorted(whole, start) :][: len(edges)])
    lower, weight = positions(edges, set_at[0] - start, set_at[-1] + 1 - start)
    lower_of_whole, weight_of_whole = positions(whole, set_at[0], set_at[-1] + 1)
    np.testing.assert_array_equal(lower + np.searchsorted(whole, start), lower_of_whole)
    np.testing.assert_array_equal(weight, weight_of_whole)


@pytest.mark.parametrize("dark_shape", [(3, 4, 5, 2), (1, 1, 1, 2)])
def test_fields_on_one_grid_are_writable_so_that_kernels_are_compiled_once(dark_shape):
    gain, dark = RNG.random((3, 4, 5, 2)).astype(np.float32), RNG.random(dark_shape).astype(np.float32)
    fields = on_one_grid(gain, dark)
    for field, given_field in zip(fields, (gain, dark), strict=True):
        np.testing.assert_array_equal(field, np.broadcast_to(given_field, gain.shape))
        assert field.flags.writeable
        assert field.flags.c_contiguous


def reference_decode(codes, table, gain, dark, row_edges, column_edges, usable, saturated, clip, channel):
    """The definition, in float64 with explicit loops over lights and channels."""
    n, m = codes.shape[1:3]
    linear = codes.astype(np.float64) if codes.dtype.kind == "f" else table.astype(np.float64)[codes]

    def at_pixels(field, length, edges, axis):
        centres = (edges[:-1] + edges[1:] - 1) / 2
        if field.shape[axis] == 1:
            return np.repeat(field, length, axis=axis)
        low = np.clip(np.searchsorted(centres, np.arange(length), side="right") - 1, 0, len(centres) - 2)
        w = (np.arange(length) - centres[low]) / (centres[low + 1] - centres[low])
        shape = [1] * field.ndim
        shape[axis] = length
        a, b = np.take(field, low, axis=axis), np.take(field, low + 1, axis=axis)
        return a + w.reshape(shape) * (b - a)

    full = [at_pixels(at_pixels(f.astype(np.float64), n, row_edges, 1), m, column_edges, 2) for f in (gain, dark)]
    values = (linear - full[1]) * full[0]
    chosen = slice(None) if channel in (None, "mean") else slice(channel, channel + 1)
    with np.errstate(invalid="ignore"):
        valid = (usable != 0)[None] & (codes < saturated).all(axis=3) & (codes[..., chosen] > clip).any(axis=3)
        known = (full[0] > 0)[..., chosen]
        valid &= np.isfinite(values[..., chosen]).all(axis=3) & known.all(axis=3)
    values = np.where(known & np.isfinite(values[..., chosen]), values[..., chosen], 0)
    return (values if channel is None else values.mean(axis=3)), valid


def run_decode(codes, table, gain, dark, row_edges, column_edges, usable, saturated, clip, channel):
    first, last = (channel, channel + 1) if isinstance(channel, int) else (0, codes.shape[3])
    kind = codes.dtype.type
    coding, channels = (table, kind(saturated), kind(clip)), (first, last, channel is not None)
    out, valid = decode_codes(codes, coding, (gain, dark, usable), (row_edges, column_edges), channels=channels)
    return (out if channel is None else out[..., 0]), valid


@pytest.mark.parametrize("flat", [True, False])
@pytest.mark.parametrize("channels", [1, 3, 5])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_decoding_equals_its_definition(dtype, channels, flat):
    n, m, lights, block = 23, 41, 3, 8
    if dtype is np.float32:
        codes = RNG.normal(0.3, 0.4, (lights, n, m, channels)).astype(np.float32)
        codes[0, 3, 4, 0], codes[1, 5, 6, -1] = np.nan, np.inf
        table, saturated, clip = np.zeros(2, np.float32), 0.9, 0.0
    else:
        top = np.iinfo(dtype).max
        codes = RNG.integers(0, top + 1, (lights, n, m, channels)).astype(dtype)
        codes[:, :5] = 0
        table, saturated, clip = code_table(dtype, SRGB), int(0.9 * top), 0
    row_edges, column_edges = (np.array([0, k]) if flat else block_edges(k, block) for k in (n, m))
    shape = (lights, len(row_edges) - 1, len(column_edges) - 1, channels)
    gain, dark = RNG.uniform(0.5, 2, shape).astype(np.float32), RNG.uniform(0, 0.1, shape).astype(np.float32)
    gain[1, 0, -1, 0] = np.nan
    usable = (RNG.random((n, m)) < 0.9).astype(np.uint8)
    settings = (codes, table, gain, dark, row_edges, column_edges, usable, saturated, clip)
    for channel in (None, "mean", channels - 1):
        values, valid = run_decode(*settings, channel)
        expected, expected_valid = reference_decode(*settings, channel)
        np.testing.assert_array_equal(valid, expected_valid)
        assert np.isfinite(values).all()
        np.testing.assert_allclose(values[valid], expected[valid], rtol=1e-5, atol=2e-6)


@pytest.mark.parametrize(("dtype", "channels"), [(np.uint8, 1), (np.uint16, 3), (np.float32, 2)])
def test_counting_equals_its_definition(dtype, channels):
    codes = RNG.integers(0, 200, (31, 17, channels)).astype(dtype)
    codes[2:4], codes[7, 7] = 0, 150
    if dtype is np.float32:
        codes[9, 9, 0], codes[9, 10, -1], codes[9, 11] = np.nan, np.inf, -np.inf
    usable = (RNG.random((31, 17)) < 0.8).astype(np.uint8)
    hot, cold, broken, inside, most = count_unusable(codes, usable, dtype(180), dtype(0))
    within = usable != 0
    assert inside == within.sum()
    assert broken == (within & ~np.isfinite(codes).all(axis=2)).sum()
    finite = np.isfinite(codes).all(axis=2)
    expected_hot = (within & finite & (codes >= 180).any(axis=2)).sum()
    expected_cold = (within & finite & (codes <= 0).all(axis=2)).sum()
    if dtype is not np.float32:
        assert (hot, cold, most) == (expected_hot, expected_cold, codes.max())
    else:  # a pixel that is not finite may be counted on either side besides
        assert expected_hot <= hot <= expected_hot + broken
        assert expected_cold <= cold <= expected_cold + broken


def test_luma_keeps_saturation():
    codes = RNG.integers(0, 4000, (11, 13, 3)).astype(np.uint16)
    codes[3, 4] = (4095, 10, 10)
    weights = np.array([0.299, 0.587, 0.114])
    luma = to_luma(codes, np.uint16(4014), 4095.0, weights, 0.5)
    expected = np.rint(codes @ weights)
    expected[3, 4] = 4095
    assert np.abs(luma[..., 0] - expected).max() <= 1
    assert luma[3, 4, 0] == 4095


def test_block_levels_ignore_dust_and_dead_pixels_and_count_the_unusable():
    table = code_table(np.uint16, LINEAR, 12)
    clean = RNG.normal(2000, 20, (64, 48, 2))
    codes = np.rint(clean).astype(np.uint16)
    codes[5:8, 5:8], codes[20, 20], codes[40, 30] = 200, 0, 4095
    edges = block_edges(64, 16), block_edges(48, 16)
    levels, unusable = block_levels(codes, table, *edges, 4014.0, 0.0)
    np.testing.assert_allclose(levels, 2000 / 4095, rtol=4 * 20 / 2000 / 16 + 0.002)
    assert unusable[0, 0].min() >= 9 / 256
    assert unusable[3, 2].max() < 0.01
    codes[:16, :16] = 4095
    levels, unusable = block_levels(codes, table, *edges, 4014.0, 0.0)
    assert np.isnan(levels[0, 0]).all()
    assert (unusable[0, 0] == 1).all()


@settings(max_examples=25, deadline=None)
@given(st.floats(1e-6, 1e6))
def test_block_levels_scale_with_the_light(factor):
    """Equivariance over twelve orders of magnitude, for float samples."""
    values = np.random.default_rng(3).uniform(0.5, 1.5, (16, 16, 1)).astype(np.float32)
    edges = np.array([0, 8, 16])
    table = np.zeros(2, np.float32)
    one, _ = block_levels(values, table, edges, edges, np.inf, -np.inf)
    other, _ = block_levels(values * np.float32(factor), table, edges, edges, np.inf, -np.inf)
    np.testing.assert_allclose(other, one * np.float32(factor), rtol=1e-5)


def test_outliers_are_counted_per_pixel():
    codes = np.full((8, 8, 1), 100, np.uint8)
    codes[2, 3], codes[5, 6] = 3, 200
    counts = np.zeros((8, 8), np.uint8)
    table, edges = code_table(np.uint8, LINEAR), np.array([0, 8])
    level = np.full((1, 1, 1), 100 / 255, np.float32)
    count_outliers(codes, table, level, edges, edges, 0.1, np.inf, counts)
    assert counts.sum() == counts[2, 3] == 1
    count_outliers(codes, table, level, edges, edges, -np.inf, 0.02, counts)
    assert counts.sum() == 2
    assert counts[5, 6] == 1


def test_white_gain_makes_a_white_facing_the_lamp_one():
    table = code_table(np.uint16, LINEAR)
    board = np.full((32, 32, 3), 0.6 * 65535 * np.cos(0.5) * 0.97).astype(np.uint16) + 1000
    edges = block_edges(32, 16), block_edges(32, 16)
    dark = np.full((1, 1, 3), 1000 / 65535, np.float32)
    options = {"limits": (65000.0, 0.0), "name": "w.png"}
    field = white_field(board, table, dark, edges, lit=(np.cos(0.5), 0.97), **options)
    np.testing.assert_allclose(field.gain * 0.6, 1, rtol=1e-4)
    assert field.uniformity.min() > 0.999
    assert field.problems == ()
    board[:16, :16] = 65535
    partial = white_field(board, table, dark, edges, lit=(np.cos(0.5), 0.97), **options)
    assert np.isnan(partial.gain[0, 0]).all()
    assert np.isfinite(partial.gain[1:, 1:]).all()
    assert partial.bad_blocks == 0.25
    assert [p.kind for p in partial.problems] == ["white-partial"]
    with pytest.raises(CaptureError, match="grazes"):
        white_field(board, table, dark, edges, lit=(0.01, 1.0), **options)


def test_srgb_known_values():
    np.testing.assert_allclose(
        colour.decode(np.array([0, 0.04045, 0.5, 1]), "srgb"), [0, 0.0031308, 0.2140411, 1], rtol=2e-5
    )
    table = code_table(np.uint8, SRGB)
    assert table.dtype == np.float32
    assert table[255] == 1
    assert (np.diff(table) > 0).all()


def test_saturation_codes():
    assert saturation_code(np.uint8, None) == 254
    assert saturation_code(np.uint16, 0.98, 12) == 4014
    assert saturation_code(np.uint16, 1.0) == 65535
    assert saturation_code(np.float32, None) == np.inf
    assert saturation_code(np.float32, 0.5) == np.float32(0.5)


def test_linearity():
    reflectances = np.array([0.03, 0.09, 0.2, 0.36, 0.59, 0.9])
    exact = check_linearity(0.7 * reflectances + 0.01, reflectances)
    np.testing.assert_allclose([exact.slope, exact.intercept, exact.r_squared], [0.7, 0.01, 1], rtol=1e-12)
    assert exact.worst_deviation < 1e-12
    bent = 0.7 * reflectances
    bent[4] += 0.05
    found = check_linearity(bent, reflectances)
    slope, intercept = np.polyfit(reflectances, bent, 1)
    residual = bent - slope * reflectances - intercept
    np.testing.assert_allclose([found.slope, found.intercept], [slope, intercept], rtol=1e-10)
    np.testing.assert_allclose(found.worst_deviation, np.abs(residual).max() / bent.max(), rtol=1e-10)
    np.testing.assert_allclose(found.r_squared, np.corrcoef(reflectances, bent)[0, 1] ** 2, rtol=1e-10)
    assert found.worst_patch == 4


@pytest.mark.parametrize(
    ("values", "reflectances"),
    [([1, 2], [0.1, 0.2]), ([1, 2, np.nan], [0.1, 0.2, 0.3]), ([1, 2, 3], [0.2, 0.2, 0.2]), ([1, 2, 3], [1, 2])],
)
def test_linearity_refuses(values, reflectances):
    with pytest.raises(ValueError):
        check_linearity(np.array(values, float), np.array(reflectances, float))


@given(st.floats(1e-12, 1e12), st.floats(-10, 10))
def test_linearity_does_not_depend_on_the_scale(scale, offset):
    reflectances = np.array([0.05, 0.2, 0.4, 0.9])
    values = reflectances**1.1 + offset
    one, other = check_linearity(values, reflectances), check_linearity(scale * values, reflectances)
    np.testing.assert_allclose(other.slope, scale * one.slope, rtol=1e-6)
    np.testing.assert_allclose(
        [other.r_squared, other.worst_deviation], [one.r_squared, one.worst_deviation], rtol=1e-6
    )
