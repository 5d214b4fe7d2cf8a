"""Errors on measured reflectances, real cameras and real lamps that the estimators were not trained on."""

import numpy as np
import pytest
from benchmarks import spectra as bench

from nishiki.colour.colour import illuminant
from nishiki.colour.estimate import METHODS, estimate_spectra, fit_estimator
from nishiki.colour.sampling import channel_weights
from nishiki.colour.training import synthetic_reflectances

pytestmark = pytest.mark.data


@pytest.fixture(scope="module")
def measured(data):
    folder = data / "spectra"
    sets = bench.read_reflectances(folder)
    return {
        "cameras": bench.read_cameras(folder),
        "lamps": bench.read_illuminants(folder),
        "munsell": next(iter(sets.values())),
        "paints": next(iter(bench.read_paints(folder).values())),
    }


def error(estimator, spectra, weights, noise=0.0):
    """Mean over spectra of the root-mean-square error over bands."""
    seen = spectra @ weights.T
    seen = seen * (1.0 + noise * np.random.default_rng(0).standard_normal(seen.shape))
    found = estimate_spectra(seen, estimator).spectra()
    return float(np.sqrt(np.mean((found - spectra) ** 2, axis=1)).mean())


def test_own_lamps_equal_the_published_files(measured):
    for name, file in (("A", "A"), ("D65", "D6500"), ("F11", "F11")):
        np.testing.assert_allclose(illuminant(name), measured["lamps"][file], rtol=1e-5)


def test_twenty_eight_cameras_are_read(measured):
    assert len(measured["cameras"]) == 28
    assert all(curves.shape == (3, 61) for curves in measured["cameras"].values())


@pytest.mark.slow
@pytest.mark.parametrize("split", ["even", "odd", "random"])
def test_munsell_half_for_training(measured, split):
    spectra = measured["munsell"]
    order = np.random.default_rng(1).permutation(len(spectra)) if split == "random" else np.arange(len(spectra))
    halves = (order[0::2], order[1::2]) if split != "odd" else (order[1::2], order[0::2])
    train, test = spectra[halves[0]], spectra[halves[1]]
    lamp, camera = measured["lamps"]["A"], measured["cameras"]["Canon 60D"]
    weights = channel_weights(lamp, camera)
    fitted = {m: fit_estimator(train, lamp, camera, method=m, white_width=0.05) for m in METHODS}
    assert 0.0200 < error(fitted["paper"], test, weights) < 0.0225
    assert error(fitted["wiener"], test, weights) < error(fitted["paper"], test, weights)
    assert error(fitted["local"], test, weights) < 0.0110
    assert error(fitted["local"], test, weights, noise=0.005) < 0.0115


@pytest.mark.slow
def test_paints_that_no_training_set_holds(measured):
    lamp, camera = measured["lamps"]["A"], measured["cameras"]["Canon 60D"]
    weights = channel_weights(lamp, camera)
    for training in (measured["munsell"], synthetic_reflectances()):
        found = {
            m: error(fit_estimator(training, lamp, camera, method=m), measured["paints"], weights) for m in METHODS
        }
        assert found["local"] < found["wiener"] < found["paper"] * 1.01
        assert found["local"] < 0.05


@pytest.mark.slow
def test_paints_of_makers_that_the_set_was_not_chosen_on(data, measured):
    """Little more than half of the paper's error, and no maker on which the linear estimate would have been better."""
    unseen = (
        "BobRoss_LP Chartpak_GrumbacherPTO Divolo_Restauro ETAC_EFX500t GretagMacbethMini Maimeri_Classico "
        "MunsellGlossy5P MunsellGlossy5Y Schmincke_Mussini Schmincke_Primacryl Titan_Bizancio Vallejo_AcrylicStudio "
        "WinsorNewton_Artist WinsorNewton_Finity"
    ).split()
    makers = bench.read_makers(data / "spectra")
    if not set(unseen) <= set(makers):
        pytest.skip("no paints by maker in the measured data")
    lamp, camera = measured["lamps"]["A"], measured["cameras"]["Canon 60D"]
    weights = channel_weights(lamp, camera)
    reference = fit_estimator(measured["munsell"], lamp, camera, method="paper")
    own = {m: fit_estimator(synthetic_reflectances(), lamp, camera, method=m) for m in ("local", "wiener")}
    for maker in unseen:
        assert error(own["local"], makers[maker], weights) < error(own["wiener"], makers[maker], weights)
    paints = np.concatenate([makers[maker] for maker in unseen])
    assert error(own["local"], paints, weights) < 0.58 * error(reference, paints, weights)


@pytest.mark.slow
def test_every_camera_and_lamp_keeps_white_and_order(measured):
    spectra = measured["munsell"]
    for index, name in enumerate(list(measured["cameras"])[::7]):
        for lamp in ("A", "D6500", "F11")[index % 3 : index % 3 + 1]:
            camera = measured["cameras"][name]
            weights = channel_weights(measured["lamps"][lamp], camera)
            fitted = {m: fit_estimator(spectra[0::2], measured["lamps"][lamp], camera, method=m) for m in METHODS}
            for e in fitted.values():
                np.testing.assert_allclose(estimate_spectra(np.ones(3), e).spectra(), 1.0, atol=1e-6)
            errors = [error(fitted[m], spectra[1::2], weights) for m in ("local", "wiener")]
            assert errors[0] < 0.75 * errors[1]
