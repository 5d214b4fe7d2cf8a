"""The cloth that pictures show: it lies on its ball and the floor, keeps its length, and is what its program makes."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from nishiki.render.cloth.surfaces import STEP, read_drape

PROGRAM = Path(__file__).resolve().parents[2] / "benchmarks/draped_cloth.py"


def program():
    """The program that made the shipped file."""
    spec = importlib.util.spec_from_file_location("draped_cloth", PROGRAM)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_shipped_cloth_rests_on_the_ball_and_the_floor_with_its_length_kept():
    points = read_drape()
    assert points.shape == (129, 129, 3)
    away = np.linalg.norm(points - [0, 0.30, 0], axis=2) - 0.16
    assert away.min() > 0.0019
    assert points[..., 1].min() > 0.0019
    assert points[64, 64, 1] == pytest.approx(0.462, abs=1e-4)
    assert points[0, 0, 1] < 0.2  # its corners hang
    for axis in (0, 1):
        lengths = np.linalg.norm(np.diff(points, axis=axis), axis=2)
        assert np.sqrt(np.mean((128 * lengths - 1) ** 2)) < 0.02


def test_points_are_kept_to_a_micrometre(tmp_path):
    points = np.random.default_rng(3).uniform(-0.6, 0.6, (9, 9, 3))
    program().write_drape(tmp_path / "cloth.npz", points)
    np.testing.assert_allclose(read_drape(tmp_path / "cloth.npz"), points, atol=STEP / 2 + 1e-12)


@pytest.mark.long
def test_the_shipped_cloth_is_what_its_program_makes():
    points, speed = program().drape()
    assert speed < 0.02
    # Other processors round differently, and a fold may then move by a little.
    assert np.abs(points - read_drape()).max() < 1e-3
