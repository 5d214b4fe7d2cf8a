"""What oblique images say of a model's error, carried over to the directions around them."""

from dataclasses import replace

import numpy as np
import pytest

from nishiki.brdf.cloth.interface import gloss_of
from nishiki.brdf.cloth.store import load_brdf, save_brdf
from nishiki.brdf.cloth.yarn_facets import (
    CENTRE,
    REACH_DIFFERENCE,
    fit_ratio,
    likeness,
    places_of,
    ratio,
    shape_of,
    without_correction,
)
from nishiki.goniometry.directions import unit
from nishiki.render.cloth.scene import together
from nishiki.render.display import three_channels


def direction(theta, phi):
    return unit(np.radians(np.atleast_1d(theta)), np.radians(np.atleast_1d(phi)))


IMAGES = direction([30.0, 60.0, 45.0], [0.0, 90.0, 45.0]), direction([50.0, 20.0, 70.0], [160.0, 250.0, 225.0])


def test_images_are_met_and_far_directions_left_alone():
    places = places_of(*IMAGES)
    weights = fit_ratio(places, np.array([1.3, 0.9, 1.0]), np.ones(3), quarter=True)
    np.testing.assert_allclose(ratio(*IMAGES, places, weights, True), [1.3, 0.9, 1.0], rtol=0.02)
    far = direction(10.0, 0.0), direction(10.0, 180.0)
    assert ratio(*far, places, weights, True) == pytest.approx(1, abs=1e-4)


def test_ratio_is_symmetric_and_continuous():
    places = places_of(*IMAGES)
    weights = fit_ratio(places, np.array([1.3, 0.9, 1.0]), np.ones(3), quarter=True)
    rng = np.random.default_rng(1)
    theta, phi = rng.uniform(0, 85, (2, 200)), rng.uniform(0, 360, (2, 200))
    i, o = direction(theta[0], phi[0]), direction(theta[1], phi[1])
    here = ratio(i, o, places, weights, True)
    assert np.ptp(here) > 0.1
    np.testing.assert_allclose(ratio(o, i, places, weights, True), here, rtol=1e-12)
    for mirror in ([-1, 1, 1], [1, -1, 1], [-1, -1, 1]):
        np.testing.assert_allclose(ratio(i * mirror, o * mirror, places, weights, True), here, rtol=1e-12)
    near = ratio(i, direction(theta[1] + 0.01, phi[1]), places, weights, True)
    assert np.abs(near - here).max() < 1e-3


def test_likeness_is_positive_definite_and_ends_at_its_reach():
    rng = np.random.default_rng(2)
    theta, phi = rng.uniform(0, 85, (2, 60)), rng.uniform(0, 360, (2, 60))
    places = places_of(direction(theta[0], phi[0]), direction(theta[1], phi[1]))
    for quarter in (True, False):
        matrix = likeness(places, places, quarter)
        np.testing.assert_allclose(matrix, matrix.T, atol=1e-12)
        assert np.linalg.eigvalsh(matrix).min() > -1e-9
    near, far = (places_of(direction(angle, 0.0), direction(angle, 180.0)) for angle in (20.0, 60.0))
    assert far[0, 3] - near[0, 3] > REACH_DIFFERENCE
    assert likeness(near, far, False) == 0
    assert likeness(near, near, False) == pytest.approx(1, abs=1e-12)


def test_black_images_say_nothing():
    weights = fit_ratio(places_of(*IMAGES), np.array([0.0, 1.0, 1.0]), np.ones(3), quarter=False)
    assert np.abs(weights).max() < 1e-9


def test_model_with_images_is_stored_and_reciprocal(tmp_path):
    places = places_of(*IMAGES)
    plain = without_correction(shape_of(CENTRE), [0.1, 0.2], [0.0, 0.0])
    weights = fit_ratio(places, np.array([1.2, 0.8, 1.1]), np.ones(3), quarter=True)
    brdf = replace(plain, images=places, image_weights=weights)
    i, o = IMAGES
    np.testing.assert_allclose(brdf.evaluate(i, o) / plain.evaluate(i, o), np.tile([[1.2], [0.8], [1.1]], 2), rtol=0.02)
    np.testing.assert_allclose(brdf.evaluate(i, o), brdf.evaluate(o, i), rtol=1e-9)
    save_brdf(tmp_path / "brdf.npz", brdf)
    np.testing.assert_array_equal(load_brdf(tmp_path / "brdf.npz").evaluate(i, o), brdf.evaluate(i, o))


def test_models_that_differ_in_their_images_are_not_taken_for_one():
    places, (i, o) = places_of(*IMAGES), IMAGES
    first = replace(without_correction(shape_of(CENTRE), [0.1], [0.0]), images=places, image_weights=np.zeros(3))
    others = [
        replace(first, image_weights=fit_ratio(places, np.array([1.2, 0.8, 1.1]), np.ones(3), quarter=True)),
        replace(first, quarter=False),
        gloss_of(first),
    ]
    for brdf, values in zip([first, *others], together([first, *others], i, o), strict=True):
        np.testing.assert_array_equal(values, three_channels(brdf.evaluate(i, o)))
