"""Selection by robust re-fit: the half of the samples that agree best with one Lambertian surface, then all that do.

Least trimmed squares (P. J. Rousseeuw, Least median of squares regression, J. Am. Stat. Assoc. 79, 1984) with
concentration steps (Rousseeuw and van Driessen, Computing LTS regression for large data sets, Data Min. Knowl. Disc.
12, 2006), made for photometric stereo in three ways:

* The starts are windows of brightness ranks, not random subsets: highlights are the brightest of a pixel's samples and
  shadows the darkest, so one of a few windows is nearly free of both, however many lights each has spoilt.
* A sample that is too bright counts several times as badly as one that is equally too dark. Gloss only ever adds light,
  and its skirt spoils many lights by a little; noise and shading errors go both ways.
* The residual is judged relative to the fitted albedo: a fit that explains the samples by a steeper surface with a
  brighter albedo is not favoured.
"""

import numpy as np
from numba import njit, prange

from nishiki.photometric.block import BLOCK, FAR, TERMS, add_up, distances, keep_below, solve_block, sort_block

CHUNK = 32  # blocks that share one set of work arrays


@njit(cache=True, error_model="numpy")
def load_block(observations, valid, start, width, values, known, count):
    """Copy a block, divided by each pixel's largest sample, so that every radiometric scale is treated alike."""
    shared = valid.shape[1] == 1
    peak = np.zeros(BLOCK, dtype=np.float32)
    for p in range(BLOCK):
        count[p] = 0.0
    for j in range(observations.shape[0]):
        for p in range(BLOCK):
            inside = p < width and (valid[j, 0] if shared else valid[j, start + p])
            value = observations[j, start + p] if inside else np.float32(0.0)
            values[j, p] = value
            known[j, p] = np.float32(1.0) if inside else np.float32(0.0)
            count[p] += known[j, p]
            peak[p] = max(peak[p], value)
    for p in range(BLOCK):
        # Two divisions by normal numbers: 1 / peak would overflow where the peak is subnormal.
        peak[p] = peak[p] if peak[p] > np.float32(0.0) else np.float32(1.0)
    for j in range(observations.shape[0]):
        for p in range(BLOCK):
            values[j, p] = values[j, p] / peak[p]


@njit(cache=True, error_model="numpy")
def rank_limits(ordered, count, share, part, at_least, low, high):
    """Values that bound the window of ranks that starts at the fraction `part` of the places it can have."""
    for p in range(BLOCK):
        size = min(max(at_least, np.floor(share * count[p] + 0.5)), count[p])
        first = int(np.floor(part * (count[p] - size) + 0.5))
        last = max(first + int(size) - 1, 0)
        low[p] = ordered[first, p]
        high[p] = ordered[last, p]


@njit(cache=True, error_model="numpy")
def window_weights(values, known, low, high, weights):
    """Weight 1 for known samples from low to high."""
    for j in range(values.shape[0]):
        for p in range(BLOCK):
            inside = known[j, p] > 0 and low[p] <= values[j, p] and values[j, p] <= high[p]
            weights[j, p] = np.float32(1.0) if inside else np.float32(0.0)


@njit(cache=True, inline="always")
def concentrate(distance, ordered, comparators, count, coverage, at_least, limit, weights):
    """Keep each pixel's `coverage` share of best fitting samples (equal ones with them)."""
    for j in range(distance.shape[0]):
        for p in range(BLOCK):
            ordered[j, p] = distance[j, p]
    sort_block(ordered, comparators)
    for p in range(BLOCK):
        size = min(max(at_least, np.ceil(coverage * count[p])), count[p])
        limit[p] = ordered[max(int(size) - 1, 0), p]
    keep_below(distance, limit, weights)


@njit(cache=True, error_model="numpy")
def judge(distance, weights, scaled, count, coverage, at_least, floor, quality):
    """Mean squared relative distance of the kept samples, raised where fewer than asked were lit."""
    kept = np.zeros(BLOCK, dtype=np.float32)
    total = np.zeros(BLOCK, dtype=np.float32)
    for j in range(distance.shape[0]):
        for p in range(BLOCK):
            ratio = min(distance[j, p] / scaled[p + 3 * BLOCK], np.float32(10.0))
            kept[p] += weights[j, p]
            total[p] += weights[j, p] * ratio * ratio
    for p in range(BLOCK):
        size = min(max(at_least, np.ceil(coverage * count[p])), count[p])
        enough = kept[p] >= at_least
        mean = total[p] / max(kept[p], np.float32(1.0)) + floor * floor
        quality[p] = mean * size / max(kept[p], np.float32(1.0)) if enough else FAR


@njit(cache=True, error_model="numpy")
def spread(values, directions, weights, scaled, floor, scale):
    """Standard deviation of the kept residuals, with the noise floor (relative to the albedo) added."""
    total = np.zeros(BLOCK, dtype=np.float32)
    kept = np.zeros(BLOCK, dtype=np.float32)
    for j in range(values.shape[0]):
        x, y, z = directions[j, 0], directions[j, 1], directions[j, 2]
        for p in range(BLOCK):
            r = values[j, p] - (scaled[p] * x + scaled[p + BLOCK] * y + scaled[p + 2 * BLOCK] * z)
            total[p] += weights[j, p] * r * r
            kept[p] += weights[j, p]
    for p in range(BLOCK):
        variance = total[p] / max(kept[p] - np.float32(3.0), np.float32(1.0))
        scale[p] = np.sqrt(variance) + floor * scaled[p + 3 * BLOCK]


@njit(cache=True, error_model="numpy")
def accept(values, known, directions, scaled, scale, brighter, darker, weights):
    """Weight 1 for every lit sample within -darker .. brighter times the scale of the fit."""
    for j in range(values.shape[0]):
        x, y, z = directions[j, 0], directions[j, 1], directions[j, 2]
        for p in range(BLOCK):
            shading = scaled[p] * x + scaled[p + BLOCK] * y + scaled[p + 2 * BLOCK] * z
            r = values[j, p] - shading
            fits = r <= brighter * scale[p] and r >= -darker * scale[p]
            inside = fits and shading > np.float32(0.0) and known[j, p] > np.float32(0.0)
            weights[j, p] = np.float32(1.0) if inside else np.float32(0.0)


@njit(cache=True, parallel=True, error_model="numpy")
def refit_selection(observations, valid, directions, products, comparators, settings, usable, highlights, shadows):
    """Mark in `usable` the samples that one Lambertian surface explains; shapes as in `threshold_selection`.

    directions (lights, 3) and products (lights, 9) float32; settings float32: starts, steps, window, coverage, above,
    brighter, darker, floor, at_least, rounds.
    """
    lights, pixels = observations.shape
    starts, steps, rounds = int(settings[0]), int(settings[1]), int(settings[9])
    window, coverage, above = settings[2], settings[3], settings[4]
    brighter, darker, floor, at_least = settings[5], settings[6], settings[7], settings[8]
    blocks = (pixels + BLOCK - 1) // BLOCK
    for chunk in prange((blocks + CHUNK - 1) // CHUNK):
        values = np.empty((lights, BLOCK), dtype=np.float32)
        known, weights, distance = np.empty_like(values), np.empty_like(values), np.empty_like(values)
        ordered, ranked = np.empty_like(values), np.empty_like(values)
        sums = np.empty(TERMS * BLOCK, dtype=np.float32)
        scaled, best = np.empty(4 * BLOCK, dtype=np.float32), np.empty(4 * BLOCK, dtype=np.float32)
        count, low, high = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
        limit = np.empty(BLOCK, np.float32)
        quality, record, scale = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
        for block in range(chunk * CHUNK, min((chunk + 1) * CHUNK, blocks)):
            start = block * BLOCK
            width = min(BLOCK, pixels - start)
            load_block(observations, valid, start, width, values, known, count)
            for j in range(lights):
                for p in range(BLOCK):
                    ranked[j, p] = values[j, p] if known[j, p] > np.float32(0.0) else FAR
            sort_block(ranked, comparators)
            best[:] = 0.0
            limit[:] = 0.0
            record[:] = np.inf
            for s in range(starts):
                part = np.float32(s / max(starts - 1, 1))
                rank_limits(ranked, count, window, part, at_least, low, high)
                window_weights(values, known, low, high, weights)
                scaled[:] = 0.0
                for _ in range(steps + 1):
                    add_up(values, weights, products, sums)
                    solve_block(sums, at_least, scaled)
                    distances(values, known, directions, scaled, above, distance)
                    concentrate(distance, ordered, comparators, count, coverage, at_least, low, weights)
                judge(distance, weights, scaled, count, coverage, at_least, floor, quality)
                for p in range(BLOCK):
                    if quality[p] < record[p]:
                        record[p], limit[p] = quality[p], low[p]
                        for k in range(4):
                            best[p + k * BLOCK] = scaled[p + k * BLOCK]
            distances(values, known, directions, best, above, distance)
            keep_below(distance, limit, weights)
            spread(values, directions, weights, best, floor, scale)
            for _ in range(rounds):
                accept(values, known, directions, best, scale, brighter, darker, weights)
                add_up(values, weights, products, sums)
                solve_block(sums, at_least, best)
            accept(values, known, directions, best, scale, brighter, darker, weights)
            write_block(values, known, directions, best, weights, at_least, start, width, usable, highlights, shadows)


@njit(cache=True, error_model="numpy")
def write_block(values, known, directions, scaled, weights, at_least, start, width, usable, highlights, shadows):
    """Samples kept and the reasons for the others; a pixel without a trustworthy fit keeps every known sample."""
    for p in range(width):
        kept = np.float32(0.0)
        for j in range(values.shape[0]):
            kept += weights[j, p]
        trusted = kept >= at_least
        bright, dark = 0, 0
        for j in range(values.shape[0]):
            inside = known[j, p] > np.float32(0.0)
            taken = weights[j, p] > np.float32(0.0) if trusted else inside
            shading = scaled[p] * directions[j, 0]
            shading += scaled[p + BLOCK] * directions[j, 1] + scaled[p + 2 * BLOCK] * directions[j, 2]
            usable[j, start + p] = taken
            if inside and not taken:
                if values[j, p] > max(shading, np.float32(0.0)):
                    bright += 1
                else:
                    dark += 1
        highlights[start + p] = bright
        shadows[start + p] = dark
