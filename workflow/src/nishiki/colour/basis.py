"""Bases of reflectance and the system matrix of camera and lamp (Tominaga and Tanaka 2004, eq. 5-7)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nishiki.colour.sampling import BANDS, integration_weights
from nishiki.errors import UserError


@dataclass(frozen=True)
class PrincipalBasis:
    """Reflectance model S = mean + coefficients @ vectors.

    vectors : (K, 61) orthonormal rows, the strongest first, each with a positive sum.
    mean : (61,) zero for the uncentred basis.
    explained : (K,) share of the training energy (uncentred) or variance (centred) in each vector.
    """

    vectors: np.ndarray
    mean: np.ndarray
    explained: np.ndarray


def principal_basis(reflectances: np.ndarray, count: int, *, centred: bool = False) -> PrincipalBasis:
    """Principal vectors of measured reflectances.

    Uncentred (the default) is the paper's form, S = sum_k sigma_k S_k (Tominaga and Tanaka 2004, eq. 5): singular
    vectors of the data as they are, so that black is a zero of all coefficients. `centred=True` is principal component
    analysis about the mean.

    reflectances : (M, 61) in [0, 1]; count : 1 <= K <= min(M, 61). Raises UserError for other shapes or NaN.
    """
    data = checked_spectra(reflectances, "training reflectances")
    limit = min(data.shape[0] - int(centred), BANDS)
    if not 1 <= count <= limit:
        raise UserError(
            f"number of bases: expected 1 to {limit} for {data.shape[0]} training spectra, found {count}; "
            "ask for fewer bases or give more spectra"
        )
    mean = data.mean(axis=0) if centred else np.zeros(BANDS)
    _, singular, vectors = np.linalg.svd(data - mean, full_matrices=False)
    vectors = vectors[:count]
    vectors = vectors * np.where(vectors.sum(axis=1) < 0, -1.0, 1.0)[:, None]
    energy = singular**2
    total = energy.sum()
    explained = energy[:count] / total if total > 0 else np.zeros(count)
    return PrincipalBasis(vectors=vectors, mean=mean, explained=explained)


def channel_weights(illuminant: np.ndarray, sensitivities: np.ndarray, *, rule: str = "trapezoid") -> np.ndarray:
    """Linear functional of each white-normalised channel: response = weights @ S, and weights @ 1 = 1.

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
    products = normalised(curves) * normalised(lamp) * integration_weights(rule)
    totals = products.sum(axis=1)
    blind = np.flatnonzero(~(totals > 1e-12 * max(np.abs(totals).max(), np.finfo(float).tiny)))
    if blind.size:
        raise UserError(
            f"camera channel {', '.join(str(int(i)) for i in blind)} (counted from 0): expected some response to the "
            "white reference under this illuminant, found none; leave it out or correct its table or the lamp's"
        )
    return products / totals[:, None]


def normalised(curves: np.ndarray) -> np.ndarray:
    """Curves (..., 61) divided by their largest absolute value; a curve of zeros stays as it is."""
    top = np.abs(curves).max(axis=-1, keepdims=True)
    return curves / np.where(top > 0, top, 1.0)


def checked_spectra(values: np.ndarray, name: str) -> np.ndarray:
    """(M, 61) float64 from (61,) or (M, 61); UserError if the shape differs or a value is not finite."""
    spectra = np.atleast_2d(np.asarray(values, dtype=float))
    if spectra.ndim != 2 or spectra.shape[1] != BANDS or spectra.shape[0] == 0:
        raise UserError(
            f"{name}: expected {BANDS} bands (400-700 nm every 5 nm) a curve, found shape {np.shape(values)}; "
            "bring the curve onto the working grid first"
        )
    if not np.all(np.isfinite(spectra)):
        raise UserError(f"{name}: expected finite values, found NaN or infinity; correct the table")
    return spectra
