"""Spectral sensitivities of a camera from one photograph of a colour target (Jiang et al. 2013), and their error."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from nishiki.colour.basis import channel_weights
from nishiki.colour.sampling import WAVELENGTHS_NM
from nishiki.packages import optional


@dataclass(frozen=True)
class Sensitivities:
    """Sensitivities that a target supports.

    Attributes
    ----------
    curves : (3, 61) float64
        On the working grid (400 to 700 nm, every 5 nm), the largest of each channel at 1, never negative.
    residual : float
        Root mean square of what they leave of the patches, relative to the white patch.
    left_out : float
        The same of patches that were left out in turn.
    """

    curves: np.ndarray
    residual: float
    left_out: float


def chart_reflectances() -> tuple[tuple[str, ...], np.ndarray]:
    """Names and reflectances (24, 61) of the ColorChecker Classic: means of thirty charts, BabelColor 2012."""
    colour = _colour_science()
    chart = colour.SDS_COLOURCHECKERS["BabelColor Average"]
    curves = [np.interp(WAVELENGTHS_NM, each.wavelengths, each.values) for each in chart.values()]
    return tuple(chart), np.array(curves)


def recover(linear: np.ndarray, illuminant: np.ndarray, reflectances: np.ndarray, usable: np.ndarray) -> Sensitivities:
    """Sensitivities as sums of two principal components of each channel of 28 cameras (Jiang et al. 2013, eq. 5).

    Parameters
    ----------
    linear : (24, 3)
        Linear values of the patches.
    illuminant : (61,)
        Spectrum of the lamp on the working grid.
    reflectances : (24, 61)
        Of the patches.
    usable : (24,) bool
        Patches that take part.

    Notes
    -----
    The components are those of Dyer et al. (2017), computed from the cameras of Jiang et al.
    """
    fit = _fit(linear[usable], illuminant, reflectances[usable])
    expected = _responses(fit, illuminant, reflectances, linear, usable)
    left_out = np.empty_like(linear)
    for k in np.flatnonzero(usable):
        others = usable.copy()
        others[k] = False
        curves = _fit(linear[others], illuminant, reflectances[others])
        left_out[k] = _responses(curves, illuminant, reflectances, linear, others)[k]
    white = linear[18].mean()
    return Sensitivities(
        fit / fit.max(axis=1, keepdims=True),
        float(np.sqrt(np.mean((expected - linear)[usable] ** 2)) / white),
        float(np.sqrt(np.mean((left_out - linear)[usable] ** 2)) / white),
    )


def _fit(linear: np.ndarray, illuminant: np.ndarray, reflectances: np.ndarray) -> np.ndarray:
    """(3, 61) curves, not normalised."""
    colour = _colour_science()
    shape = colour.SpectralShape(400, 700, 10)
    every = slice(None, None, 2)
    grid = WAVELENGTHS_NM[every]
    lamp = colour.SpectralDistribution(illuminant[every] / illuminant.max(), grid)
    patches = colour.MultiSpectralDistributions(reflectances.T[every], grid)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        recovered = colour.recovery.RGB_to_msds_camera_sensitivities_Jiang2013(linear, lamp, patches, shape=shape)
    curves = np.array([np.interp(WAVELENGTHS_NM, recovered.wavelengths, values) for values in recovered.values.T])
    return np.maximum(curves, 0)


def _responses(curves, illuminant, reflectances, linear, usable) -> np.ndarray:
    """Values (24, 3) that curves predict, each channel at the scale that suits the usable patches best."""
    seen = reflectances @ channel_weights(illuminant, curves).T
    scale = np.sum(seen[usable] * linear[usable], axis=0) / np.sum(seen[usable] ** 2, axis=0)
    return scale * seen


def _colour_science():
    """The package, without its remarks on other packages that are not there."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return optional("colour-science")
