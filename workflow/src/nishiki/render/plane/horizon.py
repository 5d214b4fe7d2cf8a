"""Compiled loops of `nishiki.render.plane.shade`: horizons along lines and rays, and what they hide of a lamp.

All of them in one file, because the cache of the compiler watches only the file of the function that it has compiled.
"""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def _disc_share(elevation, horizon, radius):
    """Share of a disc of angular `radius` centred at `elevation` above a straight horizon (angles, radians)."""
    if radius <= 0.0:
        return 1.0 if elevation > horizon else 0.0
    d = (elevation - horizon) / radius
    if d >= 1.0:
        return 1.0
    if d <= -1.0:
        return 0.0
    return 0.5 + (d * np.sqrt(1.0 - d * d) + np.arcsin(d)) / np.pi


@njit(cache=True, nogil=True, error_model="numpy")
def _sweep_line(line, start, relief, slope, step, hull, out):
    """Find the horizon along the line row = start + slope column, out (columns,); NaN off the map or where unknown.

    Each piece of the surface has an upper convex hull of its own, a linked list over the columns: tops (pieces,) is its
    nearest column, valid where line_of (pieces,) is `line`; below (columns,) the next column of a hull, -1 at its end.
    """
    (surface, pieces), (tops, line_of, below, heights) = relief, hull
    rows, columns = surface.shape
    for column in range(columns - 1, -1, -1):
        out[column] = np.nan
        at = start + slope * column
        row = int(np.floor(at))
        share = at - row
        if row < 0 or row >= rows or (share > 0.0 and row + 1 >= rows):
            continue
        height = np.float64(surface[row, column])
        if share > 0.0:
            height = (1.0 - share) * height + share * surface[row + 1, column]
        if not np.isfinite(height):
            continue
        piece = pieces[row, column] if pieces.shape[0] > 0 else 0  # neighbours with heights are of one piece
        top = tops[piece] if line_of[piece] == line else -1
        tangent = -1e30
        if top >= 0:
            tangent = (heights[top] - height) / (top - column)
            while below[top] >= 0:
                under = below[top]
                deeper = (heights[under] - height) / (under - column)
                if deeper < tangent:
                    break
                tangent = deeper  # the point at the top lies below the line to the one beneath it
                top = under
            tangent /= step
        out[column] = tangent
        below[column], heights[column] = top, height
        tops[piece], line_of[piece] = column, line


@njit(cache=True, nogil=True, error_model="numpy")
def sweep(first, last, lines, surface, pieces, count, lamp, out):
    """Find the visibility of the pixels between the lines k - 1 and k, for k = first .. last - 1: one a column.

    Line k is row = k + phase + slope column.  A pixel's tangent is the mean of its two lines'; tangents below `floor`
    count as that: what lies further off than a tile's border reaches is then the same as nothing.  pieces: (rows,
    columns) int32 piece of each pixel, 0 .. count - 1, or (0, 0): all of piece 0.
    lines: phase, slope and step; lamp: elevation, radius and floor.
    """
    (phase, slope, step), (elevation, radius, floor), (rows, columns) = lines, lamp, surface.shape
    low, high = np.tan(max(elevation - radius, -1.5)), np.tan(min(elevation + radius, 1.5))
    tops, line_of = np.empty(count, np.int64), np.full(count, first - 2)
    hull, relief = (tops, line_of, np.empty(columns, np.int64), np.empty(columns)), (surface, pieces)
    before, here = np.empty(columns), np.empty(columns)
    _sweep_line(first - 1, first - 1 + phase, relief, slope, step, hull, before)
    for k in range(first, last):
        _sweep_line(k, k + phase, relief, slope, step, hull, here)
        for column in range(columns):
            lower = k - 1 + phase + slope * column
            row = int(np.floor(lower)) + 1
            if row < 0 or row >= rows:
                continue
            weight = row - lower  # 0 < weight <= 1: 1 is the line k
            a, b = before[column], here[column]
            if weight == 1.0 or not np.isfinite(a):
                a = b
            elif not np.isfinite(b):
                b = a
            tangent = (1.0 - weight) * max(a, floor) + weight * max(b, floor)
            if not tangent >= low:
                out[row, column] = 1.0
            elif tangent > high and elevation + radius < 1.5:
                out[row, column] = 0.0
            else:
                out[row, column] = _disc_share(elevation, np.arctan(tangent), radius)
        before, here = here, before


@njit(cache=True, nogil=True, error_model="numpy")
def _march_pixel(row, column, surface, pieces, pitch, direction, limits):
    """Find the tangent of a pixel's horizon along a unit direction (column, row); -1e30 where nothing is there.

    Only heights of the pixel's own piece count.
    Stops where a height of `highest` could no longer pass the horizon found, or `lowest`, and after `end` pixels.
    """
    (to_column, to_row), (lowest, highest, end) = direction, limits
    rows, columns = surface.shape
    by_column = abs(to_column) >= abs(to_row)
    main = abs(to_column) if by_column else abs(to_row)
    length = 1.0 / main
    step_column, step_row = to_column * length, to_row * length
    start = surface[row, column] / pitch
    one_piece = pieces.shape[0] == 0
    piece = 0 if one_piece else pieces[row, column]
    tangent = -1e30
    k = 1
    while True:
        distance = k * length
        c, r = column + k * step_column, row + k * step_row
        if distance > end or (highest - start) <= distance * max(tangent, lowest):
            return tangent
        inside = -1e-9 <= c <= columns - 1 + 1e-9 and -1e-9 <= r <= rows - 1 + 1e-9
        if not inside:
            return tangent
        r0, c0 = int(np.floor(r + 1e-9)), int(np.floor(c + 1e-9))
        if by_column:
            c0 = int(np.round(c))
            share = max(0.0, r - r0)
            other = surface[min(r0 + 1, rows - 1), c0]
        else:
            r0 = int(np.round(r))
            share = max(0.0, c - c0)
            other = surface[r0, min(c0 + 1, columns - 1)]
        here = np.float64(surface[r0, c0])
        height = here if share < 1e-8 else (1.0 - share) * here + share * other
        value = (height / pitch - start) / distance
        if value > tangent and (one_piece or pieces[r0, c0] == piece):  # false for NaN
            tangent = value
        k += 1


@njit(cache=True, nogil=True, error_model="numpy")
def march(first, last, surface, pieces, pitch, lamp, highest, out):
    """Find the visibility of a lamp from each pixel, at (column, row, z) in pixels or in that direction where w is 0.

    pieces as in `sweep`; lamp: column, row, z, w, angular radius.
    """
    light_column, light_row, light_z, w, radius = lamp
    for row in range(first, last):
        for column in range(surface.shape[1]):
            start = surface[row, column] / pitch
            dc, dr = light_column - w * column, light_row - w * row
            horizontal = np.sqrt(dc * dc + dr * dr)
            rise = light_z - (w * start if w > 0.0 else 0.0)
            if not np.isfinite(start) or horizontal <= 1e-12 * abs(rise):
                out[row, column] = 1.0
                continue
            elevation = np.arctan2(rise, horizontal)
            lowest = np.tan(max(elevation - radius, -1.5))
            end = horizontal if w > 0.0 else 1e30
            towards, limits = (dc / horizontal, dr / horizontal), (lowest, highest, end)
            tangent = _march_pixel(row, column, surface, pieces, pitch, towards, limits)
            out[row, column] = _disc_share(elevation, np.arctan(tangent), radius)
