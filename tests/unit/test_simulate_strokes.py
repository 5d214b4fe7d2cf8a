"""Brush strokes and hashed noise of the simulator."""

import math

import numpy as np

from nishiki.simulate.painting.objects import Strokes, apply_strokes, stroke_profile
from nishiki.simulate.painting.picture import CanvasMap
from nishiki.simulate.randomness import fractal_noise, hash_uint, line_noise, normals, plane_noise, uniform, uniforms

MASK = (1 << 64) - 1


def slow_hash(key, counter):
    """SplitMix64's output function in Python's own integers."""
    z = (key + (counter + 1) * 0x9E3779B97F4A7C15) & MASK
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & MASK
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & MASK
    return z ^ (z >> 31)


def slow_plane(key, x, y):
    i, j = math.floor(x), math.floor(y)
    corner = [
        [(slow_hash(slow_hash(key, (j + b) & MASK), (i + a) & MASK) >> 11) / 2**53 for a in (0, 1)] for b in (0, 1)
    ]
    sx, sy = (f * f * (3 - 2 * f) for f in (x - i, y - j))
    rows = [left + (right - left) * sx for left, right in corner]
    return rows[0] + (rows[1] - rows[0]) * sy


def test_noise_equals_slow_form():
    random = np.random.default_rng(0)
    for _ in range(200):
        key, counter = int(random.integers(0, 2**63)), int(random.integers(0, 2**40))
        assert int(hash_uint(np.uint64(key), np.uint64(counter))) == slow_hash(key, counter)
        x, y = random.uniform(-50, 50, 2)
        assert abs(plane_noise(np.uint64(key), x, y) - slow_plane(key, x, y)) < 1e-12
    x, y = random.uniform(-9, 9, (2, 5, 7))
    slow = [
        (slow_plane(3, a, b) + 0.5 * slow_plane(4, 2 * a, 2 * b)) / 1.5 for a, b in zip(x.flat, y.flat, strict=True)
    ]
    np.testing.assert_allclose(fractal_noise(x, y, key=3, octaves=2).ravel(), slow, atol=1e-6)


def test_hashed_numbers_are_uniform_and_normal():
    values = uniforms(9, np.arange(20000))
    assert values[:9].tolist() == [uniform(np.uint64(9), np.uint64(n)) for n in range(9)]
    assert abs(values.mean() - 0.5) < 0.01
    assert np.histogram(values, 10, (0, 1))[0].min() > 1800
    bells = normals(9, np.arange(20000))
    assert abs(bells.mean()) < 0.03
    assert abs(bells.std() - 1) < 0.02
    steps = np.array([line_noise(np.uint64(1), x) for x in np.arange(0, 20, 0.01)])
    assert np.abs(np.diff(steps)).max() < 0.016  # 1.5 times the step: the steepest a smoothstep can be


def one_stroke(**changes):
    values = {
        "x": 5.0,
        "y": 4.0,
        "angle": 0.4,
        "bend": 0.05,
        "length": 6.0,
        "width": 2.0,
        "thickness": 0.1,
        "ridge": 0.5,
        "label": 7,
        "group": 0,
        "key": 12345,
    } | changes
    types = {"label": np.uint8, "group": np.uint8, "key": np.uint64}
    return Strokes(**{name: np.array([value], types.get(name, float)) for name, value in values.items()})


def test_a_stroke_equals_its_profile_on_a_bare_ground():
    plan = CanvasMap.blank(80, 100)
    paint, label = np.zeros((160, 200), np.float32), np.zeros((160, 200), np.uint8)
    apply_strokes(paint, label, plan, one_stroke(), step_mm=0.05)
    expected = np.zeros((160, 200))
    covered = np.zeros((160, 200), bool)
    for i in range(160):
        for j in range(200):
            dx, dy = (j + 0.5) * 0.05 - 5.0, (i + 0.5) * 0.05 - 4.0
            run = dx * math.cos(0.4) + dy * math.sin(0.4)
            across = dy * math.cos(0.4) - dx * math.sin(0.4) - 0.025 * run * run
            cover, body = stroke_profile(0.5 + run / 6.0, across / 1.0, 3.0, 0.5, np.uint64(12345))
            expected[i, j], covered[i, j] = cover * 0.1 * body, cover > 0.5
    np.testing.assert_allclose(paint, expected, atol=1e-6)
    np.testing.assert_array_equal(label == 7, covered)
    assert 0.4 * 12.0 < covered.sum() * 0.05**2 < 12.0  # of length times width
    assert paint.max() > 0.1


def test_a_stroke_stays_in_its_group_and_in_the_picture():
    plan = CanvasMap.blank(80, 100)
    plan.group[:, 50:] = 1
    paint, label = np.zeros((160, 200), np.float32), np.zeros((160, 200), np.uint8)
    apply_strokes(paint, label, plan, one_stroke(), step_mm=0.05)
    assert paint[:, :100].any()
    assert not paint[:, 100:].any()
    assert not label[:, 100:].any()
    for x, y in ((-1.0, 4.0), (5.0, -0.5), (10.5, 8.2), (-50.0, 90.0)):
        apply_strokes(paint, label, plan, one_stroke(x=x, y=y), step_mm=0.05)
    assert np.isfinite(paint).all()
