"""Measure the noise of a polariser series, and the differences that separate specular from diffuse light.

The differences are sums of planes, q_j = sum_p Q_jp plane_p (circular: I_off - I_on / beta); that of the photographs is
var(I) = slope I + floor in each channel (shot noise; read noise and rounding).
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from nishiki.errors import require
from nishiki.polarisation.polariser_states import StateSums


@dataclass(frozen=True)
class PhotographNoise:
    """The variance of a photograph's values I, modelled as slope I + floor.

    Each is (channels,) float64 in the units of `Views.read`, at the longest exposure time.
    """

    slope: np.ndarray
    floor: np.ndarray

    @property
    def positive(self) -> bool:
        """Return whether every channel has some noise."""
        return bool(((self.slope > 0) | (self.floor > 0)).all())


@dataclass(frozen=True)
class Differences:
    """The sums of planes that are smoothed, and how the noise of photographs enters them."""

    of_planes: np.ndarray  # (d, planes), difference j is sum_p of_planes[j, p] plane_p
    level: np.ndarray  # (d, planes) and count (d,): its variance is slope sum_p level[j, p] plane_p + floor count[j]
    count: np.ndarray
    # (planes, d, planes) and shared_count (planes, d): covariance of plane p with difference j, in the same way
    shared_level: np.ndarray
    shared_count: np.ndarray


def differences_of(
    sums: StateSums, *, phase: float | None = None, sense: int = 1, scales: np.ndarray | None = None
) -> Differences:
    """Compute the differences of a series; for circular states those of I_off and I_on / beta at beta = 1.

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
    """Express expected photographs as sums of planes: (states, planes)."""
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
        """Return planes of some rows, float64; of circular states I_off and I_on / beta."""
        part = self.planes[:, rows].astype(np.float64)
        if self.inverse is not None:
            part[1] *= self.inverse[rows]
        return part

    def differences(self, part: np.ndarray) -> np.ndarray:
        """Compute the differences (d, rows, columns, channels)."""
        return np.einsum("jp,p...->j...", self.kinds.of_planes, part)

    def noise_of_differences(self, part: np.ndarray, rows: slice) -> tuple[np.ndarray, np.ndarray]:
        """Compute the factors of slope and floor in the variances of the differences, in the same shape."""
        kinds = self.kinds
        if self.inverse is None:
            return np.maximum(np.einsum("jp,p...->j...", kinds.level, part), 0), _cells(kinds.count)
        each = self._noise_of_planes(part, rows)
        return sum(level for level, _ in each)[None], sum(count for _, count in each)[None]

    def share_noise(self, part: np.ndarray, rows: slice) -> tuple[np.ndarray, np.ndarray]:
        """Compute these factors in the covariances (planes, d, rows, columns, channels) of planes with differences."""
        kinds = self.kinds
        if self.inverse is None:
            return np.einsum("pjk,k...->pj...", kinds.shared_level, part), _cells(kinds.shared_count)
        (off, off_count), (on, on_count) = self._noise_of_planes(part, rows)
        return np.stack([off, -on])[:, None], np.stack([np.broadcast_to(off_count, on.shape), -on_count])[:, None]

    def _noise_of_planes(self, part: np.ndarray, rows: slice):
        """Compute (factor of slope, factor of floor) of I_off and of I_on / beta."""
        scales = self.kinds.level[0]
        inverse = scales[1] * require(self.inverse)[rows].astype(np.float64)
        lit = np.maximum(part, 0)
        return (scales[0] * lit[0], scales[0] ** 2 * np.ones(1)), (inverse * lit[1], inverse**2)


def inverse_of(beta: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Compute 1 / beta at every pixel and channel, 0 where beta is unknown: nothing is divided there."""
    return np.broadcast_to(np.float32(1) / np.where(beta > 0, beta, np.float32(np.inf)), shape)


def _cells(values: np.ndarray) -> np.ndarray:
    """Append axes for rows, columns and channels."""
    return values[..., None, None, None]


STRIP = 16  # rows
MOST_PIXELS = 1 << 17  # that the noise is measured on
BINS, FEWEST_IN_BIN = 16, 200  # of brightness, for the noise
APART = 2  # pixels between those that second differences for the noise compare: one apart shares demosaiced samples


def measure_noise(series: Series) -> tuple[PhotographNoise | None, np.ndarray]:
    """Measure the noise of the photographs and the colour of the specular light (d * channels,) by the view itself.

    Second differences of every other pixel in both directions (after Immerkaer 1996) of c_l q_k - c_k q_l, for channels
    k and l: the diffuse light is not in q, and what has the colour c cancels. The median of their squares in bins of
    brightness gives the variance c_l^2 var(q_k) + c_k^2 var(q_l), from which slope and floor of the channels follow by
    non-negative least squares of the relative error. With one or two channels they are taken of q itself.
    """
    rows, columns = series.planes.shape[1:3]
    tops = range(0, rows - 2 * APART, STRIP * -(-rows * columns // MOST_PIXELS))  # evenly spread
    strips = [_Strip.of(series, slice(top, min(top + STRIP, rows))) for top in tops]
    colour = _colour_of(np.concatenate([strip.values for strip in strips], axis=1))
    order, edges = _bins(np.concatenate([strip.level for strip in strips]).mean(axis=(1, 2)))
    level, count = (np.concatenate([getattr(s, name) for s in strips])[order] for name in ("level", "count"))
    channels = colour.shape[1]
    table, variances = [], []
    for j, each in enumerate(colour):
        for k, other, c_k, c_other in _pairs_of(each):
            squares = [
                squared_differences(c_other * strip.q[j, ..., k] - c_k * strip.q[j, ..., other], strip.complete, APART)
                for strip in strips
            ]
            energy = np.concatenate(squares)[order]
            for first, last in edges:
                row = np.zeros((2, channels))
                for channel, factor in ((k, c_other**2), (other, c_k**2)):
                    row[0, channel] += factor * level[first:last, j, channel].mean()
                    row[1, channel] += factor * count[first:last, j, channel].mean()
                table.append(row.ravel())
                variances.append(np.median(energy[first:last]))
    return _least_squares(np.array(table), np.array(variances), channels), colour.ravel()


def _least_squares(table: np.ndarray, variances: np.ndarray, channels: int) -> PhotographNoise | None:
    """Fit slopes and floors >= 0 with table @ (slopes, floors) ~ variances, relative errors counting alike.

    Bins without any noise (of rounded values) are ignored. None where too few are left.
    """
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
    """Differences of some rows."""

    q: np.ndarray
    # (d, pixels, channels) of their usable pixels; level and count (pixels, d, channels) of the pixels (`complete`)
    # whose eight neighbours `APART` pixels away are usable too
    values: np.ndarray
    complete: np.ndarray
    level: np.ndarray
    count: np.ndarray

    @classmethod
    def of(cls, series: Series, rows: slice) -> "_Strip":
        part, usable = series.rows(rows), series.usable[rows]
        q = series.differences(part)
        complete = complete_around(usable, APART)
        inner = [
            np.broadcast_to(each, q.shape)[:, APART:-APART, APART:-APART][:, complete].transpose(1, 0, 2)
            for each in series.noise_of_differences(part, rows)
        ]
        return cls(q, q[:, usable], complete, *inner)


def complete_around(usable: np.ndarray, apart: int) -> np.ndarray:
    """Mark (rows - 2 apart, columns - 2 apart) bool pixels that are usable with their eight neighbours so far apart."""
    across = usable[:, : -2 * apart] & usable[:, apart:-apart] & usable[:, 2 * apart :]
    return across[: -2 * apart] & across[apart:-apart] & across[2 * apart :]


def squared_differences(values: np.ndarray, complete: np.ndarray, apart: int) -> np.ndarray:
    """Square second differences, down and across, of values (rows, columns, ...), over their variance under noise of 1.

    Of the pixels that are `complete`; they vanish on planes and edges (J. Immerkaer, Fast noise variance estimation,
    CVIU 64, 1996). Divided by the median of the square of a normal number: their median is the noise's variance.
    """
    from scipy.special import chdtri

    along = values[:, : -2 * apart] - 2 * values[:, apart:-apart] + values[:, 2 * apart :]
    both = along[: -2 * apart] - 2 * along[apart:-apart] + along[2 * apart :]
    weights = np.array([1, -2, 1])
    return both[complete] ** 2 / ((weights @ weights) ** 2 * chdtri(1, 0.5))


def _bins(level: np.ndarray) -> tuple[np.ndarray, list[tuple[int, int]]]:
    """Order pixels by their bin of brightness, and find where in this order each bin with enough pixels lies."""
    bright = np.sqrt(level)
    top = np.percentile(bright, 99.9) if len(bright) else 0.0
    number = np.minimum((bright * (BINS / top) if top > 0 else 0 * bright).astype(np.int64), BINS - 1)
    order = np.argsort(number, kind="stable")
    edges = np.searchsorted(number[order], np.arange(BINS + 1))
    return order, [(a, b) for a, b in pairwise(edges.tolist()) if b - a >= FEWEST_IN_BIN]


def _pairs_of(colour: np.ndarray) -> list[tuple[int, int, float, float]]:
    """List channels k, l and their colours c_k, c_l, whose difference c_l q_k - c_k q_l has no light of that colour."""
    n = len(colour)
    if n < 3:
        return [(k, k, 0.0, 1.0) for k in range(n)]
    pairs = sorted({tuple(sorted((k, (k + step) % n))) for k in range(n) for step in (1, 2)})
    return [(k, other, float(colour[k]), float(colour[other])) for k, other in pairs]


def _colour_of(values: np.ndarray) -> np.ndarray:
    """Find the unit vectors (d, channels) along which values (d, pixels, channels) vary together.

    They are the colour of the specular light where it is strong. Noise is not shared by channels, so that the diagonal
    of their products is fitted (principal factor); two values have no other product and use it.
    """
    joined = values.transpose(0, 2, 1).reshape(values.shape[0] * values.shape[2], values.shape[1])
    products = joined @ joined.T
    strength = products.diagonal().copy()
    for _ in range(30 if len(products) > 2 else 1):
        sizes, axes = np.linalg.eigh(products)
        shared = max(sizes[-1], 0.0) * axes[:, -1] ** 2
        np.fill_diagonal(products, np.minimum(shared, strength))
    colour = axes[:, -1] * (1 if axes[:, -1].sum() >= 0 else -1)
    return colour.reshape(values.shape[0], values.shape[2])
