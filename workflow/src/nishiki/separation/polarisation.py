"""Diffuse and specular reflection of one view from its photographs under several polariser states.

The diffuse part left the body after many scatterings and is taken as unpolarised, the specular part as keeping what
the lamp's polariser gave it. Derivations: docs/stages/polarise.md.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numba import njit

from nishiki.render.threads import over_rows
from nishiki.separation.polariser_states import StateSums


@dataclass(frozen=True)
class SeparatedView:
    """diffuse, specular (rows, columns, channels) float32, 0 where not valid; specular may be negative, which is noise.
    valid (rows, columns) bool: every photograph that was used is valid there, and what divides is known."""

    diffuse: np.ndarray
    specular: np.ndarray
    valid: np.ndarray


def sum_planes(
    photographs: Iterable[tuple[np.ndarray, np.ndarray]], weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Weighted sums (planes, rows, columns, channels) float32 of photographs, and where all that count are valid.

    photographs: (values (rows, columns, channels) float32, valid (rows, columns) bool) in the order of the columns of
    weights (planes, states); taken one at a time, those of weight 0 too.
    """
    planes = valid = None
    for column, (values, good) in zip(weights.T, photographs, strict=True):
        if planes is None:
            planes, valid = np.zeros((len(weights), *values.shape), np.float32), np.ones(good.shape, bool)
        if not column.any():
            continue
        valid &= good
        add_weighted(planes, np.ascontiguousarray(values, np.float32), np.asarray(column, np.float32))
    return planes, valid


def add_weighted(planes: np.ndarray, values: np.ndarray, weights: np.ndarray) -> None:
    """planes[p] += weights[p] * values, in place; planes (p, rows, columns, channels), all float32."""
    flat, added = planes.reshape(len(planes), -1), values.reshape(-1)
    rows = -(-len(added) // ROW)

    def band(first: int, last: int) -> None:
        add_weighted_band(flat, added, weights, first * ROW, min(last * ROW, len(added)))

    over_rows(band, rows)


ROW = 1 << 14


@njit(cache=True, nogil=True, error_model="numpy")
def add_weighted_band(planes, values, weights, first, last):
    """Values first .. last - 1 of `add_weighted`; a value that is not finite counts as 0."""
    for p in range(planes.shape[0]):
        weight = weights[p]
        if weight == 0:
            continue
        for k in range(first, last):
            value = values[k]
            if np.isfinite(value):
                planes[p, k] += weight * value


def components(
    planes: np.ndarray,
    valid: np.ndarray,
    sums: StateSums,
    *,
    beta: np.ndarray | None = None,
    phase: float | None = None,
    sense: int = 1,
    gain: np.ndarray | None = None,
) -> SeparatedView:
    """The two components of planes made by `sum_planes` with `sums.weights`.

    none: all counts as diffuse. circular (O 2.2, app. 1): I_d = I_on / beta, I_s = I_off - I_d; beta broadcasts against
    a picture, NaN where it is unknown (those pixels become invalid). crossed, pairs: I_d = 2 crossed, I_s = parallel -
    crossed. linear: I_d = 2 (a - b), I_s = 2 b; b is the amplitude of each pixel, or, with a phase (radians), the
    amplitude at that common angle, which may be negative. mueller: I_s = (m11 + sense m22) / 2, I_d = m00 - I_s.
    gain: factor on both, broadcasts; NaN where unknown.
    """
    planes = planes.astype(np.float32, copy=False)
    if sums.method == "none":
        diffuse, specular = planes[0], np.zeros_like(planes[0])
    elif sums.method == "circular":
        if beta is None:
            raise ValueError("circular polarisation needs beta")
        diffuse = planes[1] / np.asarray(beta, np.float32)
        specular = planes[0] - diffuse
    elif sums.method in ("crossed", "pairs"):
        diffuse, specular = 2 * planes[1], planes[0] - planes[1]
    elif sums.method == "linear":
        amplitude = np.hypot(planes[1], planes[2])
        if phase is not None:
            amplitude = np.float32(np.cos(2 * phase)) * planes[1] + np.float32(np.sin(2 * phase)) * planes[2]
        diffuse, specular = 2 * (planes[0] - amplitude), 2 * amplitude
    else:
        specular = (planes[1] + np.float32(sense) * planes[2]) / 2
        diffuse = planes[0] - specular
    if gain is not None:
        diffuse, specular = diffuse * gain.astype(np.float32), specular * gain.astype(np.float32)
    known = valid & np.isfinite(diffuse).all(axis=-1) & np.isfinite(specular).all(axis=-1)
    diffuse, specular = (np.where(known[..., None], part, np.float32(0)) for part in (diffuse, specular))
    return SeparatedView(diffuse, specular, known)


def common_phase(planes: np.ndarray, valid: np.ndarray) -> tuple[float, float]:
    """Angle psi0 (radians) of the strongest light over a whole picture, and how far its pixels agree on it (0 to 1:
    length of the sum of their vectors over the sum of their lengths); planes as of `linear`."""
    cosine, sine = (planes[k][valid].astype(np.float64) for k in (1, 2))
    total = np.array([cosine.sum(), sine.sum()])
    lengths = np.hypot(cosine, sine).sum()
    return float(np.arctan2(total[1], total[0]) / 2), float(np.hypot(*total) / lengths) if lengths > 0 else 0.0


def reflected_sense(m11: np.ndarray, m22: np.ndarray) -> int:
    """Whether a mirror's m22 has the sign of m11 (+1: angles seen from one side) or the opposite (-1: seen along the
    light, which a reflection reverses), by the picture itself: polarisation that is kept shows in both."""
    return 1 if float(np.sum(np.sign(m11) * m22, dtype=np.float64)) >= 0 else -1
