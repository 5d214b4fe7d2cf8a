"""Describe the object's materials: enamelled porcelain, woven and gilded parts, lacquer, glaze.

A material is a row m of 15 numbers: 0-2 albedo of the body (red, green, blue); 3-5 reflectance of a metal at normal
incidence, 0 where there is none; 6, 7 GGX roughness along and across the tangent; 8 Oren-Nayar roughness, radians;
9-11 unit normal with its fine texture; 12-14 unit tangent, perpendicular to it. Lengths in mm.
"""

import math

import numba
import numpy as np

from nishiki.simulate.randomness import crack_distance, hash_uint, solid_fractal, solid_noise, uniform
from nishiki.simulate.reflection import facets, fresnel, rough_matter
from nishiki.simulate.turntable.shape import ANIMAL, BODY, FLUTES, FRUIT, HANDLES, LID, ROPE
from nishiki.threads import over_rows

NUMBERS = 15  # of a material
INDEX = 1.5  # of glazes and lacquer
GOLD = (0.94, 0.72, 0.34)
_ENAMELS = np.array(
    [
        [0.50, 0.05, 0.03],
        [0.05, 0.11, 0.42],
        [0.62, 0.36, 0.05],
        [0.34, 0.08, 0.26],
        [0.66, 0.30, 0.26],
        [0.05, 0.25, 0.16],
    ]
)


@numba.njit(cache=True)
def _set(m, red, green, blue, alpha):
    m[0], m[1], m[2], m[3], m[6], m[7] = red, green, blue, 0.0, alpha, alpha


@numba.njit(cache=True)
def _gild(m, along, across):
    """Gold leaf: a metal, a little soiled."""
    m[0], m[1], m[2] = 0.05, 0.035, 0.015
    m[3], m[4], m[5] = GOLD
    m[6], m[7] = along, across


@numba.njit(cache=True)
def _mix(m, red, green, blue, share):
    m[0] += share * (red - m[0])
    m[1] += share * (green - m[1])
    m[2] += share * (blue - m[2])


@numba.njit(cache=True)
def _flower(m, key, u, v, size):
    """Draw a chrysanthemum about the middle of a cell: u, v mm from it. True where it covers the ground."""
    bits = hash_uint(key, np.uint64(7))
    u -= 5.0 * (uniform(bits, np.uint64(1)) - 0.5)
    v -= 5.0 * (uniform(bits, np.uint64(2)) - 0.5)
    r, turn = math.hypot(u, v), math.atan2(v, u) + 6.283 * uniform(bits, np.uint64(3))
    reach = size * (0.8 + 0.35 * uniform(bits, np.uint64(4)))
    petals = 10.0 + math.floor(7.0 * uniform(bits, np.uint64(5)))
    wave = abs(math.cos(0.5 * petals * turn))
    edge = reach * (0.78 + 0.22 * math.sqrt(wave))
    if r > edge:
        return False
    first = int(6.0 * uniform(bits, np.uint64(6)))
    enamel = _ENAMELS[first]
    pale = 0.75 - 0.6 * r / edge + 0.35 * (solid_noise(bits, 9.0 * turn, 0.5 * r, 0.0) - 0.5)
    _set(m, enamel[0], enamel[1], enamel[2], 0.16)
    _mix(m, 0.72, 0.66, 0.55, min(max(pale, 0.0), 0.85))
    if r < 0.42 * edge:  # a second ring of petals, and the heart
        inner = abs(math.cos(0.5 * petals * turn + 1.57))
        if r < 0.42 * edge * (0.7 + 0.3 * inner):
            enamel = _ENAMELS[(first + 1) % 6]
            _mix(m, enamel[0], enamel[1], enamel[2], 0.8)
    if r < 0.15 * edge:
        _set(m, 0.55, 0.33, 0.05, 0.2)
        if (math.floor(u / 0.9) + math.floor(v / 0.9)) % 2 == 0:
            _mix(m, 0.15, 0.06, 0.02, 0.4)
    # Fine outlines: of the petals, and of the flower in gold.
    if wave * r < 0.6 and r > 0.42 * edge:
        _mix(m, 0.10, 0.03, 0.03, 0.4)
    if edge - r < 0.75:
        _gild(m, 0.36, 0.36)
    return True


@numba.njit(cache=True)
def _field(m, key, turn, s):
    """Flowers over leaves and a diapered ground, around the belly. turn : radians about the axis; s : mm upwards."""
    cells, width, height = 11.0, 41.0, 29.0
    row = math.floor((s + 14.0) / height)
    place = turn / 6.283185307179586 * cells + 0.5 * row
    column = math.floor(place)
    u, v = (place - column - 0.5) * width, s + 14.0 - height * (row + 0.5)
    bits = hash_uint(hash_uint(key, np.uint64(np.int64(row) + 5)), np.uint64(np.int64(column) % 11 + 20))
    if _flower(m, bits, u, v, 13.0):
        return
    around, tone = turn * 72.0, solid_noise(key + np.uint64(3), 4.0 * math.cos(turn), s / 18.0, 4.0 * math.sin(turn))
    _set(m, 0.64, 0.57, 0.45, 0.14)
    # Bare ground, and patches with a diaper of crossing threads in red.
    a, b = (around + s) / 6.5, (around - s) / 6.5
    line = min(abs(a - math.floor(a) - 0.5), abs(b - math.floor(b) - 0.5))
    if tone < 0.56:
        _mix(m, 0.72, 0.55, 0.40, 0.5 * max(0.45 - tone, 0.0) / 0.45)
    elif line < 0.06:
        _mix(m, 0.48, 0.10, 0.06, 0.45)
    elif (math.floor(a + 0.5) + math.floor(b + 0.5)) % 2 == 0:
        _mix(m, 0.36, 0.46, 0.40, 0.35)
    leaf = solid_noise(key + np.uint64(4), 8.0 * math.cos(turn), s / 9.0, 8.0 * math.sin(turn)) - 0.60
    if leaf > 0.0:
        vein = abs(math.sin(1.2 * (around + 0.6 * s)))
        _set(m, 0.06 + 0.10 * tone, 0.22 + 0.12 * tone, 0.10, 0.18)
        if vein < 0.16 or leaf < 0.035:
            _mix(m, 0.02, 0.07, 0.05, 0.45)


@numba.njit(cache=True)
def _waves(m, turn, s):
    """Overlapping scales (sea waves) in blue and white, rings on each."""
    width, height = 6.283185307179586 * 62.0 / 32.0, 6.0
    place = turn * 62.0 / width
    best_ring = -1.0
    row = math.floor(s / height)
    for back in range(0, 3):
        level = row + 1 - back
        shifted = place + 0.5 * (level % 2)
        u = (shifted - math.floor(shifted) - 0.5) * width
        r = math.hypot(u, s - (level - 0.6) * height)
        if r < 0.56 * width:
            best_ring = r / (0.56 * width)
    blue = best_ring < 0.0 or math.floor(best_ring * 3.4) % 2 == 1
    if blue:
        _set(m, 0.05, 0.12, 0.40, 0.15)
    else:
        _set(m, 0.68, 0.68, 0.64, 0.15)


@numba.njit(cache=True)
def _woven(m, key, around, s, slope):
    """Basket weave: strips over and under; slopes of its relief into slope (2,)."""
    pitch = 4.4
    a, b = around / pitch, s / pitch
    i, j = math.floor(a), math.floor(b)
    fa, fb = a - i - 0.5, b - j - 0.5
    over = (i + j) % 2 == 0
    along, across = (fa, fb) if over else (fb, fa)
    dye = uniform(hash_uint(key, np.uint64(np.int64(j if over else i) + 900)), np.uint64(1))
    grain = solid_noise(key + np.uint64(9), (a if over else b) * 0.8, (b if over else a) * 9.0, 0.0)
    shade = (1.0 - 0.75 * (2.0 * along) ** 4) * (1.0 - 0.55 * (2.0 * across) ** 6)
    shade *= (0.65 + 0.55 * dye) * (0.75 + 0.5 * grain)
    _set(m, 0.44 * shade, 0.29 * shade, 0.13 * shade, 0.32)
    bend, camber = -1.3 * along * abs(2.0 * along), -0.9 * across * abs(2.0 * across)
    slope[0], slope[1] = (bend, camber) if over else (camber, bend)


@numba.njit(cache=True)
def _jar(m, key, x, y, z, slope):
    r = math.hypot(x, z)
    turn, latitude = math.atan2(z, x), math.atan2(y - 58.0, r)
    s, around = 64.0 * latitude, r * math.atan2(z, x)
    if s < -49.0:
        _set(m, 0.66, 0.65, 0.60, 0.17)
        if abs(s + 52.0) < 0.8 or abs(s + 54.5) < 0.4 or y < 1.5:
            _set(m, 0.04, 0.09, 0.30, 0.17)
    elif s < -19.5:
        arch = abs(math.sin(0.5 * FLUTES * turn))
        inside = -0.33 - 0.42 * (1.0 - arch) - latitude
        if inside > 0.035:
            _woven(m, key, 64.0 * turn, s, slope)
        elif inside > 0.005:
            _gild(m, 0.40, 0.40)
        else:
            _set(m, 0.03, 0.08, 0.29, 0.13)
            dot_u, dot_v = around / 4.6 + 0.5 * (math.floor(s / 4.6) % 2), s / 4.6
            if math.hypot(dot_u - math.floor(dot_u) - 0.5, dot_v - math.floor(dot_v) - 0.5) < 0.22:
                _mix(m, 0.40, 0.42, 0.46, 0.6)
    elif s < -14.0:
        _set(m, 0.50, 0.05, 0.03, 0.15)
        key_u = turn * 72.0 / 8.0
        fret = abs(key_u - math.floor(key_u) - 0.5)
        inner = abs(s + 16.7)
        if inner > 2.1 or (fret < 0.09 and inner < 1.4) or (fret > 0.2 and fret < 0.36 and abs(inner - 0.9) < 0.45):
            _gild(m, 0.38, 0.38)
    elif s < 44.0:
        _field(m, key, turn, s)
    elif s < 53.0:
        _waves(m, turn, s)
    else:
        _set(m, 0.45, 0.06, 0.035, 0.14)
        u, v = around / 5.0 + 0.5 * (math.floor(s / 4.0) % 2), s / 4.0
        if math.hypot((u - math.floor(u) - 0.5) * 1.25, v - math.floor(v) - 0.5) < 0.3 or y > 121.5:
            _gild(m, 0.40, 0.40)
    crack = crack_distance(key + np.uint64(30), turn * 72.0 / 6.0, s / 6.0)
    if crack < 0.028 and m[3] == 0.0 and solid_noise(key + np.uint64(31), x / 22.0, y / 22.0, z / 22.0) > 0.42:
        _mix(m, 0.12, 0.08, 0.05, 0.35)


@numba.njit(cache=True)
def _lacquer(m, key, x, z):
    """Black lacquer with sprinkled gold, a gold and red spray of blossoms, and a red rim."""
    _set(m, 0.022, 0.015, 0.012, 0.13)
    r, turn = math.hypot(x, z), math.atan2(z, x)
    fleck = crack_distance(key + np.uint64(40), x / 1.5, z / 1.5)
    amount = solid_noise(key + np.uint64(41), x / 11.0, z / 11.0, 0.0)
    if fleck > 0.46 - 0.20 * amount:
        _gild(m, 0.45, 0.45)
    place = turn / 6.283185307179586 * 7.0
    column = math.floor(place)
    bits = hash_uint(key + np.uint64(42), np.uint64(np.int64(column) + 9))
    u, v = (place - column - 0.5) * 22.0, r - 26.0
    _flower(m, bits, u, v, 6.5)
    if r > 33.2:
        _set(m, 0.42, 0.035, 0.02, 0.15)


@numba.njit(cache=True)
def _cord(m, key, x, y, z, slope):
    ring, lift = math.hypot(x, z) - 45.0, y - 105.0
    phase = 2.0 * math.atan2(lift, ring) + 40.0 * math.atan2(z, x)
    strand = math.floor(phase / 6.283185307179586)
    thread = math.sin(7.0 * phase + 9.0 * math.atan2(lift, ring))
    shade = (0.75 + 0.25 * math.cos(phase)) * (0.88 + 0.12 * thread)
    if strand % 3 == 0:
        _set(m, 0.55 * shade, 0.40 * shade, 0.12 * shade, 0.38)
    elif strand % 3 == 1:
        _set(m, 0.40 * shade, 0.04 * shade, 0.04 * shade, 0.45)
    else:
        _set(m, 0.16 * shade, 0.07 * shade, 0.28 * shade, 0.45)
    slope[1] = 0.25 * thread


@numba.njit(cache=True)
def _gilded(m, key, x, y, z):
    wear = solid_fractal(key + np.uint64(50), x / 7.0, y / 7.0, z / 7.0, 4)
    brush = solid_noise(key + np.uint64(55), x / 3.0, y / 3.0, z / 0.5)
    if wear > 0.64:
        _set(m, 0.30 * (0.7 + 0.6 * brush), 0.07, 0.035, 0.42)
    else:
        _gild(m, 0.46 + 0.1 * brush, 0.24)
        _mix(m, 0.10, 0.07, 0.03, wear)


@numba.njit(cache=True)
def _creature(m, key, x, y, z):
    patch = solid_fractal(key + np.uint64(60), x / 13.0, y / 13.0, z / 13.0, 3)
    hair = solid_noise(key + np.uint64(63), x / 0.8, y / 2.6, z / 1.0)
    _set(m, 0.66, 0.63, 0.57, 0.19)
    if patch > 0.55:
        _set(m, 0.52, 0.24, 0.07, 0.19)
    elif patch < 0.36:
        _set(m, 0.11, 0.08, 0.07, 0.19)
    _mix(m, 0.10, 0.06, 0.04, 0.45 * max(hair - 0.45, 0.0) / 0.55)
    side = abs(x)
    eye = math.sqrt((side - 6.0) ** 2 + (y - 162.5) ** 2 + (z - 19.5) ** 2)
    if eye < 2.6:
        _set(m, 0.012, 0.010, 0.010, 0.10)
    elif eye < 3.4:
        _gild(m, 0.38, 0.38)
    if z > 24.8 and abs(y - 157.5) < 1.2 and side < 1.8:
        _set(m, 0.45, 0.10, 0.09, 0.2)
    if y > 168.0 and z > 5.5:
        _mix(m, 0.62, 0.30, 0.26, 0.7)


@numba.njit(cache=True)
def _fruit(m, key, x, y, z):
    ripe = solid_fractal(key + np.uint64(70), x / 16.0, y / 16.0, z / 16.0, 4)
    share = min(max((ripe - 0.38) / 0.22, 0.0), 1.0)
    _set(m, 0.58, 0.42, 0.08, 0.22)
    _mix(m, 0.55, 0.10, 0.04, share)
    if y > 96.5 or z < 50.0:
        _set(m, 0.09, 0.20, 0.06, 0.3)
    elif crack_distance(key + np.uint64(75), (x + 0.3 * z) / 1.6, y / 1.6) > 0.42:
        _mix(m, 0.22, 0.10, 0.03, 0.75)


@numba.njit(cache=True)
def _texture(m, key, place, normal, slope, ring):
    """Write bumped normal and tangent. The tangent runs around the axis; on the handles along their rings."""
    (x, y, z), (nx, ny, nz) = (place[0], place[1], place[2]), (normal[0], normal[1], normal[2])
    if ring:
        across, rise = x - math.copysign(74.0, x), y - 78.0
        tx, ty, tz = -rise, across, 0.0
    else:
        tx, ty, tz = -z, 0.0, x
    along = tx * nx + ty * ny + tz * nz
    tx, ty, tz = tx - along * nx, ty - along * ny, tz - along * nz
    length = math.sqrt(tx * tx + ty * ty + tz * tz)
    if length < 1e-9:
        tx, ty, tz = (1.0 - nx * nx, -nx * ny, -nx * nz) if abs(nx) < 0.9 else (-nx * ny, 1.0 - ny * ny, -ny * nz)
        length = math.sqrt(tx * tx + ty * ty + tz * tz)
    tx, ty, tz = tx / length, ty / length, tz / length
    bx, by, bz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
    bump_u, bump_v = -0.35 * slope[0], -0.35 * slope[1]
    for fine in range(2):
        scale, strength = (1.3, 0.03) if fine else (6.0, 0.10)
        for side in range(2):
            value = strength * (
                solid_noise(key + np.uint64(80 + 2 * fine + side), x / scale, y / scale, z / scale) - 0.5
            )
            bump_u, bump_v = (bump_u + value, bump_v) if side else (bump_u, bump_v + value)
    px, py, pz = nx + bump_u * tx + bump_v * bx, ny + bump_u * ty + bump_v * by, nz + bump_u * tz + bump_v * bz
    length = math.sqrt(px * px + py * py + pz * pz)
    px, py, pz = px / length, py / length, pz / length
    along = tx * px + ty * py + tz * pz
    tx, ty, tz = tx - along * px, ty - along * py, tz - along * pz
    length = math.sqrt(tx * tx + ty * ty + tz * tz)
    m[9], m[10], m[11] = px, py, pz
    m[12], m[13], m[14] = tx / length, ty / length, tz / length


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _describe(start, stop, parts, points, normals, key, out):
    """Write the materials at points (n, 3) into out; parts (n, 6): distances from the parts."""
    slope = np.empty(2)
    for p in range(start, stop):
        m, x, y, z = out[p], points[p, 0], points[p, 1], points[p, 2]
        part, least = BODY, 1e300
        for k in range(parts.shape[1]):
            if parts[p, k] < least:
                part, least = k, parts[p, k]
        slope[0], slope[1] = 0.0, 0.0
        m[3], m[8] = 0.0, 0.22
        if part == BODY:
            _jar(m, key, x, y, z, slope)
        elif part == LID:
            _lacquer(m, key, x, z)
        elif part == ROPE:
            _cord(m, key, x, y, z, slope)
            m[8] = 0.45
        elif part == HANDLES:
            _gilded(m, key, x, y, z)
        elif part == FRUIT:
            _fruit(m, key, x, y, z)
        elif part == ANIMAL:
            _creature(m, key, x, y, z)
        # Uneven enamel, dust, wear: no paint is even.
        uneven = solid_fractal(key, x / 24.0, y / 24.0, z / 24.0, 6)
        grain = solid_noise(key + np.uint64(20), x / 0.9, y / 0.9, z / 0.9)
        tone = 0.62 + 0.62 * uneven + 0.07 * (grain - 0.5)
        for c in range(3):
            m[c] = min(m[c] * tone, 0.9)
        rough = 0.8 + 0.5 * solid_noise(key + np.uint64(21), x / 5.0, y / 5.0, z / 5.0)
        m[6], m[7] = m[6] * rough, m[7] * rough
        _texture(m, key, points[p], normals[p], slope, part == HANDLES)


def describe(parts: np.ndarray, points: np.ndarray, normals: np.ndarray, *, key: int) -> np.ndarray:
    """Compute materials (n, NUMBERS) float64 at points (n, 3), mm.

    parts (n, parts): distances from the parts; normals (n, 3): unit, of the smooth surface.
    """
    out = np.zeros((len(points), NUMBERS))
    if len(points):
        arrays = (np.ascontiguousarray(a, np.float64) for a in (parts, points, normals))
        over_rows(_describe, len(points), *arrays, np.uint64(key), out)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _reflect(start, stop, materials, lights, views, body, gloss):
    for p in range(start, stop):
        m, lx, ly, lz = materials[p], lights[p, 0], lights[p, 1], lights[p, 2]
        vx, vy, vz = views[p, 0], views[p, 1], views[p, 2]
        nx, ny, nz = m[9], m[10], m[11]
        n_l, n_v = nx * lx + ny * ly + nz * lz, nx * vx + ny * vy + nz * vz
        l_v = lx * vx + ly * vy + lz * vz
        matter = rough_matter(n_l, n_v, l_v, m[8], INDEX)
        length = math.sqrt(max(2.0 + 2.0 * l_v, 1e-12))
        hx, hy, hz = (lx + vx) / length, (ly + vy) / length, (lz + vz) / length
        tx, ty, tz = m[12], m[13], m[14]
        bx, by, bz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
        half = hx * tx + hy * ty + hz * tz, hx * bx + hy * by + hz * bz, hx * nx + hy * ny + hz * nz
        lamp = lx * tx + ly * ty + lz * tz, lx * bx + ly * by + lz * bz, n_l
        view = vx * tx + vy * ty + vz * tz, vx * bx + vy * by + vz * bz, n_v
        shape = facets(half, lamp, view, m[6], m[7])
        cosine = min(max(hx * vx + hy * vy + hz * vz, 0.0), 1.0)
        glass, grazing = fresnel(cosine, INDEX), (1.0 - cosine) ** 5
        for c in range(3):
            body[p, c] = m[c] * matter
            gloss[p, c] = shape * (m[3 + c] + (1.0 - m[3 + c]) * grazing if m[3] > 0.0 else glass)


def reflected(materials: np.ndarray, lights: np.ndarray, views: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Body and mirror reflection (n, 3) of materials (n, NUMBERS) for unit directions to light and view (n, 3)."""
    body, gloss = np.zeros((len(materials), 3)), np.zeros((len(materials), 3))
    if len(materials):
        arrays = (np.ascontiguousarray(a, np.float64) for a in (materials, lights, views))
        over_rows(_reflect, len(materials), *arrays, body, gloss)
    return body, gloss
