"""Body shading of given normals: the terms (a, b, d) of `nishiki.photometric.lobe` by linear least squares.

With the normal known, I = c (a + b c + d x^8) is linear in its terms. Where the normals come from an intensity in which
gloss counts little (`nishiki.photometric.body_colour`), the terms that predict light are fitted here to the mean of the
channels, along those normals: light is predicted with all of the gloss and with the same normals.
"""

import numpy as np
from numba import njit

from nishiki.lanes import LANES, choose, load, planes, splat, store, widen
from nishiki.photometric import flags as bits
from nishiki.photometric.lobe import BLOCK, powers
from nishiki.photometric.refine import LEAST_FACTOR, WIDTH

TERMS = 11  # six products of (c, c^2, c x^8), three right-hand sides, the sum of squares, the weight


@njit(cache=True, error_model="numpy")
def load_block(samples, start, values, may, use, change):
    """Load the samples of the mean of a block, and their relative change by the weights of the channels."""
    intensity, mean, usable, known = samples
    zero, one = np.float32(0.0), np.float32(1.0)
    for p in range(0, BLOCK, LANES):
        difference = total = splat(zero)
        for j in range(mean.shape[0]):
            there, value = load(known, (j, start + p)), load(mean, (j, start + p))
            apart = load(intensity, (j, start + p)) - value
            value, apart = choose(there, value, zero), choose(there, apart, zero)
            difference += choose(apart > zero, apart, zero - apart)
            total += choose(value > zero, value, zero - value)
            store(values, (j, p), value)
            store(may, (j, p), choose(there, one, zero))
            store(use, (j, p), choose(there & load(usable, (j, start + p)), one, zero))
        store(change, p, choose(total > zero, difference / total, zero))


@njit(cache=True, inline="always")
def cosine_and_lobe(vectors, j, normals, p):
    """Cosine of light j, and its lobe."""
    least = np.float32(1e-3)
    n0, n1, n2 = load(normals, p), load(normals, p + BLOCK), load(normals, p + 2 * BLOCK)
    c = n0 * vectors[0, j] + n1 * vectors[1, j] + n2 * vectors[2, j]
    x = n0 * vectors[3, j] + n1 * vectors[4, j] + n2 * vectors[5, j]
    _, power = powers(choose(x > least, x, least))
    return c, power


@njit(cache=True, error_model="numpy")
def add_up_terms(values, weights, vectors, normals, sums):
    """Add normal equations of the terms to sums (TERMS * BLOCK) float64; normals (3 * BLOCK) float32."""
    zero = np.float32(0.0)
    for p in range(0, BLOCK, LANES):
        s00 = s01 = s02 = s11 = s12 = s22 = r0 = r1 = r2 = squares = total = splat(0.0)
        for j in range(values.shape[0]):
            c, power = cosine_and_lobe(vectors, j, normals, p)
            w, v = widen(choose(c > zero, load(weights, (j, p)), zero)), widen(load(values, (j, p)))
            c1, c2, c3 = widen(c), widen(c * c), widen(c * power)
            w1, w2, w3, wv = w * c1, w * c2, w * c3, w * v
            s00 += w1 * c1
            s01 += w1 * c2
            s02 += w1 * c3
            s11 += w2 * c2
            s12 += w2 * c3
            s22 += w3 * c3
            r0 += wv * c1
            r1 += wv * c2
            r2 += wv * c3
            squares += wv * v
            total += w
        store(sums, p, s00)
        store(sums, p + BLOCK, s01)
        store(sums, p + 2 * BLOCK, s02)
        store(sums, p + 3 * BLOCK, s11)
        store(sums, p + 4 * BLOCK, s12)
        store(sums, p + 5 * BLOCK, s22)
        store(sums, p + 6 * BLOCK, r0)
        store(sums, p + 7 * BLOCK, r1)
        store(sums, p + 8 * BLOCK, r2)
        store(sums, p + 9 * BLOCK, squares)
        store(sums, p + 10 * BLOCK, total)


@njit(cache=True, error_model="numpy")
def solve_terms(sums, settings, going, terms, limit):
    """Terms (3 * BLOCK) of the pixels that go on; limit (BLOCK,): three times the scatter of their samples.

    The prior is as in `nishiki.photometric.refine.refine`, with the scatter about Lambert's law of the same normal.
    """
    for p in range(BLOCK):
        s00, s01, s02 = sums[p], sums[p + BLOCK], sums[p + 2 * BLOCK]
        s11, s12, s22 = sums[p + 3 * BLOCK], sums[p + 4 * BLOCK], sums[p + 5 * BLOCK]
        r0, r1, r2, squares = sums[p + 6 * BLOCK], sums[p + 7 * BLOCK], sums[p + 8 * BLOCK], sums[p + 9 * BLOCK]
        kept = sums[p + 10 * BLOCK]
        albedo = r0 / s00
        left = squares - albedo * r0
        left = left if left > 0.0 else 0.0
        held = settings.prior * kept / 3.0 + left / (kept * albedo * albedo) / (WIDTH * WIDTH)
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
        good = (kept >= settings.at_least) & (albedo > 0.0) & (d1 > 0.0) & (d2 > 0.0) & (mean > LEAST_FACTOR * albedo)
        go = going[p] if good else 0.0  # false for NaN
        terms[p] = a if go > 0.0 else terms[p]
        terms[p + BLOCK] = b if go > 0.0 else terms[p + BLOCK]
        terms[p + 2 * BLOCK] = d if go > 0.0 else terms[p + 2 * BLOCK]
        terms[p + 3 * BLOCK] = mean if go > 0.0 else terms[p + 3 * BLOCK]
        limit[p] = np.float32(3.0 * (scatter + settings.noise * albedo))
        going[p] = go


@njit(cache=True, error_model="numpy")
def choose_again(values, known, vectors, normals, terms, limit, weights):
    """Weight 1 for the lit, known samples whose residual is at most `limit`; terms (3 * BLOCK) float32."""
    zero = np.float32(0.0)
    for p in range(0, BLOCK, LANES):
        a, b, d = load(terms, p), load(terms, p + BLOCK), load(terms, p + 2 * BLOCK)
        most = load(limit, p)
        least = zero - most
        for j in range(values.shape[0]):
            c, power = cosine_and_lobe(vectors, j, normals, p)
            r = load(values, (j, p)) - c * (a + b * c + d * power)
            fits = (r <= most) & (r >= least) & (c > zero)
            store(weights, (j, p), choose(fits, load(known, (j, p)), zero))


@njit(cache=True, nogil=True, error_model="numpy")
def fit_body_terms(begin, end, samples, vectors, settings, normals, flags, shading):
    """Replace the body shading of pixels whose normals come from another intensity than the mean of the channels.

    Parameters
    ----------
    begin, end : int
        Blocks of BLOCK pixels, of which there are at least one.
    samples : nishiki.photometric.solve.BodySamples
    vectors : (6, lights) float32
        Directions to the lights, and half vectors.
    settings : nishiki.photometric.solve.BodySettings
    normals : (pixels, 3) float32
    flags : (pixels,) uint8
        Pixels without an estimate, or without a lobe, are left as they are.
    shading : (pixels, 3) float32
        (a, b, d), scaled so that the body factor is 1 on average over the samples, weighted c^2; changed in place.
    """
    lights, pixels = samples.mean.shape
    memory = planes(3 * lights + 5, np.int64(BLOCK))
    values, may, weights = memory[:lights], memory[lights : 2 * lights], memory[2 * lights : 3 * lights]
    change, limit, surface = memory[3 * lights], memory[3 * lights + 1], memory[3 * lights + 2 :].ravel()
    sums, terms, going, rounded = np.zeros(TERMS * BLOCK), np.zeros(4 * BLOCK), np.zeros(BLOCK), surface.copy()
    for block in range(begin, end):
        start = min(block * BLOCK, pixels - BLOCK)  # the last block overlaps: its pixels get the same twice
        load_block(samples, start, values, may, weights, change)
        any_going = False
        for p in range(BLOCK):
            fitted = not flags[start + p] & (bits.NO_ESTIMATE | bits.FALLBACK)
            going[p] = 1.0 if fitted and change[p] > settings.least_change else 0.0
            any_going |= going[p] > 0.0
            for k in range(3):
                surface[p + k * BLOCK] = normals[start + p, k]
            for k in range(4):
                terms[p + k * BLOCK] = 0.0
        if not any_going:
            continue
        for step in range(2):
            if step > 0:
                for p in range(3 * BLOCK):
                    rounded[p] = np.float32(terms[p])
                choose_again(values, may, vectors, surface, rounded, limit, weights)
            add_up_terms(values, weights, vectors, surface, sums)
            solve_terms(sums, settings, going, terms, limit)
        for p in range(BLOCK):
            if terms[p + 3 * BLOCK] > 0.0:
                for k in range(3):
                    shading[start + p, k] = terms[p + k * BLOCK] / terms[p + 3 * BLOCK]
