"""Tiles of a painting at its own and ever a quarter of the resolution, written while bands of its rows come in.

Memory holds the rows of one row of tiles of each level, never a whole map. A tile has a border of its neighbours'
pixels, so that it can be interpolated by itself.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

TILE, BORDER = 512, 4
"""Side of a tile and width of its border, pixels: the border is that of two steps of mean pixels."""
FACTOR = 4
"""From one level to the next. In between a browser averages the codes of a tile, so that the levels above cost a
fifteenth of the bytes instead of a third."""

Emit = Callable[[int, int, int, np.ndarray], None]


class Pyramid:
    """Takes rows of maps and gives tiles to `emit(level, tile row, tile column, values)`.

    values : (TILE + 2 BORDER, TILE + 2 BORDER, fields) float32; beyond the edges of the map its last pixels are
    repeated. The first field is the share of a pixel that is known, and the last the number of its region; the others
    are averaged over what is known.
    """

    def __init__(self, rows: int, columns: int, fields: int, emit: Emit, *, level: int = 0):
        self.shape, self.level, self.emit = (rows, columns), level, emit
        self.held = np.empty((0, columns, fields), np.float32)
        self.first = 0  # row of the map of the first row held
        self.coming = 0  # row of tiles that comes next
        self.above: Pyramid | None = None
        self.left_over = self.held
        if max(rows, columns) > TILE:
            self.above = Pyramid(-(-rows // FACTOR), -(-columns // FACTOR), fields, emit, level=level + 1)

    def levels(self) -> list[tuple[int, tuple[int, int]]]:
        """(factor, (rows, columns)) of every level, the finest first."""
        return [(FACTOR**self.level, self.shape), *(self.above.levels() if self.above else [])]

    def push(self, rows: np.ndarray) -> None:
        """The next rows (n, columns, fields) of the map; after the last of them every tile is written."""
        if self.above:
            pending = np.concatenate([self.left_over, rows])
            complete = self.first + len(self.held) + len(rows) == self.shape[0]
            ready = len(pending) if complete else len(pending) // FACTOR * FACTOR
            self.left_over = pending[ready:]
            if ready:
                self.above.push(halved(halved(pending[:ready])))
        self.held = np.concatenate([self.held, rows])
        end = self.first + len(self.held)
        while self.coming * TILE < self.shape[0]:
            last = min((self.coming + 1) * TILE + BORDER, self.shape[0])
            if end < last:
                break
            self._write(last)
            self.coming += 1
            keep = max(self.coming * TILE - BORDER - self.first, 0)
            self.held, self.first = self.held[keep:], self.first + keep

    def _write(self, last: int) -> None:
        columns = self.shape[1]
        along = np.arange(self.coming * TILE - BORDER, (self.coming + 1) * TILE + BORDER)
        band = self.held[np.clip(along, 0, last - 1) - self.first]
        for k in range(-(-columns // TILE)):
            across = np.clip(np.arange(k * TILE - BORDER, (k + 1) * TILE + BORDER), 0, columns - 1)
            self.emit(self.level, self.coming, k, band[:, across])


def halved(values: np.ndarray) -> np.ndarray:
    """Means over 2 x 2 pixels of the fields of (rows, columns, fields), weighted by the first field, that is by what is
    known of each; the last field is taken from the pixel after the middle."""
    rows, columns = values.shape[:2]
    values = np.pad(values, ((0, rows % 2), (0, columns % 2), (0, 0)), mode="edge")
    blocks = (values.shape[0] // 2, 2, values.shape[1] // 2, 2)
    share = values[..., 0].reshape(blocks).sum(axis=(1, 3))
    total = (values * values[..., :1]).reshape(*blocks, -1).sum(axis=(1, 3))
    out = np.divide(total, share[..., None], out=np.zeros_like(total), where=share[..., None] > 0)
    out[..., 0] = share / 4
    out[..., -1] = values[1::2, 1::2, -1]
    return out


def filled(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Values (rows, columns, fields) with those that are not known replaced by means of their surroundings, so that a
    lossy code spends nothing on their edges."""
    if known.all():
        return values
    if min(known.shape) < 2 or not known.any():
        mean = values[known].mean(axis=0) if known.any() else np.zeros(values.shape[-1], values.dtype)
        return np.where(known[..., None], values, mean)
    stacked = np.concatenate([known[..., None], values, np.zeros((*known.shape, 1), np.float32)], axis=-1)
    coarse = halved(np.where(known[..., None], stacked, 0).astype(np.float32))
    under = filled(coarse[..., 1:-1], coarse[..., 0] > 0)
    under = under.repeat(2, axis=0).repeat(2, axis=1)[: known.shape[0], : known.shape[1]]
    return np.where(known[..., None], values, under)
