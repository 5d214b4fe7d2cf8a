"""Compiled loops over a plane scene: cast shadows, and its shading under all lights in one pass over the pixels.

A light meets a pixel in two numbers only: the irradiance on the facet (diffuse) and the specular term D F G / cos_r.
Colour is linear in both, so that they are summed over the lights that share a spectrum and multiplied by the 3 x K
matrix of that spectrum once (Tominaga and Tanaka 2004, eq. 19, without its loop over wavelengths).

LANES neighbouring pixels of a row are computed at a time, in float64 (`nishiki.lanes`). Every pixel sees the same
operations in the same order whatever the number of threads, so that the bytes do not depend on it. All loops stand in
one file, because the cache of the compiler watches only the file of the function that it has compiled.
"""

import math

import numpy as np
from numba import njit

from nishiki.brdf.torrance_sparrow import MIRROR, exp2_negative, fresnel_scalar, phi_squared
from nishiki.lanes import LANES, choose, load, root, splat, store


@njit(cache=True, nogil=True, error_model="numpy")
def _disc_share(elevation, horizon, radius):
    """Compute the share of a disc of angular `radius` at `elevation` above a straight horizon (angles, radians)."""
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


NORMAL_MISSING, COLOUR_MISSING, TURNED_AWAY, BACKGROUND, OVERFLOW = (1 << bit for bit in range(5))
"""What can be wrong with a pixel of a rendered plane. It is 0 where its normal is zero, not finite or not of unit
length, where a colour coefficient is not finite, and where its value is outside the range of float32. A facet with
n . v <= 0 cannot be seen from here: its diffuse light is shown, its gloss is not. The ray of the background misses the
painting."""
UNUSABLE = NORMAL_MISSING | COLOUR_MISSING | OVERFLOW  # the pixel is 0


NX, NY, NZ, A, B, D, EX, EY, XX, XY, YY, X, Y, INDEX, LOSS, ENTER, VISIBLE, COS_R, GLOSS = range(19)
"""Rows of the gathered pixel data: normal, terms of the body shading, covariance of the slopes, place on the
plane, gloss of the region, share of the lamp in sight, cosine of the eye; from GLOSS on beta, 1 / gamma^2 of each lobe.
"""
NEGLIGIBLE = 60.0
"""Exponent: facet distributions below 2 to the minus this count as 0."""
# Mean of x^8 over a uniform half space, weighted by the cosine, for a facet that faces the eye: 4 int (2u - 1) u^4 du
# for u from 1/2 to 1.
_AMBIENT_SKIRT = 4 * ((1 - 0.5**6) / 3 - (1 - 0.5**5) / 5)
_TWO_LN2 = 2.0 * math.log(2.0)
_FLOAT32_MAX = float(np.finfo(np.float32).max)


@njit(cache=True, nogil=True, error_model="numpy")
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, nogil=True, error_model="numpy")
def _towards(source, pixel):
    """Compute unit vectors from the pixels' places to `source`, homogeneous (4,), and the squared distances."""
    x = source[0] - source[3] * load(pixel, (X, 0))
    y = source[1] - source[3] * load(pixel, (Y, 0))
    square = x * x + y * y + source[2] * source[2]
    inverse = 1.0 / root(square)
    return (x * inverse, y * inverse, source[2] * inverse), square


@njit(cache=True, nogil=True, error_model="numpy")
def _transmit(cosine, pixel):
    """Compute the body's light transmitted by the surface, relative to frontal."""
    cosine, index = choose(cosine > 1e-6, choose(cosine < 1.0, cosine, 1.0), 1e-6), load(pixel, (INDEX, 0))
    passed = (1.0 - fresnel_scalar(cosine, index)) / (1.0 - fresnel_scalar(splat(1.0), index))
    return 1.0 - load(pixel, (LOSS, 0)) * (1.0 - passed)


@njit(cache=True, nogil=True, error_model="numpy")
def _specular(normal, half, length, cos_i, cos_r, pixel):
    """Sum beta D F G / cos_r over the lobes; half: sum of the unit vectors to light and eye, and its length.

    sin^2(phi / 2) = |n x s|^2 / (2 |s| (|s| + n.s)). Over slopes of covariance C, D is s^2 / sqrt(det(s^2 + C))
    exp(-d (s^2 + C)^-1 d / 2), with d the offset of the normal's slope from the half vector's, scaled to the length
    phi, so that a lobe without blur depends on phi alone. At the half vector itself the square of that scale is n_z^3:
    an angle is n_z^2 of a step of slope along the tilt and n_z of one across it.
    """
    (nx, ny, nz), (hx, hy, hz), both = normal, half, cos_i + cos_r
    cx, cy, cz = ny * hz - nz * hy, nz * hx - nx * hz, nx * hy - ny * hx
    y = (cx * cx + cy * cy + cz * cz) / (2.0 * length * (length + both))
    phi2 = phi_squared(choose(y < 0.5, y, 0.5))
    steep, flat = choose(nz > 0.2, nz, 0.2), choose(hz > 1e-3, hz, 1e-3)
    dx, dy = nx / steep - hx / flat, ny / steep - hy / flat
    square = dx * dx + dy * dy
    scale = choose(square > 1e-12, phi2 / choose(square > 1e-12, square, 1.0), steep * steep * steep)
    xx, xy, yy = scale * load(pixel, (XX, 0)), scale * load(pixel, (XY, 0)), scale * load(pixel, (YY, 0))
    total = splat(0.0)
    for lobe in range(GLOSS, pixel.shape[0], 2):
        narrow = 1.0 / (load(pixel, (lobe + 1, 0)) * _TWO_LN2)
        a, c = narrow + xx, narrow + yy
        inverse = 1.0 / (a * c - xy * xy)
        e = scale * (c * dx * dx - 2.0 * xy * dx * dy + a * dy * dy) * inverse * (1.0 / _TWO_LN2)
        facets = exp2_negative(choose(e < NEGLIGIBLE, e, NEGLIGIBLE)) * narrow * root(inverse)
        total += load(pixel, (lobe, 0)) * choose(e < NEGLIGIBLE, facets, 0.0)
    cos_q = choose(length < 2.0, 0.5 * length, 1.0)
    groove = 2.0 * both / (length * cos_q) * choose(cos_i < cos_r, cos_i / cos_r, 1.0)
    bounded = choose(groove < 1.0 / cos_r, groove, 1.0 / cos_r)
    value = total * fresnel_scalar(cos_q, load(pixel, (INDEX, 0))) * bounded
    return choose((cos_i > 0.0) & (cos_r > 0.0), value, 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _gather(row, start, maps, plane, pixel, sigma, marks):
    """Put the pixels from `start` on into their lanes; those beyond the row repeat its last one."""
    normals, coefficients, shading, slopes = maps
    columns = coefficients.shape[1]
    for i in range(LANES):
        column = min(start + i, columns - 1)
        nx, ny, nz = (np.float64(normals[row, column, 0]), np.float64(normals[row, column, 1]),
                      np.float64(normals[row, column, 2]))  # fmt: skip
        good = abs(nx * nx + ny * ny + nz * nz - 1.0) < 0.02  # false for NaN
        pixel[NX, i], pixel[NY, i], pixel[NZ, i] = nx if good else 0.0, ny if good else 0.0, nz if good else 1.0
        marks[i] = 0 if good else NORMAL_MISSING
        w = plane[2, 0] * column + plane[2, 1] * row + plane[2, 2]
        pixel[X, i] = (plane[0, 0] * column + plane[0, 1] * row + plane[0, 2]) / w if w > 0.0 else 0.0
        pixel[Y, i] = (plane[1, 0] * column + plane[1, 1] * row + plane[1, 2]) / w if w > 0.0 else 0.0
        for k in range(shading.shape[2]):
            pixel[A + k, i] = shading[row, column, k]
        for k in range(slopes.shape[2]):
            pixel[XX + k, i] = slopes[row, column, k]
        for k in range(coefficients.shape[2]):
            sigma[k, i] = coefficients[row, column, k]


@njit(cache=True, nogil=True, error_model="numpy")
def _gather_gloss(row, start, labels, finish, pixel):
    """Put the gloss of the pixels' regions into their lanes."""
    gloss, index, transmission, entering = finish
    for i in range(LANES):
        region = labels[row, min(start + i, labels.shape[1] - 1)]
        pixel[INDEX, i], pixel[LOSS, i], pixel[ENTER, i] = index[region], transmission[region], entering[region]
        for m in range(gloss.shape[1]):
            pixel[GLOSS + m, i] = gloss[region, m]


@njit(cache=True, nogil=True, error_model="numpy")
def _store(row, start, total, sigma, pixel, marks, pictures):
    """Store totals as float32; overflows, and values from missing input, become 0 (their flag gives the reason)."""
    out, flags = pictures
    for i in range(min(LANES, out.shape[1] - start)):
        mark, fits = marks[i], True
        if not pixel[COS_R, i] > 0.0:
            mark |= TURNED_AWAY
        for channel in range(out.shape[2]):
            fits = fits and abs(total[channel, i]) <= _FLOAT32_MAX
        if not fits:
            mark |= OVERFLOW if np.isfinite(sigma[:, i]).all() else COLOUR_MISSING
        for channel in range(out.shape[2]):
            out[row, start + i, channel] = total[channel, i] if mark & UNUSABLE == 0 else 0.0
        flags[row, start + i] = mark


@njit(cache=True, nogil=True, error_model="numpy")
def shade(first, last, maps, finish, lamps, colours, view, pictures):
    """Fill rows first .. last - 1 of: sum over the lights of A sigma E c f + white E beta D F G / cos_r.

    c = max(n.l, 0), f the factor of the body shading; of a metal (index MIRROR) A sigma E beta D G / cos_r. maps:
    normals (R, C, 3), coefficients (R, C, K), shading (R, C, 3 or 5) or (0, 0, 0): f = 1, and slopes (R, C, 3),
    covariance of the slopes in a pixel, or (0, 0, 0): none, float32; labels (R, C) uint8, or (1, 1): all pixels have
    its row of finish; finish: gloss (regions, 2 lobes): beta, 1 / gamma^2 of each lobe; index (regions,); transmission
    (regions,): share of the surface's loss that the body's light suffers, entering (regions,): what is left of ambient
    light on its way in; lights (L, 6): x, y, z, w, intensity, squared reference distance; group (L,) row of matrices
    (G, channels, K) and whites (G, channels); visibility (L, R, C) float32 or (0, 0, 0): all 1; plane (3, 3)
    maps (column, row, 1) to the plane; eye (4,) homogeneous; ambient: irradiance of the uniform half space, and its
    group; out (R, C, channels) float32, flags (R, C) uint8.
    """
    labels, (lights, group, visibility), (matrices, whites) = maps[4], lamps, colours
    (plane, eye, ambient, ambient_group), lossy = view, finish[2].max() > 0.0
    glossy, shaded = finish[0].shape[1] > 0, maps[2].shape[0] > 0
    pixel, marks = np.zeros((GLOSS + finish[0].shape[1], LANES)), np.zeros(LANES, np.int64)
    pixel[A], pixel[VISIBLE] = 1.0, 1.0
    sigma, total = np.empty((matrices.shape[2], LANES)), np.empty((whites.shape[1], LANES))
    body, shine = np.empty((len(whites), LANES)), np.empty((len(whites), LANES))
    _gather_gloss(0, 0, labels, finish, pixel)
    for row in range(first, last):
        for start in range(0, maps[1].shape[1], LANES):
            _gather(row, start, maps[:4], plane, pixel, sigma, marks)
            if labels.size > 1:
                _gather_gloss(row, start, labels, finish, pixel)
            normal = load(pixel, (NX, 0)), load(pixel, (NY, 0)), load(pixel, (NZ, 0))
            a, b, d = load(pixel, (A, 0)), load(pixel, (B, 0)), load(pixel, (D, 0))
            ex, ey = load(pixel, (EX, 0)), load(pixel, (EY, 0))
            seen, _ = _towards(eye, pixel)
            cos_r, leaving = _dot(normal, seen), splat(1.0)
            store(pixel, (COS_R, 0), cos_r)
            if lossy:
                leaving = _transmit(cos_r, pixel)
            body[:], shine[:] = 0.0, 0.0
            mean = a + (b + ex * normal[0] + ey * normal[1]) * (2.0 / 3.0) + d * _AMBIENT_SKIRT
            around = 0.5 * ambient * (1.0 + normal[2]) * load(pixel, (ENTER, 0)) * leaving
            store(body, (ambient_group, 0), around * choose(mean > 0.0, mean, 0.0))
            for j in range(len(lights)):
                light, square = _towards(lights[j], pixel)
                cos_i, irradiance = _dot(normal, light), splat(lights[j, 4])
                if lights[j, 5] > 0.0:
                    irradiance = lights[j, 4] * lights[j, 5] / square
                if visibility.shape[0] > 0:
                    for i in range(LANES):
                        pixel[VISIBLE, i] = visibility[j, row, min(start + i, visibility.shape[2] - 1)]
                irradiance = irradiance * load(pixel, (VISIBLE, 0))
                half = light[0] + seen[0], light[1] + seen[1], light[2] + seen[2]
                length2 = _dot(half, half)
                factor = choose(cos_i > 0.0, cos_i, 0.0)
                if shaded:
                    along = choose(cos_i + cos_r > 0.0, cos_i + cos_r, 0.0)
                    x2 = along * along / choose(length2 > 1e-12, length2, 1e-12)
                    x4 = x2 * x2
                    terms = a + b * cos_i + d * (x4 * x4) + ex * light[0] + ey * light[1]
                    factor = factor * choose(terms > 0.0, terms, 0.0)
                if lossy:
                    factor = factor * leaving * _transmit(cos_i, pixel)
                gloss = splat(0.0)
                if glossy:
                    gloss = _specular(normal, half, root(length2), cos_i, cos_r, pixel)
                g, metal = group[j], load(pixel, (INDEX, 0)) > 0.5 * MIRROR  # its gloss has the colour of its body
                store(body, (g, 0), load(body, (g, 0)) + choose(metal, gloss, factor) * irradiance)
                store(shine, (g, 0), load(shine, (g, 0)) + choose(metal, 0.0, gloss) * irradiance)
            for channel in range(len(total)):
                value = splat(0.0)
                for g in range(len(whites)):
                    colour = splat(0.0)
                    for k in range(len(sigma)):
                        colour += matrices[g, channel, k] * load(sigma, (k, 0))
                    value += colour * load(body, (g, 0)) + whites[g, channel] * load(shine, (g, 0))
                store(total, (channel, 0), value)
            _store(row, start, total, sigma, pixel, marks, pictures)
