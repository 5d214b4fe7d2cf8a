"""Predicted photographs and sequences: the model written out for single pixels, tiles, paths."""

import numpy as np
import pytest

from nishiki.brdf.torrance_sparrow import specular
from nishiki.render.plane.frame import render
from nishiki.render.plane.kernel import NORMAL_MISSING
from nishiki.render.plane.scene import Gloss, Light, PlaneScene, View
from nishiki.render.plane.shade import PlaneMaps, cast_shadows, predict_observations
from nishiki.stages.render.painting import orbit

GLOSS = Gloss([[0.7], [164.0]], [[0.2], [0.07]], [1.45, 1.5])


def maps(rows=30, columns=41, channels=5):
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:rows, :columns].astype(float)
    height = 1.5 * np.sin(x / 3) * np.cos(y / 4) + 0.7 * np.cos(x / 1.7 + y / 2.3)
    slope_y, slope_x = np.gradient(height)
    normals = np.stack([-slope_x, slope_y, np.ones_like(x)], -1)  # rows run downwards, y up
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    albedo = rng.uniform(0.05, 0.9, (rows, columns, channels))
    labels = (x > columns / 2).astype(np.uint8)
    return normals.astype(np.float32), albedo.astype(np.float32), labels, height.astype(np.float32)


@pytest.mark.parametrize("channels", [1, 3, 7])
def test_prediction_is_the_model_in_the_channels_of_the_camera(channels):
    normals, albedo, labels, height = maps(channels=channels)
    lights = [Light(direction=(1, 2, 2)), Light(position_mm=(-20, 15, 30))]
    shadows = cast_shadows(height, lights, pitch=1.0)
    model = PlaneMaps(normals, albedo, GLOSS, labels=labels)
    predicted = list(predict_observations(model, lights, visibility=shadows))
    for light, prediction in zip(lights, predicted, strict=True):
        source = light.homogeneous()
        visible = cast_shadows(height, [light], pitch=1.0)[0]
        for row, column in ((0, 0), (7, 30), (29, 40), (15, 20), (22, 3)):
            point = np.array([column - 20.0, 14.5 - row, 0])
            to_light = source[:3] - source[3] * point
            to_light /= np.linalg.norm(to_light)
            normal = normals[row, column].astype(float)
            region = labels[row, column]
            shine = specular(
                normal, to_light, np.array([0, 0, 1.0]),
                beta=GLOSS.beta[region, 0], gamma=GLOSS.gamma[region, 0],
                refractive_index=GLOSS.refractive_index[region],
            )  # fmt: skip
            expected = visible[row, column] * (albedo[row, column] * max(normal @ to_light, 0) + shine)
            np.testing.assert_allclose(prediction.values[row, column], expected, rtol=2e-6, atol=1e-12)
    assert np.all(predicted[0].flags == 0)


def test_missing_normals_and_shapes():
    normals, albedo, _, _ = maps()
    normals[3, 4] = 0
    (prediction,) = predict_observations(PlaneMaps(normals, albedo, Gloss.none()), [Light(direction=(0, 0, 1))])
    assert prediction.flags[3, 4] == NORMAL_MISSING
    assert np.all(prediction.values[3, 4] == 0)


def small_scene():
    normals, albedo, labels, height = maps(channels=3)
    return PlaneScene(normals, albedo, labels=labels, height=height, gloss=GLOSS)


def test_the_eye_of_a_film_swings_about_its_target():
    view = View(eye_mm=(0, 10, 80), target_mm=(1, 2, 0), field_of_view=0.6, rows=20, columns=30)
    views = list(orbit(view, 4))
    offsets = np.array([np.subtract(v.eye_mm, v.target_mm) for v in views])
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), np.linalg.norm([-1, 8, 80]))
    np.testing.assert_allclose(offsets[1], [-1, 8, 80], atol=1e-9)
    assert offsets[0, 0] > 30
    scene, lights = small_scene(), [Light(direction=(1, 1, 1))]
    shadows = cast_shadows(scene.height, lights, pitch=scene.pitch)
    expected = render(scene, lights, views[2])
    np.testing.assert_array_equal(render(scene, lights, views[2], visibility=shadows).xyz, expected.xyz)
