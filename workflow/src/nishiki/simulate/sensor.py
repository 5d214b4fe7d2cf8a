"""The camera: spectral sensitivities, noise, digitisation."""

from __future__ import annotations

import math

import numba
import numpy as np

from nishiki.simulate.randomness import normal
from nishiki.simulate.settings import CameraSettings
from nishiki.threads import over_rows

FINE_NM = np.arange(380.0, 780.5, 2.0)  # finer and wider than the grid on which the chain works

# (peak, centre nm, width below, width above) of each lobe of red, green and blue
_RGB = (
    ((0.95, 602.0, 26.0, 36.0), (0.10, 540.0, 30.0, 26.0), (0.03, 440.0, 20.0, 24.0)),
    ((1.00, 534.0, 32.0, 37.0), (0.05, 468.0, 18.0, 20.0)),
    ((0.86, 456.0, 24.0, 29.0), (0.06, 530.0, 26.0, 30.0)),
)


def channel_names(count: int) -> tuple[str, ...]:
    """red, green, blue for three channels, else band1 (long waves) to bandN (short waves)."""
    return ("red", "green", "blue") if count == 3 else tuple(f"band{index + 1}" for index in range(count))


def sensitivities(wavelengths_nm: np.ndarray, channels: int) -> np.ndarray:
    """Relative sensitivities (channels, wavelengths), 0..1: invented smooth lobes behind an infrared and UV filter.

    Three channels: broad overlapping red, green and blue with small side lobes. More: one bell each, evenly placed
    from 655 to 430 nm.
    """
    w = np.asarray(wavelengths_nm, float)
    cut = 1.0 / (1.0 + np.exp(-(w - 408.0) / 5.0)) / (1.0 + np.exp((w - 672.0) / 7.0))
    if channels == 3:
        return np.array([sum(_lobe(w, *lobe) for lobe in lobes) for lobes in _RGB]) * cut
    centres = np.linspace(655.0, 430.0, channels)
    width = 0.5 * 225.0 / (channels - 1)
    return np.array([_lobe(w, 0.9, centre, width, 1.15 * width) for centre in centres]) * cut


def _lobe(w, peak, centre, below, above):
    return peak * np.exp(-0.5 * ((w - centre) / np.where(w < centre, below, above)) ** 2)


@numba.njit(cache=True, nogil=True)
def _expose(start, stop, signal, full_scale, black, electrons, read_noise, noisy, key, first, codes):
    columns, channels = signal.shape[1], signal.shape[2]
    for row in range(start, stop):
        for column in range(columns):
            for channel in range(channels):
                count = max(np.float64(signal[row, column, channel]), 0.0) * electrons
                if noisy:
                    place = np.uint64(((first + row) * columns + column) * channels + channel)
                    # One normal number serves both: shot noise of a large count is normal with that variance.
                    count += math.sqrt(count + read_noise * read_noise) * normal(key, place)
                code = math.floor(black + count / electrons * (full_scale - black) + 0.5)
                codes[row, column, channel] = min(max(code, 0.0), full_scale)


def dark_frame(shape: tuple[int, ...], camera: CameraSettings, *, key: int) -> np.ndarray:
    """Codes (rows, columns, channels) with the lens closed: black level and read noise."""
    return expose(np.zeros(shape, np.float32), camera, key=key)


def expose(signal: np.ndarray, camera: CameraSettings, *, key: int, first_row: int = 0) -> np.ndarray:
    """Codes (rows, columns, channels) uint16 of an exposure; 1.0 in `signal` fills the well and the converter.

    Shot noise is taken as normal (the well holds thousands of electrons; below some ten electrons the read noise
    hides the difference). `first_row` is the row of the image at which this band starts, so that bands join exactly.
    """
    codes = np.empty(signal.shape, np.uint16)
    full = float(2**camera.bits - 1)
    over_rows(
        _expose,
        len(codes),
        np.ascontiguousarray(signal, np.float32),
        full,
        float(camera.black_level),
        camera.full_well,
        camera.read_noise,
        camera.noise,
        np.uint64(key),
        first_row,
        codes,
    )
    return codes
