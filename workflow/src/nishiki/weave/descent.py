"""Bounded least squares with the linear strengths eliminated: one compiled solver for the weave fit.

The unknowns are those of `reading.PARAMETERS` for both planes in a row, then log F0. At each point the two strengths
(gloss, body), both at least 0, are solved for exactly (variable projection, Golub and Pereyra, SIAM J. Numer. Anal.
10(2), 1973, here with the non-negative solution of two unknowns in closed form), and only the rest is searched.
"""

from math import exp, sqrt

import numpy as np
from numba import njit

from nishiki.weave.reading import SIZE, fill_columns, shape_of

UNKNOWNS = 2 * SIZE + 1


@njit(cache=True, nogil=True, error_model="numpy")
def strengths(a, b, y):
    """(gloss, body) >= 0 that minimise |gloss a + body b - y|^2."""
    aa = bb = ab = ay = by = 0.0
    for k in range(y.size):
        aa, bb, ab = aa + a[k] * a[k], bb + b[k] * b[k], ab + a[k] * b[k]
        ay, by = ay + a[k] * y[k], by + b[k] * y[k]
    det = aa * bb - ab * ab
    if det > 1e-13 * aa * bb:
        gloss, body = (ay * bb - by * ab) / det, (by * aa - ay * ab) / det
        if gloss >= 0.0 and body >= 0.0:
            return gloss, body
    alone_a = max(ay / aa, 0.0) if aa > 0.0 else 0.0
    alone_b = max(by / bb, 0.0) if bb > 0.0 else 0.0
    if alone_a * max(ay, 0.0) >= alone_b * max(by, 0.0):
        return alone_a, 0.0
    return 0.0, alone_b


@njit(cache=True, nogil=True, error_model="numpy")
def residuals(p, theta_i, theta_r, split, y, weight, shared, reading, work, out):
    """out (n,) = weight (model - y); rows 0..split are the weft plane's, the rest the warp's. Returns sum of squares.

    shared: one pair of strengths for both planes, else one for each. work: (n, 2).
    """
    f0, n = exp(p[2 * SIZE]), y.size
    fill_columns(shape_of(p[:SIZE], 0), exp(p[3]), theta_i[:split], theta_r[:split], f0, reading, work[:split])
    fill_columns(shape_of(p[SIZE:], 1), exp(p[SIZE + 3]), theta_i[split:], theta_r[split:], f0, reading, work[split:])
    for k in range(n):
        work[k, 0] *= weight[k]
        work[k, 1] *= weight[k]
        out[k] = weight[k] * y[k]
    total = 0.0
    for part in range(1 if shared else 2):
        low, high = (0, n) if shared else ((0, split) if part == 0 else (split, n))
        if high == low:
            continue
        gloss, body = strengths(work[low:high, 0], work[low:high, 1], out[low:high])
        for k in range(low, high):
            out[k] = gloss * work[k, 0] + body * work[k, 1] - out[k]
            total += out[k] * out[k]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def costs(points, theta_i, theta_r, split, y, weight, shared, reading):
    """Sum of squares (points,) at every row of points (points, UNKNOWNS)."""
    work, out, found = np.empty((y.size, 2)), np.empty(y.size), np.empty(len(points))
    for k in range(len(points)):
        found[k] = residuals(points[k], theta_i, theta_r, split, y, weight, shared, reading, work, out)
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def jacobian(p, low, high, free, theta_i, theta_r, split, y, weight, shared, reading):
    """Residuals (n,), Jacobian (n, free) of the projected residual, sum of squares; steps stay within the bounds."""
    n, m = y.size, free.size
    work, here, there, back = np.empty((n, 2)), np.empty(n), np.empty(n), np.empty(n)
    cost = residuals(p, theta_i, theta_r, split, y, weight, shared, reading, work, here)
    out, q = np.empty((n, m)), p.copy()
    for j in range(m):
        at = free[j]
        step = 1e-6 * max(high[at] - low[at], 1e-9)
        up, down = min(p[at] + step, high[at]), max(p[at] - step, low[at])
        q[at] = up
        residuals(q, theta_i, theta_r, split, y, weight, shared, reading, work, there)
        q[at] = down
        residuals(q, theta_i, theta_r, split, y, weight, shared, reading, work, back)
        q[at] = p[at]
        for k in range(n):
            out[k, j] = (there[k] - back[k]) / (up - down) if up > down else 0.0
    return here, out, cost


@njit(cache=True, nogil=True, error_model="numpy")
def descend(p, low, high, free, theta_i, theta_r, split, y, weight, shared, reading, rounds, tolerance):
    """Levenberg-Marquardt with bounds: steps are clipped, unknowns at a bound that push outwards are held.

    Returns (p, sum of squares). Ends when a step gains less than `tolerance` of the sum or none is found.
    """
    p = p.copy()
    n = y.size
    work, trial = np.empty((n, 2)), np.empty(n)
    damping = 1e-3
    here, slopes, cost = jacobian(p, low, high, free, theta_i, theta_r, split, y, weight, shared, reading)
    for _ in range(rounds):
        gradient, normal = slopes.T @ here, slopes.T @ slopes
        for j in range(free.size):
            at = free[j]
            if (p[at] <= low[at] and gradient[j] > 0.0) or (p[at] >= high[at] and gradient[j] < 0.0):
                normal[j, :] = 0.0
                normal[:, j] = 0.0
                gradient[j] = 0.0
        scale = np.sqrt(np.diag(normal))
        for j in range(free.size):
            scale[j] = scale[j] if scale[j] > 0.0 else 1.0
        normal, gradient = normal / np.outer(scale, scale), gradient / scale
        gained = 0.0
        while damping < 1e10:
            matrix = normal.copy()
            for j in range(free.size):
                matrix[j, j] += damping + 1e-14 if matrix[j, j] > 0.0 else 1.0
            move = np.linalg.solve(matrix, -gradient) / scale
            q = p.copy()
            for j in range(free.size):
                q[free[j]] = min(max(p[free[j]] + move[j], low[free[j]]), high[free[j]])
            found = residuals(q, theta_i, theta_r, split, y, weight, shared, reading, work, trial)
            if found < cost:
                gained, p, damping = cost - found, q, max(damping * 0.2, 1e-12)
                break
            damping *= 4.0
        if gained <= tolerance * cost or gained == 0.0:
            return p, min(cost, cost - gained)
        here, slopes, cost = jacobian(p, low, high, free, theta_i, theta_r, split, y, weight, shared, reading)
        if sqrt(cost) < 1e-15 * sqrt(n):
            break
    return p, cost
