"""What is asked of the renderer (a camera, captured views and their weights), what it gives, and what it works on."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from nishiki.codec.store import CodedTexels
from nishiki.geometry.camera import Camera
from nishiki.geometry.camera_path import CameraPath
from nishiki.geometry.raster import Raster

Method = Literal["nearest", "linear", "cubic"]


@dataclass(frozen=True)
class Neighbours:
    """views (n,) int: captured views that take part, and their weights (n,) float64, which sum to 1."""

    views: np.ndarray
    weights: np.ndarray


def neighbours(
    turn: CameraPath, position: float, *, method: Method = "linear", without: frozenset[int] = frozenset()
) -> Neighbours:
    """The captured views around `position` (radians along the path) and their weights.

    linear: the two nearest, one to each side (the form of Miyazaki et al. 2007, section 4.3.3).  cubic: four, by the
    polynomial through them (Lagrange), which is exact for residuals that change up to the third power of the angle.
    nearest: one.
    without: views that may not take part (left out, or the one that is to be predicted).  At the ends of an open path
    the last views take the place of missing ones.
    """
    usable = np.array([k for k in range(len(turn.position)) if k not in without], int)
    if not len(usable):
        raise ValueError("expected at least one captured view, found none")
    offset = turn.position[usable] - position
    if turn.closed:
        offset = (offset + 0.5 * turn.length) % turn.length - 0.5 * turn.length
    order = np.argsort(offset, kind="stable")
    usable, offset = usable[order], offset[order]
    exact = np.flatnonzero(np.abs(offset) <= 1e-9 * max(turn.length, 1e-300))
    if len(exact) or method == "nearest" or len(usable) == 1:
        best = int(exact[0]) if len(exact) else int(np.argmin(np.abs(offset)))
        return Neighbours(usable[best : best + 1], np.ones(1))
    each = 2 if method == "cubic" else 1
    chosen = surrounding(offset, each, closed=turn.closed, length=turn.length)
    views, places = usable[chosen[0]], chosen[1]
    return Neighbours(views, lagrange(places))


def surrounding(offset: np.ndarray, each: int, *, closed: bool, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Indexes and offsets of the `each` views before and after 0 in sorted offsets; round the turn where closed."""
    count = len(offset)
    each = min(each, count // 2) if count > 1 else 1
    first = int(np.searchsorted(offset, 0.0))
    if closed:
        raw = np.arange(first - each, first + each)
        return raw % count, offset[raw % count] + length * (raw // count)
    start = min(max(first - each, 0), count - 2 * each)
    if first in (0, count):  # beyond the ends: no extrapolation
        nearest = 0 if first == 0 else count - 1
        return np.array([nearest]), offset[[nearest]]
    raw = np.arange(start, start + 2 * each)
    return raw, offset[raw]


def lagrange(places: np.ndarray) -> np.ndarray:
    """Weights (n,) of values at distinct places (n,) for the value at 0 of the polynomial through them."""
    weights = np.ones(len(places))
    for i, here in enumerate(places):
        for j, there in enumerate(places):
            if i != j:
                weights[i] *= -there / (here - there)
    return weights


@dataclass(frozen=True)
class Shot:
    """One picture to make: from `camera`, with the residual of captured views (and for pixels that not all of them
    see, `fallback`), under lights with weights L_j / L."""

    camera: Camera
    views: Neighbours
    fallback: Neighbours
    lights: tuple[tuple[int, float], ...] = ((0, 1.0),)


@dataclass(frozen=True)
class ObjectPicture:
    """linear (rows, columns, channels) float32, 0 where nothing is shown; covered (rows, columns) bool: pixel centres
    on the surface; reached: covered, or carried on beyond the edge by `rim` pixels; triangle, barycentric: what the
    pixels show (see `nishiki.geometry.raster.Raster`); depth (rows, columns) float32, +inf where not covered."""

    linear: np.ndarray
    covered: np.ndarray
    reached: np.ndarray
    triangle: np.ndarray
    barycentric: np.ndarray
    depth: np.ndarray


def lit_by(shot: Shot, lights: tuple[tuple[int, float], ...]) -> Shot:
    """The same picture under a sum of captured lights (index, L_j / L) (Miyazaki et al. 2007, eq. 13 to 15)."""
    return replace(shot, lights=lights)


@dataclass
class Prepared:
    """A shot whose pixels are sorted by the tiles they look into."""

    shot: Shot
    raster: Raster
    pixels: np.ndarray  # flat indexes of covered pixels
    s: np.ndarray
    t: np.ndarray
    slots: dict[int, int]  # tile -> place in `first`
    first: np.ndarray
    order: np.ndarray
    lamps: list  # of the shot's lights, as this camera has them
    values: np.ndarray = field(init=False)  # (lights, parts, pixels, channels): in the capture's encoding

    @cached_property
    def mixture(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Views (n,) int64 whose residual takes part, their weights and fallback weights (n,) float32."""
        shot = self.shot
        views = np.union1d(shot.views.views, shot.fallback.views).astype(np.int64)
        weights, fallback = (
            np.array([n.weights[n.views == v].sum() for v in views], np.float32) for n in (shot.views, shot.fallback)
        )
        return views, weights, fallback


@dataclass(frozen=True)
class Tile:
    """A tile as the renderer reads it, its texels in one row: kd, ks (T * T, channels) and sigma (T * T,); positions,
    normals (T * T, 3); residual: of each part, or None."""

    parameters: tuple[np.ndarray, np.ndarray, np.ndarray]
    positions: np.ndarray
    normals: np.ndarray
    residual: tuple[CodedTexels, ...] | None

    @property
    def nbytes(self) -> int:
        """Size of the arrays."""
        arrays = (*self.parameters, self.positions, self.normals, *(self.residual or ()))
        return sum(values.nbytes for values in arrays)
