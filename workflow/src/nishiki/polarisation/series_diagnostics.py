"""How well a series of polariser states agrees with its own model, on an even choice of pixels."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from nishiki.polarisation.polariser_states import StateSums
from nishiki.polarisation.series_order import find_order, remove_nuisance

MOST_VALUES = 1 << 19
ROWS = 32
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
        self.valid: np.ndarray | None = None

    def add(self, values: np.ndarray, valid: np.ndarray) -> None:
        """The next photograph."""
        if not self.has_fit:
            return
        some = valid[:: self.step, :: self.step]
        self.valid = some.copy() if self.valid is None else self.valid & some
        self.values.append(values[:: self.step, :: self.step].copy())

    def blocks(self) -> Iterator[np.ndarray]:
        """(states, values) float64 of the pixels that are valid in all photographs, a few rows at a time."""
        for first in range(0, len(self.valid), ROWS):
            part = slice(first, first + ROWS)
            inside = self.valid[part]
            if inside.any():
                yield np.stack([values[part][inside].ravel() for values in self.values]).astype(np.float64)


def diagnose(sums: StateSums, thinned: Thinned) -> dict:
    """What the series says of itself; empty for sums without a fit.

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
    diagnostics: dict = {
        "residual": float(np.sqrt(left / count) / (total / count)) if total > 0 else None,
        "unexplained": _unexplained(sums, series),
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


def _unexplained(sums: StateSums, series: np.ndarray) -> float:
    """See `diagnose`; series (states, groups)."""
    left = series - sums.design @ (sums.inverse @ series)
    varied = float(((series - series.mean(axis=0)) ** 2).sum())
    if not varied > 0 or np.sqrt((left**2).mean()) < DRIFT * abs(series.mean()):
        return 0.0
    return float((left**2).sum()) / varied
