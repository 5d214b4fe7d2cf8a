"""Fit normals under a reflectance with a diffuse fall-off and a gloss lobe beside Lambert's law, per pixel.

Model of one sample, with c = max(n . l, 0), x = max(n . h, 0), h the half vector of light and view:

    I = c * (a + b * c + d * x^e)

a is Lambert's term; b lets the diffuse reflectance depend on the incidence, as the transmission into a dielectric, a
rough body or a penumbra make it do; d x^e is the skirt of the gloss, whose peak the selection has removed. It is the
low-frequency reflectance of B. Shi, P. Tan, Y. Matsushita and K. Ikeuchi, Bi-polynomial modeling of low-frequency
reflectances, IEEE Trans. PAMI 36 (6), 2014, with other terms. b and d are held towards 0 by a weak prior, so that with
few lights or a matt surface the Lambertian estimate results. Solved by damped Gauss-Newton over the two tangential
components of the normal and (a, b, d) together; then the samples are chosen again by their residuals, and so on.

BLOCK pixels at a time, as (lights, BLOCK) float32, in vector registers over the pixels. Each pixel is treated alone,
and its lights are added up in their order: its result depends neither on the pixels that share its block nor on tiles
and threads. Numbers of a block lie in one flat array, BLOCK of each kind after the other: in loops of float64 numbers,
which the compiler makes vector code of, it then needs to check few pairs of arrays for overlap. Products and sums are
rounded apart: with fused multiply-add the bytes would depend on the processor.
"""

from collections import namedtuple

import numpy as np
from numba import njit

from nishiki.lanes import BLOCK, LANES, choose, load, planes, splat, store, store_rows
from nishiki.small_matrices import factorise, substitute

SUMS = 21  # 15 products and 5 right-hand sides of the Gauss-Newton step, the sum of squares
SURFACE = 12  # normal, two tangents, a, b, d: float32, as the samples are
EXPONENT = 8  # e of the model, that of `nishiki.brdf.torrance_sparrow`
SLOPES = 6  # of a sample: by the tangents, c, c x^e; residual, weight
FIT = 7  # normal, a, b, d, penalised sum of squares: float64


Fit = namedtuple("Fit", "fit moved surface trial_surface sums trial slopes prior damping turn going better")
"""Fit of a block, and the scratch memory of its search; flat arrays.

fit, moved (FIT * BLOCK) float64: the fit, and a step's; surface, trial_surface (SURFACE * BLOCK), sums, trial
(SUMS * BLOCK) float32: what they give; slopes (SLOPES * lights, LANES) float32; better (BLOCK,) float32 and going,
float64: 1 where so, else 0; prior, damping, turn (BLOCK,) float64.
"""


@njit(cache=True)
def make_fit(lights):
    """Make the memory of a fit."""
    memory, wide = planes(2 * (SURFACE + SUMS) + 1, np.int64(BLOCK)), np.zeros((4, BLOCK))
    rows = SURFACE + SUMS
    return Fit(
        np.zeros(FIT * BLOCK), np.zeros(FIT * BLOCK),
        memory[:SURFACE].ravel(), memory[SURFACE : 2 * SURFACE].ravel(),
        memory[2 * SURFACE : SURFACE + rows].ravel(), memory[SURFACE + rows : 2 * rows].ravel(),
        planes(SLOPES * lights, np.int64(LANES)), wide[0], wide[1], wide[2], wide[3], memory[2 * rows],
    )  # fmt: skip


@njit(cache=True, inline="always")
def powers(x):
    """Compute x^7 and x^8 (EXPONENT)."""
    x2 = x * x
    lower = x * x2 * (x2 * x2)
    return lower, lower * x


@njit(cache=True, error_model="numpy")
def add_up(values, weights, vectors, surface, slopes, sums):
    """Sum over the lights into sums (SUMS * BLOCK) float32 the terms of the Gauss-Newton step.

    values, weights (lights, BLOCK) float32; vectors (6, lights) float32: l and h; surface (SURFACE * BLOCK) float32;
    slopes (SLOPES * lights, LANES): work array, so that either loop finds room in the registers.
    """
    for p in range(0, BLOCK, LANES):
        differentiate(values, weights, vectors, surface, p, slopes)
        add_products(slopes, p, sums)


@njit(cache=True, inline="always")
def differentiate(values, weights, vectors, surface, p, slopes):
    """Differentiate every sample by the five unknowns; compute its residual and its weight."""
    zero, least, slope = np.float32(0.0), np.float32(1e-3), np.float32(EXPONENT)
    n0, n1, n2 = load(surface, p), load(surface, p + BLOCK), load(surface, p + 2 * BLOCK)
    s0, s1, s2 = load(surface, p + 3 * BLOCK), load(surface, p + 4 * BLOCK), load(surface, p + 5 * BLOCK)
    t0, t1, t2 = load(surface, p + 6 * BLOCK), load(surface, p + 7 * BLOCK), load(surface, p + 8 * BLOCK)
    a, b, d = load(surface, p + 9 * BLOCK), load(surface, p + 10 * BLOCK), load(surface, p + 11 * BLOCK)
    for j in range(values.shape[0]):
        lx, ly, lz = vectors[0, j], vectors[1, j], vectors[2, j]
        hx, hy, hz = vectors[3, j], vectors[4, j], vectors[5, j]
        c = n0 * lx + n1 * ly + n2 * lz
        w = choose(c > zero, load(weights, (j, p)), zero)
        c = choose(c > zero, c, zero)
        x = n0 * hx + n1 * hy + n2 * hz
        lower, power = powers(choose(x > least, x, least))
        factor = a + b * c + d * power
        along = factor + b * c
        skirt = d * slope * c * lower
        k = SLOPES * j
        store(slopes, (k, 0), along * (s0 * lx + s1 * ly + s2 * lz) + skirt * (s0 * hx + s1 * hy + s2 * hz))
        store(slopes, (k + 1, 0), along * (t0 * lx + t1 * ly + t2 * lz) + skirt * (t0 * hx + t1 * hy + t2 * hz))
        store(slopes, (k + 2, 0), c)
        store(slopes, (k + 3, 0), c * power)
        store(slopes, (k + 4, 0), load(values, (j, p)) - c * factor)
        store(slopes, (k + 5, 0), w)


@njit(cache=True, error_model="numpy")
def add_products(slopes, p, sums):
    """Sum weighted products of the derivatives with each other and with the residuals, and the squares."""
    zero = np.float32(0.0)
    m00 = m01 = m02 = m03 = m04 = m11 = m12 = m13 = m14 = m22 = m23 = m24 = m33 = m34 = m44 = splat(zero)
    r0 = r1 = r2 = r3 = r4 = squares = splat(zero)
    for k in range(0, slopes.shape[0], SLOPES):
        e0, e1, c = load(slopes, (k, 0)), load(slopes, (k + 1, 0)), load(slopes, (k + 2, 0))
        e4, r, w = load(slopes, (k + 3, 0)), load(slopes, (k + 4, 0)), load(slopes, (k + 5, 0))
        e3 = c * c
        w0, w1, w2, w3, w4, wr = w * e0, w * e1, w * c, w * e3, w * e4, w * r
        m00 += w0 * e0
        m01 += w0 * e1
        m02 += w0 * c
        m03 += w0 * e3
        m04 += w0 * e4
        m11 += w1 * e1
        m12 += w1 * c
        m13 += w1 * e3
        m14 += w1 * e4
        m22 += w2 * c
        m23 += w2 * e3
        m24 += w2 * e4
        m33 += w3 * e3
        m34 += w3 * e4
        m44 += w4 * e4
        r0 += wr * e0
        r1 += wr * e1
        r2 += wr * c
        r3 += wr * e3
        r4 += wr * e4
        squares += wr * r
    upper = (m00, m01, m02, m03, m04, m11, m12, m13, m14, m22, m23, m24, m33, m34, m44)
    store_rows(sums.reshape(SUMS, BLOCK), p, (*upper, r0, r1, r2, r3, r4, squares))


@njit(cache=True, error_model="numpy", forceinline=True)
def factors_of(sums, p, damping, prior):
    """Factorise a pixel's damped normal equations with the prior on b and d."""
    f = np.float64
    ridge, more = 1e-9 * f(sums[p + 9 * BLOCK]), 1.0 + damping
    diagonal = (
        f(sums[p]) * more + ridge,
        f(sums[p + 5 * BLOCK]) * more + ridge,
        f(sums[p + 9 * BLOCK]) * more + ridge,
        (f(sums[p + 12 * BLOCK]) + prior) * more + ridge,
        (f(sums[p + 14 * BLOCK]) + prior) * more + ridge,
    )
    m21, m31, m41 = f(sums[p + 6 * BLOCK]), f(sums[p + 7 * BLOCK]), f(sums[p + 8 * BLOCK])
    m32, m42, m43 = f(sums[p + 10 * BLOCK]), f(sums[p + 11 * BLOCK]), f(sums[p + 13 * BLOCK])
    m10, m20, m30 = f(sums[p + BLOCK]), f(sums[p + 2 * BLOCK]), f(sums[p + 3 * BLOCK])
    return factorise(diagonal, m10, m20, m30, f(sums[p + 4 * BLOCK]), (m21, m31, m41, m32, m42, m43))


@njit(cache=True, error_model="numpy")
def set_surface(fit, surface):
    """Set unit normals and terms of a fit, as float32, with two tangents each.

    Tangents by T. Duff et al., Building an orthonormal basis, revisited, JCGT 6 (1), 2017. The normals of the fit
    become unit vectors.
    """
    for p in range(BLOCK):
        x, y, z = fit[p], fit[p + BLOCK], fit[p + 2 * BLOCK]
        length = np.sqrt(x * x + y * y + z * z)
        x, y, z = x / length, y / length, z / length
        sign = 1.0 if z >= 0.0 else -1.0
        k = -1.0 / (sign + z)
        m = x * y * k
        fit[p], fit[p + BLOCK], fit[p + 2 * BLOCK] = x, y, z
        across, along = (1.0 + sign * x * x * k, sign * m, -sign * x), (m, sign + y * y * k, -y)
        terms = (fit[p + 3 * BLOCK], fit[p + 4 * BLOCK], fit[p + 5 * BLOCK])
        for row, value in enumerate((x, y, z, *across, *along, *terms)):
            surface[p + row * BLOCK] = np.float32(value)


@njit(cache=True, error_model="numpy")
def propose(state):
    """Make the fits after one damped Gauss-Newton step, `moved`, and by how much it turns each normal, radians.

    A pixel whose equations are singular is no longer going and stays where it is.
    """
    fit, surface, sums, moved, prior = state.fit, state.surface, state.sums, state.moved, state.prior
    for p in range(BLOCK):
        b, d = fit[p + 4 * BLOCK], fit[p + 5 * BLOCK]
        factors = factors_of(sums, p, state.damping[p], prior[p])
        u, v, da, db, dd = substitute(
            factors,
            np.float64(sums[p + 15 * BLOCK]),
            np.float64(sums[p + 16 * BLOCK]),
            np.float64(sums[p + 17 * BLOCK]),
            np.float64(sums[p + 18 * BLOCK]) - prior[p] * b,
            np.float64(sums[p + 19 * BLOCK]) - prior[p] * d,
        )
        go = 1.0 if factors.positive else 0.0
        go = go * state.going[p]
        u, v = (u, v) if go > 0.0 else (0.0, 0.0)
        size = np.sqrt(u * u + v * v)
        shrink = 0.3 / (size if size > 0.3 else 0.3)
        u, v = u * shrink, v * shrink
        moved[p] = fit[p] + u * surface[p + 3 * BLOCK] + v * surface[p + 6 * BLOCK]
        moved[p + BLOCK] = fit[p + BLOCK] + u * surface[p + 4 * BLOCK] + v * surface[p + 7 * BLOCK]
        moved[p + 2 * BLOCK] = fit[p + 2 * BLOCK] + u * surface[p + 5 * BLOCK] + v * surface[p + 8 * BLOCK]
        moved[p + 3 * BLOCK] = fit[p + 3 * BLOCK] + (da if go > 0.0 else 0.0)
        moved[p + 4 * BLOCK] = b + (db if go > 0.0 else 0.0)
        moved[p + 5 * BLOCK] = d + (dd if go > 0.0 else 0.0)
        state.turn[p] = size
        state.going[p] = go


@njit(cache=True, error_model="numpy")
def judge(state, start):
    """Find the pixels whose step lowers the penalised sum of squares; set their damping, and which go on.

    start: there is nothing to compare with yet.
    """
    fit, moved, sums, prior = state.fit, state.moved, state.trial, state.prior
    damping, turn, going, better = state.damping, state.turn, state.going, state.better
    for p in range(BLOCK):
        b, d = moved[p + 4 * BLOCK], moved[p + 5 * BLOCK]
        cost = sums[p + 20 * BLOCK] + prior[p] * (b * b + d * d)
        moved[p + 6 * BLOCK] = cost
        lower = 1.0 if start or cost < fit[p + 6 * BLOCK] else 0.0
        better[p] = lower * going[p]
        if not start:
            raised = damping[p] * 16.0
            raised = raised if raised > 1e-2 else 1e-2
            damping[p] = damping[p] * 0.25 if lower > 0.0 else raised
            going[p] = going[p] * (1.0 if turn[p] >= 1e-3 else 0.0)


@njit(cache=True, error_model="numpy")
def take(chosen, source, target):
    """Copy numbers of the chosen pixels (BLOCK,) from one flat array to another."""
    for start in range(0, target.size, BLOCK):
        new, old = source[start : start + BLOCK], target[start : start + BLOCK]
        for p in range(len(chosen)):
            value, present = new[p], old[p]  # both are read, or the compiler chooses between their places by a branch
            old[p] = value if chosen[p] > np.float32(0.0) else present


@njit(cache=True, error_model="numpy")
def take_lanes(chosen, source, target):
    """Take lanes of float32 numbers."""
    for p in range(0, BLOCK, LANES):
        here = load(chosen, p) > np.float32(0.0)
        for start in range(p, target.size, BLOCK):
            store(target, start, choose(here, load(source, start), load(target, start)))


@njit(cache=True, error_model="numpy")
def descend(values, weights, vectors, rounds, state):
    """Run damped Gauss-Newton for the pixels that are going, from `state.fit`; it ends with their fits."""
    for p in range(state.fit.size):
        state.moved[p] = state.fit[p]
    for p in range(BLOCK):
        state.damping[p] = 1e-3
    for step in range(rounds + 1):  # the first one is that of no length
        if step > 0:
            propose(state)
        if not state.going.any():
            break
        set_surface(state.moved, state.trial_surface)
        add_up(values, weights, vectors, state.trial_surface, state.slopes, state.trial)
        judge(state, step == 0)
        take(state.better, state.moved, state.fit)
        take_lanes(state.better, state.trial_surface, state.surface)
        take_lanes(state.better, state.trial, state.sums)


@njit(cache=True, error_model="numpy")
def choose_samples(values, known, vectors, surface, limit, weights, count):
    """Set weight 1 for the lit, known samples whose residual is at most `limit` (BLOCK,) float32; count them."""
    zero, one, low = np.float32(0.0), np.float32(1.0), np.float32(1e-3)
    for p in range(0, BLOCK, LANES):
        most, total = load(limit, p), splat(zero)
        least = zero - most
        n0, n1, n2 = load(surface, p), load(surface, p + BLOCK), load(surface, p + 2 * BLOCK)
        a, b, d = load(surface, p + 9 * BLOCK), load(surface, p + 10 * BLOCK), load(surface, p + 11 * BLOCK)
        for j in range(values.shape[0]):
            c = n0 * vectors[0, j] + n1 * vectors[1, j] + n2 * vectors[2, j]
            x = n0 * vectors[3, j] + n1 * vectors[4, j] + n2 * vectors[5, j]
            r = load(values, (j, p)) - c * (a + b * c + d * powers(choose(x > low, x, low))[1])
            w = choose((r <= most) & (r >= least) & (c > zero), load(known, (j, p)), zero)
            store(weights, (j, p), w)
            total += choose(w > zero, one, zero)
        store(count, p, total)


@njit(cache=True, error_model="numpy")
def tangential_variance(sums, p, prior):
    """Compute the trace of the tangential block of the inverse of the normal equations; negative if singular."""
    m = factors_of(sums, p, 0.0, prior)
    # the first two columns of the inverse of L
    u1 = -m.l10
    u2 = -m.l20 - m.l21 * u1
    u3 = -m.l30 - m.l31 * u1 - m.l32 * u2
    u4 = -m.l40 - m.l41 * u1 - m.l42 * u2 - m.l43 * u3
    v2 = -m.l21
    v3 = -m.l31 - m.l32 * v2
    v4 = -m.l41 - m.l42 * v2 - m.l43 * v3
    trace = m.i0 + u1 * u1 * m.i1 + u2 * u2 * m.i2 + u3 * u3 * m.i3 + u4 * u4 * m.i4
    trace = trace + m.i1 + v2 * v2 * m.i2 + v3 * v3 * m.i3 + v4 * v4 * m.i4
    return trace if m.positive else -1.0
