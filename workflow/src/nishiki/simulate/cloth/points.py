"""Choose points of the yarns' surface that light can reach, and trace paths between them.

A path is a chain of 2 to 4 points with what the inner points pass on; light that enters at one end and leaves at the
other is the product of two factors, one for the lamp's direction and one for the camera's. Either end may be the
lamp's, so that the result is reciprocal to the last bit but rounding.
"""

import math
from dataclasses import dataclass

import numba
import numpy as np

from nishiki.simulate.cloth.geometry import Solids, Yarns, escapes, first_hit, inside, turned_frame
from nishiki.simulate.cloth.settings import ClothSettings
from nishiki.simulate.randomness import subkey, uniform
from nishiki.simulate.reflection import body, in_frame, reflect_filament
from nishiki.threads import over_rows

R2 = (0.7548776662466927, 0.5698402909980532)  # Roberts' sequence in two dimensions: 1/p, 1/p², p³ = p + 1
_LEVELS_DEG = (2.0, 6.0, 15.0, 40.0, 75.0)  # elevation of the directions that test how free a point lies
_EVERY = (1, 1, 2, 3, 3)  # of the points that are reached first at that level one in so many is kept
_AZIMUTHS = 8  # directions around a point
_LIFT = 2e-3  # of the spacing: rays start so far above the surface


@dataclass(frozen=True)
class SurfacePoints:
    """Points of the yarns' surface."""

    place: np.ndarray  # (n, 3) mm, a little above the surface
    frame: np.ndarray  # (n, 6) normal and filament direction
    area: np.ndarray  # (n,) mm²
    kind: np.ndarray  # (n,) 0 warp, 1 weft


def make_points(solids: Solids, settings: ClothSettings, *, candidates: int) -> SurfacePoints:
    """Choose points among `candidates` that are spread evenly over all sides of all yarns.

    What the lowest of 40 directions reaches, at the tops, is all that light at grazing angles meets, and is little: all
    its points are kept, of others one in 2 or 3, which then stands for the area of as many. Points that no direction
    reaches are left out (they are inside of yarns that touch, or below the cloth).
    """
    systems = (solids.warp, solids.weft)
    sizes = [len(yarns.shape) * yarns.length * _contour(yarns.exponent, yarns.shape[0])[2] for yarns in systems]
    random = np.random.default_rng(subkey(settings.seed, "cloth points"))
    parts = []
    for kind, (yarns, size) in enumerate(zip(systems, sizes, strict=True)):
        each = max(int(candidates * size / sum(sizes) / len(yarns.shape)), 16)
        parts += [_on_yarn(yarns, yarn, kind, each, random) for yarn in range(len(yarns.shape))]
    place, area, which = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    frame = np.empty((len(place), 6))
    twist = np.radians([settings.warp.twist_deg, settings.weft.twist_deg])
    lift = _LIFT * min(settings.warp.spacing_mm, settings.weft.spacing_mm)
    level = np.empty(len(place), np.uint8)
    over_rows(
        _finish, len(place), place, which, (solids.numbers, solids.free, twist, lift), (probes(), _AZIMUTHS), frame,
        level,
    )  # fmt: skip
    kept = []
    for number, every in enumerate(_EVERY):
        some = np.flatnonzero(level == number)
        if len(some) < 8 * every:
            every = 1
        kept.append(some[random.integers(every) :: every])
        area[some] *= len(some) / max(len(kept[-1]), 1)
    kept = np.sort(np.concatenate(kept))
    return SurfacePoints(place[kept], frame[kept], area[kept], np.where(which[kept] > 0, 0, 1))


def probes() -> np.ndarray:
    """Return directions (40, 3): rings of 8 azimuths, the lowest first; each second ring is turned by half a step."""
    rings = []
    for number, level in enumerate(np.radians(_LEVELS_DEG)):
        turn = 2.0 * math.pi / _AZIMUTHS * (np.arange(_AZIMUTHS) + 0.5 * (number % 2))
        z = np.full(_AZIMUTHS, math.sin(level))
        rings.append(np.column_stack([math.cos(level) * np.cos(turn), math.cos(level) * np.sin(turn), z]))
    return np.concatenate(rings)


def _contour(exponent: float, shape: np.ndarray, steps: int = 720):
    """Trace (u, ζ) round a section, finely, with the length (mm) from the start, and the whole length."""
    angle = np.linspace(0.0, 2.0 * math.pi, steps + 1)
    u = np.cos(angle)
    zeta = np.sign(np.sin(angle)) * np.sqrt(np.maximum(1.0 - np.abs(u) ** exponent, 0.0))
    zeta[[0, steps // 2, steps]] = 0.0
    length = np.concatenate([[0.0], np.cumsum(np.hypot(shape[1] * np.diff(u), shape[2] * np.diff(zeta)))])
    return np.column_stack([u, zeta]), length, length[-1]


def _on_yarn(yarns: Yarns, yarn: int, kind: int, count: int, random):
    """Compute points (count, 3), areas and `which` (see geometry.inside) of one yarn."""
    contour, length, total = _contour(yarns.exponent, yarns.shape[yarn])
    start = random.uniform(0.0, 1.0, 2)
    index = np.arange(count)
    s, t = ((start[axis] + index * R2[axis]) % 1.0 for axis in range(2))
    offset, a, b = yarns.shape[yarn]
    u, zeta = (np.interp(s * total, length, contour[:, axis]) for axis in range(2))
    # Rate along the contour from the neighbours, half a degree on either side.
    ahead = [np.interp((s * total + step) % total, length, contour[:, 0]) for step in (-total / 720, total / 720)]
    rate_v = np.clip(a * (ahead[1] - ahead[0]) / (2.0 * total / 720), -1.0, 1.0)
    zeta = np.sign(zeta) * np.sqrt(np.maximum(1.0 - np.abs(u) ** yarns.exponent, 0.0))
    samples = yarns.path.shape[1]
    place = t * samples
    low = np.floor(place).astype(int) % samples
    f = (place - np.floor(place))[:, None]
    height, slope, roll, turn = (yarns.path[yarn, low] * (1 - f) + yarns.path[yarn, (low + 1) % samples] * f).T
    v, rise = a * u, slope + turn * a * u
    # Sides of the area element: (v', 0, z') along the contour and (0, 1, rise) along the yarn.
    up = np.sqrt(1.0 - rate_v**2) * np.where(u > 0.0, 1.0, -1.0) + roll * rate_v
    area = np.sqrt(up**2 + rate_v**2 * (1.0 + rise**2)) * total * yarns.length / count
    sideways = (yarn + 0.5) * yarns.spacing + offset + v
    along, z = t * yarns.length, height + roll * v + b * zeta
    columns = (sideways, along, z) if kind == 0 else (along, sideways, z)
    return np.column_stack(columns), area, np.full(count, 1 + yarn if kind == 0 else -1 - yarn)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _finish(start, stop, place, which, solids, probes, frame, level):
    """Compute frames and lift points above the surface. level : lowest ring that reaches the point, 255 = none."""
    (numbers, free, twist, lift), (directions, azimuths) = solids, probes
    for p in range(start, stop):
        f = frame[p]
        turned_frame(place[p, 0], place[p, 1], place[p, 2], which[p], numbers, twist, f)
        for axis in range(3):
            place[p, axis] += lift * f[axis]
        x, y, z = place[p, 0], place[p, 1], place[p, 2]
        level[p] = 255
        if inside(x, y, z, numbers) != 0:
            continue
        for k in range(directions.shape[0]):
            dx, dy, dz = directions[k, 0], directions[k, 1], directions[k, 2]
            if f[0] * dx + f[1] * dy + f[2] * dz > 0.0 and escapes(x, y, z, dx, dy, dz, numbers, free):
                level[p] = k // azimuths
                break


@dataclass(frozen=True)
class Ends:
    """One end of each chain."""

    point: np.ndarray  # (n,) which of the surface points it is, -1 = none
    place: np.ndarray  # (n, 3) mm
    frame: np.ndarray  # (n, 6)
    kind: np.ndarray  # (n,)
    toward: np.ndarray  # (n, 3): unit direction to the next point


@dataclass(frozen=True)
class Chains:
    """Random walks."""

    first: Ends  # first, last: both ends
    last: Ends
    weight: np.ndarray  # (n, channels) area × π × transmission of the inner points, mm²
    order: np.ndarray  # (n,) number of points, 2 to 1 + bounces


def make_chains(solids: Solids, points: SurfacePoints, settings: ClothSettings, *, count: int, bounces: int) -> Chains:
    """Trace `count` random walks of up to `bounces` further meetings from points chosen by their area.

    The walk leaves each point by the cosine law, so that one more point multiplies the weight by π f.
    """
    random = np.random.default_rng(subkey(settings.seed, "cloth chains"))
    share = np.cumsum(points.area)
    chosen = np.searchsorted(share, (np.arange(count) + random.uniform()) / count * share[-1], side="right")
    chosen = np.minimum(chosen, len(points.area) - 1)
    dye = np.array([settings.warp.dye, settings.weft.dye])
    surface = np.array([[y.along, y.across, settings.index] for y in (settings.warp, settings.weft)])
    twist = np.radians([settings.warp.twist_deg, settings.weft.twist_deg])
    lift = 2e-3 * min(settings.warp.spacing_mm, settings.weft.spacing_mm)
    shape = (count, bounces)
    ends, toward = np.zeros((*shape, 9)), np.zeros((*shape, 6))
    kind, weight = np.full(shape, -1, np.int8), np.zeros((*shape, dye.shape[1]))
    over_rows(
        _walk, count, np.uint64(subkey(settings.seed, "cloth walk")), (points.place[chosen], points.frame[chosen]),
        (solids.numbers, solids.free, twist, lift), (dye, surface), (ends, toward, kind, weight),
    )  # fmt: skip
    walk, step = np.nonzero(kind >= 0)
    start = chosen[walk]
    first = Ends(start, points.place[start], points.frame[start], points.kind[start], toward[walk, step, :3])
    last_ends = ends[walk, step]
    none, kind = np.full(len(start), -1), kind[walk, step].astype(np.int64)
    last = Ends(none, last_ends[:, :3].copy(), last_ends[:, 3:].copy(), kind, toward[walk, step, 3:])
    return Chains(first, last, weight[walk, step] * (math.pi * share[-1] / count), step + 2)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _walk(start, stop, key, points, solids, cloth, out):
    (place, frame), (numbers, free, twist, lift), (dye, surface) = points, solids, cloth
    ends, toward, kind, weight = out
    f = np.empty(6)
    passed = np.empty(dye.shape[1])
    for w in range(start, stop):
        x, y, z = place[w]
        for k in range(6):  # not f[:] = frame[w], for whose errors numba compiles the printing of numbers
            f[k] = frame[w, k]
        passed[:] = 1.0
        bx = by = bz = 0.0  # direction back to the last point
        k = 0
        for step in range(kind.shape[1]):
            place_in_key = np.uint64(2 * (w * 8 + step))
            a, b = uniform(key, place_in_key), uniform(key, place_in_key + np.uint64(1))
            r, turn, c = math.sqrt(a), 2.0 * math.pi * b, math.sqrt(1.0 - a)
            lx, ly = r * math.cos(turn), r * math.sin(turn)
            ux, uy, uz = f[1] * f[5] - f[2] * f[4], f[2] * f[3] - f[0] * f[5], f[0] * f[4] - f[1] * f[3]
            dx, dy, dz = lx * f[3] + ly * ux + c * f[0], lx * f[4] + ly * uy + c * f[1], lx * f[5] + ly * uz + c * f[2]
            if step == 0:
                ox, oy, oz = dx, dy, dz
            else:
                ix, iy, iz = in_frame(bx, by, bz, f)
                mirror = reflect_filament((ix, iy, iz), (lx, ly, c), surface[k])
                white = body(iz, c, surface[k, 2])
                for channel in range(passed.shape[0]):
                    passed[channel] *= math.pi * (mirror + dye[k, channel] * white)
            t, which = first_hit(x, y, z, dx, dy, dz, numbers, free)
            if which == 0:
                break
            x, y, z = x + t * dx, y + t * dy, z + t * dz
            turned_frame(x, y, z, which, numbers, twist, f)
            k = 0 if which > 0 else 1
            bx, by, bz = -dx, -dy, -dz
            x, y, z = x + lift * f[0], y + lift * f[1], z + lift * f[2]
            if f[0] * bx + f[1] * by + f[2] * bz <= 0.0:
                break  # met from inside, where two yarns touch
            kind[w, step] = k
            ends[w, step, 0], ends[w, step, 1], ends[w, step, 2] = x, y, z
            for axis in range(6):
                ends[w, step, 3 + axis] = f[axis]
            toward[w, step, 0], toward[w, step, 1], toward[w, step, 2] = ox, oy, oz
            toward[w, step, 3], toward[w, step, 4], toward[w, step, 5] = bx, by, bz
            for channel in range(passed.shape[0]):
                weight[w, step, channel] = passed[channel]
