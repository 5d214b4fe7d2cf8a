"""Bounded least squares with the linear strengths eliminated: one compiled solver for the weave fit.

The unknowns are those of `reading.PARAMETERS` for both planes in a row, then log F0. At each point the two strengths
(gloss, body), both at least 0, are solved for exactly (variable projection, Golub and Pereyra, SIAM J. Numer. Anal.
10(2), 1973, here with the non-negative solution of two unknowns in closed form), and only the rest is searched.
"""

from math import exp, sqrt

import numpy as np
from numba import njit

from nishiki.weave.model import SIZE, fill_columns, shape_of

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
def residuals(p, rows, split, y, weight, shared, reading, work, out):
    """out (n,) = weight (model - y); rows: see reading.rows_of; 0..split lie in the weft plane. Returns sum of squares.

    shared: one pair of strengths for both planes, else one for each. work: (n, 2).
    """
    f0, n = exp(p[2 * SIZE]), y.size
    weft, warp = shape_of(p[:SIZE], 0), shape_of(p[SIZE:], 1)
    fill_columns(weft, warp, exp(p[3]), exp(p[SIZE + 3]), rows, f0, reading, work)
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
def costs(points, rows, split, y, weight, shared, reading):
    """Sum of squares (points,) at every row of points (points, UNKNOWNS)."""
    work, out, sums = np.empty((y.size, 2)), np.empty(y.size), np.empty(len(points))
    for k in range(len(points)):
        sums[k] = residuals(points[k], rows, split, y, weight, shared, reading, work, out)
    return sums


@njit(cache=True, nogil=True, error_model="numpy")
def jacobian(p, low, high, free, rows, split, y, weight, shared, reading):
    """Residuals (n,), Jacobian (n, free) of the projected residual, sum of squares; steps stay within the bounds."""
    n, m = y.size, free.size
    work, here, there, back = np.empty((n, 2)), np.empty(n), np.empty(n), np.empty(n)
    cost = residuals(p, rows, split, y, weight, shared, reading, work, here)
    out, q = np.empty((n, m)), p.copy()
    for j in range(m):
        at = free[j]
        step = 1e-6 * max(high[at] - low[at], 1e-9)
        up, down = min(p[at] + step, high[at]), max(p[at] - step, low[at])
        q[at] = up
        residuals(q, rows, split, y, weight, shared, reading, work, there)
        q[at] = down
        residuals(q, rows, split, y, weight, shared, reading, work, back)
        q[at] = p[at]
        for k in range(n):
            out[k, j] = (there[k] - back[k]) / (up - down) if up > down else 0.0
    return here, out, cost


@njit(cache=True, nogil=True, error_model="numpy")
def _step(p, low, high, free, normal, gradient, scale, damping):
    """The damped step from p; unknowns that it would carry over a bound stop there, and the others are solved anew."""
    m = free.size
    fixed, move = np.zeros(m, np.bool_), np.zeros(m)
    for _ in range(m):
        matrix, right = normal.copy(), -gradient
        for j in range(m):
            matrix[j, j] += damping + 1e-14 if matrix[j, j] > 0.0 else 1.0
        for j in range(m):
            if fixed[j]:
                right -= matrix[:, j] * (move[j] * scale[j])
        for j in range(m):
            if fixed[j]:
                matrix[j, :] = 0.0
                matrix[:, j] = 0.0
                matrix[j, j], right[j] = 1.0, move[j] * scale[j]
        move = np.linalg.solve(matrix, right) / scale
        clear = True
        for j in range(m):
            at = free[j]
            if not fixed[j] and not low[at] <= p[at] + move[j] <= high[at]:
                move[j] = (low[at] if p[at] + move[j] < low[at] else high[at]) - p[at]
                fixed[j], clear = True, False
        if clear:
            break
    q = p.copy()
    for j in range(m):
        q[free[j]] = min(max(p[free[j]] + move[j], low[free[j]]), high[free[j]])
    return q


@njit(cache=True, nogil=True, error_model="numpy")
def descend(p, low, high, free, rows, split, y, weight, shared, reading, rounds, tolerance):
    """Levenberg-Marquardt with bounds: unknowns at a bound that push outwards are held.

    Returns (p, sum of squares). Ends when a step gains less than `tolerance` of the sum or none is found.
    """
    p = p.copy()
    n = y.size
    work, trial = np.empty((n, 2)), np.empty(n)
    damping = 1e-3
    here, slopes, cost = jacobian(p, low, high, free, rows, split, y, weight, shared, reading)
    for _ in range(rounds):
        gradient, normal = slopes.T @ here, slopes.T @ slopes
        for j in range(free.size):
            at = free[j]
            if (p[at] <= low[at] and gradient[j] > 0.0) or (p[at] >= high[at] and gradient[j] < 0.0):
                normal[j, :] = 0.0
                normal[:, j] = 0.0
                gradient[j] = 0.0
        scale = np.sqrt(np.diag(normal))
        least = 1e-30 * scale.max()
        for j in range(free.size):
            if not scale[j] > least:  # no effect: held
                normal[j, :] = 0.0
                normal[:, j] = 0.0
                gradient[j], scale[j] = 0.0, 1.0
        normal, gradient = normal / np.outer(scale, scale), gradient / scale
        gained = 0.0
        while damping < 1e10:
            q = _step(p, low, high, free, normal, gradient, scale, damping)
            tried = residuals(q, rows, split, y, weight, shared, reading, work, trial)
            if tried < cost:
                gained, p, damping = cost - tried, q, max(damping * 0.2, 1e-12)
                break
            damping *= 4.0
        if gained <= tolerance * cost or gained == 0.0:
            return p, min(cost, cost - gained)
        here, slopes, cost = jacobian(p, low, high, free, rows, split, y, weight, shared, reading)
        if sqrt(cost) < 1e-15 * sqrt(n):
            break
    return p, cost
