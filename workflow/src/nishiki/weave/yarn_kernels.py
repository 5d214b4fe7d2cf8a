"""Compiled parts of the model of interlaced elliptical yarns: its height, horizons and sums; see `yarn_weave`."""

import math

from numba import njit

from nishiki.brdf.cloth.yarn_kernels import facet_reflection
from nishiki.brdf.kernels import fresnel_scalar

HALF_PI = 0.5 * math.pi
HOLE = -9.0  # height where no yarn lies
# Columns of a point: its normal, its yarn's direction on the surface, the third axis, share of the plane over n_z
NORMAL, ALONG, ACROSS, WEIGHT, COLUMNS = 0, 3, 6, 9, 10
SHORTEST, GROWTH, STEPS = 0.04, 1.26, 20  # of a ray over the surface, in spacings: to 3.2
STEEPEST = 20.0  # slope to which the sides of a section are followed
BLEND = 0.015  # height over which warp and weft pass into each other where they cross, so that sums are smooth
LEAST = 1e-3  # share of a place below which a yarn is left out


@njit(cache=True, nogil=True, error_model="numpy")
def bump(d, spacing, period, soft):
    """How far a yarn has changed sides at distance d from its binding, 1 there and 0 half a period away; its slope."""
    d = d - period * math.floor(d / period + 0.5)
    half, far = 0.5 * spacing, 0.5 * period
    low = math.tanh((far + half) / soft) - math.tanh((far - half) / soft)
    top = 2.0 * math.tanh(half / soft)
    right, left = math.tanh((d + half) / soft), math.tanh((d - half) / soft)
    slope = ((1.0 - right * right) - (1.0 - left * left)) / soft
    return (right - left - low) / (top - low), slope / (top - low)


@njit(cache=True, nogil=True, error_model="numpy")
def warp_at(x, y, form):
    """Height of the warp yarn's upper side at (x, y), and its slopes along x and y; HOLE beside it.

    form = (harness, step, q, a1, b1, a2, b2, amplitude 1, amplitude 2, soft, arch), lengths in warp spacings.
    """
    harness, q, a1, b1 = form[0], form[2], form[3], form[4]
    period = harness * q
    column = math.floor(x + 0.5)
    u = (x - column) / a1
    if abs(u) >= 1.0:
        return HOLE, 0.0, 0.0
    d = y - form[1] * column * q
    share, slope = bump(d, q, period, form[9] * q)
    root = math.sqrt(1.0 - u * u)
    turn = 2.0 * math.pi / period
    arch = 0.5 * form[10] * period if harness > 2.0 else 0.0
    height = form[7] * (1.0 - 2.0 * share) + arch * (1.0 - math.cos(turn * d)) + b1 * root
    across = -b1 * u / (a1 * max(root, 1e-9))
    along = -2.0 * form[7] * slope + arch * turn * math.sin(turn * d)
    return height, max(min(across, STEEPEST), -STEEPEST), along


@njit(cache=True, nogil=True, error_model="numpy")
def weft_at(x, y, form, binding):
    """The same of the weft yarn; binding[k]: the column at which weft yarn k comes up."""
    q, a2, b2 = form[2], form[5], form[6]
    row = math.floor(y / q + 0.5)
    v = (y - row * q) / a2
    if abs(v) >= 1.0:
        return HOLE, 0.0, 0.0
    share, slope = bump(x - binding[int(row) % binding.size], 1.0, form[0], form[9])
    root = math.sqrt(1.0 - v * v)
    height = -form[8] * (1.0 - 2.0 * share) + b2 * root
    across = -b2 * v / (a2 * max(root, 1e-9))
    return height, 2.0 * form[8] * slope, max(min(across, STEEPEST), -STEEPEST)


@njit(cache=True, nogil=True, error_model="numpy")
def height_field(x, y, form, binding, height, is_warp):
    """Fill height (y, x) and is_warp with the upper side of the cloth at places x and y; HOLE where no yarn lies."""
    for row in range(y.size):
        for column in range(x.size):
            warp = warp_at(x[column], y[row], form)[0]
            weft = weft_at(x[column], y[row], form, binding)[0]
            height[row, column] = max(warp, weft)
            is_warp[row, column] = warp >= weft


@njit(cache=True, nogil=True, error_model="numpy")
def height_table(form, binding, table):
    """Fill table (m, length) with heights over one warp yarn's column: x in -0.5 .. 0.5, y over a period."""
    rows, columns = table.shape
    for k in range(rows):
        for j in range(columns):
            x, y = (k + 0.5) / rows - 0.5, j / columns * form[0] * form[2]
            table[k, j] = max(warp_at(x, y, form)[0], weft_at(x, y, form, binding)[0])


@njit(cache=True, nogil=True, error_model="numpy")
def _looked_up(x, y, form, table):
    """Height from the table; every column is the first one, moved along by the step of the weave."""
    rows, columns = table.shape
    column = math.floor(x + 0.5)
    across = (x - column + 0.5) * rows - 0.5
    along = (y / form[2] - form[1] * column) / form[0]
    along = (along - math.floor(along)) * columns
    k = min(max(math.floor(across + 0.5), 0), rows - 1)
    j = int(along)
    share = along - j
    j = j % columns
    return table[k, j] * (1.0 - share) + table[k, (j + 1) % columns] * share


@njit(cache=True, nogil=True, error_model="numpy")
def points_of(form, binding, places, table, points, which, horizons):
    """Fill points (2 n, COLUMNS), which (2 n,), horizons (2 n, azimuths) at places (n, 3) = x, y, share of the plane.

    A place has a point on the warp and one on the weft, weighted by which of the two lies higher.
    """
    count, azimuths = places.shape[0], horizons.shape[1]
    for p in range(2 * count):
        x, y, share = places[p % count, 0], places[p % count, 1], places[p % count, 2]
        warp, weft = warp_at(x, y, form), weft_at(x, y, form, binding)
        z, dx, dy = warp if p < count else weft
        above = z - (weft[0] if p < count else warp[0])
        share *= 1.0 / (1.0 + math.exp(-min(max(above / BLEND, -40.0), 40.0)))
        points[p, :] = 0.0
        which[p] = 0
        if z == HOLE or share < LEAST * places[p % count, 2]:
            continue
        which[p] = 1 if p < count else 2
        nz = 1.0 / math.sqrt(1.0 + dx * dx + dy * dy)
        nx, ny = -dx * nz, -dy * nz
        if p < count:
            size = math.sqrt(1.0 + dy * dy)
            tx, ty, tz = 0.0, 1.0 / size, dy / size
        else:
            size = math.sqrt(1.0 + dx * dx)
            tx, ty, tz = 1.0 / size, 0.0, dx / size
        points[p, 0], points[p, 1], points[p, 2] = nx, ny, nz
        points[p, 3], points[p, 4], points[p, 5] = tx, ty, tz
        points[p, 6], points[p, 7], points[p, 8] = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
        points[p, 9] = share / nz
        for a in range(azimuths):
            turn = 2.0 * math.pi * a / azimuths
            cx, cy = math.cos(turn), math.sin(turn)
            rise, far = 0.0, SHORTEST
            for _ in range(STEPS):
                rise = max(rise, (_looked_up(x + cx * far, y + cy * far, form, table) - z) / far)
                far *= GROWTH
            horizons[p, a] = math.atan(rise)


@njit(cache=True, nogil=True, error_model="numpy")
def _free(horizons, p, direction, soft):
    """Share of a point's surroundings that lets a direction through."""
    azimuths = horizons.shape[1]
    place = math.atan2(direction[1], direction[0]) / (2.0 * math.pi) * azimuths
    place -= azimuths * math.floor(place / azimuths)
    low = int(place)
    share = place - low
    low = low % azimuths
    horizon = horizons[p, low] * (1.0 - share) + horizons[p, (low + 1) % azimuths] * share
    up = math.atan2(direction[2], math.hypot(direction[0], direction[1]))
    u = min(max(0.5 + 0.5 * (up - horizon) / soft, 0.0), 1.0)
    return u * u * (3.0 - 2.0 * u)


@njit(cache=True, nogil=True, error_model="numpy")
def weave_sums(incident, outgoing, points, which, horizons, rough, index, soft, out):
    """out (n, 2): mirror reflection and white body, 1/sr; rough (2, 2) along and across the fibres of warp, weft."""
    for k in range(incident.shape[0]):
        i, o = incident[k], outgoing[k]
        out[k, 0] = out[k, 1] = 0.0
        if not (i[2] > 0.0 and o[2] > 0.0):
            continue
        hx, hy, hz = i[0] + o[0], i[1] + o[1], i[2] + o[2]
        length = math.sqrt(hx * hx + hy * hy + hz * hz)
        hx, hy, hz = hx / length, hy / length, hz / length
        fresnel = 0.5 * fresnel_scalar(min(0.5 * length, 1.0), index)
        mirror = body = 0.0
        upright = i[0] * i[0] + i[1] * i[1] < 1e-12
        for p in range(points.shape[0]):
            if which[p] == 0:
                continue
            a = points[p]
            ci = a[0] * i[0] + a[1] * i[1] + a[2] * i[2]
            co = a[0] * o[0] + a[1] * o[1] + a[2] * o[2]
            if ci <= 0.0 or co <= 0.0:
                continue
            seen = a[9] * _free(horizons, p, o, soft)
            if not upright:
                seen *= _free(horizons, p, i, soft)
            if seen <= 0.0:
                continue
            ra, rc = rough[which[p] - 1, 0], rough[which[p] - 1, 1]
            facets = facet_reflection(a, i, o, (hx, hy, hz), ci, co, ra, rc)
            mirror += seen * fresnel * facets
            body += seen * ci * co * (1.0 - fresnel_scalar(ci, index)) * (1.0 - fresnel_scalar(co, index))
        scale = 1.0 / (i[2] * o[2])
        out[k, 0], out[k, 1] = scale * mirror, scale * body / math.pi
