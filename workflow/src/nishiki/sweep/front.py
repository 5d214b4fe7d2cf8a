"""The Pareto front of error against run time, and whether a variant is beaten beyond the spread of its repeats."""

from collections.abc import Sequence
from dataclasses import dataclass

NEGLIGIBLE = 0.01
"""Errors closer than this share of each other count as equal where the times cannot be told apart either."""


@dataclass(frozen=True)
class Point:
    """A variant in the plane of time and loss. time: median over the repeats; low, high: least and greatest of them;
    loss: the error, less is better (the negative of a measure of which more is better)."""

    name: str
    time: float
    low: float
    high: float
    loss: float


def front(points: Sequence[Point]) -> list[int]:
    """Indices of the points that no other point beats, from the fastest on.

    A point is beaten by one that is at least as good in time and loss and better in one of them. O(n log n).
    """
    order = sorted(range(len(points)), key=lambda k: (points[k].time, points[k].loss))
    indices: list[int] = []
    for k in order:
        best = points[indices[-1]] if indices else None
        equal = best is not None and (best.time, best.loss) == (points[k].time, points[k].loss)
        if best is None or points[k].loss < best.loss or equal:
            indices.append(k)
    return indices


def beaten_by(point: Point, others: Sequence[Point]) -> tuple[list[Point], bool]:
    """The others that beat `point`, best loss first, and whether at least one of them does so clearly.

    Clearly: it is faster beyond the spread of the repeats, or its loss is lower by more than NEGLIGIBLE.
    """
    better = [
        other
        for other in others
        if other.time <= point.time
        and other.loss <= point.loss
        and (other.time, other.loss) != (point.time, point.loss)
    ]
    clear = any(other.high < point.low or point.loss - other.loss > NEGLIGIBLE * abs(point.loss) for other in better)
    return sorted(better, key=lambda other: (other.loss, other.time)), clear
