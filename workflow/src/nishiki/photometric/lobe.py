"""Normals from a reflectance with a diffuse fall-off and a gloss lobe: what Lambert's law leaves out, per pixel.

Model of one sample, with c = max(n . l, 0), x = max(n . h, 0), h the half vector of light and view:

    I = c * (a + b * c + d * x^e)

a is Lambert's term; b lets the diffuse reflectance depend on the incidence, as the transmission into a dielectric, a
rough body or a penumbra make it do; d x^e is the skirt of the gloss, whose peak the selection has removed. It is the
low-frequency reflectance of B. Shi, P. Tan, Y. Matsushita and K. Ikeuchi, Bi-polynomial modeling of low-frequency
reflectances, IEEE Trans. PAMI 36 (6), 2014, with other terms. b and d are held towards 0 by a weak prior, so that with
few lights or a matt surface the Lambertian estimate results. Solved by damped Gauss-Newton over the two tangential
components of the normal and (a, b, d) together; then the samples are chosen again by their residuals, and so on.

One pixel at a time; the sums over its lights are written as LANES partial sums, which the compiler makes SIMD code of
without reordering anything: the result of a pixel depends neither on tiles and threads nor on the compiler's mood.
"""

import numpy as np
from numba import njit

SUMS = 22
LANES = 16  # lights are padded to a multiple, with weight 0


@njit(cache=True, inline="always")
def raised(x, squarings):
    """x to the power 2^squarings, 1 to 5; a loop here would keep the caller's loop from becoming SIMD code."""
    x2 = x * x
    x4 = x2 * x2
    x8 = x4 * x4
    x16 = x8 * x8
    power = x4 if squarings >= 2 else x2
    power = x8 if squarings >= 3 else power
    power = x16 if squarings >= 4 else power
    return x16 * x16 if squarings >= 5 else power


@njit(cache=True, error_model="numpy")
def add_up(value, weight, vectors, frame, terms, squarings, lanes, out):
    """One pass over the lights: 15 products and 5 right-hand sides of the Gauss-Newton step, squares, sum of w c^2.

    vectors (6, lights): l and h; frame: normal and two tangents (9 numbers); terms (a, b, d); out (SUMS,) float64;
    lanes (SUMS * LANES) float32: partial sums, each over every LANES-th light. They fix the order of addition: left to
    the compiler, it would differ between a kernel just compiled and the same kernel from the cache.
    """
    n0, n1, n2, s0, s1, s2, t0, t1, t2 = frame
    a, b, d = terms
    zero, least, slope = np.float32(0.0), np.float32(1e-3), np.float32(1 << squarings)
    for k in range(SUMS * LANES):
        lanes[k] = zero
    for start in range(0, value.size, LANES):
        values, weights = value[start : start + LANES], weight[start : start + LANES]
        lx, ly, lz = (vectors[0, start : start + LANES], vectors[1, start : start + LANES],
                      vectors[2, start : start + LANES])  # fmt: skip
        hx, hy, hz = (vectors[3, start : start + LANES], vectors[4, start : start + LANES],
                      vectors[5, start : start + LANES])  # fmt: skip
        for j in range(LANES):
            w = weights[j]
            c = n0 * lx[j] + n1 * ly[j] + n2 * lz[j]
            w = w if c > zero else zero
            c = c if c > zero else zero
            x = n0 * hx[j] + n1 * hy[j] + n2 * hz[j]
            x = x if x > least else least
            power = raised(x, squarings)
            factor = a + b * c + d * power
            r = values[j] - c * factor
            along = factor + b * c
            skirt = slope * d * c * power / x
            e0 = along * (s0 * lx[j] + s1 * ly[j] + s2 * lz[j]) + skirt * (s0 * hx[j] + s1 * hy[j] + s2 * hz[j])
            e1 = along * (t0 * lx[j] + t1 * ly[j] + t2 * lz[j]) + skirt * (t0 * hx[j] + t1 * hy[j] + t2 * hz[j])
            e3, e4 = c * c, c * power
            w0, w1, w2, w3, w4 = w * e0, w * e1, w * c, w * e3, w * e4
            lanes[j] += w0 * e0
            lanes[j + 1 * LANES] += w0 * e1
            lanes[j + 2 * LANES] += w0 * c
            lanes[j + 3 * LANES] += w0 * e3
            lanes[j + 4 * LANES] += w0 * e4
            lanes[j + 5 * LANES] += w1 * e1
            lanes[j + 6 * LANES] += w1 * c
            lanes[j + 7 * LANES] += w1 * e3
            lanes[j + 8 * LANES] += w1 * e4
            lanes[j + 9 * LANES] += w2 * c
            lanes[j + 10 * LANES] += w2 * e3
            lanes[j + 11 * LANES] += w2 * e4
            lanes[j + 12 * LANES] += w3 * e3
            lanes[j + 13 * LANES] += w3 * e4
            lanes[j + 14 * LANES] += w4 * e4
            lanes[j + 15 * LANES] += w0 * r
            lanes[j + 16 * LANES] += w1 * r
            lanes[j + 17 * LANES] += w2 * r
            lanes[j + 18 * LANES] += w3 * r
            lanes[j + 19 * LANES] += w4 * r
            lanes[j + 20 * LANES] += w * r * r
    half = LANES // 2
    while half > 0:
        for k in range(SUMS):
            for j in range(half):
                lanes[k * LANES + j] += lanes[k * LANES + j + half]
        half //= 2
    for k in range(SUMS - 1):
        out[k] = lanes[k * LANES]


@njit(cache=True, error_model="numpy")
def cholesky_solve(sums, damping, prior, matrix, step):
    """Solve the damped normal equations with the prior on b and d, in step; matrix is work. False: singular."""
    k = 0
    scale = sums[9]
    for i in range(5):
        for j in range(i, 5):
            matrix[j, i] = sums[k]
            k += 1
        if i >= 3:
            matrix[i, i] += prior
        matrix[i, i] = matrix[i, i] * (1.0 + damping) + 1e-9 * scale
    for i in range(5):
        for j in range(i + 1):
            total = matrix[i, j]
            for m in range(j):
                total -= matrix[i, m] * matrix[j, m]
            if i == j:
                if not total > 0.0:
                    return False
                matrix[i, i] = np.sqrt(total)
            else:
                matrix[i, j] = total / matrix[j, j]
    for i in range(5):
        total = step[i]
        for m in range(i):
            total -= matrix[i, m] * step[m]
        step[i] = total / matrix[i, i]
    for i in range(4, -1, -1):
        total = step[i]
        for m in range(i + 1, 5):
            total -= matrix[m, i] * step[m]
        step[i] = total / matrix[i, i]
    return True


@njit(cache=True, error_model="numpy")
def frame_of(x, y, z):
    """The unit normal with two tangents, as nine float32 (T. Duff et al., Building an orthonormal basis, JCGT 2017)."""
    length = np.sqrt(x * x + y * y + z * z)
    x, y, z = x / length, y / length, z / length
    sign = 1.0 if z >= 0.0 else -1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    f = np.float32
    return (
        (f(x), f(y), f(z), f(1.0 + sign * x * x * a), f(sign * b), f(-sign * x), f(b), f(sign + y * y * a), f(-y)),
        (x, y, z),
    )


@njit(cache=True, error_model="numpy")
def descend(value, weight, vectors, normal, terms, squarings, prior, rounds, work):
    """Damped Gauss-Newton from (normal, terms); returns both with the penalised sum of squares."""
    sums, trial, matrix, step, lanes = work
    frame, normal = frame_of(normal[0], normal[1], normal[2])
    f = np.float32
    add_up(value, weight, vectors, frame, (f(terms[0]), f(terms[1]), f(terms[2])), squarings, lanes, sums)
    cost = sums[20] + prior * (terms[1] ** 2 + terms[2] ** 2)
    damping = 1e-3
    for _ in range(rounds):
        for i in range(5):
            step[i] = sums[15 + i]
        step[3] -= prior * terms[1]
        step[4] -= prior * terms[2]
        if not cholesky_solve(sums, damping, prior, matrix, step):
            break
        turn = np.sqrt(step[0] ** 2 + step[1] ** 2)
        shrink = min(1.0, 0.3 / max(turn, 1e-30))
        u, v = step[0] * shrink, step[1] * shrink
        moved, unit = frame_of(
            normal[0] + u * frame[3] + v * frame[6],
            normal[1] + u * frame[4] + v * frame[7],
            normal[2] + u * frame[5] + v * frame[8],
        )
        a, b, d = terms[0] + step[2], terms[1] + step[3], terms[2] + step[4]
        add_up(value, weight, vectors, moved, (f(a), f(b), f(d)), squarings, lanes, trial)
        attempt = trial[20] + prior * (b * b + d * d)
        if attempt < cost:
            frame, normal, terms, cost = moved, unit, (a, b, d), attempt
            sums[:] = trial
            damping *= 0.25
            if turn < 1e-3:
                break
        else:
            damping = max(damping * 16.0, 1e-2)
            if turn < 1e-3:
                break
    return normal, terms, cost
