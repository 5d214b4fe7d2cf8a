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
    zero, one = np.float32(0.0), np.float32(1.0)
    shared = valid.shape[1] == 1
    peak = np.zeros(BLOCK, dtype=np.float32)
    count[:] = zero
    if width < BLOCK:
        values[:] = zero
        known[:] = zero
    for j in range(observations.shape[0]):
        if shared:
            for p in range(width):
                known[j, p] = one if valid[j, 0] else zero
        else:
            mark(valid[j, start : start + width], known[j, :width])
        load_row(observations[j, start : start + width], known[j], values[j], count, peak)
    for p in range(BLOCK):
        # Two divisions by normal numbers: 1 / peak would overflow where the peak is subnormal.
        peak[p] = peak[p] if peak[p] > zero else one
    for j in range(observations.shape[0]):
        row = values[j]
        for p in range(len(row)):
            row[p] = row[p] / peak[p]


@njit(cache=True, error_model="numpy")
def mark(chosen, weights):
    """Weight 1 where a sample is chosen (bool), else 0."""
    one, zero = np.float32(1.0), np.float32(0.0)
    for p in range(len(chosen)):
        weights[p] = one if chosen[p] else zero


@njit(cache=True, error_model="numpy")
def load_row(samples, known, values, count, peak):
    """One light of a block: its known samples, 0 for the others; their number and the largest so far."""
    zero = np.float32(0.0)
    for p in range(len(samples)):
        value = samples[p] if known[p] > zero else zero
        values[p] = value
        count[p] += known[p]
        peak[p] = peak[p] if peak[p] >= value else value


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
    one, zero = np.float32(1.0), np.float32(0.0)
    for j in range(values.shape[0]):
        row, mask, weight = values[j], known[j], weights[j]
        for p in range(len(row)):
            inside = (mask[p] > zero) & (low[p] <= row[p]) & (row[p] <= high[p])
            weight[p] = one if inside else zero


@njit(cache=True, error_model="numpy")
def concentrate(distance, ordered, comparators, count, coverage, at_least, limit, weights):
    """Keep each pixel's `coverage` share of best fitting samples (equal ones with them)."""
    for j in range(distance.shape[0]):
        row, target = distance[j], ordered[j]
        for p in range(len(row)):
            target[p] = row[p]
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
        row, weight = distance[j], weights[j]
        for p in range(len(row)):
            ratio = row[p] / scaled[p + 3 * BLOCK]
            ratio = ratio if ratio < np.float32(10.0) else np.float32(10.0)
            kept[p] += weight[p]
            total[p] += weight[p] * ratio * ratio
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
        row, weight = values[j], weights[j]
        for p in range(len(row)):
            r = row[p] - (scaled[p] * x + scaled[p + BLOCK] * y + scaled[p + 2 * BLOCK] * z)
            total[p] += weight[p] * r * r
            kept[p] += weight[p]
    for p in range(BLOCK):
        variance = total[p] / max(kept[p] - np.float32(3.0), np.float32(1.0))
        scale[p] = np.sqrt(variance) + floor * scaled[p + 3 * BLOCK]


@njit(cache=True, error_model="numpy")
def accept(values, known, directions, scaled, scale, brighter, darker, weights):
    """Weight 1 for every lit sample within -darker .. brighter times the scale of the fit."""
    one, zero = np.float32(1.0), np.float32(0.0)
    for j in range(values.shape[0]):
        x, y, z = directions[j, 0], directions[j, 1], directions[j, 2]
        row, mask, weight = values[j], known[j], weights[j]
        for p in range(len(row)):
            shading = scaled[p] * x + scaled[p + BLOCK] * y + scaled[p + 2 * BLOCK] * z
            r = row[p] - shading
            fits = (r <= brighter * scale[p]) & (r >= -darker * scale[p])
            weight[p] = one if fits & (shading > zero) & (mask[p] > zero) else zero


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
                far_unless(known[j], values[j], ranked[j])
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
def far_unless(known, values, out):
    """Values of the known samples, FAR for the others."""
    for p in range(len(values)):
        out[p] = values[p] if known[p] > np.float32(0.0) else FAR


@njit(cache=True, error_model="numpy")
def write_block(values, known, directions, scaled, weights, at_least, start, width, usable, highlights, shadows):
    """Samples kept and the reasons for the others; a pixel without a trustworthy fit keeps every known sample."""
    kept = np.zeros(BLOCK, np.float32)
    bright, dark = np.zeros(BLOCK, np.float32), np.zeros(BLOCK, np.float32)
    for j in range(values.shape[0]):
        weight = weights[j]
        for p in range(len(weight)):
            kept[p] += weight[p]
    for j in range(values.shape[0]):
        keep_trusted(kept, at_least, known[j], weights[j])
        count_rejected(values[j], known[j], weights[j], directions[j], scaled, bright, dark)
        row, weight = usable[j, start : start + width], weights[j]
        for p in range(len(row)):
            row[p] = weight[p] > np.float32(0.0)
    for p in range(width):
        highlights[start + p] = int(bright[p])
        shadows[start + p] = int(dark[p])


@njit(cache=True, error_model="numpy")
def keep_trusted(kept, at_least, known, weights):
    """Weights of the pixels that keep enough samples; where a fit is not to be trusted, all known ones."""
    for p in range(len(weights)):
        weights[p] = weights[p] if kept[p] >= at_least else known[p]


@njit(cache=True, error_model="numpy")
def count_rejected(values, known, weights, direction, scaled, bright, dark):
    """Add one light's rejected samples to those brighter than the fit, and to the others."""
    one, zero = np.float32(1.0), np.float32(0.0)
    x, y, z = direction[0], direction[1], direction[2]
    for p in range(len(values)):
        shading = scaled[p] * x
        shading += scaled[p + BLOCK] * y + scaled[p + 2 * BLOCK] * z
        shading = shading if shading > zero else zero
        rejected = (known[p] > zero) & (weights[p] <= zero)
        bright[p] += one if rejected & (values[p] > shading) else zero
        dark[p] += one if rejected & (values[p] <= shading) else zero
