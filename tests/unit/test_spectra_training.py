"""The synthetic training set is physical, varied and the same everywhere; measured sets are checked."""

import numpy as np
import pytest

from nishiki.errors import UserError
from nishiki.spectra import training
from nishiki.spectra.sampling import WAVELENGTHS_NM


def test_same_seed_same_set_other_seed_other_set():
    first = training.synthetic_reflectances(100, seed=5)
    np.testing.assert_array_equal(first, training.synthetic_reflectances(100, seed=5))
    assert np.abs(first - training.synthetic_reflectances(100, seed=6)).max() > 0.1


def test_stream_is_that_of_pcg64():
    """The first numbers of the stream, so that a change of the generator under us is seen."""
    draw = training._Draw(20240)
    expected = np.random.Generator(np.random.PCG64(20240)).random(3)
    np.testing.assert_array_equal(draw.uniform(0.0, 1.0, 3), expected)
    normal = training._Draw(1).normal(20000)
    assert abs(normal.mean()) < 0.02
    assert abs(normal.std() - 1.0) < 0.02


@pytest.mark.parametrize("count", [10, 137, 2000])
def test_reflectances_are_physical(count):
    spectra = training.synthetic_reflectances(count)
    assert spectra.shape == (count, WAVELENGTHS_NM.size)
    assert spectra.min() > 0
    assert spectra.max() < 1


def test_set_is_varied_yet_smooth():
    spectra = training.synthetic_reflectances()
    mean = spectra.mean(axis=1)
    assert mean.min() < 0.05
    assert mean.max() > 0.85
    slope = np.abs(np.diff(spectra, axis=1)).max() / 5.0
    assert slope < 0.03  # per nm: an edge of 10 nm logistic width at full height climbs 0.025
    hue_peak = np.argmax(spectra, axis=1)
    assert len(np.unique(hue_peak)) > 40
    energy = np.linalg.svd(spectra, compute_uv=False) ** 2
    assert 1 - energy[:8].sum() / energy.sum() < 1e-3  # natural reflectances: eight bases hold nearly everything


def test_measured_table_comes_onto_the_grid():
    grid = np.arange(380.0, 731.0, 10.0)
    table = np.random.default_rng(0).random((grid.size, 4))
    found = training.measured_reflectances(grid, table, name="mine.csv")
    np.testing.assert_allclose(found[2], np.interp(WAVELENGTHS_NM, grid, table[:, 2]), atol=1e-14)
    assert training.measured_reflectances(grid, table[:, 0], name="one column").shape == (1, 61)


def test_percent_and_short_tables_are_refused():
    grid = np.arange(400.0, 701.0, 10.0)
    with pytest.raises(UserError, match=r"mine\.csv.*divide percent"):
        training.measured_reflectances(grid, np.full((31, 2), 55.0), name="mine.csv")
    with pytest.raises(UserError, match=r"mine\.csv.*400-600"):
        training.measured_reflectances(grid[:21], np.full((21, 2), 0.5), name="mine.csv")
    with pytest.raises(UserError, match="at least 10"):
        training.synthetic_reflectances(3)
