"""One time step of a sheet of cloth on a square grid: extended position-based dynamics.

M. Macklin, M. Mueller, N. Chentanez: XPBD, Motion in Games 2016: a constraint C with compliance a moves its points
along their gradients g by -C w g / (sum w g^2 + a / dt^2); one iteration in many small steps (Macklin et al., Small
steps in physics simulation, SCA 2019), so that the multipliers start at zero in every step. Points are visited in one
fixed order: turned round from step to step, the sheet would tremble.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def keep_length(x, ai, aj, bi, bj, rest, softness):
    """Draw two points of equal mass to their distance at rest; softness: a / (w dt^2)."""
    dx, dy, dz = x[bi, bj, 0] - x[ai, aj, 0], x[bi, bj, 1] - x[ai, aj, 1], x[bi, bj, 2] - x[ai, aj, 2]
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    if length < 1e-12:
        return
    move = (length - rest) / (length * (2.0 + softness))
    x[ai, aj, 0] += move * dx
    x[ai, aj, 1] += move * dy
    x[ai, aj, 2] += move * dz
    x[bi, bj, 0] -= move * dx
    x[bi, bj, 1] -= move * dy
    x[bi, bj, 2] -= move * dz


@njit(cache=True, nogil=True, error_model="numpy")
def keep_straight(x, ai, aj, bi, bj, ci, cj, softness):
    """Draw three points in a row towards a straight line.

    The curvature a - 2 b + c, a vector: bending energy quadratic in it, as for sheets that hardly stretch (Bergou et
    al., A quadratic bending model for inextensible surfaces, SGP 2006).
    """
    for k in range(3):
        move = (x[ai, aj, k] - 2.0 * x[bi, bj, k] + x[ci, cj, k]) / (6.0 + softness)
        x[ai, aj, k] -= move
        x[bi, bj, k] += 2.0 * move
        x[ci, cj, k] -= move


@njit(cache=True, nogil=True, error_model="numpy")
def keep_shape(x, spacing, stretch, shear, bend):
    """One sweep over all constraints of the sheet x (n, n, 3); the three softnesses as in the functions above."""
    n, diagonal = x.shape[0], spacing * np.sqrt(2.0)
    for i in range(n):
        for j in range(n):
            if i > 0 and i < n - 1:
                keep_straight(x, i - 1, j, i, j, i + 1, j, bend)
            if j > 0 and j < n - 1:
                keep_straight(x, i, j - 1, i, j, i, j + 1, bend)
            if i < n - 1 and j < n - 1:
                keep_length(x, i, j, i + 1, j + 1, diagonal, shear)
                keep_length(x, i + 1, j, i, j + 1, diagonal, shear)
            if i < n - 1:
                keep_length(x, i, j, i + 1, j, spacing, stretch)
            if j < n - 1:
                keep_length(x, i, j, i, j + 1, spacing, stretch)


@njit(cache=True, nogil=True, error_model="numpy")
def keep_apart(x, before, pairs, thickness, friction):
    """Push points of the sheet apart that are nearer than `thickness`; they rub on each other.

    pairs (k, 2): numbers of points in the flattened grid; before: where the points were at the start of the step.
    """
    flat, old = x.reshape(-1, 3), before.reshape(-1, 3)
    for p in range(len(pairs)):
        a, b = pairs[p, 0], pairs[p, 1]
        dx, dy, dz = flat[b, 0] - flat[a, 0], flat[b, 1] - flat[a, 1], flat[b, 2] - flat[a, 2]
        square = dx * dx + dy * dy + dz * dz
        if square >= thickness * thickness or square < 1e-18:
            continue
        length = np.sqrt(square)
        move = 0.5 * (thickness - length) / length
        for k, d in ((0, dx), (1, dy), (2, dz)):
            flat[a, k] -= move * d
            flat[b, k] += move * d
            slip = 0.5 * friction * ((flat[b, k] - old[b, k]) - (flat[a, k] - old[a, k]))
            flat[a, k] += slip
            flat[b, k] -= slip


@njit(cache=True, nogil=True, error_model="numpy")
def distance_to_support(px, py, pz, kind, radius, top, edge):
    """Signed distance and outward normal of a ball (kind 0) or of a round table with a rounded rim (kind 1).

    The highest point of either is at height `top`, its axis is the y axis. Ball: radius. Table: a disc of this radius,
    rim rounded with radius `edge`.
    """
    if kind == 0:
        dy = py - (top - radius)
        length = np.sqrt(px * px + dy * dy + pz * pz)
        if length < 1e-12:
            return -radius, 0.0, 1.0, 0.0
        return length - radius, px / length, dy / length, pz / length
    out = np.sqrt(px * px + pz * pz)
    over, above = out - (radius - edge), py - (top - edge)
    side_x, side_z = (px / out, pz / out) if out > 1e-12 else (1.0, 0.0)
    if over <= 0.0:
        if above >= 0.0 or above > over:
            return above - edge, 0.0, 1.0, 0.0
        return over - edge, side_x, 0.0, side_z
    if above <= 0.0:
        return over - edge, side_x, 0.0, side_z
    length = np.sqrt(over * over + above * above)
    return length - edge, side_x * over / length, above / length, side_z * over / length


@njit(cache=True, nogil=True, error_model="numpy")
def lay_on(x, before, kind, radius, top, edge, gap, friction):
    """Push the points out of the support and of the floor y = 0, at least `gap` away; Coulomb friction on both."""
    n = x.shape[0]
    for i in range(n):
        for j in range(n):
            for ground in range(2):
                if ground == 1:
                    depth, nx, ny, nz = x[i, j, 1], 0.0, 1.0, 0.0
                else:
                    depth, nx, ny, nz = distance_to_support(x[i, j, 0], x[i, j, 1], x[i, j, 2], kind, radius, top, edge)
                depth = gap - depth
                if depth <= 0.0:
                    continue
                x[i, j, 0] += depth * nx
                x[i, j, 1] += depth * ny
                x[i, j, 2] += depth * nz
                mx, my, mz = x[i, j, 0] - before[i, j, 0], x[i, j, 1] - before[i, j, 1], x[i, j, 2] - before[i, j, 2]
                along = mx * nx + my * ny + mz * nz
                mx, my, mz = mx - along * nx, my - along * ny, mz - along * nz
                slip = np.sqrt(mx * mx + my * my + mz * mz)
                held = 1.0 if slip <= friction * depth else friction * depth / slip
                x[i, j, 0] -= held * mx
                x[i, j, 1] -= held * my
                x[i, j, 2] -= held * mz


@njit(cache=True, nogil=True, error_model="numpy")
def even_out(v, old, share):
    """Internal friction: each velocity drawn to the mean of its neighbours' by `share`; old is scratch.

    One sweep a step in a fixed order is not symmetric and would feed the shortest waves of the grid; this takes more
    from them than they get.
    """
    old[...] = v
    n = v.shape[0]
    for i in range(n):
        for j in range(n):
            for k in range(3):
                change, c = 0.0, old[i, j, k]
                change += old[i - 1, j, k] - c if i > 0 else 0.0
                change += old[i + 1, j, k] - c if i < n - 1 else 0.0
                change += old[i, j - 1, k] - c if j > 0 else 0.0
                change += old[i, j + 1, k] - c if j < n - 1 else 0.0
                v[i, j, k] += 0.25 * share * change


@njit(cache=True, nogil=True, error_model="numpy")
def steps(x, v, pairs, count, dt, gravity, damping, spacing, softness, support, gap, thickness, friction):
    """`count` time steps of the sheet x with velocities v, both (n, n, 3) and changed in place.

    The middle point is held, or the sheet would slide off a ball. softness: of stretch, shear and bend; support:
    kind, radius, top, edge.
    """
    before = np.empty_like(x)
    keep = np.exp(-damping * dt)
    fastest = 0.5 * thickness / dt
    n = x.shape[0]
    for _ in range(count):
        before[...] = x
        for i in range(n):
            for j in range(n):
                v[i, j, 1] -= gravity * dt
                speed = np.sqrt(v[i, j, 0] ** 2 + v[i, j, 1] ** 2 + v[i, j, 2] ** 2)
                scale = keep * (fastest / speed if speed > fastest else 1.0)
                for k in range(3):
                    v[i, j, k] *= scale
                    x[i, j, k] += dt * v[i, j, k]
        keep_shape(x, spacing, softness[0], softness[1], softness[2])
        keep_apart(x, before, pairs, thickness, 0.2)
        x[n // 2, n // 2] = before[n // 2, n // 2]
        lay_on(x, before, int(support[0]), support[1], support[2], support[3], gap, friction)
        for i in range(n):
            for j in range(n):
                for k in range(3):
                    v[i, j, k] = (x[i, j, k] - before[i, j, k]) / dt
        even_out(v, before, 0.3)
