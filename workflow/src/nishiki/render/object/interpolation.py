"""Weights of the captured views at a place between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from nishiki.geometry.camera_path import CameraPath

Method = Literal["nearest", "linear", "cubic"]


@dataclass(frozen=True)
class Neighbours:
    """views (n,) int: captured views that take part, and their weights (n,) float64, which sum to 1."""

    views: np.ndarray
    weights: np.ndarray


def neighbours(
    turn: CameraPath, position: float, *, method: Method = "linear", without: frozenset[int] = frozenset()
) -> Neighbours:
    """The captured views around `position` (radians along the path) and their weights.

    linear: the two nearest, one to each side (the form of Miyazaki et al. 2007, section 4.3.3).  cubic: four, by the
    polynomial through them (Lagrange), which is exact for residuals that change up to the third power of the angle.
    nearest: one.
    without: views that may not take part (left out, or the one that is to be predicted).  At the ends of an open path
    the last views take the place of missing ones.
    """
    usable = np.array([k for k in range(len(turn.position)) if k not in without], int)
    if not len(usable):
        raise ValueError("expected at least one captured view, found none")
    offset = turn.position[usable] - position
    if turn.closed:
        offset = (offset + 0.5 * turn.length) % turn.length - 0.5 * turn.length
    order = np.argsort(offset, kind="stable")
    usable, offset = usable[order], offset[order]
    exact = np.flatnonzero(np.abs(offset) <= 1e-9 * max(turn.length, 1e-300))
    if len(exact) or method == "nearest" or len(usable) == 1:
        best = int(exact[0]) if len(exact) else int(np.argmin(np.abs(offset)))
        return Neighbours(usable[best : best + 1], np.ones(1))
    each = 2 if method == "cubic" else 1
    chosen = surrounding(offset, each, closed=turn.closed, length=turn.length)
    views, places = usable[chosen[0]], chosen[1]
    return Neighbours(views, lagrange(places))


def surrounding(offset: np.ndarray, each: int, *, closed: bool, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Indexes and offsets of the `each` views before and after 0 in sorted offsets; round the turn where closed."""
    count = len(offset)
    each = min(each, count // 2) if count > 1 else 1
    first = int(np.searchsorted(offset, 0.0))
    if closed:
        raw = np.arange(first - each, first + each)
        return raw % count, offset[raw % count] + length * (raw // count)
    start = min(max(first - each, 0), count - 2 * each)
    if first in (0, count):  # beyond the ends: no extrapolation
        nearest = 0 if first == 0 else count - 1
        return np.array([nearest]), offset[[nearest]]
    raw = np.arange(start, start + 2 * each)
    return raw, offset[raw]


def lagrange(places: np.ndarray) -> np.ndarray:
    """Weights (n,) of values at distinct places (n,) for the value at 0 of the polynomial through them."""
    weights = np.ones(len(places))
    for i, here in enumerate(places):
        for j, there in enumerate(places):
            if i != j:
                weights[i] *= -there / (here - there)
    return weights
