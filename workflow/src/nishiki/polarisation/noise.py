"""Noise of the photographs of a polariser series, and the colour of its specular light, measured on one view."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from nishiki.polarisation.differences import PhotographNoise, Series

STRIP = 16  # rows
MOST_PIXELS = 1 << 17  # that the noise is measured on
BINS, FEWEST_IN_BIN = 16, 200  # of brightness, for the noise
APART = 2  # pixels between those that second differences for the noise compare: one apart shares demosaiced samples
CHI_MEDIAN = 0.4549364  # median of the square of a normal number
SECOND_DIFFERENCES = 36.0  # variance of (1, -2, 1) x (1, -2, 1) of numbers of variance 1


def measure_noise(series: Series) -> tuple[PhotographNoise | None, np.ndarray]:
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
    def of(cls, series: Series, rows: slice) -> _Strip:
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
    every = -(-rows * columns // MOST_PIXELS)
    return [slice(top, min(top + STRIP, rows)) for top in range(0, rows - 2 * APART, STRIP * every)]


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
