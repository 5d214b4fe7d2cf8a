"""Cast shadows against rays that are followed in small steps through the interpolated surface."""

import functools

import numpy as np
import pytest
from scipy import ndimage

from nishiki.photometric.height import integrate_normals
from nishiki.render.plane.scene import Light
from nishiki.render.plane.shade import PlaneMaps, cast_shadows
from nishiki.stages.painting_maps import predict_light


def relief(rows=40, columns=57, seed=0, amplitude=6.0):
    """Smooth hills and a few sharp ridges, heights in pixels."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:rows, :columns].astype(float)
    height = np.zeros((rows, columns))
    for _ in range(12):
        cx, cy, width = rng.uniform(0, columns), rng.uniform(0, rows), rng.uniform(1.5, 6)
        height += rng.uniform(0.2, 1) * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * width**2))
    height += 0.8 * (np.abs(x - 0.3 * y - columns / 2) < 1.5)
    return (amplitude * height).astype(np.float32)


def slow_horizon(height, pitch, row, column, to_column, to_row, end=np.inf):
    """Highest tangent among the crossings of one ray with the grid lines across its longer axis, in plain Python."""
    rows, columns = height.shape
    main = max(abs(to_column), abs(to_row))
    best, k = -1e30, 1
    while True:
        c, r = column + k * to_column / main, row + k * to_row / main
        distance = k / main
        if not (0 <= round(c, 9) <= columns - 1 and 0 <= round(r, 9) <= rows - 1) or distance > end:
            return best
        c, r = min(max(c, 0), columns - 1), min(max(r, 0), rows - 1)
        r0, c0 = int(np.floor(round(r, 9))), int(np.floor(round(c, 9)))
        r1, c1 = min(r0 + 1, rows - 1), min(c0 + 1, columns - 1)
        fr, fc = r - r0, c - c0
        value = (
            (1 - fr) * (1 - fc) * height[r0, c0]
            + (1 - fr) * fc * height[r0, c1]
            + fr * (1 - fc) * height[r1, c0]
            + fr * fc * height[r1, c1]
        )
        best = max(best, (value - height[row, column]) / (distance * pitch))
        k += 1


@functools.cache
def slow_horizons(azimuth, rows, columns, pitch):
    """`slow_horizon` of every pixel of the relief, azimuth in degrees."""
    height, a = relief(rows, columns), np.radians(azimuth)
    to = np.cos(a), -np.sin(a)
    return np.array([[slow_horizon(height, pitch, r, c, *to) for c in range(columns)] for r in range(rows)])


AZIMUTHS = [0, 45, 90, 135, 180, 225, 270, 315, 10, 37, 77, 101, 163, 200, 248, 281, 349]


@pytest.mark.slow
@pytest.mark.parametrize("azimuth", AZIMUTHS)
def test_sweep_along_grid_and_diagonals_is_exact_and_close_between(azimuth):
    height, pitch = relief(24, 31), 0.5
    slow = slow_horizons(azimuth, 24, 31, pitch)
    for elevation in (3, 12, 33, 60):
        for radius in (0.0, 0.05):
            a, e = np.radians([azimuth, elevation])
            light = Light(direction=(np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)), angular_radius=radius)
            visibility = cast_shadows(height, [light], pitch=pitch)[0]
            above = e - np.arctan(slow)
            d = np.clip(above / radius, -1, 1) if radius else np.where(above > 0, 1.0, -1.0)
            expected = 0.5 + (d * np.sqrt(1 - d * d) + np.arcsin(d)) / np.pi
            difference = np.abs(visibility - expected)
            if azimuth % 45 == 0:  # every pixel lies on a line
                assert np.all(difference[np.abs(above) > 1e-4] < 2e-3)
            else:  # a pixel between two lines takes their mean
                assert difference.mean() < 0.08, difference.mean()


@pytest.mark.slow
@pytest.mark.parametrize("elevation", [8, 25, 45, 70])
@pytest.mark.parametrize("azimuth", [0, 63, 135, 222, 301])
def test_march_equals_rays_exactly_and_sweep_up_to_the_edge(azimuth, elevation):
    height, pitch = relief(30, 37), 0.5
    a, e = np.radians([azimuth, elevation])
    light = Light(direction=(np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)))
    marched = cast_shadows(height, [light], pitch=pitch, march=True)[0]
    swept = cast_shadows(height, [light], pitch=pitch)[0]
    slow = slow_horizons(azimuth, 30, 37, pitch)
    sure = np.abs(slow - np.tan(e)) > 1e-4
    np.testing.assert_array_equal(marched[sure], (np.tan(e) > slow)[sure])
    assert np.all((swept >= 0) & (swept <= 1))
    # where the sweep differs, an edge is near: both states are among the neighbours of the exact answer (but for
    # slivers of a pixel that one of the two misses)
    wrong = swept != marched
    padded = np.pad(marched, 1, mode="edge")
    around = np.stack([padded[i : i + 30, j : j + 37] for i in range(3) for j in range(3)])
    mixed = around.min(axis=0) != around.max(axis=0)
    assert np.count_nonzero(wrong & ~mixed) <= 0.002 * mixed.size
    assert np.abs(swept - marched).mean() < 0.04
    assert np.mean(np.abs(swept - marched) > 0.5) < 0.04


def test_a_wall_casts_a_shadow_of_its_height_over_the_tangent():
    height = np.zeros((9, 60), np.float32)
    height[:, 30] = 5.0
    light = Light(direction=(np.cos(0.4), 0, np.sin(0.4)))  # from the right
    for march in (False, True):
        visibility = cast_shadows(height, [light], pitch=1.0, march=march)[0]
        length = 5 / np.tan(0.4)
        expected = np.ones(60)
        expected[(np.arange(60) < 30) & (30 - np.arange(60) < length)] = 0
        np.testing.assert_array_equal(visibility, np.broadcast_to(expected, (9, 60)))


def test_rows_run_downwards():
    height = np.zeros((40, 9), np.float32)
    height[20] = 5.0
    above = Light(direction=(0, 1, 1))  # the lamp is above the painting: the shadow falls below the wall
    visibility = cast_shadows(height, [above], pitch=1.0)[0]
    assert np.all(visibility[21:25] == 0)
    assert np.all(visibility[:20] == 1)


def test_a_near_lamp_throws_shadows_outwards():
    height = np.zeros((41, 41), np.float32)
    height[20, [14, 26]] = 3.0
    light = Light(position_mm=(0, 0, 5.0))
    visibility = cast_shadows(height, [light], pitch=1.0)[0]
    assert visibility[20, 10] == 0
    assert visibility[20, 30] == 0
    assert np.all(visibility[20, 15:26] == 1)
    far = Light(position_mm=(1e6, 5e5, 1e6))
    towards = Light(direction=(1, 0.5, 1))
    surface = relief()
    near = cast_shadows(surface, [far], pitch=1.0, march=True)
    infinite = cast_shadows(surface, [towards], pitch=1.0, march=True)
    assert np.mean(near != infinite) < 2e-3


def test_position_march_equals_rays():
    height, pitch = relief(), 0.5
    position = np.array([6.0, -9.0, 7.0])
    visibility = cast_shadows(height, [Light(position_mm=tuple(position))], pitch=pitch)[0]
    rows, columns = height.shape
    for row in range(0, rows, 3):
        for column in range(0, columns, 2):
            dc = position[0] / pitch + (columns - 1) / 2 - column
            dr = (rows - 1) / 2 - position[1] / pitch - row
            distance = np.hypot(dc, dr)
            slow = slow_horizon(height, pitch, row, column, dc / distance, dr / distance, end=distance)
            lamp = (position[2] - height[row, column]) / (distance * pitch)
            if abs(lamp - slow) > 1e-4:
                assert visibility[row, column] == (lamp > slow)


def test_soft_edges_are_the_mean_over_the_disc():
    height = np.zeros((3, 80), np.float32)
    height[:, 60] = 8.0
    e, radius = 0.5, 0.06
    light = Light(direction=(np.cos(e), 0, np.sin(e)), angular_radius=radius)
    for march in (False, True):
        visibility = cast_shadows(height, [light], pitch=1.0, march=march)[0, 1, :60]
        # share of the disc's area above the horizon, by counting points of the disc
        grid = (np.arange(400) + 0.5) / 200 - 1
        v = np.broadcast_to(grid[:, None], (400, 400))[grid[:, None] ** 2 + grid[None] ** 2 < 1]
        horizon = np.arctan(8.0 / (60 - np.arange(60)))
        counted = np.array([(e + radius * v > h).mean() for h in horizon])
        np.testing.assert_allclose(visibility, counted, atol=3e-3)
        assert np.count_nonzero((visibility > 0.01) & (visibility < 0.99)) >= 3


def test_flat_maps_and_missing_heights_are_lit():
    light = Light(direction=(1, 0, 1e-3))
    flat = cast_shadows(np.zeros((5, 7), np.float32), [light], pitch=1.0)
    assert np.all(flat == 1)
    height = np.zeros((5, 7), np.float32)
    height[2, 3] = np.nan
    height[1, 2] = np.inf
    result = cast_shadows(height, [light, Light(position_mm=(9, 9, 1))], pitch=1.0)
    assert np.all(result == 1)
    nothing = cast_shadows(np.full((3, 3), np.nan, np.float32), [light], pitch=1.0, march=True)
    assert np.all(nothing == 1)


def test_overhead_lamp_and_scale():
    height = relief()
    assert np.all(cast_shadows(height, [Light(direction=(0, 0, 1))], pitch=1.0, march=True) == 1)
    light = Light(direction=(0.3, 0.8, 0.4), angular_radius=0.02)
    one = cast_shadows(height, [light], pitch=1.0)
    for scale in (1e-6, 1e6):
        other = cast_shadows(height * np.float32(scale), [light], pitch=scale)
        assert np.mean(np.abs(one - other) > 1e-3) < 1e-3


def small_object(side=120, radius=20, tilt=0.0):
    """Normals of a cap in the middle of a large frame, its mask; it stands on a slope of `tilt` along x.

    The tilt is that of an object whose lower edge lies below its middle by far more than the cap is high.
    """
    y, x = np.mgrid[:side, :side] - (side - 1) / 2.0
    mask = np.hypot(x, y) < radius
    z = np.sqrt(np.maximum(1.5 * radius**2 - x * x - y * y, 1.0))
    normals = np.dstack([x / z - tilt, -y / z, np.ones_like(x)])
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    return np.where(mask[..., None], normals, [0.0, 0.0, 1.0]).astype(np.float32), mask


@pytest.mark.parametrize("march", [False, True])
def test_the_background_of_a_small_object_casts_no_shadow_on_it(march):
    normals, mask = small_object()
    height = integrate_normals(normals, valid=mask).height
    for azimuth in (0.0, 0.7, 1.6, 3.9):
        light = Light(direction=(np.cos(azimuth) * np.cos(0.4), np.sin(azimuth) * np.cos(0.4), np.sin(0.4)))
        faces = mask & (normals @ np.array(light.central_direction(), np.float32) > 0.05)
        visible = cast_shadows(height, [light], pitch=1.0, march=march)[0]
        assert visible[faces].min() == 1  # a convex cap shadows none of what faces the lamp
        assert np.all(visible[~mask] == 1)


def test_the_prediction_of_a_small_object_is_that_without_shadows():
    normals, mask = small_object(tilt=0.3)
    model = PlaneMaps(normals, np.full((*mask.shape, 3), 0.5, np.float32) * mask[..., None])
    height = integrate_normals(normals, valid=mask).height
    light = Light(direction=(-np.cos(0.5), 0, np.sin(0.5)), angular_radius=0.01)
    with_shadows = predict_light(model, light, visibility=cast_shadows(height, [light], pitch=1.0))
    without = predict_light(model, light)
    faces = mask & (without.body > 0.05)
    np.testing.assert_array_equal(with_shadows.channels[faces], without.channels[faces])


@pytest.mark.parametrize("azimuth", [0, 45, 20, 115, 250])
@pytest.mark.parametrize("march", [False, True])
def test_pieces_shadow_themselves_but_not_each_other(azimuth, march):
    """Interleaved pieces, one of them in two arms: the same as each piece alone."""
    height = relief(40, 57)
    y, x = np.mgrid[:40, :57]
    bridge = (y >= 36) | (x % 19 < 7)
    island = (x % 19 > 8) & (x % 19 < 17) & (y < 33)
    height[~bridge & ~island] = np.nan
    height[island] += 50 * (1 + x[island] // 19)
    a, e = np.radians([azimuth, 12])
    light = Light(direction=(np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)))
    together = cast_shadows(height, [light], pitch=0.5, march=march)
    pieces, count = ndimage.label(np.isfinite(height))
    assert count == 4
    for piece in range(1, count + 1):
        own = pieces == piece
        alone = cast_shadows(np.where(own, height, np.nan), [light], pitch=0.5, march=march)
        np.testing.assert_array_equal(together[0][own], alone[0][own])
    assert together.min() < 1
