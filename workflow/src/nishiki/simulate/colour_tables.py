"""Spectra into numbers: what each paint gives in each channel of the camera and in XYZ."""

from __future__ import annotations

import numpy as np

from nishiki.simulate.lamp import planck_spectrum
from nishiki.simulate.palette import Palette
from nishiki.simulate.sensor import FINE_NM, sensitivities
from nishiki.simulate.settings import SimulationSettings


def camera_tables(palette: Palette, settings: SimulationSettings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(table, squared, white): response of each paint (labels, channels) relative to a perfect white, the same for the
    squared reflectance (light that met the paint twice), and the white's own response (channels,), the largest = 1."""
    lamp = planck_spectrum(FINE_NM, settings.lights.colour_temperature_k)
    weights = sensitivities(FINE_NM, settings.camera.channels) * lamp
    white = weights.sum(axis=1)
    weights = (weights / white[:, None]).T
    return palette.spectra @ weights, palette.spectra**2 @ weights, white / white.max()


def xyz_tables(spectra: np.ndarray, illuminant: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(table (labels, 3), squared, white (3,)): XYZ of spectra (labels, 61) at 400..700/5 nm under an illuminant (61,).

    Y of a perfect white is 1. Plain sums over the 61 bands.
    """
    from nishiki.colour.colour import xyz_matrix

    return (
        xyz_matrix(illuminant, spectra).T,
        xyz_matrix(illuminant, spectra**2).T,
        xyz_matrix(illuminant, np.ones((1, spectra.shape[1])))[:, 0],
    )
