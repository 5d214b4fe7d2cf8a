"""Light that meets the yarns more than once: paths from point to point inside the cloth, traced once for all lamps.

A path is a chain of 2 to 4 points with what the inner points pass on; light that enters at one end and leaves at the
other is the product of two factors, one for the lamp's direction and one for the camera's. Either end may be the
lamp's, so that the result is reciprocal to the last bit but rounding.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np

from nishiki.simulate.cloth.filament import body, facets, in_frame
from nishiki.simulate.cloth.geometry import Solids
from nishiki.simulate.cloth.points import SurfacePoints, turned_frame
from nishiki.simulate.cloth.rays import first_hit
from nishiki.simulate.cloth.settings import ClothSettings
from nishiki.simulate.randomness import subkey, uniform
from nishiki.threads import over_rows


@dataclass(frozen=True)
class Ends:
    """One end of each chain. point : (n,) which of the surface points it is, -1 = none. place (n, 3) mm, frame (n, 6),
    kind (n,), toward (n, 3): unit direction to the next point."""

    point: np.ndarray
    place: np.ndarray
    frame: np.ndarray
    kind: np.ndarray
    toward: np.ndarray


@dataclass(frozen=True)
class Chains:
    """first, last : both ends. weight : (n, channels) area × π × what the inner points pass on, mm². order : (n,)
    number of points, 2 to 1 + bounces."""

    first: Ends
    last: Ends
    weight: np.ndarray
    order: np.ndarray


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
        _walk, count, np.uint64(subkey(settings.seed, "cloth walk")), points.place[chosen], points.frame[chosen],
        solids.numbers, solids.free, twist, lift, dye, surface, ends, toward, kind, weight,
    )  # fmt: skip
    walk, step = np.nonzero(kind >= 0)
    start = chosen[walk]
    first = Ends(start, points.place[start], points.frame[start], points.kind[start], toward[walk, step, :3])
    last_ends = ends[walk, step]
    none, kind = np.full(len(start), -1), kind[walk, step].astype(np.int64)
    last = Ends(none, last_ends[:, :3].copy(), last_ends[:, 3:].copy(), kind, toward[walk, step, 3:])
    return Chains(first, last, weight[walk, step] * (math.pi * share[-1] / count), step + 2)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _walk(start, stop, key, place, frame, numbers, free, twist, lift, dye, surface, ends, toward, kind, weight):
    f = np.empty(6)
    passed = np.empty(dye.shape[1])
    for w in range(start, stop):
        x, y, z = place[w]
        f[:] = frame[w]
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
                mirror = facets(ix, iy, iz, lx, ly, c, surface[k, 0], surface[k, 1], surface[k, 2])
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
            ends[w, step, 3:] = f
            toward[w, step, 0], toward[w, step, 1], toward[w, step, 2] = ox, oy, oz
            toward[w, step, 3], toward[w, step, 4], toward[w, step, 5] = bx, by, bz
            weight[w, step] = passed
