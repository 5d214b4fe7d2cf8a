"""Compute the BRDF of a simulated cloth: points that light and camera reach, by rays among yarns, and their reflection.

ρ(i, o) = 1/(A cosθ_i cosθ_o) ∫ V(i) V(o) (n·i)⁺ (n·o)⁺ f(i, o) dS over the yarns' surface above an area A, and the same
over paths that meet the yarns several times. Both parts are symmetric in i and o.

A path is a chain of 2 to 4 points with what the inner points pass on; light that enters at one end and leaves at the
other is the product of two factors, one for the lamp's direction and one for the camera's. Either end may be the
lamp's, so that the result is reciprocal to the last bit but rounding.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numba
import numpy as np

from nishiki.errors import require
from nishiki.simulate.cloth.geometry import Solids, Yarns, escapes, first_hit, inside, make_solids, turned_frame
from nishiki.simulate.cloth.settings import ClothSettings
from nishiki.simulate.randomness import GOLDEN_RATIO, subkey, uniform
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


_DIRECTIONS = 64  # held at a time
_STRONG = 0.05  # ends that pass on less than this (1/sr) are traced by lot, at least one in
_LOT = 8.0
BINS_A_YARN = 2  # of the openness


@dataclass(frozen=True)
class SimulatedCloth:
    """A cloth ready to be lit: its settings, solids, the points of its surface, and the paths between them."""

    settings: ClothSettings
    solids: Solids
    points: SurfacePoints
    chains: Chains | None

    @property
    def dye(self) -> np.ndarray:
        """(2, channels) albedo of the body of warp and weft."""
        return np.array([self.settings.warp.dye, self.settings.weft.dye])

    @property
    def surface(self) -> np.ndarray:
        """(2, 3) roughness along and across the filaments, and refractive index, of warp and weft."""
        s = self.settings
        return np.array([[yarn.along, yarn.across, s.index] for yarn in (s.warp, s.weft)])


def make_cloth(
    settings: ClothSettings, *, candidates: int = 150_000, chains: int = 60_000, bounces: int = 2
) -> SimulatedCloth:
    """Make yarns, points and paths.

    candidates: points before unreachable ones are dropped. chains: random walks. bounces: further meetings of light and
    yarns, 0 to 3.
    """
    solids = make_solids(settings)
    points = make_points(solids, settings, candidates=candidates)
    paths = make_chains(solids, points, settings, count=chains, bounces=bounces) if bounces and chains else None
    return SimulatedCloth(settings, solids, points, paths)


def trace(settings: ClothSettings | SimulatedCloth, incident, outgoing, **quality) -> np.ndarray:
    """Compute the BRDF (n, channels) in 1/sr for pairs of directions; `quality` as in `make_cloth`.

    incident, outgoing : (n, 3) or (3,) unit vectors away from the cloth, x along the weft, y along the warp, z up.
    0 where either is not above the horizon. Deterministic: the same settings give the same values.
    """
    cloth = settings if isinstance(settings, SimulatedCloth) else make_cloth(settings, **quality)
    incident, outgoing = np.broadcast_arrays(
        np.atleast_2d(np.asarray(incident, float)), np.atleast_2d(np.asarray(outgoing, float))
    )
    values = np.zeros((len(incident), cloth.dye.shape[1]))
    for rows, lamps, views, index in blocks(cloth, incident, outgoing):
        values[rows] = cell_maps(cloth, lamps, views, index).mean(axis=(1, 2))
    return values


def blocks(cloth: SimulatedCloth, incident: np.ndarray, outgoing: np.ndarray) -> Iterator[tuple]:
    """Yield blocks of pairs of directions (n, 3) that share their rays: (rows, lamps, views, index).

    rows of the pairs, reach of their lamps and views, and the combinations of these, (pairs, 2). Pairs with a direction
    not above the horizon are dropped.
    """
    up = np.flatnonzero((incident[:, 2] > 1e-6) & (outgoing[:, 2] > 1e-6))
    lamps, lamp = _distinct(incident[up])
    views, view = _distinct(outgoing[up])
    for first in range(0, len(lamps), _DIRECTIONS):
        of_lamps = (lamp >= first) & (lamp < first + _DIRECTIONS)
        from_lamps = trace_reach(cloth, lamps[first : first + _DIRECTIONS])
        for other in range(0, len(views), _DIRECTIONS):
            pairs = np.flatnonzero(of_lamps & (view >= other) & (view < other + _DIRECTIONS))
            if len(pairs):
                to_views = trace_reach(cloth, views[other : other + _DIRECTIONS])
                yield up[pairs], from_lamps, to_views, np.column_stack([lamp[pairs] - first, view[pairs] - other])


def _distinct(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the different directions (to 1e-9), and their number for each row."""
    _, first, index = np.unique(np.round(directions, 9), axis=0, return_index=True, return_inverse=True)
    return np.ascontiguousarray(directions[first]), index.reshape(-1)


@dataclass(frozen=True)
class Reach:
    """The reach of directions (d, 3)."""

    directions: np.ndarray
    lit: np.ndarray  # (d, points) float32, n·d where the point is reached, else 0
    # first, last (d, channels, chains) float32, or None: light that enters a path at either end
    first: np.ndarray | None
    last: np.ndarray | None


def trace_reach(cloth: SimulatedCloth, directions: np.ndarray) -> Reach:
    """Trace rays from all points, and from the ends of all paths, in some directions."""
    directions = np.ascontiguousarray(directions)
    points, chains = cloth.points, cloth.chains
    lit = np.empty((len(directions), len(points.area)), np.float32)
    over_rows(
        _reach, len(directions), directions, points.place, points.frame, cloth.solids.numbers, cloth.solids.free, lit
    )
    if chains is None:
        return Reach(directions, lit, None, None)
    entering = np.empty((2, len(directions), cloth.dye.shape[1], len(chains.first.kind)), np.float32)
    for ends, out in zip((chains.first, chains.last), entering, strict=True):
        over_rows(
            _ends, len(directions), (directions, lit), (ends.point, ends.place, ends.frame, ends.kind, ends.toward),
            (cloth.solids.numbers, cloth.solids.free), (cloth.surface, cloth.dye), out,
        )  # fmt: skip
    return Reach(directions, lit, *entering)


def cell_maps(cloth: SimulatedCloth, lamps, views, index: np.ndarray) -> np.ndarray:
    """Map the BRDF in the camera's view over one period of the cloth: (pairs, bins in y, bins in x, channels), 1/sr.

    A point is seen where its line of sight meets the plane z = 0. Light that met the yarns more than once is
    spread evenly. The mean over the bins is the BRDF.
    """
    solids, points = cloth.solids, cloth.points
    shape = (BINS_A_YARN * len(solids.weft.shape), BINS_A_YARN * len(solids.warp.shape))
    cell = np.array([solids.weft.length, solids.warp.length])
    maps = np.zeros((len(index), *shape, cloth.dye.shape[1]))
    over_rows(
        _bin, len(index), index, (lamps.directions, views.directions, lamps.lit, views.lit),
        (points.place, points.frame, points.area, points.kind), (cloth.surface, cloth.dye), cell, maps,
    )  # fmt: skip
    maps *= shape[0] * shape[1]
    maps += sum_bounces(cloth, lamps, views, index)[:, None, None]
    cosines = lamps.directions[index[:, 0], 2] * views.directions[index[:, 1], 2]
    return maps / (solids.area * cosines[:, None, None, None])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _bin(start, stop, index, directions, points, cloth, cell, maps):
    (lamps, views, lit, seen), (place, frame, area, kind), (surface, dye) = directions, points, cloth
    rows, columns, channels = maps.shape[1:]
    for n in range(start, stop):
        lamp, view = index[n, 0], index[n, 1]
        sx, sy, sz = lamps[lamp, 0], lamps[lamp, 1], lamps[lamp, 2]
        tx, ty, tz = views[view, 0], views[view, 1], views[view, 2]
        for p in range(area.shape[0]):
            share = np.float64(lit[lamp, p]) * np.float64(seen[view, p]) * area[p]
            if share > 0.0:
                f, k = frame[p], kind[p]
                ix, iy, iz = in_frame(sx, sy, sz, f)
                ox, oy, oz = in_frame(tx, ty, tz, f)
                mirror = reflect_filament((ix, iy, iz), (ox, oy, oz), surface[k])
                white = body(iz, oz, surface[k, 2])
                u = (place[p, 0] - place[p, 2] * tx / tz) / cell[0]
                v = (place[p, 1] - place[p, 2] * ty / tz) / cell[1]
                i = min(int((u - math.floor(u)) * columns), columns - 1)
                j = min(int((v - math.floor(v)) * rows), rows - 1)
                for channel in range(channels):
                    maps[n, j, i, channel] += share * (mirror + dye[k, channel] * white)


def sum_bounces(cloth: SimulatedCloth, lamps: Reach, views: Reach, index: np.ndarray) -> np.ndarray:
    """Sum light that met the yarns more than once, (pairs, channels) mm²/sr.

    Both ends of every path take turns as the lamp's. Over the cell's area and both cosines it is a BRDF.
    """
    out = np.zeros((len(index), cloth.dye.shape[1]))
    if cloth.chains is None:
        return out
    of_lamps, of_views = ((require(reach.first), require(reach.last)) for reach in (lamps, views))
    for channel in range(out.shape[1]):
        weight = (0.5 * cloth.chains.weight[:, channel]).astype(np.float32)
        matrix = (of_lamps[0][:, channel] * weight) @ of_views[1][:, channel].T
        matrix += (of_lamps[1][:, channel] * weight) @ of_views[0][:, channel].T
        out[:, channel] = matrix[index[:, 0], index[:, 1]]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _reach(start, stop, directions, place, frame, numbers, free, lit):
    for d in range(start, stop):
        dx, dy, dz = directions[d, 0], directions[d, 1], directions[d, 2]
        for p in range(place.shape[0]):
            cosine = frame[p, 0] * dx + frame[p, 1] * dy + frame[p, 2] * dz
            if cosine > 0.0 and escapes(place[p, 0], place[p, 1], place[p, 2], dx, dy, dz, numbers, free):
                lit[d, p] = cosine
            else:
                lit[d, p] = 0.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _ends(start, stop, lamps, ends, solids, cloth, out):
    """Compute the light that enters each path from each direction.

    Where the end is a surface point its ray is reused. Weak other ends are drawn by lot and count for more in turn: the
    same ones in all directions, so that nothing flickers.
    """
    (directions, lit), (point, place, frame, kind, toward) = lamps, ends
    (numbers, free), (surface, dye) = solids, cloth
    for d in range(start, stop):
        dx, dy, dz = directions[d, 0], directions[d, 1], directions[d, 2]
        for p in range(place.shape[0]):
            out[d, :, p] = 0.0
            f, k, share = frame[p], kind[p], 1.0
            ix, iy, iz = in_frame(dx, dy, dz, f)
            if iz <= 0.0 or (point[p] >= 0 and lit[d, point[p]] == 0.0):
                continue
            ox, oy, oz = in_frame(toward[p, 0], toward[p, 1], toward[p, 2], f)
            mirror = reflect_filament((ix, iy, iz), (ox, oy, oz), surface[k])
            if point[p] < 0:
                share = min(max(iz * mirror / _STRONG, 1.0 / _LOT), 1.0)
                if p * GOLDEN_RATIO - math.floor(p * GOLDEN_RATIO) >= share:
                    continue
                if not escapes(place[p, 0], place[p, 1], place[p, 2], dx, dy, dz, numbers, free):
                    continue
            white = body(iz, oz, surface[k, 2])
            for channel in range(out.shape[1]):
                out[d, channel, p] = iz * (mirror + dye[k, channel] * white) / share
