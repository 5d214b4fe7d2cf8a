"""Compute the BRDF of a simulated cloth: points that light and camera reach, by rays among yarns, and their reflection.

ρ(i, o) = 1/(A cosθ_i cosθ_o) ∫ V(i) V(o) (n·i)⁺ (n·o)⁺ f(i, o) dS over the yarns' surface above an area A, and the same
over paths that meet the yarns several times. Both parts are symmetric in i and o.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numba
import numpy as np

from nishiki.errors import require
from nishiki.simulate.cloth.geometry import Solids, escapes, make_solids
from nishiki.simulate.cloth.points import Chains, SurfacePoints, make_chains, make_points
from nishiki.simulate.cloth.settings import ClothSettings
from nishiki.simulate.randomness import GOLDEN_RATIO
from nishiki.simulate.reflection import body, in_frame, reflect_filament
from nishiki.threads import over_rows

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
