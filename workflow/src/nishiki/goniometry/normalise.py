"""Reflectances from the light of the cloth and of the white board (Takeda and Tanaka, eq. 4); repeats of a direction as
one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Averaged:
    """rows (m,): index of the first measurement of each pair of directions; values, noise (m, regions, channels);
    valid (m, regions); repeats (m,): measurements that were brought together."""

    rows: np.ndarray
    values: np.ndarray
    noise: np.ndarray
    valid: np.ndarray
    repeats: np.ndarray


def reflectance(
    light: np.ndarray, noise: np.ndarray, white: np.ndarray, white_noise: np.ndarray, white_reflectance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """rho = (L_sample / L_white) rho_white / pi and its standard deviation, sr^-1; all (..., channels), L in any one
    unit, exposure times divided out. Relative variances add. 0 where the board gave no light, or so little that the
    quotient leaves float64."""
    known = white > 0
    safe = np.where(known, white, 1.0)
    with np.errstate(over="ignore", invalid="ignore"):
        scale = np.where(known, white_reflectance / (np.pi * safe), 0.0)
        values = light * scale
        deviation = np.hypot(noise * scale, values * (white_noise / safe))
    finite = np.isfinite(values) & np.isfinite(deviation)
    return np.where(finite, values, 0.0), np.where(finite, deviation, 0.0)


def average_repeats(
    angles_deg: np.ndarray, values: np.ndarray, noise: np.ndarray, valid: np.ndarray, exposures: np.ndarray
) -> Averaged:
    """Measurements of the same pair of directions as one: weighted by exposure time, those not valid left out.

    angles_deg (n, 4); values, noise (n, regions, channels); valid (n, regions); exposures (n,) > 0. The order of the
    first measurements is kept. Where none of a pair is valid the result is 0 and not valid.
    """
    folded = np.round(np.where(angles_deg[:, [0, 0, 2, 2]] == 0, [[1, 0, 1, 0]], 1) * angles_deg, 4)
    folded[:, [1, 3]] = np.round(folded[:, [1, 3]] % 360, 4) % 360
    _, rows, group = np.unique(folded, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(rows)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    group = rank[group.ravel()]
    rows = rows[order]
    weights = np.where(valid, exposures[:, None], 0.0)
    total = np.zeros((len(rows), valid.shape[1]))
    np.add.at(total, group, weights)
    usable = total > 0
    share = weights / np.where(usable, total, 1.0)[group]
    mean, variance = np.zeros((2, len(rows), *values.shape[1:]))
    # what is not valid may be no number at all: a share of 0 would not take it out
    values, noise = (np.where(valid[..., None], of, 0.0) for of in (values, noise))
    np.add.at(mean, group, share[..., None] * values)
    np.add.at(variance, group, (share[..., None] * noise) ** 2)
    return Averaged(rows, mean, np.sqrt(variance), usable, np.bincount(group))
