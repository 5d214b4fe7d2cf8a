"""Shadows, bounced light and relief of the simulator against brute force."""

import math
from functools import partial

import numpy as np
import pytest

from nishiki.simulate.painting import relief
from nishiki.simulate.painting.relief import (
    bounced_irradiance,
    level_out,
    lit_share,
    pixel_maps,
    visible_share,
    weave_under_paint,
)
from nishiki.threads import strips


def hills(size=48, seed=0):
    """Smooth random hills, slopes to about 45°, sample distance 1."""
    random = np.random.default_rng(seed)
    spectrum = np.fft.rfft2(random.normal(size=(size, size)))
    fy, fx = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None, :]
    smooth = np.fft.irfft2(spectrum * np.exp(-(((fx**2 + fy**2) / 0.09**2) ** 1)), s=(size, size))
    return (smooth / np.abs(np.diff(smooth, axis=0)).max() * 1.2).astype(np.float32)


def ray_is_free(height, i, j, light, fine=0.1):
    """March a ray in tenths of a sample; bilinear height; outside the field nothing stands in the way."""
    flat = math.hypot(light[0], light[1])
    run = np.arange(0.6, 100.0, fine)
    y, x = i - run * light[1] / flat, j + run * light[0] / flat
    inside = (y >= 0) & (x >= 0) & (y <= height.shape[0] - 1) & (x <= height.shape[1] - 1)
    run, y, x = run[inside], y[inside], x[inside]
    a, b = np.minimum(y.astype(int), height.shape[0] - 2), np.minimum(x.astype(int), height.shape[1] - 2)
    fy, fx = y - a, x - b
    ground = (height[a, b] * (1 - fx) + height[a, b + 1] * fx) * (1 - fy)
    ground += (height[a + 1, b] * (1 - fx) + height[a + 1, b + 1] * fx) * fy
    return not np.any(ground > height[i, j] + run * light[2] / flat + 1e-6)


def disc(direction, radius, count=24):
    """Directions evenly over a small disc about `direction` (sunflower pattern)."""
    index = np.arange(count) + 0.5
    r, turn = radius * np.sqrt(index / count), index * math.pi * (3 - math.sqrt(5))
    side = np.cross(direction, [0, 0, 1.0])
    side /= np.linalg.norm(side)
    up = np.cross(side, direction)
    points = direction + np.tan(r)[:, None] * (np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * up)
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def shadow_map(height, light, *, step_mm, angular_radius):
    """Share of the lamp that each sample sees past the relief."""
    rest = (tuple(light), step_mm, float(height.max()), angular_radius)
    rows, columns = height.shape
    return np.array([[visible_share(height, i, j, *rest) for j in range(columns)] for i in range(rows)])


@pytest.mark.parametrize("azimuth", [0.3, 2.0, 4.1])
def test_shadow_equals_brute_force_rays(azimuth):
    height, radius = hills(), math.radians(3.0)
    light = np.array([math.cos(azimuth), math.sin(azimuth), math.tan(math.radians(14))])
    light /= np.linalg.norm(light)
    fast = shadow_map(height, light, step_mm=1.0, angular_radius=radius)
    rays = disc(light, radius)
    random = np.random.default_rng(1)
    places = random.integers(6, 42, (150, 2))
    slow = np.array([np.mean([ray_is_free(height, i, j, ray) for ray in rays]) for i, j in places])
    found = fast[places[:, 0], places[:, 1]]
    assert 0.05 < np.mean(slow < 0.5) < 0.95  # there are shadows, and there is light
    assert np.abs(found - slow).mean() < 0.02
    assert np.mean((found > 0.5) == (slow > 0.5)) >= 0.97


def test_wall_casts_the_shadow_of_its_height():
    height = np.zeros((9, 60), np.float32)
    height[:, 40:] = 5.0
    elevation = math.radians(30.0)
    light = np.array([math.cos(elevation), 0.0, math.sin(elevation)])
    lit = shadow_map(height, light, step_mm=1.0, angular_radius=0.0)[4]
    length = 5.0 / math.tan(elevation)  # 8.66 samples in front of the wall, whose foot lies between 39 and 40
    assert (lit[:31] == 1.0).all()
    assert (lit[int(40 - length) + 1 : 39] == 0.0).all()
    assert (shadow_map(height, np.array([0.0, 0.0, 1.0]), step_mm=1.0, angular_radius=0.01) == 1.0).all()


def test_lit_share_is_the_area_of_a_disc_above_a_chord():
    points = np.random.default_rng(0).uniform(-1, 1, (200_000, 2))
    points = points[(points**2).sum(axis=1) < 1]
    for z in (-0.9, -0.3, 0.0, 0.5, 0.99):
        assert lit_share(0.5 + z * 0.02, 0.5, 0.02) == pytest.approx(np.mean(points[:, 1] > -z), abs=4e-3)
    assert lit_share(0.5, 0.6, 0.02) == 0.0
    assert lit_share(0.6, 0.5, 0.02) == 1.0
    assert lit_share(0.4, 0.5, 0.0) == 0.0


def test_bounce_equals_a_sum_over_the_whole_neighbourhood():
    """A V-shaped valley of 45° walls: light from wall to wall, against a sum over a finer mesh."""
    pitch, wide = 1.0, 41
    x = np.arange(wide) - wide // 2
    height = np.broadcast_to(np.abs(x).astype(np.float32), (wide, wide)).copy()
    slope_x = np.broadcast_to(np.sign(x).astype(np.float32), (wide, wide)).copy()
    zero = np.zeros_like(height)
    light = np.ones_like(height)
    found = bounced_irradiance(light, height, slope_x, zero, pitch_mm=pitch)
    # The wall opposite a point at distance d from the valley's line: exact integral over what 8 rings reach.
    fine = 0.05
    px = np.arange(-8.5, 8.5, fine) + fine / 2
    grid_x, grid_y = np.meshgrid(px, px)
    for d in (2, 3, 4, 6):
        r_2 = (grid_x) ** 2 + grid_y**2 + (np.abs(grid_x + d) - d) ** 2
        rise = np.abs(grid_x + d) - d
        opposite = (grid_x + d < 0) & (np.hypot(grid_x, grid_y) < 8.5)
        arriving = (rise - grid_x) / math.sqrt(2)
        leaving = -grid_x - rise
        exact = np.sum(np.where(opposite, arriving * leaving / (math.pi * r_2**2), 0.0)) * fine**2
        assert found[wide // 2, wide // 2 + d] == pytest.approx(exact, rel=0.15)
    assert found[wide // 2, wide // 2 + 2] > 2 * found[wide // 2, wide // 2 + 6] > 0


def test_bounce_vanishes_where_nothing_faces_a_point():
    plane = np.broadcast_to(np.arange(30, dtype=np.float32) * 0.7, (30, 30)).copy()
    slope = np.full_like(plane, 0.7)
    light = np.ones_like(plane)
    assert bounced_irradiance(light, plane, slope, np.zeros_like(plane), pitch_mm=1.0).max() < 1e-6
    dome = -0.02 * ((np.mgrid[:30, :30] - 15.0) ** 2).sum(axis=0).astype(np.float32)
    i, j = np.mgrid[:30, :30].astype(np.float32) - 15
    assert bounced_irradiance(light, dome, -0.04 * j, 0.04 * i, pitch_mm=1.0).max() < 1e-6


@pytest.fixture(params=[256, 10])
def band(request, monkeypatch):
    """Pictures higher than one band of rows must come out the same."""
    monkeypatch.setattr(relief, "strips", partial(strips, most=request.param))


@pytest.mark.usefixtures("band")
def test_pixel_normals_are_the_gradient_of_the_height():
    height = hills(96) * 0.2
    normals, mean, steepest = pixel_maps(height, step_mm=0.1, supersampling=2)
    rows, columns = np.gradient(height.astype(float), 0.1)
    unit = np.stack([-columns, rows, np.ones_like(rows)], axis=-1)  # rows run downwards, y upwards
    unit /= np.linalg.norm(unit, axis=-1, keepdims=True)
    blocks = unit.reshape(48, 2, 48, 2, 3).mean(axis=(1, 3))
    blocks /= np.linalg.norm(blocks, axis=-1, keepdims=True)
    np.testing.assert_allclose(normals, blocks, atol=2e-6)
    np.testing.assert_allclose(mean, height.reshape(48, 2, 48, 2).mean(axis=(1, 3)), atol=1e-6)
    slope = np.arctan(np.hypot(rows, columns)).reshape(48, 2, 48, 2).max(axis=(1, 3))
    np.testing.assert_allclose(steepest, slope, atol=1e-5)


@pytest.mark.usefixtures("band")
def test_level_out_is_the_binomial_filter():
    height = np.random.default_rng(0).normal(size=(12, 14)).astype(np.float32)
    padded = np.pad(height.astype(float), 1, mode="edge")
    kernel = np.outer([1, 2, 1], [1, 2, 1]) / 16
    slow = sum(kernel[i, j] * padded[i : i + 12, j : j + 14] for i in range(3) for j in range(3))
    np.testing.assert_allclose(level_out(height), slow, atol=1e-6)


@pytest.mark.usefixtures("band")
def test_thick_paint_hides_the_weave():
    bare = weave_under_paint(np.zeros((64, 64), np.float32), step_mm=0.1)
    covered = weave_under_paint(np.full((64, 64), 2.0, np.float32), step_mm=0.1)
    assert np.ptp(bare) > 0.02
    assert np.ptp(covered) < 1e-4
