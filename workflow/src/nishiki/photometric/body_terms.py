"""Body shading of given normals: the terms (a, b, d) of `nishiki.photometric.lobe` by linear least squares.

With the normal known, I = c (a + b c + d x^8) is linear in its terms. Where the normals come from an intensity in which
gloss counts little (`nishiki.photometric.body_colour`), the terms that predict light are fitted here to the mean of the
channels, along those normals: light is predicted with all of the gloss and with the same normals.
"""

import numpy as np
from numba import njit, prange

from nishiki.photometric import flags as bits
from nishiki.photometric.lobe import BLOCK, powers
from nishiki.photometric.refine import LEAST_FACTOR, SHADING_SQUARINGS, WIDTH

CHUNK = 32  # blocks that share one set of work arrays
TERMS = 11  # six products of (c, c^2, c x^8), three right-hand sides, the sum of squares, the weight


@njit(cache=True, error_model="numpy")
def load_block(intensity, mean, usable, known, start, width, values, may, use, change):
    """Samples of the mean of a block, and the change of its samples by the weights of the channels, relative."""
    shared_usable, shared_known = usable.shape[1] == 1, known.shape[1] == 1
    zero = np.float32(0.0)
    total = np.zeros(BLOCK, np.float32)
    change[:] = zero
    for j in range(mean.shape[0]):
        block = slice(start, start + width)
        there = np.full(width, known[j, 0]) if shared_known else known[j, block]
        is_usable = np.full(width, usable[j, 0]) if shared_usable else usable[j, block]
        load_row(intensity[j, block], mean[j, block], there, is_usable, values[j], may[j], use[j], change, total)
    for p in range(BLOCK):
        change[p] = change[p] / total[p] if total[p] > zero else zero


@njit(cache=True, error_model="numpy")
def load_row(intensity, mean, known, usable, values, may, use, change, total):
    """One light of a block: its samples, and the sums of their change and of their size."""
    zero, one = np.float32(0.0), np.float32(1.0)
    for p in range(len(mean)):
        there = known[p] != 0
        values[p] = mean[p] if there else zero
        may[p] = one if there else zero
        use[p] = one if there & (usable[p] != 0) else zero
        change[p] += abs(intensity[p] - mean[p]) if there else zero
        total[p] += abs(mean[p]) if there else zero


@njit(cache=True, error_model="numpy")
def add_up_terms(values, weights, vectors, normals, sums):
    """Normal equations of the terms into sums (TERMS * BLOCK) float64; normals (3 * BLOCK) float32."""
    zero, least = np.float32(0.0), np.float32(1e-3)
    sums[:] = 0.0
    for j in range(values.shape[0]):
        lx, ly, lz = vectors[0, j], vectors[1, j], vectors[2, j]
        hx, hy, hz = vectors[3, j], vectors[4, j], vectors[5, j]
        row, weight = values[j], weights[j]
        for p in range(BLOCK):
            c = normals[p] * lx + normals[p + BLOCK] * ly + normals[p + 2 * BLOCK] * lz
            x = normals[p] * hx + normals[p + BLOCK] * hy + normals[p + 2 * BLOCK] * hz
            _, power = powers(x if x > least else least, SHADING_SQUARINGS)
            w = np.float64(weight[p] if c > zero else zero)
            v, c1, c2, c3 = np.float64(row[p]), np.float64(c), np.float64(c * c), np.float64(c * power)
            w1, w2, w3, wv = w * c1, w * c2, w * c3, w * v
            sums[p] += w1 * c1
            sums[p + BLOCK] += w1 * c2
            sums[p + 2 * BLOCK] += w1 * c3
            sums[p + 3 * BLOCK] += w2 * c2
            sums[p + 4 * BLOCK] += w2 * c3
            sums[p + 5 * BLOCK] += w3 * c3
            sums[p + 6 * BLOCK] += wv * c1
            sums[p + 7 * BLOCK] += wv * c2
            sums[p + 8 * BLOCK] += wv * c3
            sums[p + 9 * BLOCK] += wv * v
            sums[p + 10 * BLOCK] += w


@njit(cache=True, error_model="numpy")
def solve_terms(sums, prior, noise, at_least, going, terms, limit):
    """Terms (3 * BLOCK) of the pixels that go on; limit (BLOCK,): three times the scatter of their samples.

    prior: as in `nishiki.photometric.refine.refine`, with the scatter about Lambert's law of the same normal.
    """
    for p in range(BLOCK):
        s00, s01, s02 = sums[p], sums[p + BLOCK], sums[p + 2 * BLOCK]
        s11, s12, s22 = sums[p + 3 * BLOCK], sums[p + 4 * BLOCK], sums[p + 5 * BLOCK]
        r0, r1, r2, squares = sums[p + 6 * BLOCK], sums[p + 7 * BLOCK], sums[p + 8 * BLOCK], sums[p + 9 * BLOCK]
        kept = sums[p + 10 * BLOCK]
        albedo = r0 / s00
        left = squares - albedo * r0
        left = left if left > 0.0 else 0.0
        held = prior * kept / 3.0 + left / (kept * albedo * albedo) / (WIDTH * WIDTH)
        ridge = 1e-9 * s00
        m00, m11, m22 = s00 + ridge, s11 + held + ridge, s22 + held + ridge
        l1, l2 = s01 / m00, s02 / m00
        d1, m21 = m11 - l1 * s01, s12 - l2 * s01
        k = m21 / d1
        d2 = m22 - l2 * s02 - k * m21
        u1 = r1 - l1 * r0
        d = (r2 - l2 * r0 - k * u1) / d2
        b = u1 / d1 - k * d
        a = r0 / m00 - l1 * b - l2 * d
        rest = squares - 2.0 * (a * r0 + b * r1 + d * r2)
        rest = rest + a * (a * s00 + 2.0 * (b * s01 + d * s02)) + b * (b * s11 + 2.0 * d * s12) + d * d * s22
        freedom = kept - 3.0 if kept > 4.0 else 1.0
        scatter = np.sqrt((rest if rest > 0.0 else 0.0) / freedom)
        mean = a + (b * s01 + d * s02) / s00
        good = (kept >= at_least) & (albedo > 0.0) & (d1 > 0.0) & (d2 > 0.0) & (mean > LEAST_FACTOR * albedo)
        go = going[p] if good else 0.0  # false for NaN
        terms[p] = a if go > 0.0 else terms[p]
        terms[p + BLOCK] = b if go > 0.0 else terms[p + BLOCK]
        terms[p + 2 * BLOCK] = d if go > 0.0 else terms[p + 2 * BLOCK]
        terms[p + 3 * BLOCK] = mean if go > 0.0 else terms[p + 3 * BLOCK]
        limit[p] = np.float32(3.0 * (scatter + noise * albedo))
        going[p] = go


@njit(cache=True, error_model="numpy")
def choose_again(values, known, vectors, normals, terms, limit, weights):
    """Weight 1 for the lit, known samples whose residual is at most `limit`."""
    zero, least = np.float32(0.0), np.float32(1e-3)
    surface = terms.astype(np.float32)
    for j in range(values.shape[0]):
        lx, ly, lz = vectors[0, j], vectors[1, j], vectors[2, j]
        hx, hy, hz = vectors[3, j], vectors[4, j], vectors[5, j]
        row, may, weight = values[j], known[j], weights[j]
        for p in range(BLOCK):
            c = normals[p] * lx + normals[p + BLOCK] * ly + normals[p + 2 * BLOCK] * lz
            x = normals[p] * hx + normals[p + BLOCK] * hy + normals[p + 2 * BLOCK] * hz
            _, power = powers(x if x > least else least, SHADING_SQUARINGS)
            r = row[p] - c * (surface[p] + surface[p + BLOCK] * c + surface[p + 2 * BLOCK] * power)
            weight[p] = may[p] if (r <= limit[p]) & (r >= -limit[p]) & (c > zero) else zero


@njit(cache=True, parallel=True, error_model="numpy")
def fit_body_terms(intensity, mean, usable, known, vectors, settings, normals, flags, shading):
    """Replace the body shading of pixels whose normals come from another intensity than the mean of the channels.

    Parameters
    ----------
    intensity, mean : (lights, pixels) float32
    usable, known : (lights, pixels) or (lights, 1) uint8
        Samples to start from; those to choose from again, by their residuals.
    vectors : (6, lights) float32
        Directions to the lights, and half vectors.
    settings : (4,) float64
        Prior, noise, least number of samples, and the change of the samples below which a pixel is left as it is.
    normals : (pixels, 3) float32
    flags : (pixels,) uint8
        Pixels without an estimate, or without a lobe, are left as they are.
    shading : (pixels, 3) float32
        (a, b, d), scaled so that the body factor is 1 on average over the samples, weighted c^2; changed in place.
    """
    lights, pixels = mean.shape
    prior, noise, at_least, least_change = settings[0], settings[1], settings[2], settings[3]
    blocks = (pixels + BLOCK - 1) // BLOCK
    for chunk in prange((blocks + CHUNK - 1) // CHUNK):
        values, may = np.zeros((lights, BLOCK), np.float32), np.zeros((lights, BLOCK), np.float32)
        weights = np.zeros_like(values)
        change, limit = np.zeros(BLOCK, np.float32), np.zeros(BLOCK, np.float32)
        surface, sums, terms = np.zeros(3 * BLOCK, np.float32), np.zeros(TERMS * BLOCK), np.zeros(4 * BLOCK)
        going = np.zeros(BLOCK)
        for block in range(chunk * CHUNK, min((chunk + 1) * CHUNK, blocks)):
            start = block * BLOCK
            width = min(BLOCK, pixels - start)
            load_block(intensity, mean, usable, known, start, width, values, may, weights, change)
            for p in range(BLOCK):
                fitted = p < width and not flags[start + p] & (bits.NO_ESTIMATE | bits.FALLBACK)
                going[p] = 1.0 if fitted and change[p] > least_change else 0.0
                for k in range(3):
                    surface[p + k * BLOCK] = normals[start + p, k] if p < width else np.float32(0.0)
            if going.max() == 0.0:
                continue
            terms[:] = 0.0
            for step in range(2):
                if step > 0:
                    choose_again(values, may, vectors, surface, terms, limit, weights)
                add_up_terms(values, weights, vectors, surface, sums)
                solve_terms(sums, prior, noise, at_least, going, terms, limit)
            for p in range(width):
                if terms[p + 3 * BLOCK] > 0.0:
                    for k in range(3):
                        shading[start + p, k] = terms[p + k * BLOCK] / terms[p + 3 * BLOCK]
