"""Describe the object's materials: enamelled porcelain, woven and gilded parts, lacquer, glaze.

A material is a column m of 15 numbers: 0-2 albedo of the body (red, green, blue); 3-5 reflectance of a metal at normal
incidence, 0 where there is none; 6, 7 GGX roughness along and across the tangent; 8 Oren-Nayar roughness, radians;
9-11 unit normal with its fine texture; 12-14 unit tangent, perpendicular to it. Lengths in mm.
"""

import numpy as np

from nishiki.simulate.randomness import crack_distance, mix_bits, solid_fractal, solid_noise, uniforms
from nishiki.simulate.reflection import dielectric_fresnel, facets, metal_fresnel, rough_matter
from nishiki.simulate.turntable.shape import ANIMAL, BODY, FLUTES, FRUIT, HANDLES, LID, ROPE
from nishiki.threads import over_rows, strips

NUMBERS = 15  # of a material; while it is painted, two slopes of its relief follow
SLOPE = slice(NUMBERS, NUMBERS + 2)
INDEX = 1.5  # of glazes and lacquer
GOLD = (0.94, 0.72, 0.34)
TURN = 2 * np.pi
BATCH = 1 << 14  # points at a time
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


def _set(m, where, colour, alpha):
    """Paint the materials m (NUMBERS, n) where `where` (n,) bool holds."""
    for row, value in zip((0, 1, 2, 3, 6, 7), (*colour, 0.0, alpha, alpha), strict=True):
        m[row] = np.where(where, value, m[row])


def _gild(m, where, along, across):
    """Paint gold leaf: a metal, a little soiled."""
    for row, value in enumerate((0.05, 0.035, 0.015, *GOLD, along, across)):
        m[row] = np.where(where, value, m[row])


def _mix(m, where, colour, share):
    share = np.where(where, share, 0.0)
    for row, value in enumerate(colour):
        m[row] += share * (value - m[row])


def _within(m, where, paint, *arguments):
    """Paint some materials alone, by a function of their own columns; arguments (n,), or numbers."""
    part = m[:, where]
    paint(part, *(each[where] if np.ndim(each) else each for each in arguments))
    m[:, where] = part


def _apart(a, b):
    """Compute distances from the middles of the cells of a lattice, in cells."""
    return a - np.floor(a) - 0.5, b - np.floor(b) - 0.5


def _uniform(number):
    return number % 2 == 0


def _bits(key, number):
    """Hash integers given as float64 to random bits; keys uint64."""
    return mix_bits(key, number.astype(np.int64).astype(np.uint64))


def _flower(m, key, u, v, size):
    """Draw a chrysanthemum about the middle of a cell: u, v mm from it."""
    bits = mix_bits(key, np.array([7]))
    u = u - 5.0 * (uniforms(bits, 1) - 0.5)
    v = v - 5.0 * (uniforms(bits, 2) - 0.5)
    r, turn = np.hypot(u, v), np.arctan2(v, u) + 6.283 * uniforms(bits, 3)
    reach = size * (0.8 + 0.35 * uniforms(bits, 4))
    petals = 10.0 + np.floor(7.0 * uniforms(bits, 5))
    wave = abs(np.cos(0.5 * petals * turn))
    edge = reach * (0.78 + 0.22 * np.sqrt(wave))
    covered = r <= edge
    first = (6.0 * uniforms(bits, 6)).astype(int)
    pale = 0.75 - 0.6 * r / edge + 0.35 * (solid_noise(bits, 9.0 * turn, 0.5 * r, 0.0) - 0.5)
    _set(m, covered, _ENAMELS[first].T, 0.16)
    _mix(m, covered, (0.72, 0.66, 0.55), np.clip(pale, 0.0, 0.85))
    # a second ring of petals, and the heart
    inner = abs(np.cos(0.5 * petals * turn + 1.57))
    _mix(m, r < 0.42 * edge * (0.7 + 0.3 * inner), _ENAMELS[(first + 1) % 6].T, 0.8)
    heart = r < 0.15 * edge
    _set(m, heart, (0.55, 0.33, 0.05), 0.2)
    _mix(m, heart & _uniform(np.floor(u / 0.9) + np.floor(v / 0.9)), (0.15, 0.06, 0.02), 0.4)
    # Fine outlines: of the petals, and of the flower in gold.
    _mix(m, covered & (wave * r < 0.6) & (r > 0.42 * edge), (0.10, 0.03, 0.03), 0.4)
    _gild(m, covered & (edge - r < 0.75), 0.36, 0.36)


def _field(m, key, turn, s):
    """Paint flowers over leaves and a diapered ground, around the belly. turn : radians about the axis; s : mm up."""
    cells, width, height = 11.0, 41.0, 29.0
    row = np.floor((s + 14.0) / height)
    place = turn / TURN * cells + 0.5 * row
    column = np.floor(place)
    u, v = (place - column - 0.5) * width, s + 14.0 - height * (row + 0.5)
    around, tone = turn * 72.0, solid_noise(key + np.uint64(3), 4.0 * np.cos(turn), s / 18.0, 4.0 * np.sin(turn))
    _set(m, True, (0.64, 0.57, 0.45), 0.14)
    # Bare ground, and patches with a diaper of crossing threads in red.
    a, b = (around + s) / 6.5, (around - s) / 6.5
    line = np.minimum(*(abs(each) for each in _apart(a, b)))
    bare = tone < 0.56
    _mix(m, bare, (0.72, 0.55, 0.40), 0.5 * np.maximum(0.45 - tone, 0.0) / 0.45)
    _mix(m, ~bare & (line < 0.06), (0.48, 0.10, 0.06), 0.45)
    other = _uniform(np.floor(a + 0.5) + np.floor(b + 0.5))
    _mix(m, ~bare & (line >= 0.06) & other, (0.36, 0.46, 0.40), 0.35)
    leaf = solid_noise(key + np.uint64(4), 8.0 * np.cos(turn), s / 9.0, 8.0 * np.sin(turn)) - 0.60
    leafy = leaf > 0.0
    _set(m, leafy, (0.06 + 0.10 * tone, 0.22 + 0.12 * tone, 0.10), 0.18)
    vein = abs(np.sin(1.2 * (around + 0.6 * s)))
    _mix(m, leafy & ((vein < 0.16) | (leaf < 0.035)), (0.02, 0.07, 0.05), 0.45)
    bits = _bits(_bits(key, row + 5), column % 11 + 20)
    _flower(m, bits, u, v, 13.0)


def _waves(m, turn, s):
    """Paint overlapping scales (sea waves) in blue and white, rings on each."""
    width, height = TURN * 62.0 / 32.0, 6.0
    place, row, ring = turn * 62.0 / width, np.floor(s / height), np.full(len(s), -1.0)
    for level in (row + 1, row, row - 1):
        u = _apart(place + 0.5 * (level % 2), 0)[0] * width
        r = np.hypot(u, s - (level - 0.6) * height) / (0.56 * width)
        ring = np.where(r < 1, r, ring)
    blue = (ring < 0.0) | ~_uniform(np.floor(ring * 3.4))
    _set(m, blue, (0.05, 0.12, 0.40), 0.15)
    _set(m, ~blue, (0.68, 0.68, 0.64), 0.15)


def _weave(m, key, around, s):
    """Paint a basket weave: strips over and under."""
    pitch = 4.4
    a, b = around / pitch, s / pitch
    i, j, (fa, fb) = np.floor(a), np.floor(b), _apart(a, b)
    over = _uniform(i + j)
    along, across = np.where(over, (fa, fb), (fb, fa))
    dye = uniforms(_bits(key, np.where(over, j, i) + 900), 1)
    grain = solid_noise(key + np.uint64(9), np.where(over, a, b) * 0.8, np.where(over, b, a) * 9.0, 0.0)
    shade = (1.0 - 0.75 * (2.0 * along) ** 4) * (1.0 - 0.55 * (2.0 * across) ** 6)
    shade *= (0.65 + 0.55 * dye) * (0.75 + 0.5 * grain)
    _set(m, True, (0.44 * shade, 0.29 * shade, 0.13 * shade), 0.32)
    bend, camber = -1.3 * along * abs(2.0 * along), -0.9 * across * abs(2.0 * across)
    m[SLOPE] = np.where(over, (bend, camber), (camber, bend))


def _jar(m, key, x, y, z):
    r, turn = np.hypot(x, z), np.arctan2(z, x)
    latitude = np.arctan2(y - 58.0, r)
    s, around = 64.0 * latitude, r * turn
    zone = np.digitize(s, (-49.0, -19.5, -14.0, 44.0, 53.0))
    foot, petals, band, neck = (zone == k for k in (0, 1, 2, 5))
    _set(m, foot, (0.66, 0.65, 0.60), 0.17)
    _set(m, foot & ((abs(s + 52.0) < 0.8) | (abs(s + 54.5) < 0.4) | (y < 1.5)), (0.04, 0.09, 0.30), 0.17)
    arch = abs(np.sin(0.5 * FLUTES * turn))
    inside = -0.33 - 0.42 * (1.0 - arch) - latitude
    _within(m, petals & (inside > 0.035), _weave, key, 64.0 * turn, s)
    _gild(m, petals & (inside > 0.005) & (inside <= 0.035), 0.40, 0.40)
    rest = petals & (inside <= 0.005)
    _set(m, rest, (0.03, 0.08, 0.29), 0.13)
    dots = np.hypot(*_apart(around / 4.6 + 0.5 * (np.floor(s / 4.6) % 2), s / 4.6)) < 0.22
    _mix(m, rest & dots, (0.40, 0.42, 0.46), 0.6)
    _set(m, band, (0.50, 0.05, 0.03), 0.15)
    fret, inner = abs(_apart(turn * 72.0 / 8.0, 0)[0]), abs(s + 16.7)
    bar, hook = (fret < 0.09) & (inner < 1.4), (fret > 0.2) & (fret < 0.36) & (abs(inner - 0.9) < 0.45)
    _gild(m, band & ((inner > 2.1) | bar | hook), 0.38, 0.38)
    _within(m, zone == 3, _field, key, turn, s)
    _within(m, zone == 4, _waves, turn, s)
    _set(m, neck, (0.45, 0.06, 0.035), 0.14)
    u, v = _apart(around / 5.0 + 0.5 * (np.floor(s / 4.0) % 2), s / 4.0)
    _gild(m, neck & ((np.hypot(u * 1.25, v) < 0.3) | (y > 121.5)), 0.40, 0.40)
    crack = crack_distance(key + np.uint64(30), turn * 72.0 / 6.0, s / 6.0)
    stained = solid_noise(key + np.uint64(31), x / 22.0, y / 22.0, z / 22.0) > 0.42
    _mix(m, (crack < 0.028) & (m[3] == 0.0) & stained, (0.12, 0.08, 0.05), 0.35)


def _lacquer(m, key, x, y, z):
    """Paint black lacquer with sprinkled gold, a gold and red spray of blossoms, and a red rim."""
    _set(m, True, (0.022, 0.015, 0.012), 0.13)
    r, place = np.hypot(x, z), np.arctan2(z, x) / TURN * 7.0
    fleck = crack_distance(key + np.uint64(40), x / 1.5, z / 1.5)
    amount = solid_noise(key + np.uint64(41), x / 11.0, z / 11.0, 0.0)
    _gild(m, fleck > 0.46 - 0.20 * amount, 0.45, 0.45)
    _flower(m, _bits(key + np.uint64(42), np.floor(place) + 9), _apart(place, 0)[0] * 22.0, r - 26.0, 6.5)
    _set(m, r > 33.2, (0.42, 0.035, 0.02), 0.15)


def _cord(m, key, x, y, z):
    lift = np.arctan2(y - 105.0, np.hypot(x, z) - 45.0)
    phase = 2.0 * lift + 40.0 * np.arctan2(z, x)
    thread = np.sin(7.0 * phase + 9.0 * lift)
    shade = (0.75 + 0.25 * np.cos(phase)) * (0.88 + 0.12 * thread)
    strands = ((0.55, 0.40, 0.12, 0.38), (0.40, 0.04, 0.04, 0.45), (0.16, 0.07, 0.28, 0.45))
    for strand, (*colour, alpha) in enumerate(strands):
        _set(m, np.floor(phase / TURN) % 3 == strand, [value * shade for value in colour], alpha)
    m[8], m[SLOPE.stop - 1] = 0.45, 0.25 * thread


def _gilding(m, key, x, y, z):
    wear = solid_fractal(key + np.uint64(50), x / 7.0, y / 7.0, z / 7.0, 4)
    brush = solid_noise(key + np.uint64(55), x / 3.0, y / 3.0, z / 0.5)
    worn = wear > 0.64
    _set(m, worn, (0.30 * (0.7 + 0.6 * brush), 0.07, 0.035), 0.42)
    _gild(m, ~worn, 0.46 + 0.1 * brush, 0.24)
    _mix(m, ~worn, (0.10, 0.07, 0.03), wear)


def _creature(m, key, x, y, z):
    patch = solid_fractal(key + np.uint64(60), x / 13.0, y / 13.0, z / 13.0, 3)
    hair = solid_noise(key + np.uint64(63), x / 0.8, y / 2.6, z / 1.0)
    _set(m, True, (0.66, 0.63, 0.57), 0.19)
    _set(m, patch > 0.55, (0.52, 0.24, 0.07), 0.19)
    _set(m, patch < 0.36, (0.11, 0.08, 0.07), 0.19)
    _mix(m, True, (0.10, 0.06, 0.04), 0.45 * np.maximum(hair - 0.45, 0.0) / 0.55)
    side = abs(x)
    eye = np.sqrt((side - 6.0) ** 2 + (y - 162.5) ** 2 + (z - 19.5) ** 2)
    _set(m, eye < 2.6, (0.012, 0.010, 0.010), 0.10)
    _gild(m, (eye >= 2.6) & (eye < 3.4), 0.38, 0.38)
    _set(m, (z > 24.8) & (abs(y - 157.5) < 1.2) & (side < 1.8), (0.45, 0.10, 0.09), 0.2)
    _mix(m, (y > 168.0) & (z > 5.5), (0.62, 0.30, 0.26), 0.7)


def _fruit(m, key, x, y, z):
    ripe = solid_fractal(key + np.uint64(70), x / 16.0, y / 16.0, z / 16.0, 4)
    _set(m, True, (0.58, 0.42, 0.08), 0.22)
    _mix(m, True, (0.55, 0.10, 0.04), np.clip((ripe - 0.38) / 0.22, 0.0, 1.0))
    leaf = (y > 96.5) | (z < 50.0)
    _set(m, leaf, (0.09, 0.20, 0.06), 0.3)
    seed = crack_distance(key + np.uint64(75), (x + 0.3 * z) / 1.6, y / 1.6) > 0.42
    _mix(m, ~leaf & seed, (0.22, 0.10, 0.03), 0.75)


PAINTS = {BODY: _jar, LID: _lacquer, ROPE: _cord, HANDLES: _gilding, FRUIT: _fruit, ANIMAL: _creature}


def _across(vector, normal):
    """Turn vectors (3, n) into unit vectors across unit normals; return their lengths across, too."""
    vector = vector - (vector * normal).sum(axis=0) * normal
    length = np.linalg.norm(vector, axis=0)
    return vector / np.maximum(length, 1e-300), length


def _texture(key, place, normal, slope, ring):
    """Bump normals and make tangents (6, n): around the axis; where `ring` on the handles, along their rings.

    place, normal (3, n); slope (2, n) of the relief.
    """
    x, y, z = place
    none = np.zeros(len(x))
    tangent = np.where(ring, (78.0 - y, x - np.copysign(74.0, x), none), (-z, none, x))
    tangent, length = _across(tangent, normal)
    steep = abs(normal[0]) < 0.9
    tangent = np.where(length < 1e-9, _across(np.stack([steep, ~steep, none]), normal)[0], tangent)
    bump = -0.35 * slope
    for fine, (scale, strength) in enumerate(((6.0, 0.10), (1.3, 0.03))):
        for side in range(2):
            noise = solid_noise(key + np.uint64(80 + 2 * fine + side), x / scale, y / scale, z / scale)
            bump[1 - side] += strength * (noise - 0.5)
    bumped = normal + bump[0] * tangent + bump[1] * np.cross(normal, tangent, axis=0)
    bumped /= np.linalg.norm(bumped, axis=0)
    return np.concatenate([bumped, _across(tangent, bumped)[0]])


def _describe(parts, points, normals, key) -> np.ndarray:
    """Compute materials (NUMBERS, n) at points; parts (n, 6), points and normals (3, n)."""
    part, (x, y, z) = parts.argmin(axis=1), points
    m = np.zeros((SLOPE.stop, len(part)))
    m[8] = 0.22
    for number, paint in PAINTS.items():
        _within(m, part == number, paint, key, x, y, z)
    # Uneven enamel, dust, wear: no paint is even.
    uneven = solid_fractal(key, x / 24.0, y / 24.0, z / 24.0, 6)
    grain = solid_noise(key + np.uint64(20), x / 0.9, y / 0.9, z / 0.9)
    m[:3] = np.minimum(m[:3] * (0.62 + 0.62 * uneven + 0.07 * (grain - 0.5)), 0.9)
    m[6:8] *= 0.8 + 0.5 * solid_noise(key + np.uint64(21), x / 5.0, y / 5.0, z / 5.0)
    m[9:NUMBERS] = _texture(key, points, normals, m[SLOPE], part == HANDLES)
    return m[:NUMBERS]


def describe(parts: np.ndarray, points: np.ndarray, normals: np.ndarray, *, key: int) -> np.ndarray:
    """Compute materials (n, NUMBERS) float64 at points (n, 3), mm.

    parts (n, parts): distances from the parts; normals (n, 3): unit, of the smooth surface.
    """
    out = np.zeros((len(points), NUMBERS))

    def fill(start: int, stop: int, points: np.ndarray) -> None:
        for some in strips(stop - start, BATCH):
            some = slice(start + some.start, start + some.stop)
            out[some] = _describe(parts[some], points[some].T, normals[some].T, np.uint64(key)).T

    over_rows(fill, len(points), points)
    return out


def reflect(materials: np.ndarray, lights: np.ndarray, views: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute body and mirror reflection (n, 3) of materials (n, NUMBERS) for unit vectors to light and view (n, 3)."""
    m, normal, tangent = materials.T, materials[:, 9:12], materials[:, 12:15]
    frame = np.stack([tangent, np.cross(normal, tangent), normal])
    light, view, half = (np.einsum("anc,nc->an", frame, each) for each in (lights, views, lights + views))
    l_v = np.einsum("ij,ij->i", lights, views)
    length = np.sqrt(np.maximum(2.0 + 2.0 * l_v, 1e-12))
    matter = rough_matter(light[2], view[2], l_v, m[8], INDEX)
    shape = facets(half / length, light, view, m[6], m[7])
    cosine = np.clip((1.0 + l_v) / length, 0.0, 1.0)  # of the half vector with the view
    glass = dielectric_fresnel(cosine, INDEX)
    mirror = np.where(m[3] > 0.0, metal_fresnel(cosine, m[3:6]), glass)
    return (m[:3] * matter).T, (shape * mirror).T
