"""Kernels between texels and pixels: sorting pixels by tile, bilinear look-up, and the rim of the silhouette."""

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
def asked_for(s, t, order, size):
    """List the texels that some pixels look up, in a tile of size x size.

    s, t (n,): rows and columns of all pixels, order: those of this tile.  Returns chosen (m,) int64, flat numbers of
    the texels, and place (size * size,) int32: where each stands in `chosen`, -1 where it is not asked for.
    """
    place = np.full(size * size, -1, np.int32)
    for k in range(order.size):
        p = order[k]
        i = min(max(int(s[p]), 0), max(size - 2, 0))
        j = min(max(int(t[p]), 0), max(size - 2, 0))
        below, right = min(i + 1, size - 1), min(j + 1, size - 1)
        place[i * size + j] = 0
        place[i * size + right] = 0
        place[below * size + j] = 0
        place[below * size + right] = 0
    count = 0
    chosen = np.empty(size * size, np.int64)
    for k in range(size * size):
        if place[k] == 0:
            chosen[count] = k
            place[k] = count
            count += 1
    return chosen[:count].copy(), place


@numba.njit(cache=True, nogil=True, error_model="numpy")
def look_up(texels, place, size, s, t, order, out):
    """Bilinear look-up among the chosen texels (m, channels) float32 of a tile, for the pixels `order`.

    place (size * size,): as of `asked_for`; out (n, channels) gets the values.
    Coordinates beyond the tile are taken at its border.
    """
    one, last = np.float32(1), np.float32(size - 1)
    for k in range(order.size):
        p = order[k]
        y = min(max(s[p], np.float32(0)), last)
        x = min(max(t[p], np.float32(0)), last)
        i, j = min(int(y), max(size - 2, 0)), min(int(x), max(size - 2, 0))
        fy, fx = y - np.float32(i), x - np.float32(j)
        below, right = min(i + 1, size - 1), min(j + 1, size - 1)
        a, b = place[i * size + j], place[i * size + right]
        c, d = place[below * size + j], place[below * size + right]
        for channel in range(texels.shape[1]):
            upper = texels[a, channel] * (one - fx) + texels[b, channel] * fx
            lower = texels[c, channel] * (one - fx) + texels[d, channel] * fx
            out[p, channel] = upper * (one - fy) + lower * fy


@numba.njit(cache=True, nogil=True, error_model="numpy")
def mix(residual, views, chosen, visible, weights, fallback, out):
    """Add a weighted sum of the residuals of several observations to out (m, channels), texel by texel.

    residual (M, T * T, channels) float32; views (n,) int64; chosen (m,): texels; visible (n, m) float32 in 0..1: how
    well each observation sees the texel; weights (n,): used where all of them see it; fallback (n,), none negative:
    elsewhere, times `visible` and normalised; where no observation sees the texel `fallback` alone (what the decoder
    filled in there).
    """
    count = views.size
    share = np.empty(count, np.float32)
    for i in range(chosen.size):
        fallback_sum, least, total = np.float32(0), np.float32(1), np.float32(0)
        for k in range(count):
            total += fallback[k] * visible[k, i]
            fallback_sum += fallback[k]
            if weights[k] != 0:
                least = min(least, visible[k, i])
        for k in range(count):
            if least >= np.float32(1):
                share[k] = weights[k]
            elif total > np.float32(1e-6):
                share[k] = fallback[k] * visible[k, i] / total
            else:
                share[k] = fallback[k] / fallback_sum
        for k in range(count):
            for c in range(out.shape[1]):
                out[i, c] += share[k] * residual[views[k], chosen[i], c]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _border(known, first, last):
    """Flat numbers of the unknown pixels beside pixels that are known, among rows and columns first .. last."""
    rows, columns = known.shape
    border = np.empty(4096, np.int64)
    count = 0
    for i in range(max(first[0], 0), min(last[0] + 1, rows)):
        for j in range(max(first[1], 0), min(last[1] + 1, columns)):
            if known[i, j] == 0 or known[i, j] == 255:  # 255: found already
                continue
            for y in range(max(i - 1, 0), min(i + 2, rows)):
                for x in range(max(j - 1, 0), min(j + 2, columns)):
                    if known[y, x] == 0:
                        known[y, x] = 255
                        if count == border.size:
                            longer = np.empty(2 * border.size, np.int64)
                            longer[:count] = border
                            border = longer
                        border[count] = y * columns + x
                        count += 1
    for k in range(count):
        known[border[k] // columns, border[k] % columns] = 0
    return border[:count].copy()


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fill(values, known, border, reached):
    """Fill the pixels of a border from known ones beside them; they are known as `reached` + 1."""
    rows, columns, channels = values.shape
    sums = np.zeros(channels, np.float64)
    for number in border:
        i, j = number // columns, number % columns
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
        for c in range(channels):
            values[i, j, c] = sums[c] / weight
        known[i, j] = reached + 1


def extend(values: np.ndarray, covered: np.ndarray, *, rings: int) -> np.ndarray:
    """Carry values (rows, columns, channels) float32 on beyond the covered pixels by `rings` pixels (at most 200).

    In place; reached (rows, columns) bool: covered or filled.

    A pixel at the silhouette's edge whose centre just misses the surface shows some of it all the same; left empty, it
    would be a dark rim.
    """
    known = covered.astype(np.uint8)
    rows, columns = np.flatnonzero(covered.any(axis=1)), np.flatnonzero(covered.any(axis=0))
    if not len(rows):
        return covered.copy()
    for ring in range(min(rings, 200)):
        first = np.array([rows[0] - ring, columns[0] - ring])
        last = np.array([rows[-1] + ring, columns[-1] + ring])
        _fill(values, known, _border(known, first, last), ring + 1)
    return known > 0
