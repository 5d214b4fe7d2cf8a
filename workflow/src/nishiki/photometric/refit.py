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

The selection needs many small fits; their accuracy need only be that of a decision, so float32 suffices. Every
operation treats each pixel alone: the result does not depend on which pixels share a block. Only the loops that take
most of the time are inlined by numba, which costs seconds of compilation for each.

Conditions of loops over pixels are joined by & and |: the compiler makes scalar code of branches.
"""

import numpy as np
from numba import njit

from nishiki.lanes import BLOCK, LANES, choose, larger, load, planes, root, smaller, splat, store, store_rows
from nishiki.photometric.flags import NOISE
from nishiki.small_matrices import solve_by_cofactors

TERMS = 10  # sums of a pixel
RIDGE = np.float32(1e-6)  # of the trace: keeps degenerate windows of lights finite; biases a fit by less than 1e-4
FAR = np.float32(3e38)
# shares of the samples, and bounds in units of the scale of the concentrated fit (docs/notes/stages/separate.md)
STARTS = 3  # windows of ranks that are tried
ROUNDS = 2  # fits of each start, and of the accepted samples
WINDOW = np.float32(0.4)  # share of the samples in a starting window of ranks
COVERAGE = np.float32(0.5)  # share of the samples that a fit has to explain: up to half may be spoilt
ABOVE = np.float32(4.0)  # how many times worse a sample too bright is than one too dark
BRIGHTER, DARKER = np.float32(2.0), np.float32(4.0)  # limits of acceptance after the concentration


@njit(cache=True, error_model="numpy")
def sort_block(values, comparators):
    """Sort the columns of values (lights, BLOCK) upwards, in place, by a sorting network."""
    for c in range(comparators.shape[0]):
        for p in range(0, BLOCK, LANES):
            upper, lower = (comparators[c, 0], p), (comparators[c, 1], p)
            a, b = load(values, upper), load(values, lower)
            store(values, upper, smaller(a, b))
            store(values, lower, larger(a, b))


@njit(cache=True, error_model="numpy")
def add_up(values, weights, products, sums):
    """Add each pixel's normal equations to sums (TERMS * BLOCK): six products, three right-hand sides, the weight."""
    for p in range(0, BLOCK, LANES):
        xx = xy = xz = yy = yz = zz = x = y = z = total = splat(np.float32(0.0))
        for j in range(values.shape[0]):
            w = load(weights, (j, p))
            wv = w * load(values, (j, p))
            xx += w * products[j, 0]
            xy += w * products[j, 1]
            xz += w * products[j, 2]
            yy += w * products[j, 3]
            yz += w * products[j, 4]
            zz += w * products[j, 5]
            x += wv * products[j, 6]
            y += wv * products[j, 7]
            z += wv * products[j, 8]
            total += w
        store_rows(sums.reshape(TERMS, BLOCK), p, (xx, xy, xz, yy, yz, zz, x, y, z, total))


@njit(cache=True, error_model="numpy")
def solve_block(sums, at_least, scaled):
    """Solve the sums for scaled normals (4 * BLOCK: x, y, z, length); with fewer than at_least samples they stay."""
    for p in range(BLOCK):
        trace = RIDGE * (sums[p] + sums[p + 3 * BLOCK] + sums[p + 5 * BLOCK]) + np.float32(1e-30)
        a, b, c = sums[p] + trace, sums[p + BLOCK], sums[p + 2 * BLOCK]
        d, e, f = sums[p + 3 * BLOCK] + trace, sums[p + 4 * BLOCK], sums[p + 5 * BLOCK] + trace
        u, v, w = sums[p + 6 * BLOCK], sums[p + 7 * BLOCK], sums[p + 8 * BLOCK]
        x, y, z, det = solve_by_cofactors((a, b, c, d, e, f), u, v, w)
        enough = sums[p + 9 * BLOCK] >= at_least and det > np.float32(0.0)
        scale = np.float32(1.0) / (det if enough else np.float32(1.0))
        x, y, z = x * scale, y * scale, z * scale
        x = x if enough else scaled[p]
        y = y if enough else scaled[p + BLOCK]
        z = z if enough else scaled[p + 2 * BLOCK]
        scaled[p], scaled[p + BLOCK], scaled[p + 2 * BLOCK] = x, y, z
        scaled[p + 3 * BLOCK] = np.sqrt(x * x + y * y + z * z) + np.float32(1e-20)


@njit(cache=True, error_model="numpy")
def distances(values, known, directions, scaled, out):
    """Compute each sample's misfit: |residual|, times ABOVE where it is too bright; FAR if unlit or unknown."""
    zero = np.float32(0.0)
    for p in range(0, BLOCK, LANES):
        nx, ny, nz = load(scaled, p), load(scaled, p + BLOCK), load(scaled, p + 2 * BLOCK)
        for j in range(values.shape[0]):
            shading = nx * directions[j, 0] + ny * directions[j, 1] + nz * directions[j, 2]
            r = load(values, (j, p)) - shading
            far = (shading <= zero) | (load(known, (j, p)) <= zero)
            store(out, (j, p), choose(far, FAR, choose(r > zero, r * ABOVE, zero - r)))


@njit(cache=True, error_model="numpy")
def keep_below(distance, limit, weights):
    """Set weight 1 for the samples whose distance is at most the pixel's limit (and not FAR), else 0."""
    one, zero = np.float32(1.0), np.float32(0.0)
    for p in range(0, BLOCK, LANES):
        most = load(limit, p)
        for j in range(distance.shape[0]):
            d = load(distance, (j, p))
            store(weights, (j, p), choose((d <= most) & (d < FAR), one, zero))


@njit(cache=True, error_model="numpy")
def load_block(observations, valid, start, values, known, ranked, count):
    """Copy a block, divided by each pixel's largest sample, so that every radiometric scale is treated alike.

    ranked: the same with FAR for samples that are not known.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    shared = valid.shape[1] == 1
    for p in range(0, BLOCK, LANES):
        total = peak = splat(zero)
        for j in range(observations.shape[0]):
            if shared:
                there = splat(one if valid[j, 0] else zero)
            else:
                there = choose(load(valid, (j, start + p)), one, zero)
            value = choose(there > zero, load(observations, (j, start + p)), zero)
            total += there
            peak = choose(peak >= value, peak, value)
            store(known, (j, p), there)
            store(values, (j, p), value)
        # Two divisions by normal numbers: 1 / peak would overflow where the peak is subnormal.
        peak = choose(peak > zero, peak, one)
        for j in range(observations.shape[0]):
            value = load(values, (j, p)) / peak
            store(values, (j, p), value)
            store(ranked, (j, p), choose(load(known, (j, p)) > zero, value, FAR))
        store(count, p, total)


@njit(cache=True, error_model="numpy")
def open_window(ordered, values, known, count, ranks, limits, weights):
    """Set weight 1 for the samples within a window of ranks.

    ranks: its share of the samples, the fraction of the places it can have at which it starts, and its least size;
    limits (2, BLOCK): work array.
    """
    (share, part, at_least), (low, high), one, zero = ranks, limits, np.float32(1.0), np.float32(0.0)
    for p in range(BLOCK):
        size = min(max(at_least, np.floor(share * count[p] + 0.5)), count[p])
        first = int(np.floor(part * (count[p] - size) + 0.5))
        low[p], high[p] = ordered[first, p], ordered[max(first + int(size) - 1, 0), p]
    for p in range(0, BLOCK, LANES):
        least, most = load(low, p), load(high, p)
        for j in range(values.shape[0]):
            value = load(values, (j, p))
            inside = (load(known, (j, p)) > zero) & (value >= least) & (value <= most)
            store(weights, (j, p), choose(inside, one, zero))


@njit(cache=True, error_model="numpy")
def concentrate(distance, ordered, comparators, count, at_least, limit, weights):
    """Keep each pixel's COVERAGE share of best fitting samples (equal ones with them)."""
    for p in range(0, BLOCK, LANES):
        for j in range(distance.shape[0]):
            store(ordered, (j, p), load(distance, (j, p)))
    sort_block(ordered, comparators)
    for p in range(BLOCK):
        size = min(max(at_least, np.ceil(COVERAGE * count[p])), count[p])
        limit[p] = ordered[max(int(size) - 1, 0), p]
    keep_below(distance, limit, weights)


@njit(cache=True, error_model="numpy")
def judge(distance, weights, scaled, count, at_least, quality):
    """Average the squared relative distance of the kept samples, raised where fewer than required were lit."""
    zero, one, most, floor = np.float32(0.0), np.float32(1.0), np.float32(10.0), np.float32(NOISE)
    for p in range(0, BLOCK, LANES):
        kept = total = splat(zero)
        albedo = load(scaled, p + 3 * BLOCK)
        for j in range(distance.shape[0]):
            weight, ratio = load(weights, (j, p)), load(distance, (j, p)) / albedo
            ratio = choose(ratio < most, ratio, most)
            kept += weight
            total += weight * ratio * ratio
        number = choose(kept > one, kept, one)
        store(quality, p, total / number + floor * floor)
        store(quality, p + BLOCK, number)
        store(quality, p + 2 * BLOCK, kept)
    for p in range(BLOCK):
        size = min(max(at_least, np.ceil(COVERAGE * count[p])), count[p])
        enough = quality[p + 2 * BLOCK] >= at_least
        quality[p] = quality[p] * size / quality[p + BLOCK] if enough else FAR


@njit(cache=True, error_model="numpy")
def spread(values, directions, weights, scaled, scale):
    """Estimate the deviation of the kept residuals, with the noise floor (relative to the albedo) added."""
    zero, one, unknowns = np.float32(0.0), np.float32(1.0), np.float32(3.0)
    for p in range(0, BLOCK, LANES):
        nx, ny, nz = load(scaled, p), load(scaled, p + BLOCK), load(scaled, p + 2 * BLOCK)
        kept = total = splat(zero)
        for j in range(values.shape[0]):
            weight = load(weights, (j, p))
            r = load(values, (j, p)) - (nx * directions[j, 0] + ny * directions[j, 1] + nz * directions[j, 2])
            total += weight * r * r
            kept += weight
        freedom = kept - unknowns
        variance = total / choose(freedom > one, freedom, one)
        store(scale, p, root(variance) + load(scaled, p + 3 * BLOCK) * np.float32(NOISE))


@njit(cache=True, error_model="numpy")
def accept(values, known, directions, scaled, scale, weights):
    """Weight 1 for every lit sample within -DARKER .. BRIGHTER times the scale of the fit."""
    one, zero = np.float32(1.0), np.float32(0.0)
    for p in range(0, BLOCK, LANES):
        nx, ny, nz = load(scaled, p), load(scaled, p + BLOCK), load(scaled, p + 2 * BLOCK)
        most, least = load(scale, p) * BRIGHTER, load(scale, p) * -DARKER
        for j in range(values.shape[0]):
            shading = nx * directions[j, 0] + ny * directions[j, 1] + nz * directions[j, 2]
            r = load(values, (j, p)) - shading
            fits = (r <= most) & (r >= least) & (shading > zero) & (load(known, (j, p)) > zero)
            store(weights, (j, p), choose(fits, one, zero))


@njit(cache=True, nogil=True, error_model="numpy")
def refit_selection(first, last, observations, valid, lamps, at_least, selected):
    """Mark in `selected` the samples that one Lambertian surface explains, of the blocks first .. last - 1.

    observations (lights, pixels) float32, at least BLOCK pixels; valid (lights, pixels) bool, or (lights, 1) for "the
    same everywhere"; lamps and selected are named tuples of `nishiki.photometric.light_selection`.
    """
    lights, pixels = observations.shape
    directions, products, comparators, of_half = lamps
    memory, row = planes(6 * lights + TERMS + 17, np.int64(BLOCK)), 6 * lights
    values, known, weights = memory[:lights], memory[lights : 2 * lights], memory[2 * lights : 3 * lights]
    distance, ordered = memory[3 * lights : 4 * lights], memory[4 * lights : 5 * lights]
    ranked, sums = memory[5 * lights : row], memory[row : row + TERMS].ravel()
    scaled, best = memory[row + TERMS : row + TERMS + 4].ravel(), memory[row + TERMS + 4 : row + TERMS + 8].ravel()
    row += TERMS + 8
    count, low, high, limit = memory[row], memory[row + 1], memory[row + 2], memory[row + 3]
    record, scale, quality = memory[row + 4], memory[row + 5], memory[row + 6 :].ravel()
    for block in range(first, last):
        start = min(block * BLOCK, pixels - BLOCK)  # the last block overlaps: whatever shares it, a pixel is the same
        load_block(observations, valid, start, values, known, ranked, count)
        sort_block(ranked, comparators)
        for p in range(BLOCK):
            limit[p], record[p] = 0.0, np.inf
            for k in range(4):
                best[p + k * BLOCK] = 0.0
        for s in range(STARTS):
            part = np.float32(s / max(STARTS - 1, 1))
            open_window(ranked, values, known, count, (WINDOW, part, at_least), (low, high), weights)
            for p in range(4 * BLOCK):
                scaled[p] = 0.0
            for _ in range(ROUNDS):
                add_up(values, weights, products, sums)
                solve_block(sums, at_least, scaled)
                distances(values, known, directions, scaled, distance)
                concentrate(distance, ordered, of_half, count, at_least, low, weights)
            judge(distance, weights, scaled, count, at_least, quality)
            for p in range(BLOCK):
                if quality[p] < record[p]:
                    record[p], limit[p] = quality[p], low[p]
                    for k in range(4):
                        best[p + k * BLOCK] = scaled[p + k * BLOCK]
        distances(values, known, directions, best, distance)
        keep_below(distance, limit, weights)
        spread(values, directions, weights, best, scale)
        for _ in range(ROUNDS):
            accept(values, known, directions, best, scale, weights)
            add_up(values, weights, products, sums)
            solve_block(sums, at_least, best)
        accept(values, known, directions, best, scale, weights)
        write_block(values, known, directions, best, weights, at_least, start, selected)


@njit(cache=True, error_model="numpy")
def write_block(values, known, directions, scaled, weights, at_least, start, selected):
    """Write the samples kept and the reasons for the others; a pixel without a trustworthy fit keeps all known ones."""
    zero, one = np.float32(0.0), np.float32(1.0)
    rejected = planes(np.int64(2), np.int64(BLOCK))
    for p in range(0, BLOCK, LANES):
        nx, ny, nz = load(scaled, p), load(scaled, p + BLOCK), load(scaled, p + 2 * BLOCK)
        kept = bright = dark = splat(zero)
        for j in range(values.shape[0]):
            kept += load(weights, (j, p))
        trusted = kept >= at_least
        for j in range(values.shape[0]):
            there = load(known, (j, p))
            weight = choose(trusted, load(weights, (j, p)), there)
            shading = nx * directions[j, 0] + ny * directions[j, 1] + nz * directions[j, 2]
            shading = choose(shading > zero, shading, zero)
            brighter = load(values, (j, p)) > shading
            left_out = choose((there > zero) & (weight <= zero), one, zero)
            bright += choose(brighter, left_out, zero)
            dark += choose(brighter, zero, left_out)
            store(selected.usable, (j, start + p), weight > zero)
        store(rejected, (0, p), bright)
        store(rejected, (1, p), dark)
    for p in range(BLOCK):
        selected.highlights[start + p] = int(rejected[0, p])
        selected.shadows[start + p] = int(rejected[1, p])
