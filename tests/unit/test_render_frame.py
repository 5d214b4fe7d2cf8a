"""Views, sampling and averaging: against rays in space, brute-force averages and symmetry."""

import dataclasses

import numpy as np
import pytest

from nishiki.errors import UserError
from nishiki.render.plane import frame as camera
from nishiki.render.plane.frame import reduce_maps, render
from nishiki.render.plane.kernel import BACKGROUND, NORMAL_MISSING
from nishiki.render.plane.scene import Ambient, Gloss, Light, PlaneScene, View
from nishiki.render.plane.shade import cast_shadows, pixel_to_plane, shade_xyz

WHITE = np.ones((1, 61))


def flat(rows, columns, values=None, **changes):
    """A flat matte scene of grey `values` (rows, columns)."""
    normals = np.zeros((rows, columns, 3), np.float32) + np.float32([0, 0, 1])
    grey = np.ones((rows, columns)) if values is None else values
    return PlaneScene(normals, np.asarray(grey, np.float32)[..., None], basis=WHITE, **changes)


def bumpy(rows=60, columns=80, seed=2):
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(rows, columns, 3)) * [0.2, 0.2, 0] + [0, 0, 1]
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    return PlaneScene(
        normals.astype(np.float32),
        rng.uniform(0.1, 0.9, (rows, columns, 1)).astype(np.float32),
        basis=WHITE,
        height=rng.uniform(0, 3.0, (rows, columns)).astype(np.float32),
        labels=rng.integers(0, 2, (rows, columns)).astype(np.uint8),
        gloss=Gloss([[0.5], [2.0]], [[0.3], [0.1]], [1.45, 1.5]),
    )


FRONT = Light(direction=(0, 0, 1))
OBLIQUE = View(eye_mm=(30, -20, 70), target_mm=(3, 2, 0), up=(0.1, 1, 0), field_of_view=0.9, rows=48, columns=64)


@pytest.mark.parametrize("terms", [(0.2, 0.5, 0.1), (0.2, 0.5, 0.1, 0.3, -0.2)])
def test_every_term_of_the_body_counts_in_every_picture(terms):
    scene = flat(8, 8, shading=np.full((8, 8, len(terms)), terms, np.float32))
    light = Light(direction=(0.6, 0.3, 0.7))
    larger = render(scene, [light], View(rows=16, columns=16))
    np.testing.assert_allclose(larger.xyz[4, 4], shade_xyz(scene, [light]).values[4, 4], rtol=1e-5)


def slow_rays(view):
    """Where the ray through each pixel's centre meets z = 0, one pixel at a time."""
    eye, target = np.array(view.eye_mm, float), np.array(view.target_mm, float)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, view.up)
    right /= np.linalg.norm(right)
    above = np.cross(right, forward)
    points = np.full((view.rows, view.columns, 2), np.nan)
    for row in range(view.rows):
        for column in range(view.columns):
            side = (column + 0.5 - view.columns / 2) / (view.rows / 2) * np.tan(view.field_of_view / 2)
            high = (view.rows / 2 - row - 0.5) / (view.rows / 2) * np.tan(view.field_of_view / 2)
            ray = forward + side * right + high * above
            if ray[2] < 0:
                points[row, column] = (eye - ray * eye[2] / ray[2])[:2]
    return points


@pytest.mark.parametrize("view", [OBLIQUE, dataclasses.replace(OBLIQUE, eye_mm=(200, 0, 5), target_mm=(0, 0, 4))])
def test_homography_is_the_rays(view):
    matrix = camera.screen_to_plane(view, flat(10, 10))
    column, row = np.meshgrid(np.arange(view.columns), np.arange(view.rows))
    x, y, w = np.einsum("ij,jrc->irc", matrix, np.stack([column, row, np.ones_like(row)]).astype(float))
    points = slow_rays(view)
    hits = np.isfinite(points[..., 0])
    np.testing.assert_array_equal(w > 0, hits)
    np.testing.assert_allclose(np.stack([x / w, y / w], -1)[hits], points[hits], rtol=1e-9, atol=1e-9)


def test_frontal_view_of_the_size_of_the_maps_samples_nothing():
    scene, lights = bumpy(), [Light(direction=(1, 2, 3))]
    visibility = cast_shadows(scene.height, lights, pitch=1.0)
    direct = shade_xyz(scene, lights, visibility=visibility)
    result = render(scene, lights)
    np.testing.assert_array_equal(result.xyz, direct.values)
    assert result.samples_per_pixel == 1
    assert 0 < visibility[0].mean() < 1
    # through the sampler, one sample a pixel, it is the same picture
    pinned = render(scene, lights, View(rows=60, columns=80), samples=(1, 1024))
    np.testing.assert_array_equal(pinned.xyz, direct.values)
    sampled = camera.sample_maps(scene, visibility, np.eye(3), scene.shape, scene.shape)
    np.testing.assert_allclose(sampled.normals, scene.normals, atol=1e-7)
    np.testing.assert_array_equal(sampled.coefficients, scene.coefficients)
    np.testing.assert_array_equal(sampled.labels, scene.labels)
    np.testing.assert_allclose(sampled.visibility, visibility, atol=1e-7)


def test_sampling_is_bilinear_and_normals_stay_unit():
    scene = bumpy(8, 9)
    rng = np.random.default_rng(0)
    for _ in range(50):
        x, y = rng.uniform(-0.5, 8.5), rng.uniform(-0.5, 7.5)
        samples = camera.sample_maps(scene, None, np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]]), (1, 1), scene.shape)
        cx, cy = np.clip(x, 0, 8), np.clip(y, 0, 7)
        c, r = min(int(cx), 7), min(int(cy), 6)
        fx, fy = cx - c, cy - r
        weights = np.array([[(1 - fy) * (1 - fx), (1 - fy) * fx], [fy * (1 - fx), fy * fx]])
        expected = np.einsum("ij,ijk->k", weights, scene.coefficients[r : r + 2, c : c + 2])
        np.testing.assert_allclose(samples.coefficients[0, 0], expected, rtol=1e-5)
        normal = np.einsum("ij,ijk->k", weights, scene.normals[r : r + 2, c : c + 2])
        np.testing.assert_allclose(samples.normals[0, 0], normal / np.linalg.norm(normal), atol=1e-6)
        assert samples.inside[0, 0]
        assert samples.labels[0, 0] == scene.labels[int(cy + 0.5), int(cx + 0.5)]


def test_a_pinhole_sees_a_ramp_where_its_rays_meet_it():
    rows, columns = 200, 260
    plane = pixel_to_plane(flat(rows, columns).pitch, (rows, columns))
    column, row = np.meshgrid(np.arange(columns), np.arange(rows))
    ramp = 0.5 + 0.002 * (plane[0, 0] * column + plane[0, 2]) - 0.001 * (plane[1, 1] * row + plane[1, 2])
    view = dataclasses.replace(OBLIQUE, field_of_view=0.5)
    result = render(flat(rows, columns, ramp), [FRONT], view)
    points = slow_rays(view)
    expected = 0.5 + 0.002 * points[..., 0] - 0.001 * points[..., 1]
    inner = result.coverage == 1
    assert inner.mean() > 0.5
    np.testing.assert_allclose(result.xyz[inner, 1], expected[inner], atol=2e-4)


def test_far_view_of_fine_stripes_is_grey_not_moire():
    stripes = np.tile([0.0, 1.0], 600)[None].repeat(900, axis=0)
    scene = flat(900, 1200, stripes)
    for rows, columns, maximum in ((41, 53, 1024), (41, 53, 64), (7, 9, 256)):
        result = render(scene, [FRONT], View(rows=rows, columns=columns), samples=(2, maximum))
        inner = result.coverage > 0.999
        assert inner.any()
        assert np.abs(result.xyz[inner, 1] - 0.5).max() < 0.03
        assert (result.reduction > 1) == ((1200 / columns) ** 2 > maximum)
    grazing = View(eye_mm=(0, -1500, 60), target_mm=(0, 0, 0), field_of_view=0.6, rows=60, columns=80)
    result = render(scene, [FRONT], grazing)
    inner = result.coverage > 0.999
    assert np.abs(result.xyz[inner, 1] - 0.5).max() < 0.05
    assert result.samples_per_pixel > 100
    assert 1 < result.reduction < 16


def test_mean_brightness_survives_any_reduction_and_any_view():
    scene = flat(333, 471, np.random.default_rng(0).uniform(0, 1, (333, 471)))
    mean = scene.coefficients.mean()
    for rows, columns in ((5, 7), (50, 70), (333, 471), (400, 500)):
        result = render(scene, [FRONT], View(rows=rows, columns=columns))
        weight = result.coverage[..., None] if (rows, columns) != scene.shape else 1.0
        total = (result.xyz * 1.0)[..., 1].sum() / np.sum(weight * np.ones((rows, columns, 1)))
        assert total == pytest.approx(mean, rel=6e-3)
        area = result.coverage.sum() * max(333 / rows, 471 / columns) ** 2
        assert area == pytest.approx(333 * 471, rel=2e-2)


def test_supersampling_is_the_mean_of_a_finer_picture():
    scene, lights = bumpy(), [Light(direction=(1, 1, 2)), Light(position_mm=(30, 10, 60), falloff=True)]
    fine = render(scene, lights, View(rows=240, columns=320), samples=(1, 1024))
    coarse = render(scene, lights, View(rows=60, columns=80), samples=(4, 1024))
    assert render(scene, lights, View(rows=60, columns=80)).samples_per_pixel == 1  # native
    coarse = render(scene, lights, View(rows=30, columns=40), samples=(8, 1024))
    blocks = fine.xyz.reshape(30, 8, 40, 8, 3).mean(axis=(1, 3), dtype=np.float64)
    np.testing.assert_allclose(coarse.xyz, blocks, rtol=2e-5)


def test_gloss_follows_the_eye():
    """A flat glossy mirror shows the lamp where the half vector is the normal."""
    rows = columns = 101
    scene = dataclasses.replace(flat(rows, columns, np.zeros((rows, columns))), gloss=Gloss([[1.0]], [[0.02]], [1.5]))
    view = View(eye_mm=(0, -60, 100), target_mm=(0, 0, 0), field_of_view=0.7, rows=120, columns=120)
    light = Light(position_mm=(20, 80, 100))
    result = render(scene, [light], view)
    row, column = np.unravel_index(np.argmax(result.xyz[..., 1]), result.coverage.shape)
    point = slow_rays(view)[row, column]
    # equal heights of lamp and eye: the mirror point is half way
    np.testing.assert_allclose(point, [10, 10], atol=1.5)


def test_background_edges_and_missing_normals():
    scene = flat(20, 20)
    scene.normals[5:15, 5:15] = 0
    result = render(scene, [FRONT], View(rows=40, columns=80), samples=(4, 1024))
    assert np.all(result.xyz[0, 0] == 0)
    assert result.flags[0, 0] == BACKGROUND
    assert result.flags[20, 40] == NORMAL_MISSING
    assert np.all(result.xyz[20, 40] == 0)
    assert result.flags[2, 40] == 0
    assert result.coverage[2, 40] == 1
    assert np.all(np.isfinite(result.xyz))
    everything = render(
        scene, [FRONT], View(eye_mm=(0, 0, 5), target_mm=(0, 50, 5), up=(0, 0, 1), field_of_view=1.0, rows=9, columns=9)
    )
    assert np.all((everything.flags == BACKGROUND) | (everything.coverage > 0))


def test_grazing_eye_is_finite():
    for z in (1e-2, 1e-5):
        view = View(eye_mm=(0, -80, z), target_mm=(0, 0, 0), field_of_view=0.8, rows=33, columns=44)
        result = render(bumpy(), [Light(direction=(0, 1, 0.01))], view, ambient=Ambient(level=0.1))
        assert np.all(np.isfinite(result.xyz))
        assert np.all(np.isfinite(result.coverage))


def test_views_do_not_depend_on_the_number_of_threads(monkeypatch):
    results = []
    for count in (1, 2, 5):
        monkeypatch.setattr("nishiki.threads.threads", lambda count=count: count)
        results.append(render(bumpy(), [Light(direction=(1, 1, 1), angular_radius=0.05)], OBLIQUE))
    for result in results:
        assert result.xyz.tobytes() == results[0].xyz.tobytes()
        assert result.flags.tobytes() == results[0].flags.tobytes()


def test_reduction_averages_blocks_and_keeps_normals_unit():
    scene = bumpy(7, 10)
    scene.normals[0, 0] = 0
    reduced, visibility = reduce_maps(scene, np.ones((2, 7, 10), np.float32), 4)
    assert reduced.shape == (2, 3)
    assert visibility.shape == (2, 2, 3)
    np.testing.assert_allclose(reduced.coefficients[0, 0, 0], scene.coefficients[:4, :4, 0].mean(), rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(reduced.normals, axis=2), 1, atol=1e-6)
    total = scene.normals[:4, :4].reshape(-1, 3).sum(0, dtype=float)
    np.testing.assert_allclose(reduced.normals[0, 0], total / np.linalg.norm(total), atol=1e-6)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: View(eye_mm=(0, 0, -1), rows=3, columns=3), "view"),
        (lambda: View(eye_mm=(0, 0, 1)), "rows"),
        (lambda: View(rows=3), "columns"),
        (lambda: View(eye_mm=(0, 5, 5), up=(0, 1, 1), rows=3, columns=3), "up"),
        (lambda: View(eye_mm=(0, 5, 5), field_of_view=4.0, rows=3, columns=3), "180"),
    ],
)
def test_mistakes_are_named(make, words):
    with pytest.raises(UserError, match=words):
        make()
