"""Build the yarns of a simulated cloth as solids along their paths, and intersect rays with them.

After Peirce, The geometry of cloth structure, J. Textile Institute 28(3), 1937: a yarn follows arcs round those that it
crosses and is straight between them. Floats may arch above.

The compiled functions take `Solids.numbers` (everything about the yarns in one row) and `Solids.free` (free distances
by voxel). x along the weft, y along the warp, z up; lengths in mm; the cloth is periodic in x and y. A yarn's section
in a plane across it is the set |ζ|² + |u|^e < 1 with u = v/a (v from the centre line) and ζ = (z − z_c − roll·v)/b.
"""

import math
from dataclasses import dataclass
from math import gcd

import numba
import numpy as np

from nishiki.errors import UserError
from nishiki.simulate.cloth.settings import ClothSettings, YarnSettings
from nishiki.simulate.randomness import subkey
from nishiki.threads import over_rows


def weave_pattern(weave: str, harness: int, step: int, *, face: str = "warp") -> np.ndarray:
    """Return (harness, harness) bool, row = weft yarn, column = warp yarn: True where the warp lies on top.

    plain : alternating. twill : the warp passes under one weft yarn a repeat, one place on with each yarn. satin : the
    same with a step that leaves no two bindings side by side; step and harness have no common factor. face : the yarns
    that are on top mostly.
    """
    if weave == "plain":
        return (np.add.outer(np.arange(2), np.arange(2)) % 2).astype(bool)
    step = 1 if weave == "twill" else step
    if weave == "satin" and (gcd(step, harness) != 1 or step % harness in (1, harness - 1)):
        raise UserError(
            f"simulation: a {harness}-harness satin: expected a step of 2 to {harness - 2} without common factor, "
            f"found {step}"
        )
    warp_up = np.ones((harness, harness), bool)
    yarns = np.arange(harness)
    warp_up[(step * yarns) % harness, yarns] = False
    return warp_up if face == "warp" else ~warp_up.T


SAMPLES = 96  # a crossing


@dataclass(frozen=True)
class Descent:
    """The way from one side to the other.

    Two arcs of angle `angle` (radians) and `radius`, and between them a straight part of length `straight`; width along
    the cloth, height from extreme to extreme. Lengths in mm.
    """

    width: float
    height: float
    angle: float
    radius: float
    straight: float


def make_descent(*, width: float, height: float, bend: float) -> Descent:
    """Make a descent. bend 0: no arcs, straight from corner to corner; 1: arcs only.

    2R sin θ + l cos θ = width and 2R(1 − cos θ) + l sin θ = height give R = (width − height/tan θ)/(2 tan(θ/2)).
    """
    steep = math.atan2(height, width)
    angle = steep * (1.0 + bend)
    radius = max(width - height / math.tan(angle), 0.0) / (2.0 * math.tan(0.5 * angle))
    straight = max(height - 2.0 * radius * (1.0 - math.cos(angle)), 0.0) / math.sin(angle)
    return Descent(width, height, angle, radius, straight)


def fall(descent: Descent, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute height (+height/2 .. −height/2) and slope at s along the cloth, measured from the descent's middle."""
    half, r = 0.5 * descent.width, descent.radius
    u = np.clip(half - np.abs(s), 0.0, None)  # from the nearer end
    on_arc = u < r * math.sin(descent.angle)
    inside = np.sqrt(np.maximum(r * r - np.minimum(u, r) ** 2, 1e-30))
    drop = np.where(on_arc, r - inside, 0.5 * descent.height - np.abs(s) * math.tan(descent.angle))
    slope = np.where(on_arc, -u / inside, -math.tan(descent.angle))
    level = np.abs(s) >= half
    height = np.where(level, 0.5 * descent.height, 0.5 * descent.height - drop)
    return -np.sign(s) * height, np.where(level, 0.0, slope)


def centre_line(on_top: np.ndarray, *, spacing: float, amplitude: float, bend: float, rest: float, arch: float):
    """Compute height and slope (crossings · SAMPLES,) of the centre line over a period, and the descent that it uses.

    on_top : (crossings,) bool, periodic. spacing : of the crossed yarns, mm. amplitude : height above the middle at a
    crossing, mm. rest : share of the spacing on which the yarn lies level. arch : steepest slope of the float's arch.
    """
    count = len(on_top)
    descent = make_descent(width=(1.0 - rest) * spacing, height=2.0 * amplitude, bend=bend)
    place = np.arange(count * SAMPLES) * (spacing / SAMPLES)
    period = count * spacing
    side = np.where(on_top, 1.0, -1.0)
    crossing = np.arange(count * SAMPLES) // SAMPLES
    height, slope = amplitude * side[crossing], np.zeros(len(place))
    changes = [k for k in range(count) if on_top[k] != on_top[k - 1]]
    for k in changes:
        s = (place - k * spacing + 0.5 * period) % period - 0.5 * period
        near = np.abs(s) <= 0.5 * spacing
        z, dz = fall(descent, s[near])
        sign = 1.0 if on_top[k - 1] else -1.0
        height[near], slope[near] = sign * z, sign * dz
    for first, last in zip(changes, [*changes[1:], *[k + count for k in changes[:1]]], strict=True):
        if on_top[first] and last - first > 1:
            length = (last - first) * spacing
            t = ((place - first * spacing) % period) / length
            u = 2.0 * np.clip(t, 0.0, 1.0) - 1.0
            # the arch (1 − u²)² is level at both ends; _STEEPEST is its steepest slope by t
            top = arch * length / _STEEPEST
            height = height + top * (1.0 - u * u) ** 2
            slope = slope + top / length * (-8.0 * u * (1.0 - u * u))
    return height, slope, descent


_STEEPEST = 16.0 / (3.0 * math.sqrt(3.0))


POWERS = 1024  # |u|^e is stored at so many steps of |u|
_BISECTIONS = 14  # halvings of a spacing


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _knots(along, length, yarn, system, numbers):
    """Find where the two samples of a path about a place begin in `numbers`, and the share of the second."""
    samples = int(numbers[system + 1])
    place = along / length * samples
    low = math.floor(place)
    first = low - samples * math.floor(low / samples)
    second = first + 1 if first + 1 < samples else 0
    start = int(numbers[system + 4]) + 4 * samples * yarn
    return start + 4 * first, start + 4 * second, place - low


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _in_yarn(v, along, z, spacing, length, system, numbers):
    """Find the yarn at sideways place v and place `along`; -1 where the point is in none."""
    slot, count = math.floor(v / spacing), int(numbers[system])
    yarn = slot - count * math.floor(slot / count)
    shape = int(numbers[system + 3]) + 3 * yarn
    u = v - (slot + 0.5) * spacing - numbers[shape]  # from the centre line
    side = abs(u) / numbers[shape + 1]
    if side >= 1.0:
        return -1
    k, n, f = _knots(along, length, yarn, system, numbers)
    height = numbers[k] + f * (numbers[n] - numbers[k])
    roll = numbers[k + 2] + f * (numbers[n + 2] - numbers[k + 2])
    zeta = (z - height - roll * u) / numbers[shape + 2]
    if zeta * zeta >= 1.0:
        return -1
    q = side * POWERS
    m = int(q)
    power = int(numbers[system + 5]) + m
    reach = numbers[power] + (q - m) * (numbers[power + 1] - numbers[power])
    return yarn if zeta * zeta + reach < 1.0 else -1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def inside(x, y, z, numbers):
    """Return 0 where (x, y, z) lies in no yarn, 1 + k in warp yarn k, −1 − k in weft yarn k."""
    k = _in_yarn(x, y, z, numbers[0], numbers[11] * numbers[1], 5, numbers)
    if k >= 0:
        return 1 + k
    k = _in_yarn(y, x, z, numbers[1], numbers[5] * numbers[0], 11, numbers)
    return -1 - k if k >= 0 else 0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _free_at(x, y, z, numbers, free):
    """Look up the distance (mm) that is free of yarns about a point between the lowest and the highest z."""
    k = int((z - numbers[2]) / (numbers[3] - numbers[2]) * free.shape[0])
    if k < 0 or k >= free.shape[0]:
        return 0.0
    u, v = x / (numbers[0] * numbers[5]), y / (numbers[1] * numbers[11])
    i, j = int((u - math.floor(u)) * free.shape[2]), int((v - math.floor(v)) * free.shape[1])
    return np.float64(free[k, min(j, free.shape[1] - 1), min(i, free.shape[2] - 1)])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def first_hit(x, y, z, dx, dy, dz, numbers, free):
    """Find the distance along a unit direction to the first yarn, and which (see `inside`); (−1, 0) if it meets none.

    Where yarns may be near, even steps of 0.12 thicknesses and a bisection: a chord shorter than a step may be missed,
    which is a penetration of less than 0.002 thicknesses.
    """
    low, high, step = numbers[2], numbers[3], numbers[4]
    t = 0.0
    if z > high:
        if dz >= 0.0:
            return -1.0, 0
        t = (high - z) / dz
    near = t
    while True:
        h = z + t * dz
        if (dz >= 0.0 and h > high) or (dz <= 0.0 and h < low):
            return -1.0, 0
        ahead = _free_at(x + t * dx, y + t * dy, h, numbers, free)
        if ahead < step:
            yarn = inside(x + t * dx, y + t * dy, h, numbers)
            if yarn != 0:
                break
            ahead = step
        near = t
        t += ahead
    far = t
    for _ in range(_BISECTIONS):
        middle = 0.5 * (near + far)
        other = inside(x + middle * dx, y + middle * dy, z + middle * dz, numbers)
        if other != 0:
            far, yarn = middle, other
        else:
            near = middle
    return near, yarn


@numba.njit(cache=True, nogil=True, error_model="numpy")
def escapes(x, y, z, dx, dy, dz, numbers, free):
    """Check whether the ray from a point in a unit direction with dz > 0 leaves the cloth."""
    high, step = numbers[3], numbers[4]
    while z <= high:
        ahead = _free_at(x, y, z, numbers, free)
        if ahead < step:
            if inside(x, y, z, numbers) != 0:
                return False
            ahead = step
        x, y, z = x + ahead * dx, y + ahead * dy, z + ahead * dz
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _yarn_frame(v, along, z, spacing, length, system, numbers):
    """Compute outward normal, not normalised (sideways, along, up), and slope of the yarn at a point of its surface."""
    slot, count = math.floor(v / spacing), int(numbers[system])
    yarn = slot - count * math.floor(slot / count)
    shape = int(numbers[system + 3]) + 3 * yarn
    u = v - (slot + 0.5) * spacing - numbers[shape]  # from the centre line
    a, b, exponent = numbers[shape + 1], numbers[shape + 2], numbers[system + 2]
    k, n, f = _knots(along, length, yarn, system, numbers)
    height = numbers[k] + f * (numbers[n] - numbers[k])
    slope = numbers[k + 1] + f * (numbers[n + 1] - numbers[k + 1])
    roll = numbers[k + 2] + f * (numbers[n + 2] - numbers[k + 2])
    turn = numbers[k + 3] + f * (numbers[n + 3] - numbers[k + 3])
    up = 2.0 * (z - height - roll * u) / (b * b)
    across = math.copysign(exponent * min(abs(u) / a, 1.0) ** (exponent - 1.0) / a, u) - up * roll
    return across, -up * (slope + turn * u), up, slope + turn * u


@numba.njit(cache=True, nogil=True, error_model="numpy")
def turned_frame(x, y, z, which, numbers, twist, f):
    """Fill f with the normal and the filament direction, which is the yarn's turned by the twist about the normal.

    `which` as in `inside`; twist of warp and weft in radians.
    """
    if which > 0:
        nx, ny, nz, slope = _yarn_frame(x, y, z, numbers[0], numbers[11] * numbers[1], 5, numbers)
        tx, ty, tz = 0.0, 1.0, slope
    else:
        ny, nx, nz, slope = _yarn_frame(y, x, z, numbers[1], numbers[5] * numbers[0], 11, numbers)
        tx, ty, tz = 1.0, 0.0, slope
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    nx, ny, nz = nx / length, ny / length, nz / length
    dot = nx * tx + ny * ty + nz * tz  # 0 up to rounding on the surface itself
    tx, ty, tz = tx - dot * nx, ty - dot * ny, tz - dot * nz
    length = math.sqrt(tx * tx + ty * ty + tz * tz)
    tx, ty, tz = tx / length, ty / length, tz / length
    angle = twist[0] if which > 0 else twist[1]
    c, s = math.cos(angle), math.sin(angle)
    bx, by, bz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
    f[0], f[1], f[2] = nx, ny, nz
    f[3], f[4], f[5] = c * tx + s * bx, c * ty + s * by, c * tz + s * bz


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_voxels(start, stop, sizes, numbers, empty):
    """Set 1 where the centre of a voxel (z, y, x) of these sizes lies in no yarn, for the layers start .. stop."""
    for k in range(start, stop):
        z = numbers[2] + (k + 0.5) * sizes[0]
        for j in range(empty.shape[1]):
            for i in range(empty.shape[2]):
                empty[k, j, i] = inside((i + 0.5) * sizes[2], (j + 0.5) * sizes[1], z, numbers) == 0


_STEP = 0.12  # of the thinner yarn's thickness
_ACROSS, _UP = 20, 28  # voxels a yarn, and in the cloth's height, of the map of free distances


@dataclass(frozen=True)
class Yarns:
    """The yarns of one system.

    spacing, length (a period along the yarn) in mm. shape : (yarns, 3) offset of the centre line sideways, half width
    a, half thickness b. path : (yarns, samples, 4) height of the centre line, its slope, roll (shear of the section)
    and its slope along the yarn. exponent : of the section. power : |u|^e at 0 .. 1.
    """

    spacing: float
    length: float
    shape: np.ndarray
    path: np.ndarray
    exponent: float
    power: np.ndarray
    descent: Descent


@dataclass(frozen=True)
class Solids:
    """Both systems of yarns."""

    warp: Yarns
    weft: Yarns
    pattern: np.ndarray  # (weft, warp) bool over the whole cell, True where the warp is on top
    free: np.ndarray  # (z, y, x) float32 mm, how far from a place in that voxel there is certainly no yarn

    @property
    def area(self) -> float:
        """Area of the cell on the plane, mm²."""
        return self.warp.length * self.weft.length

    @property
    def numbers(self) -> np.ndarray:
        """Arguments of the compiled functions beside `free`, in one row: see `_pack`."""
        return _pack(self.warp, self.weft)


_HEAD = 18  # numbers before those of the yarns


def _pack(warp: Yarns, weft: Yarns) -> np.ndarray:
    """Pack the yarns into one row of numbers.

    0, 1 spacing of warp and weft; 2, 3 lowest and highest z; 4 step of a ray. Then for warp (5 ..) and weft (11 ..):
    number of yarns, samples of a path, exponent, and the starts of shape, path and power. Compiled functions count the
    references of every array that they hand on, which costs more than the arithmetic.
    """
    tops = [y.shape[:, 2] + np.abs(y.path[..., 2]).max(axis=1) * y.shape[:, 1] for y in (warp, weft)]
    low = min(np.min(y.path[..., 0].min(axis=1) - top) for y, top in zip((warp, weft), tops, strict=True))
    high = max(np.max(y.path[..., 0].max(axis=1) + top) for y, top in zip((warp, weft), tops, strict=True))
    step = _STEP * 2.0 * min(warp.shape[:, 2].min(), weft.shape[:, 2].min())  # of a ray, mm
    parts, head, end = [], [warp.spacing, weft.spacing, low, high, step], _HEAD
    for yarns in (warp, weft):
        head += [len(yarns.shape), yarns.path.shape[1], yarns.exponent]
        for values in (yarns.shape, yarns.path, yarns.power):
            head.append(end)
            parts.append(values.ravel())
            end += values.size
    return np.concatenate([np.array([*head, 0.0]), *parts])


def make_solids(settings: ClothSettings) -> Solids:
    """Make the yarns of one irregular cell.

    At a crossing warp and weft touch: their amplitudes add up to the sum of their half thicknesses, `warp_crimp` of it
    being the warp's.
    """
    pattern = weave_pattern(settings.weave, settings.harness, settings.step, face=settings.face)
    pattern = np.tile(pattern, (settings.repeats, settings.repeats))
    contact = 0.5 * (settings.warp.thickness_mm + settings.weft.thickness_mm)
    warp, weft = settings.warp_crimp * contact, (1.0 - settings.warp_crimp) * contact
    random = np.random.default_rng(subkey(settings.seed, "cloth yarns"))
    systems = (
        _system(settings, settings.warp, settings.weft.spacing_mm, pattern.T, warp, random),
        _system(settings, settings.weft, settings.warp.spacing_mm, ~pattern, weft, random),
    )
    return Solids(*systems, pattern, _free_distances(*systems))


def _free_distances(warp: Yarns, weft: Yarns) -> np.ndarray:
    """Compute for every voxel a distance that is certainly free of yarn.

    It is the distance to the nearest voxel whose centre is in a yarn, less a voxel's diagonal: yarn reaches much less
    beyond such voxels, because sections are blunt.
    """
    from scipy.ndimage import distance_transform_edt

    counts = (_UP, len(weft.shape) * _ACROSS, len(warp.shape) * _ACROSS)
    numbers = _pack(warp, weft)
    sizes = np.array([(numbers[3] - numbers[2]) / _UP, weft.spacing / _ACROSS, warp.spacing / _ACROSS])
    empty = np.empty(counts, np.uint8)
    over_rows(fill_voxels, counts[0], sizes, numbers, empty)
    margin = _ACROSS  # distances beyond the cloth's height are of no use: the period need only be extended a little
    padded = np.pad(empty, ((0, 0), (margin, margin), (margin, margin)), mode="wrap")
    distance = distance_transform_edt(padded, sampling=sizes)[:, margin:-margin, margin:-margin]
    reach = 0.9 * margin * sizes[1:].min()
    return np.clip(distance - np.linalg.norm(sizes), 0.0, reach).astype(np.float32)


def _system(settings: ClothSettings, yarn: YarnSettings, crossed: float, on_top, amplitude: float, random) -> Yarns:
    count, crossings = on_top.shape
    paths = []
    for row in on_top:
        height, slope, descent = centre_line(
            row,
            spacing=crossed,
            amplitude=amplitude,
            bend=settings.bend,
            rest=settings.rest,
            arch=math.tan(math.radians(settings.arch_deg)),
        )
        paths.append(np.stack([height, slope], axis=-1))
    length = crossings * crossed
    waves = _waves(random, count, crossings * SAMPLES, length)
    uneven = settings.irregularity
    thickness, roll = 0.5 * yarn.thickness_mm, 0.05 * uneven
    path = np.concatenate([np.array(paths), roll * waves[1]], axis=-1)
    path[..., :2] += 0.04 * uneven * yarn.thickness_mm * waves[0]
    half = 0.5 * yarn.spacing_mm * yarn.fill
    free = 0.5 * yarn.spacing_mm - half
    shape = np.empty((count, 3))
    shape[:, 0] = np.clip(0.02 * uneven * yarn.spacing_mm * random.standard_normal(count), -0.9 * free, 0.9 * free)
    shape[:, 1] = np.minimum(half * (1.0 + 0.03 * uneven * random.uniform(-1.0, 1.0, count)), half + 0.1 * free)
    shape[:, 2] = thickness * (1.0 + 0.05 * uneven * random.uniform(-1.0, 1.0, count))
    power = np.linspace(0.0, 1.0, POWERS + 1) ** yarn.flatness
    return Yarns(yarn.spacing_mm, length, shape, path, yarn.flatness, power, descent)


def _waves(random, count: int, samples: int, length: float) -> np.ndarray:
    """Draw smooth periodic curves of variance about 1 and their slopes (2, count, samples, 2): a mean and two waves."""
    t = 2.0 * math.pi * np.arange(samples) / samples
    amplitude, phase = random.standard_normal((2, count, 3)), random.uniform(0.0, 2.0 * math.pi, (2, count, 3))
    curve = np.repeat(amplitude[..., :1, None], samples, axis=2)[..., 0] * 0.7
    slope = np.zeros_like(curve)
    for wave in (1, 2):
        a, p = amplitude[..., wave, None] * 0.7, phase[..., wave, None]
        curve = curve + a * np.cos(wave * t + p)
        slope = slope - a * wave * np.sin(wave * t + p) * (2.0 * math.pi / length)
    return np.stack([curve, slope], axis=-1)
