"""The differences of a polariser series that tell specular from diffuse light, and the noise that they take over.

They are sums of planes, q_j = sum_p Q_jp plane_p (circular: I_off - I_on / beta); that of the photographs is var(I) =
slope I + floor in each channel (shot noise; read noise and rounding).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nishiki.polarisation.polariser_states import StateSums


@dataclass(frozen=True)
class PhotographNoise:
    """Variance of a photograph's values I: slope I + floor, each (channels,) float64 in the units of `Views.read`, at
    the longest exposure time."""

    slope: np.ndarray
    floor: np.ndarray

    @property
    def positive(self) -> bool:
        """Whether every channel has some."""
        return bool(((self.slope > 0) | (self.floor > 0)).all())


@dataclass(frozen=True)
class Differences:
    """The sums of planes that are smoothed, and how the noise of photographs enters them.

    of_planes : (d, planes), difference j is sum_p of_planes[j, p] plane_p. level : (d, planes) and count (d,): its
    variance is slope sum_p level[j, p] plane_p + floor count[j]. shared_level : (planes, d, planes) and shared_count
    (planes, d): covariance of plane p with difference j, in the same way.
    """

    of_planes: np.ndarray
    level: np.ndarray
    count: np.ndarray
    shared_level: np.ndarray
    shared_count: np.ndarray


def differences_of(
    sums: StateSums, *, phase: float | None = None, sense: int = 1, scales: np.ndarray | None = None
) -> Differences:
    """The differences of a series; for circular states those of I_off and I_on / beta at beta = 1.

    Photographs are linear in the planes too (as far as these are known), which is what their noise depends on. Three or
    more analyser angles at each pixel's own phase have two differences, mixed so that photographs of equal noise leave
    them uncorrelated.

    Parameters
    ----------
    phase, sense
        As in `polarisation.components`.
    scales : (states,), optional
        Factor by which each photograph was multiplied for its shorter exposure time: its slope grows with it, its
        floor with the square.
    """
    rows = {
        "circular": [[1, -1]],
        "crossed": [[1, -1]],
        "pairs": [[1, -1]],
        "linear": [[0, 1, 0], [0, 0, 1]] if phase is None else [[0, np.cos(2 * phase), np.sin(2 * phase)]],
        "mueller": [[0, 0.5, 0.5 * sense]],
    }[sums.method]
    of_planes, weights = np.array(rows, np.float64), sums.weights
    if len(of_planes) > 1:
        of_planes = np.linalg.inv(np.linalg.cholesky((of_planes @ weights) @ (of_planes @ weights).T)) @ of_planes
    of_photographs = of_planes @ weights
    scales = np.ones(weights.shape[1]) if scales is None else np.asarray(scales, np.float64)
    lit = scales[:, None] * _photographs_by_planes(sums)
    return Differences(
        of_planes,
        of_photographs**2 @ lit,
        of_photographs**2 @ scales**2,
        np.einsum("pf,jf,fk->pjk", weights, of_photographs, lit),
        (weights * scales**2) @ of_photographs.T,
    )


def _photographs_by_planes(sums: StateSums) -> np.ndarray:
    """(states, planes): expected photographs as sums of planes."""
    if sums.method == "linear":
        return sums.design
    if sums.method == "mueller":
        return sums.design[:, [sums.elements.index(k) for k in (0, 5, 10)]]
    return (sums.weights.T > 0).astype(np.float64)


@dataclass(frozen=True)
class Series:
    """One view: planes, usable pixels, differences; inverse: 1 / beta of circular states, else None."""

    planes: np.ndarray
    usable: np.ndarray
    kinds: Differences
    inverse: np.ndarray | None

    def rows(self, rows: slice) -> np.ndarray:
        """Planes of some rows, float64; of circular states I_off and I_on / beta."""
        part = self.planes[:, rows].astype(np.float64)
        if self.inverse is not None:
            part[1] *= self.inverse[rows]
        return part

    def differences(self, part: np.ndarray) -> np.ndarray:
        """(d, rows, columns, channels)."""
        return np.einsum("jp,p...->j...", self.kinds.of_planes, part)

    def noise_of_differences(self, part: np.ndarray, rows: slice) -> tuple[np.ndarray, np.ndarray]:
        """What slope and floor are multiplied by in the variances of the differences, as these."""
        kinds = self.kinds
        if self.inverse is None:
            return np.maximum(np.einsum("jp,p...->j...", kinds.level, part), 0), _cells(kinds.count)
        each = self._noise_of_planes(part, rows)
        return sum(level for level, _ in each)[None], sum(count for _, count in each)[None]

    def noise_shared(self, part: np.ndarray, rows: slice) -> tuple[np.ndarray, np.ndarray]:
        """The same of the covariances (planes, d, rows, columns, channels) of planes with differences."""
        kinds = self.kinds
        if self.inverse is None:
            return np.einsum("pjk,k...->pj...", kinds.shared_level, part), _cells(kinds.shared_count)
        (off, off_count), (on, on_count) = self._noise_of_planes(part, rows)
        return np.stack([off, -on])[:, None], np.stack([np.broadcast_to(off_count, on.shape), -on_count])[:, None]

    def _noise_of_planes(self, part: np.ndarray, rows: slice):
        """(factor of slope, factor of floor) of I_off and of I_on / beta."""
        scales = self.kinds.level[0]
        inverse = scales[1] * self.inverse[rows].astype(np.float64)
        lit = np.maximum(part, 0)
        return (scales[0] * lit[0], scales[0] ** 2 * np.ones(1)), (inverse * lit[1], inverse**2)


def inverse_of(beta: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """1 / beta at every pixel and channel, 0 where beta is unknown: nothing is divided there."""
    return np.broadcast_to(np.float32(1) / np.where(beta > 0, beta, np.float32(np.inf)), shape)


def _cells(values: np.ndarray) -> np.ndarray:
    """With axes for rows, columns and channels."""
    return values[..., None, None, None]
