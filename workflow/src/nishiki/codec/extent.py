"""What part of a tile's block is coded: the arc of views that see it, and the rectangle that holds any surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nishiki.codec.observations import arc_views, visible_arc

SIDES = (8, 16, 32, 48, 64, 96, 128, 192, 256)


@dataclass(frozen=True)
class Extent:
    """start, length: arc of views; row, column, rows, columns: rectangle of texels. length 0: nothing sees the tile."""

    start: int
    length: int
    row: int
    column: int
    rows: int
    columns: int

    @property
    def texels(self) -> tuple[slice, slice]:
        """Slices of the rectangle in arrays (T, T, ...)."""
        return slice(self.row, self.row + self.rows), slice(self.column, self.column + self.columns)

    def observations(self, views: int, lights: int) -> np.ndarray:
        """(lights * length,) int64: observations of the block, in its order."""
        return (np.arange(lights)[:, None] * views + arc_views(self.start, self.length, views)[None]).reshape(-1)

    def row_of_numbers(self) -> tuple[int, ...]:
        """As the index stores it."""
        return self.start, self.length, self.row, self.column, self.rows, self.columns


def extent_of(seen: np.ndarray, inside: np.ndarray, *, full_turn: bool, arcs: bool) -> Extent:
    """seen (views,) bool; inside (T, T) bool. arcs: False keeps all views."""
    start, length = visible_arc(seen, full_turn=full_turn) if arcs else (0, len(seen) if seen.any() else 0)
    row, rows = _side(inside.any(axis=1))
    column, columns = _side(inside.any(axis=0))
    return Extent(start, length, row, column, rows, columns)


def _side(used: np.ndarray) -> tuple[int, int]:
    """First texel and number of texels: the smallest of SIDES that holds all used ones, or the whole tile."""
    at = np.flatnonzero(used)
    if not len(at):
        return 0, min(SIDES[0], len(used))
    length = at[-1] + 1 - at[0]
    side = min(s for s in (*SIDES, len(used)) if length <= s <= len(used))
    return int(min(at[0], len(used) - side)), int(side)
