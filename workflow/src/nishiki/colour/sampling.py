"""Bring measured curves onto the working grid of wavelengths, and build bases and system matrices there.

Every spectrum inside the project is an array whose last axis is `WAVELENGTHS_NM`: 400 to 700 nm every 5 nm, 61 bands.
"""

from typing import Any

import numpy as np

from nishiki.errors import UserError

WAVELENGTHS_NM = np.arange(400.0, 701.0, 5.0)
WAVELENGTHS_NM.setflags(write=False)
BANDS = WAVELENGTHS_NM.size
SPECTRAL_ROWS = 16  # of spectra in memory


def resample(
    wavelengths_nm: np.ndarray, values: np.ndarray, *, name: str = "curve", tolerance_nm: float = 5.0
) -> np.ndarray:
    """Bring measured curves onto the working grid, linearly between their samples.

    Parameters
    ----------
    wavelengths_nm : (W,) strictly increasing or strictly decreasing, nm.
    values : (..., W) any unit; the last axis belongs to `wavelengths_nm`.
    name : what to call the curve in an error message (file name or curve name).
    tolerance_nm : the ends may miss 400 or 700 nm by at most this much; the end value is then repeated (never
        extrapolated by slope). 0 forbids even that.

    Returns
    -------
    (..., 61) float64.

    Raises
    ------
    UserError : wrong shapes, too few samples, unsorted or repeated wavelengths, NaN, 400-700 nm not covered.
    """
    wavelengths, samples = _checked_curve(wavelengths_nm, values, name)
    low, high = wavelengths[0], wavelengths[-1]
    if low > WAVELENGTHS_NM[0] + tolerance_nm or high < WAVELENGTHS_NM[-1] - tolerance_nm:
        raise UserError(
            f"{name}: expected a curve that covers 400-700 nm (within {tolerance_nm:g} nm), found {low:g}-{high:g} nm; "
            "measure the missing part, or extend the table by hand with values that you can defend"
        )
    inside = np.clip(WAVELENGTHS_NM, low, high)
    right = np.clip(np.searchsorted(wavelengths, inside, side="right"), 1, wavelengths.size - 1)
    left = right - 1
    fraction = (inside - wavelengths[left]) / (wavelengths[right] - wavelengths[left])
    return samples[..., left] * (1.0 - fraction) + samples[..., right] * fraction


def _checked_curve(wavelengths_nm, values, name):
    wavelengths = np.asarray(wavelengths_nm, dtype=float)
    samples = np.asarray(values, dtype=float)
    if wavelengths.ndim != 1 or samples.ndim < 1 or samples.shape[-1] != wavelengths.size:
        raise UserError(
            f"{name}: expected one value a wavelength, found {wavelengths.shape} wavelengths and "
            f"values {samples.shape}; give arrays whose last axes agree"
        )
    if wavelengths.size < 2:
        raise UserError(f"{name}: expected at least 2 wavelengths, found {wavelengths.size}; give the whole curve")
    if wavelengths[0] > wavelengths[-1]:
        wavelengths, samples = wavelengths[::-1], samples[..., ::-1]
    if not np.all(np.diff(wavelengths) > 0):
        bad = int(np.flatnonzero(~(np.diff(wavelengths) > 0))[0])
        raise UserError(
            f"{name}: expected wavelengths that rise without repeats, found {wavelengths[bad]:g} nm followed by "
            f"{wavelengths[bad + 1]:g} nm; sort the table and remove repeats"
        )
    if not np.all(np.isfinite(samples)):
        raise UserError(
            f"{name}: expected finite values, found {int(np.sum(~np.isfinite(samples)))} NaN or infinite; "
            "fill or drop them"
        )
    return wavelengths, samples


def principal_basis(reflectances: np.ndarray, count: int) -> np.ndarray:
    """Find the principal vectors of measured reflectances, (K, 61) orthonormal rows, the strongest first.

    The paper's form, S = sum_k sigma_k S_k (Tominaga and Tanaka 2004, eq. 5): singular vectors of the data as they are,
    so that black is a zero of all coefficients. Each has a positive sum.

    reflectances : (M, 61) in [0, 1]; count : 1 <= K <= min(M, 61). Raises UserError for other shapes or NaN.
    """
    data = checked_spectra(reflectances, "training reflectances")
    limit = min(data.shape[0], BANDS)
    if not 1 <= count <= limit:
        raise UserError(
            f"number of bases: expected 1 to {limit} for {data.shape[0]} training spectra, found {count}; "
            "ask for fewer bases or give more spectra"
        )
    vectors = np.linalg.svd(data, full_matrices=False)[2][:count]
    return vectors * np.where(vectors.sum(axis=1) < 0, -1.0, 1.0)[:, None]


def channel_weights(illuminant: np.ndarray, sensitivities: np.ndarray) -> np.ndarray:
    """Compute the linear functional of each white-normalised channel: response = weights @ S, and weights @ 1 = 1.

    illuminant : (61,) relative power, >= 0. sensitivities : (N, 61) any scale a channel. Returns (N, 61).
    White normalisation divides each channel by its response to the perfect white, so lamp power, exposure and gain
    cancel and every row sums to 1: this is the bookkeeping under which a perfect white must return S = 1.
    Raises UserError where a channel sees no light at all.
    """
    lamp = checked_spectra(illuminant, "illuminant")[0]
    curves = checked_spectra(sensitivities, "camera sensitivities")
    if np.any(lamp < 0):
        raise UserError(f"illuminant: expected power >= 0, found {lamp.min():g}; correct the table")
    # only shapes matter: brought to a largest value of 1, no unit of power or response leaves float64
    steps = np.ones(BANDS)
    steps[[0, -1]] *= 0.5  # trapezoids: exact for piecewise linear curves
    products = normalise_curves(curves) * normalise_curves(lamp) * steps
    totals = products.sum(axis=1)
    blind = np.flatnonzero(~(totals > 1e-12 * max(np.abs(totals).max(), np.finfo(float).tiny)))
    if blind.size:
        raise UserError(
            f"camera channel {', '.join(str(int(i)) for i in blind)} (counted from 0): expected some response to the "
            "white reference under this illuminant, found none; leave it out or correct its table or the lamp's"
        )
    return products / totals[:, None]


def under_one_lamp(illuminant: np.ndarray | None = None, sensitivities: np.ndarray | None = None) -> dict[str, Any]:
    """Express channels that were photographed under lamps of their own as those of one camera under one lamp.

    illuminant : (1, 61), or (N, 61) relative power of each channel's lamp; sensitivities : (N, 61). Only their product
    decides a response: the one lamp (61,) is the mean of all, and each sensitivity (N, 61) is multiplied by what its
    own lamp is relative to it. Returns those that are given.
    """
    curves = {} if sensitivities is None else {"sensitivities": sensitivities}
    if illuminant is None:
        return curves
    if len(illuminant) == 1:
        return {"illuminant": illuminant[0], **curves}
    lamps = normalise_curves(illuminant)
    mean = lamps.mean(axis=0)
    relative = np.divide(lamps, mean, out=np.zeros_like(lamps), where=mean > 0)
    return {"illuminant": mean, **{name: values * relative for name, values in curves.items()}}


def normalise_curves(curves: np.ndarray) -> np.ndarray:
    """Divide curves (..., 61) by their largest absolute value; a curve of zeros stays as it is."""
    top = np.abs(curves).max(axis=-1, keepdims=True)
    return curves / np.where(top > 0, top, 1.0)


def checked_spectra(values: np.ndarray, name: str) -> np.ndarray:
    """Check spectra (61,) or (M, 61), as (M, 61) float64; UserError if the shape differs or a value is not finite."""
    spectra = np.atleast_2d(np.asarray(values, dtype=float))
    if spectra.ndim != 2 or spectra.shape[1] != BANDS or spectra.shape[0] == 0:
        raise UserError(
            f"{name}: expected {BANDS} bands (400-700 nm every 5 nm) a curve, found shape {np.shape(values)}; "
            "bring the curve onto the working grid first"
        )
    if not np.all(np.isfinite(spectra)):
        raise UserError(f"{name}: expected finite values, found NaN or infinity; correct the table")
    return spectra
