"""Transforms of tiles: proven against PyWavelets and against their own definition."""

import numpy as np
import pytest
import pywt
from hypothesis import given, settings
from hypothesis import strategies as st

from nishiki.codec.design import arc_views, view_matrix, visible_arc
from nishiki.codec.solve import Footprints
from nishiki.codec.transform import Block, analysis_matrix, cosine_matrix, level_matrix, plane_transform
from nishiki.errors import UserError

FAMILIES = ("haar", "db2", "db3", "sym4", "coif1", "bior4.4", "bior2.2")


def block(wavelet="db2", *, size=16, levels=3, views=6, lights=1, kind="cosine", mirrored=False):
    plane = plane_transform(wavelet, size, size, levels, mirrored=mirrored)
    return Block(plane, view_matrix(kind, views), view_matrix("cosine", lights))


def reference_plane(image, wavelet, levels):
    """Mallat's arrangement of pywt's own transform, level after level."""
    out = image.copy()
    for level in range(levels):
        size = len(image) >> level
        low, (horizontal, vertical, diagonal) = pywt.dwt2(out[:size, :size], wavelet, mode="periodization")
        out[:size, :size] = np.block([[low, vertical], [horizontal, diagonal]])
    return out


@pytest.mark.parametrize("wavelet", FAMILIES)
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_planes_are_those_of_pywavelets(wavelet, dtype):
    image = np.random.default_rng(0).standard_normal((32, 32))
    plane = plane_transform(wavelet, 32, 32, 3)
    found = Block(plane, np.eye(1), np.eye(1)).forward(image.astype(dtype)[None, None, None])[0, 0, 0]
    expected = reference_plane(image, wavelet, 3) * plane.gains
    assert found.dtype == dtype
    np.testing.assert_allclose(found, expected, atol=1e-11 if dtype == np.float64 else 1e-5)


@pytest.mark.parametrize("wavelet", ["haar", "db2", "sym4", "coif2"])
def test_view_wavelet_is_that_of_pywavelets_down_to_odd_bands(wavelet):
    values = np.random.default_rng(1).standard_normal(36)
    middle, fine = pywt.dwt(values, wavelet, mode="periodization")
    coarse, middle = pywt.dwt(middle, wavelet, mode="periodization")
    expected = np.concatenate([cosine_matrix(9) @ coarse, middle, fine])
    np.testing.assert_allclose(view_matrix(wavelet, 36) @ values, expected, atol=1e-11)


@pytest.mark.parametrize("wavelet", ["haar", "db2", "db3", "sym4", "coif1"])
@pytest.mark.parametrize("kind", ["cosine", "db2", "haar", "none"])
@pytest.mark.parametrize("views", [1, 7, 36])
def test_discarded_energy_is_the_error(wavelet, kind, views):
    rng = np.random.default_rng(2)
    transform = block(wavelet, views=views, kind=kind, lights=3)
    values = rng.standard_normal((2, 3, views, 16, 16))
    coefficients = transform.forward(values)
    kept = np.where(np.abs(coefficients) > 1.0, coefficients, 0.0)
    error = np.sum((transform.inverse(kept) - values) ** 2)
    assert error == pytest.approx(np.sum((coefficients - kept) ** 2), rel=1e-9)
    single = values.astype(np.float32)
    coefficients = transform.forward(single)
    kept = np.where(np.abs(coefficients) > 1.0, coefficients, np.float32(0))
    error = np.sum((transform.inverse(kept).astype(np.float64) - single) ** 2)
    assert error == pytest.approx(np.sum((coefficients - kept).astype(np.float64) ** 2), rel=1e-5)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("wavelet", ["bior4.4", "bior2.2"])
def test_biorthogonal_inverse_adjoint_and_unit_basis(wavelet, mirrored):
    rng = np.random.default_rng(3)
    transform = block(wavelet, mirrored=mirrored, views=5)
    values, other = rng.standard_normal((2, 1, 1, 5, 16, 16))
    np.testing.assert_allclose(transform.inverse(transform.forward(values)[None][0]), values, atol=1e-11)
    assert np.sum(transform.adjoint(values) * other) == pytest.approx(
        np.sum(values * transform.inverse(other)), rel=1e-10
    )
    unit = np.zeros((1, 1, 5, 16, 16))
    for place in ((0, 0), (1, 5), (15, 15), (7, 12)):
        unit[:] = 0
        unit[0, 0, 2, *place] = 1
        assert np.sum(transform.inverse(unit) ** 2) == pytest.approx(1, rel=1e-9)
    assert np.sum(transform.inverse(other) ** 2) <= transform.plane.bound * np.sum(other**2) * (1 + 1e-9)


@pytest.mark.parametrize("lights", [1, 3])
@pytest.mark.parametrize("wavelet", ["bior4.4", "db2", "haar"])
def test_gradient_of_chosen_coefficients_is_the_gradient_of_all_there(wavelet, lights):
    rng = np.random.default_rng(5)
    plane = plane_transform(wavelet, 32, 16, 3)
    transform = Block(plane, view_matrix("db2", 6), view_matrix("cosine", lights))
    values = rng.standard_normal((3, lights, 6, 32, 16)).astype(np.float32)
    chosen = (rng.random(values.shape) < 0.02).astype(np.uint8)
    chosen[0, 0, 2] = 0
    chosen[1] = 0
    every, some = transform.adjoint(values), transform.adjoint(values, (chosen > 0).any(axis=(3, 4)))
    assert np.array_equal(some[chosen > 0], every[chosen > 0])
    assert np.isfinite(some).all()


def test_levels_are_matrices_also_where_rows_and_columns_are_empty():
    rng = np.random.default_rng(6)
    transform = block("bior4.4", size=16, levels=1, views=1)
    values = np.zeros((1, 1, 1, 16, 16))
    values[..., 3:6, 9] = rng.standard_normal(3)
    matrix = level_matrix("bior4.4", 16)
    expected = matrix @ values[0, 0, 0] @ matrix.T * transform.plane.gains
    np.testing.assert_allclose(transform.forward(values)[0, 0, 0], expected, atol=1e-12)
    inverse = np.linalg.inv(matrix)
    expected = inverse @ (values[0, 0, 0] / transform.plane.gains) @ inverse.T
    np.testing.assert_allclose(transform.inverse(values)[0, 0, 0], expected, atol=1e-12)


def test_mirrored_ends_pass_a_constant_and_a_ramp():
    """Nine-seven filters kill straight lines inside; a mirrored end leaves no jump where a periodic one does."""
    ramp = np.arange(16.0)
    assert np.abs(level_matrix("bior4.4", 16, mirrored=True)[9:14] @ ramp).max() < 1e-9
    assert np.abs(level_matrix("bior4.4", 16)[8:] @ ramp).max() > 1
    assert np.abs(level_matrix("bior4.4", 16, mirrored=True)[8:] @ np.ones(16)).max() < 1e-11


def test_sizes_that_cannot_be_halved_stop_early():
    assert plane_transform("db2", 24, 40, 9).levels == 3
    assert plane_transform("db2", 15, 16, 4).levels == 0
    values = np.random.default_rng(4).standard_normal((1, 1, 2, 15, 15))
    transform = block(size=15, levels=4, views=2)
    np.testing.assert_allclose(transform.inverse(transform.forward(values)), values, atol=1e-12)
    np.testing.assert_allclose(analysis_matrix("db2", 9, 3), np.eye(9))


def test_wrong_families_are_reported():
    with pytest.raises(UserError, match="wavelet"):
        plane_transform("daubechies", 16, 16, 2)
    with pytest.raises(UserError, match="orthonormal"):
        view_matrix("bior4.4", 8)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.booleans(), min_size=1, max_size=40), st.booleans())
def test_arc_holds_every_seen_view_and_no_shorter_one_does(seen, full_turn):
    seen = np.array(seen)
    start, length = visible_arc(seen, full_turn=full_turn)
    views = len(seen)
    held = np.zeros(views, bool)
    held[arc_views(start, length, views)] = True
    assert not (seen & ~held).any()
    if length:
        assert seen[start]
        assert seen[(start + length - 1) % views]
        starts = range(views) if full_turn else range(views - length + 2)
        for other in starts:
            shorter = np.zeros(views, bool)
            shorter[arc_views(other, length - 1, views)] = True
            assert (seen & ~shorter).any()


def slow_look_up(texels, observation, s, t):
    """Four texels of each pixel, weighted."""
    size = texels.shape[-1]
    i, j = np.clip(s.astype(int), 0, size - 2), np.clip(t.astype(int), 0, size - 2)
    d, r = s - i, t - j
    value = lambda k, m: texels[:, observation, i + k, j + m]  # noqa: E731
    return (1 - d) * ((1 - r) * value(0, 0) + r * value(0, 1)) + d * ((1 - r) * value(1, 0) + r * value(1, 1))


def test_look_up_and_its_adjoint():
    rng = np.random.default_rng(5)
    observation, s, t = rng.integers(0, 4, 300), *(rng.uniform(0, 11, (2, 300)).astype(np.float32))
    s[:4], t[:4] = [0, 11, 0, 11], [0, 0, 11, 11]
    feet = Footprints.of(observation, s, t, (4, 12, 12))
    texels = rng.standard_normal((2, 4, 12, 12))
    seen = np.empty((2, 300))
    seen[:, feet.order] = feet.look_up(texels)
    np.testing.assert_allclose(seen, slow_look_up(texels, observation, s, t), atol=1e-6)
    values = rng.standard_normal((2, 300))
    assert np.sum(feet.spread(values) * texels) == pytest.approx(np.sum(values * feet.look_up(texels)), rel=1e-12)
    power = rng.standard_normal((1, 4, 12, 12))
    for _ in range(300):
        power = feet.spread(feet.look_up(power))
        norm = np.linalg.norm(power)
        power /= norm
    assert norm <= feet.density().max() * (1 + 1e-6)
