"""Expected colour error of estimated spectra under lights that the camera has not seen.

Surfaces of one camera response differ in spectrum. How far their colours then differ under another light is read from
the training set: the colour differences between its spectra and what the estimator makes of their responses, at the
spectra whose responses lie nearest to a pixel's.
"""

from __future__ import annotations

import numpy as np

from nishiki.colour.colour import delta_e_2000, illuminant, white_xyz, xyz_from_spectra, xyz_to_lab
from nishiki.colour.estimate import SpectralEstimator, estimate_spectra
from nishiki.colour.local import ResponseSpace, distances

LIGHTS = ("D65", "A", "FL11")  # daylight, incandescent light, a fluorescent lamp of three narrow bands
NEIGHBOURS = 24
SAMPLE = 2000


def colour_differences(estimated: np.ndarray, true: np.ndarray, light: str) -> np.ndarray:
    """CIEDE2000 (...) between spectra (..., 61) under a CIE illuminant."""
    lamp = illuminant(light)
    white = white_xyz(lamp)
    return delta_e_2000(*(xyz_to_lab(xyz_from_spectra(lamp, spectra), white) for spectra in (estimated, true)))


def expected_colour_error(
    responses: np.ndarray,
    training: np.ndarray,
    weights: np.ndarray,
    estimator: SpectralEstimator,
    *,
    lights: tuple[str, ...] = LIGHTS,
) -> dict[str, np.ndarray]:
    """Expected CIEDE2000 of each response under each light.

    Parameters
    ----------
    responses : (P, N) finite white-normalised responses of pixels.
    training : (M, 61) reflectances that the estimator was fitted to.
    weights : (N, 61) from `nishiki.colour.basis.channel_weights`.
    estimator : fitted to `training`.
    lights : names of CIE illuminants.

    Returns
    -------
    Light -> (P,): mean over the `NEIGHBOURS` training spectra with the nearest responses. It holds for surfaces like
    those of the training set, for responses without noise (what noise adds is in every light's picture alike).
    """
    seen = training @ weights.T
    estimated = estimate_spectra(seen, estimator).spectra()
    errors = np.array([colour_differences(estimated, training, light) for light in lights])
    space = ResponseSpace(estimator.mean, estimator.whiten, estimator.low, estimator.high)
    apart = distances(space.coordinates(np.asarray(responses, float)), space.coordinates(seen))
    count = min(NEIGHBOURS, len(training))
    nearest = np.argpartition(apart, count - 1, axis=1)[:, :count]
    return {light: row[nearest].mean(axis=1) for light, row in zip(lights, errors, strict=True)}


def sample_rows(rows: int, columns: int, count: int = SAMPLE) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of a regular grid of at most about `count` pixels."""
    step = max(1, int(np.ceil(np.sqrt(rows * columns / count))))
    return np.arange(step // 2, rows, step), np.arange(step // 2, columns, step)
