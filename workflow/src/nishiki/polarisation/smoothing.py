"""Free photographs of a polariser series of the noise that the specular part brings into both components.

What tells specular from diffuse light is a difference of photographs, q = sum_p Q_p plane_p (circular: I_off - I_on /
beta). Its noise is large beside the specular light, and it enters the diffuse part with the opposite sign. Two things
are known of it: it has one colour nearly everywhere, that of the lamp, and its noise is that of the photographs,
var(I) = slope I + floor in each channel (shot noise; read noise and rounding). `measure_noise` measures slope and floor
on the view itself, `smooth_differences` removes from q what the noise explains, and the planes move to the most likely
ones that have the smoothed difference q':

    plane_p' = plane_p - cov(plane_p, q) / var(q) (q - q').

The formulas of `polarisation.components` applied to these planes are the inverse-variance combination of the two
estimates of the diffuse part: that of the crossed polarisers, and all light less the specular light. The diffuse part
is not smoothed.
"""

from dataclasses import dataclass

import numpy as np

from nishiki.polarisation.noise import PhotographNoise, Series, differences_of, inverse_of, measure_noise
from nishiki.polarisation.polariser_states import StateSums
from nishiki.threads import over_rows

PATCH = 8  # pixels a side of the squares that are transformed
STEP = 3  # pixels from one square to the next
FEWEST = 16  # usable pixels of a square
FARTHEST = 3.0  # standard deviations of its own noise by which a pixel may change
BAND = 64  # rows that are smoothed at a time


@dataclass(frozen=True)
class Smoothed:
    """Smoothed planes."""

    planes: np.ndarray  # as `components` takes them
    noise: PhotographNoise | None  # of the photographs, None where it cannot be measured
    # share of the differences below -3 standard deviations of their own noise, which noise alone leaves at about 0.1
    # %, None where it is not known or amplitudes cannot be negative
    doubtful: float | None


def smooth_planes(
    planes: np.ndarray,
    usable: np.ndarray,
    sums: StateSums,
    *,
    counted: np.ndarray | None = None,
    beta: np.ndarray | None = None,
    phase: float | None = None,
    sense: int = 1,
    scales: np.ndarray | None = None,
) -> Smoothed:
    """Smooth the differences in the planes for `components`, and measure their noise.

    Parameters
    ----------
    planes : (planes, rows, columns, channels) float32
        Made by `sum_planes` with `sums.weights`.
    usable : (rows, columns) bool
        Pixels that take part: valid ones, inside the silhouette where one is known. Others stay as they are.
    counted : (rows, columns) bool, optional
        Pixels over which doubtful values are counted, all usable ones by default.
    beta : array, optional
        Circular: broadcasts against a picture.
    phase, sense, scales
        As in `differences_of`.

    Returns
    -------
    Smoothed
        With the planes as given where there is nothing to do: one state, a picture smaller than a square, no noise.
    """
    rows, columns = planes.shape[1:3]
    if sums.method == "none" or min(rows, columns) < PATCH:
        return Smoothed(planes, None, None)
    inverse = None if beta is None else inverse_of(np.asarray(beta, np.float32), planes.shape[1:])
    counted = usable if counted is None else usable & counted
    series = Series(planes, usable, differences_of(sums, phase=phase, sense=sense, scales=scales), inverse)
    noise, colour = measure_noise(series)
    if noise is None or not noise.positive:
        return Smoothed(planes, noise, None)
    smoothed, doubtful = np.empty_like(planes), np.zeros(-(-rows // BAND))

    def bands(first: int, last: int, _: np.ndarray) -> None:
        for top in range(first * BAND, min(last * BAND, rows), BAND):
            below = _smooth_rows(series, top, min(top + BAND, rows), noise, colour, smoothed)
            doubtful[top // BAND] = np.count_nonzero(below & counted[top : top + BAND, :, None])

    over_rows(bands, len(doubtful), planes)
    values = np.count_nonzero(counted) * planes.shape[3]
    share = float(doubtful.sum() / values) if len(series.kinds.of_planes) == 1 and values else None
    return Smoothed(smoothed, noise, share)


def _smooth_rows(series: Series, top: int, bottom: int, noise: PhotographNoise, colour: np.ndarray, smoothed):
    """Smooth rows top .. bottom - 1 of the planes; neighbours that share a square with them are read.

    Return which values of these rows are below -3 standard deviations of their noise.
    """
    height = series.planes.shape[1]
    rows = slice(max(top - PATCH + 1, 0), min(bottom + PATCH - 1, height))
    part = series.rows(rows)
    q = series.differences(part)
    level, count = series.noise_of_differences(part, rows)
    variance = np.broadcast_to(noise.slope * level + noise.floor * count, q.shape)
    joined, usable = _join(q), series.usable[rows]
    smooth = smooth_differences(joined, _join(variance), usable, colour, first=rows.start, height=height)
    change = (joined - smooth).reshape(*joined.shape[:2], len(q), -1).transpose(2, 0, 1, 3)
    change /= np.where(variance > 0, variance, np.inf)
    level, count = series.share_noise(part, rows)
    part -= np.einsum("pj...,j...->p...", noise.slope * level + noise.floor * count, change)
    if series.inverse is not None:
        part[1] /= np.where(series.inverse[rows] > 0, series.inverse[rows], 1)
    middle = slice(top - rows.start, bottom - rows.start)
    usable = series.usable[top:bottom, :, None]
    kept = usable & (change[:, middle] != 0).any(axis=0)
    smoothed[:, top:bottom] = np.where(kept, part[:, middle], series.planes[:, top:bottom])
    return usable & (q[0, middle] < -3 * np.sqrt(variance[0, middle]))


def _join(values: np.ndarray) -> np.ndarray:
    """Join (d, rows, columns, channels) to (rows, columns, d * channels), contiguous."""
    return np.ascontiguousarray(values.transpose(1, 2, 0, 3)).reshape(*values.shape[1:3], -1)


def smooth_differences(
    q: np.ndarray, variance: np.ndarray, usable: np.ndarray, colour: np.ndarray, *, first: int = 0, height: int = 0
) -> np.ndarray:
    """Remove noise by thresholds on the cosine transform of overlapping squares (Yu and Sapiro 2011).

    The channels of a square are divided by their standard deviations and rotated so that the first axis has the given
    colour: there the light of all channels is added up with weights 1 / variance; the other axes hold noise, except
    where the reflected light has another colour. Coefficients of a square that stay below the largest one that noise
    alone is expected to have, sqrt(2 ln n) standard deviations of n, are set to 0 (Donoho and Johnstone 1994), but not
    the mean along the first axis. A pixel changes by at most `FARTHEST` standard deviations of its own noise, so that
    dark pixels take no noise from bright neighbours.

    Parameters
    ----------
    q, variance : (rows, columns, n) float64
    usable : (rows, columns) bool
        Other pixels neither take part nor change.
    colour : (n,) float64
    first, height : int
        Number of the first row and of all rows of the picture, where a band is given. Rows near the band's ends, other
        than the picture's own, are smoothed incompletely.
    """
    height = height or len(q)
    across = np.array(_places(q.shape[1]))
    sums, weights = np.zeros(q.shape), np.zeros(q.shape[:2])
    for top in (y - first for y in _places(height) if first <= y and y + PATCH <= first + len(q)):
        rows, columns = np.s_[top : top + PATCH], across + np.arange(PATCH)[:, None]
        parts = (np.moveaxis(each[rows][:, columns], 1, 0) for each in (q, variance, usable))
        smooth, weight = _smooth_squares(np.asarray(colour, np.float64), *parts)
        for column, part in zip(columns, smooth, strict=True):
            sums[rows, column] += part
            weights[rows, column] += weight
    counted = (weights > 0) & usable
    smooth = np.where(counted[..., None], sums / np.where(counted, weights, 1)[..., None], q)
    reach = FARTHEST * np.sqrt(variance)
    return np.clip(smooth, q - reach, q + reach)


def _places(size: int) -> list[int]:
    """List the first pixels of the squares along a side; the last square ends with the side."""
    return sorted({*range(0, size - PATCH + 1, STEP), size - PATCH})


COSINES = np.sqrt(2 / PATCH) * np.cos(np.pi * (np.arange(PATCH) + 0.5) * np.arange(PATCH)[:, None] / PATCH)
COSINES[0] = np.sqrt(1 / PATCH)
COSINES = COSINES.astype(np.float32)
"""Orthonormal cosine transform (PATCH, PATCH)."""


def _smooth_squares(colour, q, variance, usable):
    """Smooth squares (PATCH columns, PATCH rows, squares, n); return them times their weights (squares,), and these."""
    inside, n, count = usable[..., None], q.shape[-1], usable.sum(axis=(0, 1))
    sums = (np.where(inside, each, 0).sum(axis=(0, 1)) for each in (q, variance))
    means, sizes = (each / np.maximum(count, 1)[:, None] for each in sums)
    known = (count >= FEWEST) & (sizes > 0).all(axis=1)
    total = np.where(known, sizes.sum(axis=1), np.inf)
    sizes = np.sqrt(np.where(known[:, None], sizes, 1))
    square = (np.where(inside, q, means) / sizes).astype(np.float32)
    # the reflection x - mirror (mirror x) takes the colour, divided by the noise, to the first axis (Householder)
    mirror = colour / sizes
    mirror /= np.linalg.norm(mirror, axis=1, keepdims=True)
    sign = np.where(mirror[:, :1] >= 0, 1.0, -1.0)
    mirror[:, :1] += sign
    mirror = (mirror / np.sqrt(np.abs(mirror[:, :1]))).astype(np.float32)
    square = _reflect(mirror, _transform(COSINES, square))
    kept = np.abs(square) >= np.sqrt(2 * np.log(PATCH * PATCH * n))
    kept[0, 0, :, 0] = True
    weight = 1 / (np.einsum("abik->i", kept, dtype=np.float64) * total)
    square = _transform(COSINES.T, _reflect(mirror, square * kept))
    return square * (weight[:, None] * sizes), weight


def _transform(cosines: np.ndarray, square: np.ndarray) -> np.ndarray:
    """Multiply the first two axes of squares by a matrix each."""
    rest = square.shape[2:]
    square = (cosines @ square.reshape(PATCH, -1)).reshape(PATCH, PATCH, -1)
    return np.matmul(cosines, square).reshape(PATCH, PATCH, *rest)


def _reflect(mirror: np.ndarray, square: np.ndarray) -> np.ndarray:
    return square - mirror * np.einsum("...k,...k->...", square, mirror)[..., None]
