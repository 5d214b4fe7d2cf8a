"""Kernels between texels and pixels: sorting pixels by tile, bilinear look-up, and the rim of the silhouette."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, error_model="numpy")
def by_tile(tile, slots):
    """Stable counting sort of pixels by tile.

    tile (n,) int32 >= 0; slots: number of tiles.  Returns first (slots + 1,) int64 and order (n,) int64: the pixels of
    tile k are order[first[k] : first[k + 1]].
    """
    first = np.zeros(slots + 1, np.int64)
    for i in range(tile.size):
        first[tile[i] + 1] += 1
    for k in range(slots):
        first[k + 1] += first[k]
    place = first.copy()
    order = np.empty(tile.size, np.int64)
    for i in range(tile.size):
        k = tile[i]
        order[place[k]] = i
        place[k] += 1
    return first, order


@numba.njit(cache=True, nogil=True, error_model="numpy")
def look_up(texture, s, t, order, out):
    """Bilinear look-up: texture (T, T, channels) float32 at rows s, columns t of the pixels `order`, into out (n, ch).

    Coordinates beyond the tile are taken at its border.
    """
    rows, columns, channels = texture.shape
    for k in range(order.size):
        p = order[k]
        y = min(max(s[p], np.float32(0)), np.float32(rows - 1))
        x = min(max(t[p], np.float32(0)), np.float32(columns - 1))
        i, j = min(int(y), max(rows - 2, 0)), min(int(x), max(columns - 2, 0))
        fy, fx = y - np.float32(i), x - np.float32(j)
        below, right = min(i + 1, rows - 1), min(j + 1, columns - 1)
        one = np.float32(1)
        for c in range(channels):
            upper = texture[i, j, c] * (one - fx) + texture[i, right, c] * fx
            lower = texture[below, j, c] * (one - fx) + texture[below, right, c] * fx
            out[p, c] = upper * (one - fy) + lower * fy


@numba.njit(cache=True, nogil=True, error_model="numpy")
def mix(residual, views, visible, weights, fallback, out):
    """Add a weighted sum of the residuals of several observations to out (T, T, channels), texel by texel.

    residual (M, T, T, channels) float32; views (n,) int64; visible (n, T, T) float32 in 0..1: how well each observation
    sees the texel; weights (n,): used where all of them see it; fallback (n,), none negative: elsewhere, times
    `visible` and normalised; where no observation sees the texel `fallback` alone (what the decoder filled in there).
    """
    count = views.size
    rows, columns, channels = out.shape
    share = np.empty(count, np.float32)
    for i in range(rows):
        for j in range(columns):
            whole, least, total = np.float32(0), np.float32(1), np.float32(0)
            for k in range(count):
                total += fallback[k] * visible[k, i, j]
                whole += fallback[k]
                if weights[k] != 0:
                    least = min(least, visible[k, i, j])
            for k in range(count):
                if least >= np.float32(1):
                    share[k] = weights[k]
                elif total > np.float32(1e-6):
                    share[k] = fallback[k] * visible[k, i, j] / total
                else:
                    share[k] = fallback[k] / whole
            for k in range(count):
                for c in range(channels):
                    out[i, j, c] += share[k] * residual[views[k], i, j, c]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _ring(values, known, reached):
    """One ring of `extend`: fills unknown pixels next to known ones; their number."""
    rows, columns, channels = values.shape
    filled = 0
    sums = np.zeros(channels, np.float64)
    for i in range(rows):
        for j in range(columns):
            if known[i, j] != 0:
                continue
            weight = 0.0
            sums[:] = 0
            for y in range(max(i - 1, 0), min(i + 2, rows)):
                for x in range(max(j - 1, 0), min(j + 2, columns)):
                    if known[y, x] == 0 or known[y, x] > reached:
                        continue
                    share = 1.0 if y == i or x == j else 0.5
                    # a straight line through two known pixels, away from the rim, where there are two
                    yy, xx = 2 * y - i, 2 * x - j
                    line = 0 <= yy < rows and 0 <= xx < columns and 0 < known[yy, xx] <= reached
                    weight += share
                    for c in range(channels):
                        here = np.float64(values[y, x, c])
                        slope = here - np.float64(values[yy, xx, c]) if line else 0.0
                        # half the slope: the noise of a full extrapolation grows with every ring
                        sums[c] += share * (here + 0.5 * slope)
            if weight > 0:
                for c in range(channels):
                    values[i, j, c] = sums[c] / weight
                known[i, j] = reached + 1
                filled += 1
    return filled


def extend(values: np.ndarray, covered: np.ndarray, *, rings: int) -> tuple[np.ndarray, np.ndarray]:
    """Values (rows, columns, channels) float32 carried on beyond the covered pixels by `rings` pixels.

    A pixel at the silhouette's edge whose centre just misses the surface shows some of it all the same; left empty, it
    would be a dark rim.  Returns the values, and reached (rows, columns) bool: covered or filled.
    """
    values = np.ascontiguousarray(values, np.float32).copy()
    known = covered.astype(np.uint8)
    for ring in range(rings):
        if not _ring(values, known, ring + 1):
            break
    return values, known > 0
