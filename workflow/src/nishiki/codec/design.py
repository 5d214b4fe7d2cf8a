"""Fix the agreement of encoder and decoder: the header of a store, the coded extent and the axis of views.

A tile is seen from an arc of the turn. Views outside the arc cost nothing: they are not in the block. Gaps inside
it (held-out views, occlusion) are invisible samples, which the solver fills.
"""

from dataclasses import dataclass, field, fields
from functools import lru_cache

import numpy as np

from nishiki.codec.transform import Block, PlaneTransform, analysis_matrix, cosine_matrix, levels_of, plane_transform
from nishiki.errors import UserError
from nishiki.formats.stored import PlainFields


def visible_arc(seen: np.ndarray, *, full_turn: bool) -> tuple[int, int]:
    """Find first view and number of views of the shortest arc that holds every seen view.

    seen (views,) bool. full_turn: the last view neighbours the first, so that an arc may pass the end. (0, 0) where
    nothing is seen; the lowest start where two arcs are equally short.
    """
    views = len(seen)
    at = np.flatnonzero(seen)
    if not len(at):
        return 0, 0
    if not full_turn:
        return int(at[0]), int(at[-1] - at[0] + 1)
    gaps = np.diff(np.append(at, at[0] + views))
    widest = int(np.argmax(gaps))
    start = int(at[(widest + 1) % len(at)])
    return start, int(views - gaps[widest] + 1)


def arc_views(start: int, length: int, views: int) -> np.ndarray:
    """List the views (length,) int64 of an arc, in the order of the turn."""
    return (start + np.arange(length)) % views


@lru_cache(maxsize=512)
def view_matrix(kind: str, length: int) -> np.ndarray:
    """Make the basis (length, length) float64 orthonormal; rows are basis vectors, lowest frequency first.

    kind: "cosine" (DCT-II), "none", or the name of an orthonormal wavelet: as many levels as `length` allows, an odd
    coarsest band goes on with a DCT.
    Raises UserError for a biorthogonal wavelet.
    """
    if kind == "none" or length == 1:
        return np.eye(length)
    if kind == "cosine":
        return cosine_matrix(length)
    levels = levels_of(length, 32)
    matrix = analysis_matrix(kind, length, levels)
    if np.abs(matrix @ matrix.T - np.eye(length)).max() > 1e-9:
        raise UserError(f"view_transform: expected an orthonormal family, found {kind!r}")
    coarse = length >> levels
    if coarse > 1:
        matrix[:coarse] = cosine_matrix(coarse) @ matrix[:coarse]
    return matrix


SIDES = (8, 16, 32, 48, 64, 96, 128, 192, 256, 320, 384, 448)


@dataclass(frozen=True)
class Extent:
    """The coded arc of views (start, length) and rectangle of texels (row, column, rows, columns); length 0: unseen."""

    start: int
    length: int
    row: int
    column: int
    rows: int
    columns: int

    @property
    def texels(self) -> tuple[slice, slice]:
        """Slices of the rectangle in arrays (T, T, ...)."""
        return slice(self.row, self.row + self.rows), slice(self.column, self.column + self.columns)

    def observations(self, views: int, lights: int) -> np.ndarray:
        """List the observations (lights * length,) int64 of the block, in its order."""
        return (np.arange(lights)[:, None] * views + arc_views(self.start, self.length, views)[None]).reshape(-1)

    def row_of_numbers(self) -> tuple[int, ...]:
        """Return the numbers that the index stores."""
        return self.start, self.length, self.row, self.column, self.rows, self.columns


def extent_of(seen: np.ndarray, inside: np.ndarray, *, full_turn: bool, arcs: bool) -> Extent:
    """Find the extent of seen (views,) bool and inside (T, T) bool. arcs: False keeps all views."""
    start, length = visible_arc(seen, full_turn=full_turn) if arcs else (0, len(seen) if seen.any() else 0)
    row, rows = _side(inside.any(axis=1))
    column, columns = _side(inside.any(axis=0))
    return Extent(start, length, row, column, rows, columns)


def _side(used: np.ndarray) -> tuple[int, int]:
    """Find first texel and number of texels: the smallest of SIDES that holds all used ones, or the whole tile."""
    at = np.flatnonzero(used)
    if not len(at):
        return 0, min(SIDES[0], len(used))
    length = at[-1] + 1 - at[0]
    side = min(s for s in (*SIDES, len(used)) if length <= s <= len(used))
    return int(min(at[0], len(used) - side)), int(side)


GROUPS = ("kd", "ks", "sigma")


@dataclass(frozen=True)
class Design(PlainFields):
    """The parameters of the coding.

    tile_size T; views, lights, channels of the capture; full_turn; encoding. wavelet, levels,
    mirrored: of the planes; view_transform, light_transform: along the
    observations; arcs: whether a tile's block spans only the views that see it; model: False for image-based coding.
    step: of the residual's quantiser; parameter_steps: of kd, ks, log sigma. colour: a (C, C) matrix;
    parameter_colour: of kd, ks; parameter_means: of kd (C), ks (C), log sigma (1). parameter_wavelet, parameter_levels,
    parameter_mirrored: of the parameter planes.
    """

    tile_size: int
    views: int
    lights: int
    channels: int
    full_turn: bool
    encoding: str
    wavelet: str = "bior4.4"
    levels: int = 4
    mirrored: bool = False
    view_transform: str = "db2"
    light_transform: str = "cosine"
    arcs: bool = True
    model: bool = True
    step: float = 0.02
    parameter_steps: tuple[float, ...] = (0.01, 0.01, 0.1)
    colour: tuple = field(default=())
    parameter_colour: tuple = field(default=())
    parameter_means: tuple = field(default=())
    parameter_wavelet: str = "bior4.4"
    parameter_levels: int = 5
    parameter_mirrored: bool = True

    @classmethod
    def from_dict(cls, values: dict) -> "Design":
        """Invert `as_dict`. UserError where keys are missing or unknown: another version wrote them."""
        names = {f.name for f in fields(cls)}
        if set(values) != names:
            wrong = sorted(set(values) ^ names)
            raise UserError(f"residual: header with unexpected or missing entries {wrong}; run the stage again")
        return super().from_dict(values)

    def plane(self, extent: Extent) -> PlaneTransform:
        """Return the transform of the residual's planes."""
        return plane_transform(self.wavelet, extent.rows, extent.columns, self.levels, mirrored=self.mirrored)

    def parameter_plane(self, extent: Extent) -> PlaneTransform:
        """Return the transform of the parameters' planes."""
        levels, mirrored = self.parameter_levels, self.parameter_mirrored
        return plane_transform(self.parameter_wavelet, extent.rows, extent.columns, levels, mirrored=mirrored)

    def block(self, extent: Extent) -> Block:
        """Return the transform of a tile."""
        along_lights = view_matrix(self.light_transform, self.lights)
        return Block(self.plane(extent), view_matrix(self.view_transform, extent.length), along_lights)

    def shape(self, extent: Extent) -> tuple[int, int, int, int, int]:
        """Return the shape of a tile's block: (channels, lights, views, rows, columns)."""
        return self.channels, self.lights, extent.length, extent.rows, extent.columns

    def residual_shape(self, extent: Extent) -> tuple[int, int, int, int]:
        """Return the shape of a tile's coded residual: (channels, lights * views, rows, columns)."""
        return self.channels, self.lights * extent.length, extent.rows, extent.columns

    def parameter_shape(self, extent: Extent) -> tuple[int, int, int, int]:
        """Return the shape of a tile's coded parameters: (channels, 3, rows, columns)."""
        return self.channels, len(GROUPS), extent.rows, extent.columns

    def mix(self) -> np.ndarray:
        """Return the matrix (C, C) float64 from old to new channels."""
        return np.array(self.colour) if self.colour else np.eye(self.channels)

    def parameter_mix(self, group: int) -> np.ndarray:
        """Return the mix (C, C) float64 of kd (0) or ks (1); (1, 1) of log sigma."""
        if group == 2:
            return np.eye(1)
        return np.array(self.parameter_colour[group]) if self.parameter_colour else np.eye(self.channels)

    def parameter_mean(self, group: int) -> np.ndarray:
        """Return the means that are subtracted before the transform."""
        count = 1 if group == 2 else self.channels
        return np.array(self.parameter_means[group]) if self.parameter_means else np.zeros(count)
