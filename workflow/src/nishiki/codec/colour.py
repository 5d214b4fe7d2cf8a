"""Decorrelation of the channels by an orthonormal matrix: rows are the new channels, the strongest first."""

from __future__ import annotations

import numpy as np


def principal_channels(covariance: np.ndarray) -> np.ndarray:
    """(C, C) float64 orthonormal: eigenvectors of a (C, C) second moment, by falling eigenvalue (the KLT).

    Each row's largest entry is positive, so that the result does not depend on the solver's choice of sign. Entries are
    multiples of 2**-20, a number that a header holds exactly; the identity where nothing is known.
    """
    if not np.isfinite(covariance).all() or np.abs(covariance).max(initial=0) == 0:
        return np.eye(len(covariance))
    _, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    rows = vectors.T[::-1]
    largest = np.take_along_axis(rows, np.abs(rows).argmax(axis=1)[:, None], axis=1)
    return np.round(rows * np.sign(largest) * 2**20) / 2**20
