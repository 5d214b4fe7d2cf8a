"""The expected colour error under other lights: its slow form, and what it says of unseen surfaces."""

import numpy as np

from nishiki.colour.colour import illuminant
from nishiki.colour.estimate import (
    NEIGHBOURS,
    colour_differences,
    estimate_spectra,
    expected_colour_error,
    fit_estimator,
    sample_rows,
)
from nishiki.colour.fitting import ResponseSpace
from nishiki.colour.sampling import WAVELENGTHS_NM, channel_weights
from nishiki.colour.training import synthetic_reflectances

TRAINING = synthetic_reflectances(500, seed=11)
CAMERA = np.exp(-0.5 * ((WAVELENGTHS_NM - np.array([[600.0], [540.0], [450.0]])) / 35.0) ** 2)
WEIGHTS = channel_weights(illuminant("A"), CAMERA)
ESTIMATOR = fit_estimator(TRAINING, illuminant("A"), CAMERA)


def test_equals_the_mean_over_neighbours_one_pixel_at_a_time():
    responses = synthetic_reflectances(20, seed=12) @ WEIGHTS.T
    found = expected_colour_error(responses, TRAINING, WEIGHTS, ESTIMATOR, lights=("FL11",))["FL11"]
    space = ResponseSpace(ESTIMATOR.mean, ESTIMATOR.whiten, ESTIMATOR.low, ESTIMATOR.high)
    seen = TRAINING @ WEIGHTS.T
    errors = colour_differences(estimate_spectra(seen, ESTIMATOR).spectra(), TRAINING, "FL11")
    for value, response in zip(found, responses, strict=True):
        apart = np.linalg.norm(space.coordinates(response[None]) - space.coordinates(seen), axis=1)
        np.testing.assert_allclose(value, errors[np.argsort(apart)[:NEIGHBOURS]].mean(), rtol=1e-12)


def test_expected_error_is_that_of_unseen_spectra():
    unseen = synthetic_reflectances(500, seed=13)
    responses = unseen @ WEIGHTS.T
    expected = expected_colour_error(responses, TRAINING, WEIGHTS, ESTIMATOR)
    found = estimate_spectra(responses, ESTIMATOR).spectra()
    for light, values in expected.items():
        true = colour_differences(found, unseen, light).mean()
        assert 0.7 * true < values.mean() < 1.2 * true
    assert expected["A"].mean() < expected["FL11"].mean()  # the light of the capture is known best


def test_sample_is_a_regular_grid_of_about_the_count():
    rows, columns = sample_rows(3000, 4000, 2000)
    assert 1000 < len(rows) * len(columns) <= 2100
    assert len(set(np.diff(rows))) == 1
    rows, columns = sample_rows(3, 5, 2000)
    assert (len(rows), len(columns)) == (3, 5)
