"""The synthetic training set is physical, varied and the same everywhere; measured sets are checked."""

import numpy as np
import pytest
from refusals import refused

from nishiki.colour import training
from nishiki.colour.sampling import WAVELENGTHS_NM
from nishiki.colour.training import edge
from nishiki.errors import UserError


def test_same_seed_same_set_other_seed_other_set():
    first = training.synthetic_reflectances(100, seed=5)
    np.testing.assert_array_equal(first, training.synthetic_reflectances(100, seed=5))
    assert np.abs(first - training.synthetic_reflectances(100, seed=6)).max() > 0.1


def test_numbers_are_stratified_and_from_pcg64():
    """The first numbers of the stream, so that a change of the generator under us is seen."""
    stream = np.random.Generator(np.random.PCG64(20240))
    order, inside = np.argsort(stream.random((50, 2)), axis=0), stream.random((50, 2))
    found = training.Draw(20240).uniform(3.0, 5.0, 50, 2)
    np.testing.assert_allclose(found, 3.0 + 2.0 * (order + inside) / 50)
    for column in found.T:
        np.testing.assert_array_equal(np.sort((column - 3.0) * 25.0).astype(int), np.arange(50))
    normal = training.Draw(1).normal(20000)
    assert abs(normal.mean()) < 0.02
    assert abs(normal.std() - 1.0) < 0.02


def test_layers_follow_kubelka_munk():
    """Against the differential equations of the two streams of light, integrated step by step (Runge and Kutta)."""
    absorption, scattering, depth, ground = 0.3, 0.8, 1.7, 0.6

    def slope(reflectance):  # dR/dx = S - 2 (K + S) R + S R^2, upwards from the ground
        return scattering - 2.0 * (absorption + scattering) * reflectance + scattering * reflectance**2

    reflectance, step = ground, depth / 4000
    for _ in range(4000):
        half = reflectance + 0.5 * step * slope(reflectance)
        reflectance += step * slope(half)
    found = training.reflectance_of_layer(*(np.array([[v]]) for v in (absorption, scattering, depth, ground)))
    assert found.item() == pytest.approx(reflectance, rel=1e-6)
    thick = training.reflectance_of_layer(np.array([absorption]), np.array([scattering])).item()
    assert slope(thick) == pytest.approx(0.0, abs=1e-12)


def test_surface_is_the_sum_of_all_inner_turns():
    body, external, internal = 0.7, 0.04, 0.55
    inside, total = (1.0 - external) * body, 0.0
    for _ in range(200):
        total += (1.0 - internal) * inside
        inside *= internal * body
    found = training.through_surface(body, external=external, internal=internal)
    assert found == pytest.approx(total, rel=1e-12)


def test_edges_lie_where_the_table_says():
    """A thick layer of the pure pigment reflects one half at the wavelength of its edge."""
    one = np.ones((1, 1))
    absorption = edge(500.0 * one, 9.0 * one, 4.0 * one, 0.6 * one)
    reflectance = training.reflectance_of_layer(absorption, 0.6 * one)[0]
    assert reflectance[WAVELENGTHS_NM == 500.0].item() == pytest.approx(0.5, abs=1e-12)
    assert reflectance[0] < 0.1
    assert reflectance[-1] > 0.98


def test_set_looks_like_paint():
    """Paints absorb in the violet: dark masstones, few whites; the mean rises towards the red."""
    mean = training.synthetic_reflectances().mean(axis=0)
    assert 0.1 < mean[0] < 0.2
    assert mean[WAVELENGTHS_NM == 440.0] < 0.26
    assert mean[-1] > 1.3 * mean[WAVELENGTHS_NM == 440.0]


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
    assert slope < 0.045  # per nm: beyond the edge of rutile K falls by a factor e in 4.5 nm
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
    with refused(UserError, "mine.csv"):
        training.measured_reflectances(grid, np.full((31, 2), 55.0), name="mine.csv")
    with pytest.raises(UserError, match=r"mine\.csv.*400-600"):
        training.measured_reflectances(grid[:21], np.full((21, 2), 0.5), name="mine.csv")
    with refused(UserError, "10", by="synthetic_reflectances"):
        training.synthetic_reflectances(3)
