"""Quantiser, context coder, start states: what is written is read, prefixes suffice, and contexts pay."""

import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nishiki.codec.entropy import Model, bands_of, decode, encode, pack, train, unpack
from nishiki.codec.rate import quantise
from nishiki.errors import UserError


def laplacian(rng, shape, levels, spread):
    """Integers as a wavelet transform leaves them: large and clustered in coarse bands, rare in fine ones."""
    out = np.zeros(shape)
    envelope = np.exp(rng.standard_normal((shape[-2] // 4 + 1, shape[-1] // 4 + 1)))
    envelope = np.kron(envelope, np.ones((4, 4)))[: shape[-2], : shape[-1]]
    for row, column, h, w, level, _, _ in bands_of(shape[-2], shape[-1], levels):
        scale = spread * 2.0 ** (level - 3) * envelope[row : row + h, column : column + w]
        decay = 1 / (1 + np.arange(shape[1]))[None, :, None, None]
        out[..., row : row + h, column : column + w] = scale * decay * rng.laplace(size=(*shape[:2], h, w))
    return np.trunc(out).astype(np.int32)


def test_bands_tile_the_plane_from_coarse_to_fine():
    covered = np.zeros((24, 40), int)
    bands = bands_of(24, 40, 3)
    for row, column, h, w, _, _, _ in bands:
        covered[row : row + h, column : column + w] += 1
    assert (covered == 1).all()
    assert (np.diff(bands[:, 4]) <= 0).all()
    for row, column, h, w, _, orientation, parent in bands:
        if parent >= 0:
            assert tuple(bands[parent, :4] * 2) == (row, column, h, w)
            assert bands[parent, 5] == orientation


@pytest.mark.parametrize("shape", [(3, 5, 16, 16), (1, 1, 8, 32), (4, 2, 15, 9), (2, 40, 8, 8)])
@pytest.mark.parametrize("spread", [0.0, 0.1, 3.0, 4000.0])
def test_what_is_written_is_read(shape, spread):
    rng = np.random.default_rng(0)
    levels = 0 if shape[-1] == 9 else 3
    blocks = [laplacian(rng, shape, levels, spread) for _ in range(3)]
    trained = train([encode(block, levels, Model.initial()) for block in blocks])
    for model in (Model.initial(), trained, unpack(pack(trained))):
        for block in blocks:
            coded = encode(block, levels, model)
            np.testing.assert_array_equal(decode(coded.data, shape, levels, model), block)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 511), st.integers(-(2**24), 2**24)), max_size=20))
def test_any_integers_survive(entries):
    block = np.zeros((2, 1, 16, 16), np.int32)
    for place, value in entries:
        block.ravel()[place] = value
    coded = encode(block, 2, Model.initial())
    np.testing.assert_array_equal(decode(coded.data, block.shape, 2, Model.initial()), block)


def test_a_prefix_decodes_the_coarse_bands():
    rng = np.random.default_rng(1)
    block = laplacian(rng, (3, 4, 32, 32), 3, 8.0)
    coded = encode(block, 3, Model.initial())
    bands = bands_of(32, 32, 3)
    for drop in (1, 2, 3):
        wanted = len(bands) - 3 * drop
        prefix = coded.data[: coded.ends[wanted - 1]]
        assert len(prefix) < len(coded.data)
        side = 32 >> drop
        expected = np.zeros_like(block)
        expected[..., :side, :side] = block[..., :side, :side]
        np.testing.assert_array_equal(decode(prefix, block.shape, 3, Model.initial(), drop=drop), expected)


def test_contexts_beat_a_general_compressor_and_static_entropy():
    rng = np.random.default_rng(2)
    blocks = [laplacian(rng, (3, 8, 32, 32), 3, 1.5) for _ in range(4)]
    trained = train([encode(block, 3, Model.initial()) for block in blocks])
    ours = sum(len(encode(block, 3, trained).data) for block in blocks) + len(pack(trained))
    general = sum(len(zlib.compress(block.astype(np.int16).tobytes(), 9)) for block in blocks)
    static = 0.0
    for row, column, h, w, _, _, _ in bands_of(32, 32, 3):
        values = np.stack([block[..., row : row + h, column : column + w] for block in blocks])
        for c in range(3):
            counts = np.unique(values[:, c], return_counts=True)[1]
            static -= np.sum(counts * np.log2(counts / counts.sum())) / 8
    assert ours < 0.75 * general
    assert ours < 0.97 * static


def test_training_spares_small_tiles_the_learning():
    rng = np.random.default_rng(3)
    blocks = [laplacian(rng, (3, 6, 16, 16), 2, 1.0) for _ in range(30)]
    plain = [encode(block, 2, Model.initial()) for block in blocks]
    trained = train(plain)
    assert sum(len(encode(b, 2, trained).data) for b in blocks) < 0.97 * sum(len(c.data) for c in plain)


def test_nothing_is_hardly_anything():
    block = np.zeros((3, 18, 64, 64), np.int32)
    trained = train([encode(block, 4, Model.initial())] * 20)
    assert len(encode(block, 4, trained).data) < 12


def test_damaged_start_states_are_reported():
    data = pack(train([encode(np.ones((1, 1, 8, 8), np.int32), 1, Model.initial())]))
    with pytest.raises(UserError, match="damaged"):
        unpack(data[:-7])
    with pytest.raises(UserError, match="version"):
        unpack(zlib.compress(b"other"))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_quantiser(dtype):
    values = np.array([0.0, 0.59, -0.61, 1.57, 1.59, -2.4, 2.6, 1e6], dtype)
    np.testing.assert_array_equal(quantise(values, 1.0), [0, 0, -1, 1, 2, -2, 3, 10**6])
    rng = np.random.default_rng(4)
    many = rng.standard_normal(10_000).astype(dtype)
    step = 0.25
    slow = [0 if abs(v) / step < 0.6 else np.sign(v) * max(int(abs(v) / step + 0.42), 1) for v in many]
    np.testing.assert_array_equal(quantise(many, step), slow)
