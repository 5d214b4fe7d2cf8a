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
def project_point(poses, lenses, view, x, y, z):
    """Compute column, row and depth of a world point in a view; 0 for column and row where the depth is <= 0.

    Arrays and the number of the view, not rows of the arrays: a row that is taken counts references, which costs twice
    as much as all else.
    """
    depth = poses[view, 8] * x + poses[view, 9] * y + poses[view, 10] * z + poses[view, 11]
    if depth <= 0.0:
        return 0.0, 0.0, depth
    u = (poses[view, 0] * x + poses[view, 1] * y + poses[view, 2] * z + poses[view, 3]) / depth
    v = (poses[view, 4] * x + poses[view, 5] * y + poses[view, 6] * z + poses[view, 7]) / depth
    k1, k2, k3 = lenses[view, 5], lenses[view, 6], lenses[view, 9]
    p1, p2 = lenses[view, 7], lenses[view, 8]
    if k1 != 0.0 or k2 != 0.0 or p1 != 0.0 or p2 != 0.0 or k3 != 0.0:
        square = u * u + v * v
        radial = 1.0 + square * (k1 + square * (k2 + square * k3))
        bent = u * radial + 2.0 * p1 * u * v + p2 * (square + 2.0 * u * u)
        v = v * radial + p1 * (square + 2.0 * v * v) + 2.0 * p2 * u * v
        u = bent
    return lenses[view, 0] * u + lenses[view, 1] * v + lenses[view, 2], lenses[view, 3] * v + lenses[view, 4], depth


@njit(**JIT)
def _distance(frames, buffer, view, column, row):
    """Interpolate the signed distance in pixels bilinearly; beyond the stored part it falls by the distance to it."""
    stride, columns = frames[view, 5], frames[view, 4]
    r = (row - frames[view, 1]) / stride
    c = (column - frames[view, 2]) / stride
    clamped_r = min(max(r, 0.0), frames[view, 3] - 1.0)
    clamped_c = min(max(c, 0.0), columns - 1.0)
    i = min(int(clamped_r), frames[view, 3] - 2)
    j = min(int(clamped_c), columns - 2)
    s, t = clamped_r - i, clamped_c - j
    at = frames[view, 0] + i * columns + j
    upper = buffer[at] * (1.0 - t) + buffer[at + 1] * t
    at += columns
    value = upper * (1.0 - s) + (buffer[at] * (1.0 - t) + buffer[at + 1] * t) * s
    if value <= 0.0 and (r != clamped_r or c != clamped_c):
        value -= stride * np.hypot(r - clamped_r, c - clamped_c)
    return value


@njit(**JIT)
def at_point(field, views, count, place, misses, enough, worst):
    """Return the (misses + 1)-th smallest signed distance, world units, at a place; it may stop below -enough.

    views[:count]: numbers of the views that take part.
    """
    (poses, lenses, frames, buffer), (x, y, z) = field, place
    for m in range(misses + 1):
        worst[m] = FAR
    for k in range(count):
        column, row, depth = project_point(poses, lenses, views[k], x, y, z)
        value = -FAR
        if depth > 0.0:
            value = _distance(frames, buffer, views[k], column, row) * depth / lenses[views[k], 10]
        for m in range(misses + 1):
            if value < worst[m]:
                worst[m], value = value, worst[m]
        if worst[misses] < -enough:
            break
    return worst[misses]


@njit(**JIT)
def _block(field, lowest, side, margin, misses, near):
    """Return -1: the cube is outside for more than `misses` views; 1: inside for all; 0: evaluate its points.

    Return also the number of views, listed in near (views,), for which it is not inside: others can be passed over.

    A cube before the camera lies within the convex hull of its projected corners, so within the circle around its
    projected centre that holds them; a distance map changes by no more than the way gone (a tenth and a pixel are
    allowed for lens distortion and for the smoothing of the map). Points nearer to the surface than margin (world's
    unit) are always asked: the surface is found between their values.
    """
    (poses, lenses, frames, buffer), (x, y, z), half, outside, found = field, lowest, 0.5 * side, 0, 0
    for view in range(len(poses)):
        reach, leaves = 0.0, False
        column, row, depth = project_point(poses, lenses, view, x + half, y + half, z + half)
        before = depth > 0.0
        extra = margin * lenses[view, 10] / depth if before else 0.0
        for corner in range(8):
            right, up, ahead = side * (corner & 1), side * (corner >> 1 & 1), side * (corner >> 2)
            c, r, depth = project_point(poses, lenses, view, x + right, y + up, z + ahead)
            if depth <= 0.0:
                before = False
                break
            reach = max(reach, (c - column) ** 2 + (r - row) ** 2)
            if frames[view, 6]:
                r, c = r - frames[view, 1], c - frames[view, 2]
                leaves |= r < 0 or r > (frames[view, 3] - 1) * frames[view, 5]
                leaves |= c < 0 or c > (frames[view, 4] - 1) * frames[view, 5]
        near[found] = view
        if not before or leaves:
            found += 1
            continue
        value = _distance(frames, buffer, view, column, row)
        reach = 1.1 * (np.sqrt(reach) + extra) + 1.0 + frames[view, 5]
        found += value < reach
        outside += value < -reach
        if outside > misses:
            return -1, found
    return 0 if found else 1, found


@njit(**JIT)
def fill_slab(field, grid, misses, band, first, last, volume):
    """Fill the clipped signed distance at the points first <= i < last of volume (i, j, k).

    field: poses, lenses, frames, buffer; grid: origin and cell, point (i, j, k) lies at origin + cell (i, j, k), and
    points along a block; volume (x, y, z) float32 of values within [-band, band].
    """
    ((ox, oy, oz), cell, block), (_, ny, nz) = grid, volume.shape
    near, worst = np.empty(len(field[0]), np.int64), np.empty(MOST_MISSES + 1)
    for i0 in range(first, last, block):
        for j0 in range(0, ny, block):
            for k0 in range(0, nz, block):
                lowest, side = (ox + cell * i0, oy + cell * j0, oz + cell * k0), cell * (block - 1)
                kind, count = _block(field, lowest, side, 2.0 * cell, misses, near)
                for i in range(i0, min(i0 + block, last)):
                    for j in range(j0, min(j0 + block, ny)):
                        for k in range(k0, min(k0 + block, nz)):
                            value = band * kind
                            if kind == 0:
                                place = ox + cell * i, oy + cell * j, oz + cell * k
                                value = at_point(field, near, count, place, misses, band, worst)
                            volume[i, j, k] = min(max(value, -band), band)


@njit(**JIT)
def cut_slab(field, depths, grid, votes, band, first, last, volume):
    """Lower volume (i, j, k) to the `votes`-th smallest distance to the edges of the parts that a point may belong to.

    field: of distances to an edge; depths (views, rows, columns) behind a part: only points before that depth and in
    the volume are evaluated. Others: as in `fill_slab`.
    """
    (poses, lenses, _, _), ((ox, oy, oz), cell), worst = field, grid, np.empty(MOST_MISSES + 1)
    (views, rows, columns), behind = depths.shape, np.empty(len(depths), np.int64)
    for i in range(first, last):
        for j in range(volume.shape[1]):
            for k in range(volume.shape[2]):
                if volume[i, j, k] <= -cell:
                    continue
                count, x, y, z = 0, ox + cell * i, oy + cell * j, oz + cell * k
                for view in range(views):
                    c, r, depth = project_point(poses, lenses, view, x, y, z)
                    row, column = int(r + 0.5), int(c + 0.5)
                    if depth > 0.0 and 0 < row < rows - 1 and 0 < column < columns - 1:
                        behind[count] = view
                        count += depth < depths[view, row, column]
                if count >= votes:
                    value = at_point(field, behind, count, (x, y, z), votes - 1, band, worst)
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
    worst, every = np.empty(MOST_MISSES + 1), np.arange(len(field[0]))
    for n in range(out.shape[0]):
        others = every[every != views[n]]
        t, best = spans[n, 0], -FAR
        while t <= spans[n, 1] and best < -reach:
            x, y = origins[n, 0] + t * directions[n, 0], origins[n, 1] + t * directions[n, 1]
            place = x, y, origins[n, 2] + t * directions[n, 2]
            least = at_point(field, others, len(others), place, misses, 8.0 * reach, worst)
            best = max(best, least)
            t += max(0.8 * abs(least), reach) if least > -FAR else reach
        out[n] = best
