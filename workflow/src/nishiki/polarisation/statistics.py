"""Count what a separation gives, and how well a series agrees with its own model."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nishiki.polarisation.polarisation import SeparatedView
from nishiki.polarisation.polariser_states import StateSums
from nishiki.polarisation.series_order import find_order, remove_nuisance

LIT = 0.1
"""Share of the brightest hundredth of a picture from which a pixel shows the object and not the dark round it."""


@dataclass(frozen=True)
class SeparationStatistics:
    """Of one view, over the valid pixels of the object and all channels."""

    valid: float  # share of the object's pixels
    diffuse: float | None  # diffuse, specular: means
    specular: float | None
    negative: float | None  # share of specular values below 0
    negative_mean: float | None  # their mean
    noise: float | None  # standard deviation of the specular values' noise
    # share of values below -3 noise, which noise alone leaves at about 0.1 %. None where nothing is valid.
    doubtful: float | None


def statistics_of(view: SeparatedView, shown: np.ndarray | None = None) -> SeparationStatistics:
    """Statistics of one separated view over the pixels that show the object, (rows, columns) bool; None: over all."""
    shown = np.ones(view.valid.shape, bool) if shown is None else shown
    share = float(view.valid[shown].mean()) if shown.any() else 0.0
    inside = view.valid & shown
    values = view.specular[inside]
    if not values.size:
        return SeparationStatistics(share, None, None, None, None, None, None)
    noise = noise_of(view.specular, inside)
    below = values[values < 0]
    return SeparationStatistics(
        share,
        float(view.diffuse[inside].mean(dtype=np.float64)),
        float(values.mean(dtype=np.float64)),
        float((values < 0).mean()),
        float(below.mean(dtype=np.float64)) if below.size else 0.0,
        noise,
        float((values < -3 * noise).mean()) if noise is not None else None,
    )


def select_lit(total: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Select, (rows, columns) bool, the pixels of total (rows, columns, channels) that are a tenth of the brightest."""
    light = total.mean(axis=-1)
    bright = float(np.percentile(light[valid], 99)) if valid.any() else 0.0
    return light >= LIT * bright if bright > 0 else np.ones(light.shape, bool)


def noise_of(values: np.ndarray, valid: np.ndarray) -> float | None:
    """Estimate the standard deviation of the noise of (rows, columns, channels); None without a 3 x 3 valid place.

    Second differences in both directions vanish on planes and edges (J. Immerkaer, Fast noise variance estimation, CVIU
    64, 1996); the median of their absolute values is used, so that texture counts little.
    """
    if min(valid.shape) < 3:
        return None
    along = values[:, :-2] - 2 * values[:, 1:-1] + values[:, 2:]
    both = along[:-2] - 2 * along[1:-1] + along[2:]
    complete = np.ones(both.shape[:2], bool)
    for row in range(3):
        for column in range(3):
            complete &= valid[row : row + complete.shape[0], column : column + complete.shape[1]]
    if not complete.any():
        return None
    # Weights (1, -2, 1) x (1, -2, 1) have a sum of squares of 36; 0.6745 is the median of |N(0, 1)|.
    return float(np.median(np.abs(both[complete])) / 0.6745 / 6)


MOST_VALUES = 1 << 19
ROWS = 32  # in memory
GROUP = 64  # neighbouring values of a photograph that are averaged
DRIFT = 0.02  # of the light: a lamp varies by as much between photographs


class Thinned:
    """Every n-th pixel of every photograph of one view, so few that all states fit into memory."""

    def __init__(self, sums: StateSums, shape: tuple[int, int], channels: int):
        self.step = 1
        while -(-shape[0] // self.step) * -(-shape[1] // self.step) * channels > MOST_VALUES:
            self.step += 1
        self.has_fit = sums.design.shape[1] > 0
        self.values: list[np.ndarray] = []
        self.valid = np.ones([-(-side // self.step) for side in shape], bool)

    def add(self, values: np.ndarray, valid: np.ndarray) -> None:
        """Add the next photograph."""
        if not self.has_fit:
            return
        self.valid &= valid[:: self.step, :: self.step]
        self.values.append(values[:: self.step, :: self.step].copy())

    def blocks(self) -> Iterator[np.ndarray]:
        """(states, values) float64 of the pixels that are valid in all photographs, a few rows at a time."""
        for first in range(0, len(self.valid), ROWS):
            part = slice(first, first + ROWS)
            inside = self.valid[part]
            if inside.any():
                yield np.stack([values[part][inside].ravel() for values in self.values]).astype(np.float64)


def diagnose(sums: StateSums, thinned: Thinned) -> dict:
    """Diagnose a series; empty for sums without a fit.

    residual: root mean square of what the least squares leaves, relative to the mean of the photographs. unexplained:
    share of the variation between the states that it leaves, of means over 64 values so that noise counts little; 0
    where it leaves less than 2 % of the light: what varies so little is the lamp. exchanged: number of states whose
    photographs another order explains better beyond doubt. mueller: the mean matrix relative to its first element.
    polarisance_median: median over the pixels of the root mean square of the 3 x 3 other elements (2 x 2 where only
    linear polarisation is known), 1 for a mirror, 0 where all polarisation is lost. pixels_used: of the choice.
    """
    if not thinned.has_fit:
        return {}
    count, total, left, sums_of_solved, ratios = 0, 0.0, 0.0, 0.0, []
    means = []
    inner = [place for place, k in enumerate(sums.elements) if k % 4 and k // 4]
    for series in thinned.blocks():
        solved = sums.inverse @ series
        left += float(((series - sums.design @ solved) ** 2).sum())
        groups = max(1, series.shape[1] // GROUP)
        means.append(series[:, : groups * GROUP].reshape(len(series), groups, -1).mean(axis=2))
        count, total = count + series.size, total + float(series.sum())
        sums_of_solved = sums_of_solved + solved.sum(axis=1)
        if inner:
            lit = solved[0] > 0
            ratios.append(np.sqrt((solved[inner][:, lit] ** 2).sum(axis=0) / np.sqrt(len(inner))) / solved[0, lit])
    if not count:
        return {"residual": None, "unexplained": None, "pixels_used": 0}
    series = np.concatenate(means, axis=1)
    order = find_order(remove_nuisance(series[:, None]), sums.design)
    rest = (series - sums.design @ (sums.inverse @ series)) ** 2
    varied = float(((series - series.mean(axis=0)) ** 2).sum())
    differ = varied > 0 and not np.sqrt(rest.mean()) < DRIFT * abs(series.mean())
    diagnostics: dict = {
        "residual": float(np.sqrt(left / count) / (total / count)) if total > 0 else None,
        "unexplained": float(rest.sum()) / varied if differ else 0.0,
        "exchanged": sum(i != k for i, k in enumerate(order.order)) if order else 0,
        "pixels_used": int(thinned.valid.sum()),
    }
    if sums.elements:
        mean = np.zeros(16)
        mean[list(sums.elements)] = sums_of_solved
        known = np.concatenate(ratios)
        diagnostics["mueller"] = (mean / mean[0]).reshape(4, 4).tolist() if mean[0] > 0 else None
        diagnostics["polarisance_median"] = float(np.median(known)) if known.size else None
    return diagnostics
