"""Photographs of a polarisation series that bear the states of others: found, and sound series left alone."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from nishiki.polarisation.polariser_states import Arm, design_matrix, equal_steps
from nishiki.polarisation.series import find_order, remove_nuisance, series_design

ANGLES = {
    "four": np.array([[0.0], [45], [90], [135]]),
    "twelve": np.arange(0, 180, 15.0)[:, None],
    "grid": np.array([(g, a) for g in (0, 30, 60, 90, 120, 150) for a in (0, 45, 90, 135)], float),
    "retarders": np.array([(g, a) for g in np.arange(0, 180, 22.5) for a in np.arange(0, 180, 30.0)]),
}


def photographs(kind, *, polarised=True, seed=0):
    """Small pictures by Mueller matrices of every pixel, with a lamp that varies, a camera that moves and noise."""
    rng, angles = np.random.default_rng(seed), ANGLES[kind]
    smooth = lambda sigma: gaussian_filter(rng.normal(size=(36, 48)), sigma) * sigma  # noqa: E731
    arms = (Arm(1.4), Arm(1.6)) if kind == "retarders" else (Arm(), Arm())
    states = np.radians(np.hstack([np.zeros_like(angles), angles]) if angles.shape[1] == 1 else angles)
    matrices = np.zeros((16, 36, 48))
    matrices[0] = 0.3 + 0.1 * np.tanh(smooth(2))
    for element in range(1, 16) if polarised else ():
        matrices[element] = matrices[0] * 0.4 * np.tanh(smooth(4))
    pictures = np.tensordot(design_matrix(*arms, states), matrices, axes=1)
    for picture in pictures:
        picture[:] = shift(picture, 0.1 * rng.normal(size=2), order=3, mode="nearest")
        picture *= 1 + 0.01 * rng.normal()
    return pictures + 3e-4 * rng.normal(size=pictures.shape)


def order_of(pictures, kind):
    return find_order(remove_nuisance(pictures), series_design(ANGLES[kind]))


@pytest.mark.parametrize("kind", ANGLES)
@pytest.mark.parametrize("polarised", [True, False])
def test_sound_series_are_left_alone(kind, polarised):
    assert all(order_of(photographs(kind, polarised=polarised, seed=s), kind).as_stated for s in range(5))


@pytest.mark.parametrize("kind", ANGLES)
def test_exchanged_photographs_are_found(kind):
    count = len(ANGLES[kind])
    for seed in range(4):
        exchanged = np.arange(count)
        first, second = (0, 1) if kind == "four" else np.random.default_rng(seed).permutation(count)[:2]
        exchanged[[first, second]] = second, first
        found = order_of(photographs(kind, seed=seed)[exchanged], kind)
        assert tuple(exchanged.tolist()) in (found.order, *found.others)
        assert found.corrected < 0.2 * found.unexplained


@pytest.mark.parametrize("step", [1, -1, 3])
def test_shifted_lists_are_found(step):
    shifted = np.roll(np.arange(24), step)
    found = order_of(photographs("grid")[shifted], "grid")
    assert not found.as_stated
    assert found.corrected < 0.1 * found.unexplained


def test_too_few_states_tell_nothing():
    assert find_order(remove_nuisance(photographs("four")[:3]), series_design(ANGLES["four"][:3])) is None


@pytest.mark.slow
@pytest.mark.data
def test_measured_series(data):
    """64 states of an instrument that turns retarders, and choices of them: sound, and with exchanged pairs."""
    paths = sorted((data / "mueller_badges").glob("*_*.png"))
    names = np.array([path.stem.split("_") for path in paths], float)
    angles = np.stack([equal_steps(column) for column in names.T], axis=1)
    read = (cv2.imread(str(path), 0).astype(np.float32) for path in paths)
    pictures = np.stack([cv2.resize(picture, (64, 48), interpolation=cv2.INTER_AREA) for picture in read])
    pictures, rng, found = pictures.astype(float), np.random.default_rng(0), 0
    for trial in range(30):
        chosen = np.sort(rng.permutation(64)[: rng.integers(36, 65)])
        design, exchanged = series_design(angles[chosen]), np.arange(len(chosen))
        assert find_order(remove_nuisance(pictures[chosen]), design).as_stated, trial
        pair = rng.permutation(len(chosen))[:2]
        exchanged[pair] = pair[::-1]
        order = find_order(remove_nuisance(pictures[chosen][exchanged]), design)
        found += tuple(exchanged.tolist()) in (order.order, *order.others)
    assert found >= 26
