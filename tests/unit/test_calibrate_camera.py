"""Linearity, noise and defects of a camera, against simulated ones that count electrons."""

import cv2
import numpy as np
import pytest
from refusals import refused

from nishiki.calibrate.camera import calibrate_camera, fit_photon_transfer
from nishiki.calibrate.result import write_calibration
from nishiki.errors import UserError

GAIN, READ, BLACK, FULL = 2.5, 3.0, 128, 4095
EXPOSURES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.8)


def series(folder, *, bend=0.0, exposures=EXPOSURES, copies=2, seed=0):
    """Frames of an uneven surface; one hot and one dead pixel; the longest exposure saturates."""
    random = np.random.default_rng(seed)
    y, x = np.mgrid[-1:1:120j, -1:1:160j]
    surface = (1 - 0.3 * (x * x + y * y) / 2) * (1 + 0.05 * np.sin(40 * x))
    lines = ["file,exposure_s"]
    for exposure in exposures:
        for k in range(copies):
            codes = exposure / 0.5 * 3600 * surface[..., None] * np.array([0.9, 1.0, 0.7])
            electrons = random.poisson(np.maximum(codes * GAIN, 0)).astype(float)
            codes = electrons / GAIN
            codes = BLACK + codes * (1 - bend * codes / FULL) + random.normal(0, READ, codes.shape)
            codes[30, 40] += 200
            codes[70, 80] = BLACK
            name = f"e{exposure:g}_{k}.png"
            stored = np.clip(np.round(codes), 0, FULL).astype(np.uint16)
            cv2.imwrite(str(folder / name), stored[..., ::-1])
            lines.append(f"{name},{exposure:g}")
    (folder / "series.csv").write_text("\n".join(lines) + "\n")
    return folder / "series.csv"


def test_gain_noise_level_and_defects_are_those_of_the_camera(tmp_path):
    result = calibrate_camera(series(tmp_path), bits=12)
    for channel in ("red", "green", "blue"):
        numbers = result.numbers["channels"][channel]
        assert numbers["gain_e_per_code"] == pytest.approx(GAIN, rel=0.03)
        assert abs(numbers["gain_e_per_code"] - GAIN) < 4 * numbers["gain_sigma"]
        assert numbers["read_noise_codes"] == pytest.approx(np.hypot(READ, 12**-0.5), rel=0.05)
        assert numbers["dark_level"] == pytest.approx(BLACK, abs=0.5)
        assert numbers["worst_deviation"] < 0.003
    assert (result.numbers["hot_samples"], result.numbers["dead_samples"]) == (3, 3)
    assert not result.numbers["used"][-1][1]  # the longest exposure saturates
    assert not result.warnings
    white = 0.98 * FULL - BLACK
    expected = np.sqrt(READ**2 + 0.5 * white / GAIN) / white
    assert result.numbers["spectra_noise"] == pytest.approx(expected, rel=0.03)
    assert result.lines["camera"] == {"black_level": pytest.approx(BLACK, abs=0.5), "bits": 12}
    write_calibration(tmp_path / "out", result)
    assert (tmp_path / "out" / "config-lines.yaml").read_text().startswith("spectra: {noise: 0.0")


def test_a_bent_response_is_warned_about(tmp_path):
    assert "linear" in calibrate_camera(series(tmp_path, bend=0.1), bits=12).warnings[0]


def test_series_that_tell_too_little_are_refused(tmp_path):
    with refused(UserError, "series.csv"):
        calibrate_camera(series(tmp_path, exposures=EXPOSURES[1:]), bits=12)
    with refused(UserError, "series.csv"):
        calibrate_camera(series(tmp_path, copies=1), bits=12)
    with refused(UserError, by="calibrate_camera"):
        calibrate_camera(series(tmp_path, exposures=(0.0, 0.1, 0.8, 0.9, 1.0)), bits=12)
    (tmp_path / "wrong.csv").write_text("file,time\n")
    with pytest.raises(UserError, match="file,exposure_s"):
        calibrate_camera(tmp_path / "wrong.csv")


def test_uncertainties_of_the_photon_transfer_are_those_of_repeats():
    signals, samples = np.array([0.0, 50, 200, 800, 3000]), 5000
    truth = READ**2 + signals / GAIN
    random = np.random.default_rng(1)
    fits = [fit_photon_transfer(signals, truth * random.chisquare(samples, 5) / samples, samples) for _ in range(300)]
    assert np.std([fit.gain for fit in fits]) == pytest.approx(np.mean([fit.gain_sigma for fit in fits]), rel=0.25)
    assert np.mean([fit.gain for fit in fits]) == pytest.approx(GAIN, rel=0.005)
    with refused(ValueError, by="fit_photon_transfer"):
        fit_photon_transfer(signals, truth[::-1], samples)
