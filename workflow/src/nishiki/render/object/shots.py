"""What is asked of the renderer, what it gives, and what it works on in between."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from nishiki.geometry.camera import Camera
from nishiki.geometry.raster import Raster
from nishiki.render.object.interpolation import Neighbours


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
    normals (T * T, 3); residual: (M, T * T, channels) of each part, or None."""

    parameters: tuple[np.ndarray, np.ndarray, np.ndarray]
    positions: np.ndarray
    normals: np.ndarray
    residual: tuple[np.ndarray, ...] | None

    @property
    def nbytes(self) -> int:
        """Size of the arrays."""
        arrays = (*self.parameters, self.positions, self.normals, *(self.residual or ()))
        return sum(values.nbytes for values in arrays)
