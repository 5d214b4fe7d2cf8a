"""Write maps of the viewer in tiles, each level a quarter of the resolution, and the heights for its shadows.

Memory holds the rows of one row of tiles of each level, never a whole map. A tile has a border of its neighbours'
pixels, so that it can be interpolated by itself.
"""

import struct
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np

from nishiki.artifacts.maps import shrink
from nishiki.threads import strips

TILE, BORDER = 512, 4
"""Side of a tile and width of its border, pixels: the border is that of two steps of mean pixels."""
FACTOR = 4
"""Reduction from level to level. In between a browser averages the codes of a tile, so that the levels above cost a
fifteenth of the bytes instead of a third."""

Emit = Callable[[int, int, int, np.ndarray], None]


class Pyramid:
    """Builder of tiles from rows of maps; calls `emit(level, tile row, tile column, values)`.

    values : (TILE + 2 BORDER, TILE + 2 BORDER, fields) float32; beyond the edges of the map its last pixels are
    repeated. The first field is the share of a pixel that is known, and the last the number of its region; the others
    are averaged over what is known.
    """

    def __init__(self, rows: int, columns: int, fields: int, emit: Emit, *, level: int = 0):
        self.shape, self.level, self.emit = (rows, columns), level, emit
        self.held: list[np.ndarray] = []  # the last rows that were pushed, from row `first` of the map up to `end`
        self.first = self.end = 0
        self.coming = 0  # row of tiles that comes next
        self.above: Pyramid | None = None
        self.left_over = np.empty((0, columns, fields), np.float32)
        if max(rows, columns) > TILE:
            self.above = Pyramid(-(-rows // FACTOR), -(-columns // FACTOR), fields, emit, level=level + 1)

    def levels(self) -> list[tuple[int, tuple[int, int]]]:
        """Return (factor, (rows, columns)) of every level, the finest first."""
        return [(FACTOR**self.level, self.shape), *(self.above.levels() if self.above else [])]

    def push(self, rows: np.ndarray) -> None:
        """Add the next rows (n, columns, fields) of the map; after the last of them every tile is written."""
        self.held.append(rows)
        self.end += len(rows)
        if self.above:
            pending = np.concatenate([self.left_over, rows]) if len(self.left_over) else rows
            ready = len(pending) if self.end == self.shape[0] else len(pending) // FACTOR * FACTOR
            self.left_over = pending[ready:]
            if ready:
                self.above.push(halve(halve(pending[:ready])))
        while self.coming * TILE < self.shape[0]:
            last = min((self.coming + 1) * TILE + BORDER, self.shape[0])
            if self.end < last:
                break
            self._write(last)
            self.coming += 1
            while self.held and self.first + len(self.held[0]) <= self.coming * TILE - BORDER:
                self.first += len(self.held.pop(0))

    def _write(self, last: int) -> None:
        columns = self.shape[1]
        along = np.arange(self.coming * TILE - BORDER, (self.coming + 1) * TILE + BORDER)
        for k in range(-(-columns // TILE)):
            across = np.clip(np.arange(k * TILE - BORDER, (k + 1) * TILE + BORDER), 0, columns - 1)
            values = np.concatenate([rows[:, across] for rows in self.held])
            self.emit(self.level, self.coming, k, values[np.clip(along, 0, last - 1) - self.first])


def halve(values: np.ndarray) -> np.ndarray:
    """Average 2 x 2 pixels of the fields of (rows, columns, fields), weighted by the first field.

    The first field is the certainty of each; the last is taken from the pixel after the middle.
    """
    rows, columns = values.shape[:2]
    values = np.pad(values, ((0, rows % 2), (0, columns % 2), (0, 0)), mode="edge")
    blocks = (values.shape[0] // 2, 2, values.shape[1] // 2, 2)
    share = values[..., 0].reshape(blocks).sum(axis=(1, 3))
    total = (values * values[..., :1]).reshape(*blocks, -1).sum(axis=(1, 3))
    out = np.divide(total, share[..., None], out=np.zeros_like(total), where=share[..., None] > 0)
    out[..., 0] = share / 4
    out[..., -1] = values[1::2, 1::2, -1]
    return out


def fill_unknown(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Fill the unknown values (rows, columns, fields) with means of their surroundings.

    A lossy code then spends nothing on their edges.
    """
    if known.all():
        return values
    if min(known.shape) < 2 or not known.any():
        mean = values[known].mean(axis=0) if known.any() else np.zeros(values.shape[-1], values.dtype)
        return np.where(known[..., None], values, mean)
    stacked = np.concatenate([known[..., None], values, np.zeros((*known.shape, 1), np.float32)], axis=-1)
    coarse = halve(np.where(known[..., None], stacked, 0).astype(np.float32))
    under = fill_unknown(coarse[..., 1:-1], coarse[..., 0] > 0)
    under = under.repeat(2, axis=0).repeat(2, axis=1)[: known.shape[0], : known.shape[1]]
    return np.where(known[..., None], values, under)


NOTHING = np.iinfo(np.int16).min  # code of no height
STEPS = 65000  # of 16 bits
THRESHOLDS = (0, 1, 2, 3, 4, 6, 8, 11, 16, 22, 32, 45, 64, 90, 128, 180, 256, 360)
"""Largest activities of each stream but the last."""
MOST = np.iinfo(np.uint8).max  # byte of an error that needs two
PLANE = (256, -256, 0, 0, 0)
"""Weights of W + N - NW."""


def height_block(
    read: Callable[[slice], np.ndarray], shape: tuple[int, int], pitch: float, most_pixels: int, least_step: float
) -> tuple[bytes, dict[str, Any]]:
    """Encode a height map for page/shadow_worker.js, 16 bits without loss; return the block and its description.

    A code is predicted from its neighbours to the left (W, WW) and above (N, NW, NE, NN),

        p = W + (w . (N - W, NW - W, NE - W, WW - W, NN - W) + 128) >> 8,

    with whole weights w fitted to the map; without all of them from W, else N, else 0. The error e, modulo 2^16,
    becomes z = 2 e or -2 e - 1 and a byte min(z, 255). Bytes go to one of several streams by the activity 2 W + 2 N +
    NW + NE of the bytes around them (0 beside the map), so that the Huffman codes of a stream fit its spread, as in
    context-based coders (Weinberger, Seroussi and Sapiro 2000). A last stream has the z from 255 on, low bytes before
    high ones.

    read : rows of the map in the unit of `pitch`, NaN where it is not known. Above `most_pixels` it is averaged.
    least_step : of a code, in pixels of the map; larger where 16 bits hold the range no finer. The block holds the
    length of each stream, four bytes, the lowest first, before its zlib data.
    """
    factor = max(1, int(np.ceil(np.sqrt(shape[0] * shape[1] / most_pixels))))
    height = shrink(read, shape, factor)
    known = np.isfinite(height)
    low, high = (float(height[known].min()), float(height[known].max())) if known.any() else (0.0, 0.0)
    step = max(least_step * pitch, (high - low) / STEPS)
    codes = np.where(known, np.rint((np.nan_to_num(height) - low) / step) - STEPS // 2, NOTHING).astype(np.int16)
    data, code = encode(codes)
    return data, {
        "rows": height.shape[0],
        "columns": height.shape[1],
        "factor": factor,
        "pitch": pitch * factor,
        "low": low + step * (STEPS // 2),
        "step": step,
        "nothing": NOTHING,
        **code,
    }


def encode(codes: np.ndarray) -> tuple[bytes, dict[str, list[int]]]:
    """Encode codes (rows, columns) int16; return the block, and the weights and thresholds for a reader."""
    weights = _fitted_weights(codes)
    padded = np.zeros((codes.shape[0] + 1, codes.shape[1] + 2), np.uint8)  # bytes, with nothing beside the map
    large = []
    for band in strips(len(codes)):
        first, last = band.start, band.stop
        errors = _errors(codes[max(first - 2, 0) : last], weights)[min(first, 2) :]
        padded[first + 1 : last + 1, 1:-1] = np.minimum(errors, MOST)
        large.append(errors[errors >= MOST])
    activity = np.zeros(codes.shape, np.uint16)
    for part, share in (((1, 0), 2), ((0, 1), 2), ((0, 0), 1), ((0, 2), 1)):
        activity += np.uint16(share) * padded[part[0] :, part[1] :][: codes.shape[0], : codes.shape[1]]
    stream = np.searchsorted(THRESHOLDS, activity).astype(np.uint8)
    values = padded[1:, 1:-1]
    streams = [_deflate(values[stream == k].tobytes()) for k in range(len(THRESHOLDS) + 1)]
    escaped = np.concatenate(large).astype("<u2")
    streams.append(_deflate(np.ascontiguousarray(escaped.view(np.uint8).reshape(-1, 2).T).tobytes()))
    block = b"".join(struct.pack("<I", len(each)) + each for each in streams)
    return block, {"weights": list(weights), "thresholds": list(THRESHOLDS)}


def _neighbours(codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return W (rows - 2, columns - 3) of the pixels that have all neighbours, and the others' differences from it."""
    rows, columns = codes.shape

    def at(up: int, left: int) -> np.ndarray:
        return codes[2 - up : rows - up, 2 - left : columns - 1 - left].astype(np.int32)

    west = at(0, 1)
    return west, np.stack([at(*place) - west for place in ((1, 0), (1, 1), (1, -1), (0, 2), (2, 0))], axis=-1)


def _fitted_weights(codes: np.ndarray) -> tuple[int, ...]:
    """Fit least-squares weights of the neighbours, in 256ths; return those of a plane where they predict better."""
    if min(codes.shape) < 8:
        return PLANE
    bands = [codes[first : first + 3] for first in range(0, len(codes) - 2, max(3, len(codes) // 256))]
    parts = [_neighbours(band) for band in bands]
    change = np.concatenate(
        [band[2:, 2:-1].astype(np.int32) - west for band, (west, _) in zip(bands, parts, strict=True)]
    )
    change, around = change.ravel(), np.concatenate([each for _, each in parts]).reshape(-1, len(PLANE))
    smooth = (np.abs(around).max(axis=1) < STEPS // 8) & (np.abs(change) < STEPS // 8)
    change, around = change[smooth], around[smooth]
    if len(change) < 100:
        return PLANE
    fitted = np.linalg.lstsq(around.astype(np.float64), change.astype(np.float64), rcond=1e-6)[0]
    rounded = np.clip(np.rint(256 * fitted), -1024, 1024).astype(np.int64)
    missed = [np.abs(change - ((around @ np.array(each) + 128) >> 8)).mean() for each in (rounded, PLANE)]
    return tuple(int(w) for w in rounded) if missed[0] < missed[1] else PLANE


def _errors(codes: np.ndarray, weights: tuple[int, ...]) -> np.ndarray:
    """Compute (rows, columns) uint16 z of all pixels; the first two rows as if they were the first of the map."""
    predicted = np.zeros(codes.shape, np.int32)
    predicted[1:, 0] = codes[:-1, 0]
    predicted[:, 1:] = codes[:, :-1]
    if codes.shape[0] > 2 and codes.shape[1] > 3:
        west, around = _neighbours(codes)
        predicted[2:, 2:-1] = west + ((around @ np.array(weights, np.int32) + 128) >> 8)
    error = (codes - predicted).astype(np.int16).astype(np.int32)
    return np.where(error < 0, -2 * error - 1, 2 * error).astype(np.uint16)


def _deflate(data: bytes) -> bytes:
    """Compress to a zlib stream, with or without a search for repetitions, whichever is shorter."""
    coder = zlib.compressobj(9, zlib.DEFLATED, zlib.MAX_WBITS, 9, zlib.Z_HUFFMAN_ONLY)
    return min(coder.compress(data) + coder.flush(), zlib.compress(data, 6), key=len)
