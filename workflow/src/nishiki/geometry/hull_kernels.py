"""Numba kernels of the visual hull: the smallest signed distance to the silhouettes at points of a grid.

A view is one row of `matrices` (12 numbers, the 3x4 matrix K [R | t]), `lenses` (9 numbers: K's upper triangle k00 k01
k02 k11 k12, then 4 unused zeros where the lens is ideal) and `frames` (start, first row, first column, rows, columns,
stride, open): where its distance map lies in one flat buffer, which part of the picture it covers, every how many
pixels, and whether the silhouette is cut off by the picture's edge.
"""

import numpy as np
from numba import njit

JIT = {"cache": True, "nogil": True, "error_model": "numpy"}
FAR = 1e30  # no distance
MOST_MISSES = 4  # views that may wrongly see background


@njit(**JIT)
def project_point(pose, lens, x, y, z, out):
    """Compute column, row and depth of a world point into out[:3]; a depth <= 0 leaves column and row alone."""
    depth = pose[8] * x + pose[9] * y + pose[10] * z + pose[11]
    out[2] = depth
    if depth <= 0.0:
        return
    u = (pose[0] * x + pose[1] * y + pose[2] * z + pose[3]) / depth
    v = (pose[4] * x + pose[5] * y + pose[6] * z + pose[7]) / depth
    k1, k2, p1, p2, k3 = lens[5], lens[6], lens[7], lens[8], lens[9]
    if k1 != 0.0 or k2 != 0.0 or p1 != 0.0 or p2 != 0.0 or k3 != 0.0:
        square = u * u + v * v
        radial = 1.0 + square * (k1 + square * (k2 + square * k3))
        bent = u * radial + 2.0 * p1 * u * v + p2 * (square + 2.0 * u * u)
        v = v * radial + p1 * (square + 2.0 * v * v) + 2.0 * p2 * u * v
        u = bent
    out[0] = lens[0] * u + lens[1] * v + lens[2]
    out[1] = lens[3] * v + lens[4]


@njit(**JIT)
def _distance(buffer, frame, column, row):
    """Interpolate the signed distance in pixels bilinearly; beyond the stored part it falls by the distance to it."""
    stride = frame[5]
    r = (row - frame[1]) / stride
    c = (column - frame[2]) / stride
    clamped_r = min(max(r, 0.0), frame[3] - 1.0)
    clamped_c = min(max(c, 0.0), frame[4] - 1.0)
    i = min(int(clamped_r), frame[3] - 2)
    j = min(int(clamped_c), frame[4] - 2)
    s, t = clamped_r - i, clamped_c - j
    at = frame[0] + i * frame[4] + j
    upper = buffer[at] * (1.0 - t) + buffer[at + 1] * t
    at += frame[4]
    value = upper * (1.0 - s) + (buffer[at] * (1.0 - t) + buffer[at + 1] * t) * s
    if value <= 0.0 and (r != clamped_r or c != clamped_c):
        value -= stride * np.hypot(r - clamped_r, c - clamped_c)
    return value


@njit(**JIT)
def at_point(field, views, place, misses, enough, spot, worst):
    """Return the (misses + 1)-th smallest signed distance, world units, at a place (3,); it may stop below -enough.

    views (n,): numbers of the views that take part.
    """
    poses, lenses, frames, buffer = field
    for m in range(misses + 1):
        worst[m] = FAR
    for view in views:
        project_point(poses[view], lenses[view], place[0], place[1], place[2], spot)
        value = -FAR
        if spot[2] > 0.0:
            value = _distance(buffer, frames[view], spot[0], spot[1]) * spot[2] / lenses[view, 10]
        for m in range(misses + 1):
            if value < worst[m]:
                worst[m], value = value, worst[m]
        if worst[misses] < -enough:
            break
    return worst[misses]


@njit(**JIT)
def _block(field, lowest, side, margin, misses, spot, near):
    """Return -1: the cube is outside for more than `misses` views; 1: inside for all; 0: evaluate its points.

    Return also the number of views, listed in near (views,), for which it is not inside: others can be passed over.

    A cube before the camera lies within the convex hull of its projected corners, so within the circle around its
    projected centre that holds them; a distance map changes by no more than the way gone (a tenth and a pixel are
    allowed for lens distortion and for the smoothing of the map). Points nearer to the surface than margin (world's
    unit) are always asked: the surface is found between their values.
    """
    (poses, lenses, frames, buffer), outside, count = field, 0, 0
    half = 0.5 * side
    for view in range(poses.shape[0]):
        project_point(poses[view], lenses[view], lowest[0] + half, lowest[1] + half, lowest[2] + half, spot)
        before = spot[2] > 0.0
        column, row = spot[0], spot[1]
        extra = margin * lenses[view, 10] / spot[2] if before else 0.0
        reach = 0.0
        leaves = False
        frame = frames[view]
        for corner in range(8):
            project_point(
                poses[view],
                lenses[view],
                lowest[0] + side * (corner & 1),
                lowest[1] + side * (corner >> 1 & 1),
                lowest[2] + side * (corner >> 2),
                spot,
            )
            if spot[2] <= 0.0:
                before = False
                break
            reach = max(reach, np.hypot(spot[0] - column, spot[1] - row))
            if frame[6]:
                r, c = spot[1] - frame[1], spot[0] - frame[2]
                leaves |= r < 0 or c < 0 or r > (frame[3] - 1) * frame[5] or c > (frame[4] - 1) * frame[5]
        near[count] = view
        if not before or leaves:
            count += 1
            continue
        value = _distance(buffer, frame, column, row)
        reach = 1.1 * (reach + extra) + 1.0 + frame[5]
        count += value < reach
        outside += value < -reach
        if outside > misses:
            return -1, count
    return 0 if count else 1, count


@njit(**JIT)
def fill_slab(field, grid, block, misses, band, first, last, volume):
    """Fill the clipped signed distance at the points first <= i < last of volume (i, j, k).

    field: poses, lenses, frames, buffer; grid: origin and cell, point (i, j, k) lies at origin + cell (i, j, k); volume
    (x, y, z) float32 of values within [-band, band].
    """
    origin, cell = grid
    spot, worst, lowest, place = np.empty(3), np.empty(MOST_MISSES + 1), np.empty(3), np.empty(3)
    (_, ny, nz), near = volume.shape, np.empty(len(field[0]), np.int64)
    for i0 in range(first, last, block):
        for j0 in range(0, ny, block):
            for k0 in range(0, nz, block):
                lowest[0] = origin[0] + cell * i0
                lowest[1] = origin[1] + cell * j0
                lowest[2] = origin[2] + cell * k0
                kind, count = _block(field, lowest, cell * (block - 1), 2.0 * cell, misses, spot, near)
                for i in range(i0, min(i0 + block, last)):
                    for j in range(j0, min(j0 + block, ny)):
                        for k in range(k0, min(k0 + block, nz)):
                            if kind != 0:
                                volume[i, j, k] = band * kind
                                continue
                            place[0], place[1] = origin[0] + cell * i, origin[1] + cell * j
                            place[2] = origin[2] + cell * k
                            value = at_point(field, near[:count], place, misses, band, spot, worst)
                            volume[i, j, k] = min(max(value, -band), band)


@njit(**JIT)
def cut_slab(field, depths, grid, votes, band, first, last, volume):
    """Lower volume (i, j, k) to the `votes`-th smallest distance to the edges of the parts that a point may belong to.

    depths: (2, views, rows, columns) behind a part, and the largest of these near each pixel, within a block; only
    points before that depth and in the volume are evaluated. grid: origin, cell, points along a block; others: as in
    `fill_slab`.
    """
    (poses, lenses, _, _), (origin, cell, block) = field, grid
    spot, worst, place, half = np.zeros(3), np.empty(MOST_MISSES + 1), np.empty(3), 0.5 * (block - 1)
    (_, ny, nz), (_, count, rows, columns) = volume.shape, depths.shape
    near, behind = np.empty(count, np.int64), np.empty(count, np.int64)
    for i0 in range(first, last, block):
        for j0 in range(0, ny, block):
            for k0 in range(0, nz, block):
                found = 0
                x, y, z = origin[0] + cell * (i0 + half), origin[1] + cell * (j0 + half), origin[2] + cell * (k0 + half)
                for view in range(count):
                    project_point(poses[view], lenses[view], x, y, z, spot)
                    row = int(min(max(spot[1] + 0.5, 0.0), rows - 1.0))
                    column = int(min(max(spot[0] + 0.5, 0.0), columns - 1.0))
                    near[found] = view
                    found += spot[2] - 2.0 * cell * half < max(depths[1, view, row, column], 0.0)
                if found < votes:
                    continue
                for i in range(i0, min(i0 + block, last)):
                    for j in range(j0, min(j0 + block, ny)):
                        for k in range(k0, min(k0 + block, nz)):
                            if volume[i, j, k] <= -cell:
                                continue
                            place[0], place[1] = origin[0] + cell * i, origin[1] + cell * j
                            place[2] = origin[2] + cell * k
                            before = 0
                            for view in near[:found]:
                                project_point(poses[view], lenses[view], place[0], place[1], place[2], spot)
                                row, column = int(spot[1] + 0.5), int(spot[0] + 0.5)
                                if spot[2] > 0.0 and 0 < row < rows - 1 and 0 < column < columns - 1:
                                    behind[before] = view
                                    before += spot[2] < depths[0, view, row, column]
                            value = at_point(field, behind[:before], place, votes - 1, band, spot, worst)
                            volume[i, j, k] = min(volume[i, j, k], max(value, -band))


@njit(**JIT)
def trace_rays(field, views, origins, directions, spans, misses, reach, out):
    """Find the largest signed distance of the hull along rays, world's unit, out (n,); tracing ends above -reach.

    misses: views that may wrongly see background at any point.

    views (n,) int64: the view that a ray belongs to, whose own silhouette takes no part; origins (n, 3), directions
    (n, 3) unit vectors; spans (n, 2): first and last distance. A distance below 0 bounds the way to the hull, so that
    the ray may go on by it (J. C. Hart, Sphere tracing, The Visual Computer 12, 1996); by four fifths of it, because
    distances are measured across the line of sight.
    """
    spot, worst, place = np.empty(3), np.empty(MOST_MISSES + 1), np.empty(3)
    every = np.arange(len(field[0]))
    for n in range(out.shape[0]):
        others = every[every != views[n]]
        t, best = spans[n, 0], -FAR
        while t <= spans[n, 1] and best < -reach:
            for axis in range(3):
                place[axis] = origins[n, axis] + t * directions[n, axis]
            least = at_point(field, others, place, misses, 8.0 * reach, spot, worst)
            best = max(best, least)
            t += max(0.8 * abs(least), reach) if least > -FAR else reach
        out[n] = best
