"""Photographs of a polariser series freed of the noise that the specular part brings into both components.

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

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit

from nishiki.polarisation.polariser_states import StateSums
from nishiki.threads import over_rows

PATCH = 8  # pixels a side of the squares that are transformed
STEP = 3  # pixels from one square to the next
FEWEST = 16  # usable pixels of a square
FARTHEST = 3.0  # standard deviations of its own noise by which a pixel may change
BAND = 64  # rows that are smoothed at a time
MOST_PIXELS = 1 << 17  # that the noise is measured on
BINS, FEWEST_IN_BIN = 16, 200  # of brightness, for the noise
APART = 2  # pixels between those that second differences for the noise compare: one apart shares demosaiced samples
CHI_MEDIAN = 0.4549364  # median of the square of a normal number
SECOND_DIFFERENCES = 36.0  # variance of (1, -2, 1) x (1, -2, 1) of numbers of variance 1


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
class Smoothed:
    """planes : as `components` takes them; noise : of the photographs, None where it cannot be measured; doubtful :
    share of the differences below -3 standard deviations of their own noise, which noise alone leaves at about 0.1 %,
    None where it is not known or amplitudes cannot be negative."""

    planes: np.ndarray
    noise: PhotographNoise | None
    doubtful: float | None


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


def smooth_planes(
    planes: np.ndarray,
    usable: np.ndarray,
    sums: StateSums,
    *,
    beta: np.ndarray | None = None,
    phase: float | None = None,
    sense: int = 1,
    scales: np.ndarray | None = None,
) -> Smoothed:
    """Planes for `components` with smoothed differences, and what is known of their noise.

    Parameters
    ----------
    planes : (planes, rows, columns, channels) float32
        Made by `sum_planes` with `sums.weights`.
    usable : (rows, columns) bool
        Pixels that take part: valid ones, inside the silhouette where one is known. Others stay as they are.
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
    inverse = None if beta is None else _inverse(np.asarray(beta, np.float32), planes.shape[1:])
    series = _Series(planes, usable, differences_of(sums, phase=phase, sense=sense, scales=scales), inverse)
    noise, colour = measure_noise(series)
    if noise is None or not noise.positive:
        return Smoothed(planes, noise, None)
    smoothed, doubtful = np.empty_like(planes), np.zeros(-(-rows // BAND))

    def bands(first: int, last: int) -> None:
        for top in range(first * BAND, min(last * BAND, rows), BAND):
            below = series.smooth_rows(top, min(top + BAND, rows), noise, colour, smoothed)
            doubtful[top // BAND] = below

    over_rows(bands, len(doubtful))
    values = np.count_nonzero(usable) * planes.shape[3]
    share = float(doubtful.sum() / values) if len(series.kinds.of_planes) == 1 and values else None
    return Smoothed(smoothed, noise, share)


def _inverse(beta: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """1 / beta at every pixel and channel, 0 where beta is unknown: nothing is divided there."""
    return np.broadcast_to(np.float32(1) / np.where(beta > 0, beta, np.float32(np.inf)), shape)


@dataclass(frozen=True)
class _Series:
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

    def smooth_rows(self, top: int, bottom: int, noise: PhotographNoise, colour: np.ndarray, smoothed) -> int:
        """Rows top .. bottom - 1 of the smoothed planes; their neighbours that share a square with them are read.
        Returns the number of values of these rows below -3 standard deviations of their noise."""
        height = self.planes.shape[1]
        rows = slice(max(top - PATCH + 1, 0), min(bottom + PATCH - 1, height))
        part = self.rows(rows)
        q = self.differences(part)
        level, count = self.noise_of_differences(part, rows)
        variance = np.broadcast_to(noise.slope * level + noise.floor * count, q.shape)
        joined, usable = _joined(q), self.usable[rows]
        smooth = smooth_differences(joined, _joined(variance), usable, colour, first=rows.start, height=height)
        change = (joined - smooth).reshape(*joined.shape[:2], len(q), -1).transpose(2, 0, 1, 3)
        change /= np.where(variance > 0, variance, np.inf)
        level, count = self.noise_shared(part, rows)
        part -= np.einsum("pj...,j...->p...", noise.slope * level + noise.floor * count, change)
        if self.inverse is not None:
            part[1] /= np.where(self.inverse[rows] > 0, self.inverse[rows], 1)
        middle = slice(top - rows.start, bottom - rows.start)
        usable = self.usable[top:bottom, :, None]
        kept = usable & (change[:, middle] != 0).any(axis=0)
        smoothed[:, top:bottom] = np.where(kept, part[:, middle], self.planes[:, top:bottom])
        return np.count_nonzero(usable & (q[0, middle] < -3 * np.sqrt(variance[0, middle])))


def _cells(values: np.ndarray) -> np.ndarray:
    """With axes for rows, columns and channels."""
    return values[..., None, None, None]


def _joined(values: np.ndarray) -> np.ndarray:
    """(rows, columns, d * channels) of (d, rows, columns, channels), contiguous."""
    return np.ascontiguousarray(values.transpose(1, 2, 0, 3)).reshape(*values.shape[1:3], -1)


def smooth_differences(
    q: np.ndarray, variance: np.ndarray, usable: np.ndarray, colour: np.ndarray, *, first: int = 0, height: int = 0
) -> np.ndarray:
    """Values freed of noise by thresholds on the cosine transform of overlapping squares (Yu and Sapiro 2011).

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
    down = [y - first for y in _places(height) if first <= y and y + PATCH <= first + len(q)]
    sums, weights = np.zeros(q.shape), np.zeros(q.shape[:2])
    smooth_squares(
        q,
        variance,
        usable,
        np.asarray(colour, np.float64),
        COSINES,
        np.float32(2 * np.log(PATCH * PATCH * q.shape[2])),
        np.array(down, np.int64),
        np.array(_places(q.shape[1]), np.int64),
        sums,
        weights,
    )
    counted = (weights > 0) & usable
    smooth = np.where(counted[..., None], sums / np.where(counted, weights, 1)[..., None], q)
    reach = FARTHEST * np.sqrt(variance)
    return np.clip(smooth, q - reach, q + reach)


def _places(size: int) -> list[int]:
    """First pixels of the squares along a side; the last square ends with the side."""
    return sorted({*range(0, size - PATCH + 1, STEP), size - PATCH})


def _cosines() -> np.ndarray:
    """(PATCH, PATCH) float32 orthonormal cosine transform."""
    k, x = np.mgrid[:PATCH, :PATCH]
    rows = np.sqrt(2 / PATCH) * np.cos(np.pi * (x + 0.5) * k / PATCH)
    rows[0] = np.sqrt(1 / PATCH)
    return rows.astype(np.float32)


COSINES = _cosines()


@njit(cache=True, nogil=True, error_model="numpy")
def smooth_squares(q, variance, usable, colour, cosines, limit, down, across, sums, weights):
    """Add the smoothed squares at rows `down` and columns `across` to sums (rows, columns, n) with their weights.
    limit: square of the threshold, in variances."""
    n = q.shape[2]
    square, half = np.empty((n, PATCH, PATCH), np.float32), np.empty((PATCH, PATCH), np.float32)
    mirror, sizes, means, kept = np.empty(n, np.float32), np.empty(n), np.empty(n), np.empty(n, np.int64)
    transposed = np.ascontiguousarray(cosines.T)
    for y0 in down:
        for x0 in across:
            total = _square_means(q, variance, usable, y0, x0, means, sizes)
            if not total > 0.0:
                continue
            _mirror_of(colour, sizes, mirror)
            for k in range(n):
                for i in range(PATCH):
                    for j in range(PATCH):
                        value = q[y0 + i, x0 + j, k] if usable[y0 + i, x0 + j] else means[k]
                        square[k, i, j] = value / sizes[k]
                _multiply(cosines, square[k], half)
                _multiply(half, transposed, square[k])
            kept[:] = 0
            for i in range(PATCH):
                for j in range(PATCH):
                    _reflect(mirror, square, i, j)
                    for k in range(n):
                        if square[k, i, j] * square[k, i, j] < limit and k + i + j > 0:
                            square[k, i, j] = np.float32(0.0)
                        else:
                            kept[k] += 1
            weight = 1.0 / (kept.sum() * total)
            for k in range(n):
                if kept[k] > 0:  # most axes of another colour are 0 throughout
                    _multiply(transposed, square[k], half)
                    _multiply(half, cosines, square[k])
            for i in range(PATCH):
                for j in range(PATCH):
                    _reflect(mirror, square, i, j)
                    for k in range(n):
                        sums[y0 + i, x0 + j, k] += weight * sizes[k] * square[k, i, j]
                    weights[y0 + i, x0 + j] += weight


@njit(cache=True, error_model="numpy", inline="always")
def _square_means(q, variance, usable, y0, x0, means, sizes):
    """Fill means and root mean variances (n,) of a square's usable pixels; the sum of the variances, 0 for too few or
    where a channel has no noise."""
    count = 0
    means[:], sizes[:] = 0.0, 0.0
    for i in range(PATCH):
        for j in range(PATCH):
            if usable[y0 + i, x0 + j]:
                count += 1
                for k in range(len(means)):
                    means[k] += q[y0 + i, x0 + j, k]
                    sizes[k] += variance[y0 + i, x0 + j, k]
    total, least = 0.0, np.inf
    for k in range(len(means)):
        means[k] /= max(count, 1)
        sizes[k] /= max(count, 1)
        total, least = total + sizes[k], min(least, sizes[k])
        sizes[k] = np.sqrt(sizes[k])
    return total if count >= FEWEST and least > 0.0 else 0.0


@njit(cache=True, error_model="numpy", inline="always")
def _mirror_of(colour, sizes, mirror):
    """Fill the vector (n,) of the reflection x - mirror (mirror x) that takes the colour, divided by the noise, to the
    first axis (Householder)."""
    length = 0.0
    for k in range(len(colour)):
        length += (colour[k] / sizes[k]) ** 2
    length = np.sqrt(length)
    first = colour[0] / sizes[0] / length
    norm = np.sqrt(1.0 + abs(first))  # half the square of the vector's length is 1 + |first|
    for k in range(len(colour)):
        mirror[k] = colour[k] / sizes[k] / length / norm
    mirror[0] += (1.0 if first >= 0 else -1.0) / norm


@njit(cache=True, error_model="numpy", inline="always")
def _reflect(mirror, square, i, j):
    along = np.float32(0.0)
    for k in range(len(mirror)):
        along += mirror[k] * square[k, i, j]
    for k in range(len(mirror)):
        square[k, i, j] -= mirror[k] * along


@njit(cache=True, error_model="numpy", inline="always")
def _multiply(a, b, out):
    """out = a b, all (PATCH, PATCH) float32."""
    for i in range(PATCH):
        for j in range(PATCH):
            out[i, j] = np.float32(0.0)
        for k in range(PATCH):
            for j in range(PATCH):
                out[i, j] += a[i, k] * b[k, j]


def measure_noise(series: _Series) -> tuple[PhotographNoise | None, np.ndarray]:
    """Noise of the photographs, and the colour of the specular light (d * channels,), both by the view itself.

    Second differences of every other pixel in both directions (after Immerkaer 1996) of c_l q_k - c_k q_l, for channels
    k and l: the diffuse light is not in q, and what has the colour c cancels. The median of their squares in bins of
    brightness gives the variance c_l^2 var(q_k) + c_k^2 var(q_l), from which slope and floor of the channels follow by
    non-negative least squares of the relative error. With one or two channels they are taken of q itself.
    """
    strips = [_Strip.of(series, rows) for rows in _strips(*series.planes.shape[1:3])]
    colour = _colour_of(np.concatenate([strip.values for strip in strips], axis=1))
    order, edges = _bins(np.concatenate([strip.level for strip in strips]).mean(axis=(1, 2)))
    level, count = (np.concatenate([getattr(s, name) for s in strips])[order] for name in ("level", "count"))
    channels = colour.shape[1]
    table, variances = [], []
    for j, each in enumerate(colour):
        for k, other, c_k, c_other in _pairs_of(each):
            squares = [strip.second(c_other * strip.q[j, ..., k] - c_k * strip.q[j, ..., other]) for strip in strips]
            energy = np.concatenate(squares)[order] ** 2
            for first, last in edges:
                row = np.zeros((2, channels))
                for channel, factor in ((k, c_other**2), (other, c_k**2)):
                    row[0, channel] += factor * level[first:last, j, channel].mean()
                    row[1, channel] += factor * count[first:last, j, channel].mean()
                table.append(row.ravel())
                variances.append(np.median(energy[first:last]) / (CHI_MEDIAN * SECOND_DIFFERENCES))
    return _least_squares(np.array(table), np.array(variances), channels), colour.ravel()


def _least_squares(table: np.ndarray, variances: np.ndarray, channels: int) -> PhotographNoise | None:
    """Slopes and floors >= 0 with table @ (slopes, floors) ~ variances, relative errors counting alike; bins without
    any noise (of rounded values) say nothing. None where too few are left."""
    from scipy.optimize import nnls

    known = variances > 0
    if known.sum() < 2 * channels:
        return None
    table = table[known] / variances[known, None]
    scale = table.max(axis=0)
    scale = np.where(scale > 0, scale, 1)
    slope, floor = (nnls(table / scale, np.ones(len(table)))[0] / scale).reshape(2, channels)
    return PhotographNoise(slope, floor)


@dataclass(frozen=True)
class _Strip:
    """Differences of some rows; of their usable pixels: values (d, pixels, channels); of pixels whose eight neighbours
    `APART` pixels away are usable too (`complete`): level and count (pixels, d, channels)."""

    q: np.ndarray
    values: np.ndarray
    complete: np.ndarray
    level: np.ndarray
    count: np.ndarray

    @classmethod
    def of(cls, series: _Series, rows: slice) -> _Strip:
        part, usable = series.rows(rows), series.usable[rows]
        q = series.differences(part)
        across = usable[:, : -2 * APART] & usable[:, APART:-APART] & usable[:, 2 * APART :]
        complete = across[: -2 * APART] & across[APART:-APART] & across[2 * APART :]
        inner = [
            np.broadcast_to(each, q.shape)[:, APART:-APART, APART:-APART][:, complete].transpose(1, 0, 2)
            for each in series.noise_of_differences(part, rows)
        ]
        return cls(q, q[:, usable], complete, *inner)

    def second(self, values: np.ndarray) -> np.ndarray:
        """(pixels,) second differences down and across of (rows, columns)."""
        along = values[:, : -2 * APART] - 2 * values[:, APART:-APART] + values[:, 2 * APART :]
        return (along[: -2 * APART] - 2 * along[APART:-APART] + along[2 * APART :])[self.complete]


def _strips(rows: int, columns: int) -> list[slice]:
    """Evenly spread strips of rows with at most about `MOST_PIXELS` pixels."""
    tall = 2 * PATCH
    every = -(-rows * columns // MOST_PIXELS)
    return [slice(top, min(top + tall, rows)) for top in range(0, rows - 2 * APART, tall * every)]


def _bins(level: np.ndarray) -> tuple[np.ndarray, list[tuple[int, int]]]:
    """Order of pixels by their bin of brightness, and where in this order each bin with enough pixels lies."""
    bright = np.sqrt(level)
    top = np.percentile(bright, 99.9) if len(bright) else 0.0
    number = np.minimum((bright * (BINS / top) if top > 0 else 0 * bright).astype(np.int64), BINS - 1)
    order = np.argsort(number, kind="stable")
    edges = np.searchsorted(number[order], np.arange(BINS + 1))
    return order, [(a, b) for a, b in pairwise(edges.tolist()) if b - a >= FEWEST_IN_BIN]


def _pairs_of(colour: np.ndarray) -> list[tuple[int, int, float, float]]:
    """Channels k, l and their colours c_k, c_l, whose difference c_l q_k - c_k q_l has no light of that colour."""
    n = len(colour)
    if n < 3:
        return [(k, k, 0.0, 1.0) for k in range(n)]
    pairs = sorted({tuple(sorted((k, (k + step) % n))) for k in range(n) for step in (1, 2)})
    return [(k, other, float(colour[k]), float(colour[other])) for k, other in pairs]


def _colour_of(values: np.ndarray) -> np.ndarray:
    """(d, channels) unit vector along which values (d, pixels, channels) vary together: the colour of the specular
    light where it is strong. Noise is not shared by channels, so that the diagonal of their products is fitted
    (principal factor); two values have no other product and use it."""
    joined = values.transpose(0, 2, 1).reshape(values.shape[0] * values.shape[2], values.shape[1])
    products = joined @ joined.T
    strength = products.diagonal().copy()
    for _ in range(30 if len(products) > 2 else 1):
        sizes, axes = np.linalg.eigh(products)
        shared = max(sizes[-1], 0.0) * axes[:, -1] ** 2
        np.fill_diagonal(products, np.minimum(shared, strength))
    colour = axes[:, -1] * (1 if axes[:, -1].sum() >= 0 else -1)
    return colour.reshape(values.shape[0], values.shape[2])
