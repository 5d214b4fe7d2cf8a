"""Read texel stacks and pixel samples, tile by tile."""

import threading
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from nishiki.atlas.atlas import Atlas
from nishiki.formats.stored import open_made_by
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh

STORE = "texels.zarr"
ATLAS = "atlas.npz"
FORMAT = 2  # of the file; readers refuse others


@dataclass(frozen=True)
class TexelSamples:
    """Object pixels that lie in one tile, sorted by observation, then as the picture is scanned."""

    observation: np.ndarray  # (n,) int32
    s: np.ndarray  # (n,) float32 row in [0, T - 1]
    t: np.ndarray  # (n,) float32 column in [0, T - 1]
    values: np.ndarray  # (n, channels) float32 linear
    row: np.ndarray  # (n,) int32 in the picture
    column: np.ndarray  # (n,) int32 in the picture
    valid: np.ndarray  # (n,) bool


class Texels:
    """The texels of one artifact, for reading; reading tiles in their order is linear in time and bounded in memory.

    tiles, size (T), observations (M = lights x views, light by light); views, lights, components, hold_out: tuples of
    names; channels: number; encoding, full_turn; cameras: of the views; atlas.
    """

    def __init__(self, folder: Path | str):
        """Open the artifact's folder. UserError where it holds no texels of this format."""
        self.folder = Path(folder)
        self._group, stored = open_made_by("texels", self.folder / STORE, "texels", FORMAT)
        self.attributes = stored
        self.tiles, self.size, self.channels = int(stored["tiles"]), int(stored["size"]), int(stored["channels"])
        self.views, self.lights = tuple(stored["views"]), tuple(stored["lights"])
        self.components, self.hold_out = tuple(stored["components"]), tuple(stored["hold_out"])
        self.encoding, self.full_turn = stored["encoding"], bool(stored["full_turn"])
        self.observations = len(self.views) * len(self.lights)
        self.cameras = [Camera.from_dict(camera) for camera in stored["cameras"]]
        self._offsets = self._group["pixels/offsets"][...]
        self._arrays: dict[str, zarr.Array] = {}
        self._cache: dict[tuple, tuple[int, np.ndarray]] = {}
        self._lock = threading.Lock()
        self._mesh: Mesh | None = None

    @cached_property
    def atlas(self) -> Atlas:
        """The atlas that the tiles belong to."""
        return Atlas.load(self.folder / ATLAS)

    @property
    def held_out(self) -> np.ndarray:
        """(M,) bool: observations of views that are held out: wholly invisible in the stacks, but among the samples."""
        return np.tile(np.isin(self.views, self.hold_out), len(self.lights))

    def read(self, component: str, tile: int) -> np.ndarray:
        """Read texels (M, T, T, channels) float32 linear of a tile in every observation, 0 where not seen."""
        self._expect_component(component)
        return np.stack([self._read_tile(f"values/{component}", tile, o) for o in range(self.observations)])

    def visible(self, tile: int) -> np.ndarray:
        """Read where `read` has a valid value: (M, T, T) bool."""
        return self._marks(tile) == 1

    def bounds(self, tile: int) -> np.ndarray:
        """Read the `channel_bits` that are saturated, where `read` has a lower bound: (M, T, T) uint8."""
        return self._marks(tile) >> 1

    def _marks(self, tile: int) -> np.ndarray:
        return np.stack([self._read_tile("visible", tile, o) for o in range(self.observations)])

    def turn_normals(self, mesh: Mesh) -> None:
        """Take the normals from a mesh: the surface that the texels are of, with normals of its own."""
        self._mesh = mesh

    @cached_property
    def triangles(self) -> np.ndarray:
        """Nearest triangle of each texel, as `texel_triangles`."""
        from nishiki.atlas.surface import texel_triangles

        return texel_triangles(self.atlas)

    def geometry(self, tile: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Read positions (T, T, 3) float32, unit normals (T, T, 3) float32, inside (T, T) bool of a tile; 0 outside.

        Inside: among the four texels that some surface point is interpolated from.
        """
        positions, normals = self._read_tile("positions", tile), self._read_tile("normals", tile)
        inside = (normals != 0).any(axis=-1)
        if self._mesh is not None:
            from nishiki.atlas.surface import texel_points

            normals = texel_points(self._mesh, self.atlas, self.triangles, slice(tile, tile + 1))[1][0]
        return positions, normals, inside

    def samples(self, component: str, tile: int, *, saturated: bool = False) -> TexelSamples:
        """Read every valid object pixel of every observation that falls into a tile; those of held-out views too.

        saturated: also pixels that are not valid but hold a value, as saturated ones do.
        """
        self._expect_component(component)
        parts = []
        for light in range(len(self.lights)):
            for view in range(len(self.views)):
                part = slice(*self._offsets[view, tile : tile + 2])
                if part.stop == part.start:
                    continue
                valid = self._read_pixels("valid", view, part, light) != 0
                every = self._read_pixels(f"values/{component}", view, part, light)
                kept = valid | (np.isfinite(every).all(axis=1) & (every > 0).any(axis=1)) if saturated else valid
                place = {name: self._read_pixels(name, view, part)[kept] for name in ("s", "t", "row", "column")}
                place["valid"] = valid[kept]
                values = every[kept]
                parts.append((np.full(len(values), light * len(self.views) + view, np.int32), place, values))
        if not parts:
            nothing = np.zeros(0, np.float32), np.zeros(0, np.int32)
            empty = np.zeros((0, self.channels), np.float32)
            return TexelSamples(nothing[1], nothing[0], nothing[0], empty, nothing[1], nothing[1], np.zeros(0, bool))
        names = ("s", "t", "row", "column", "valid")
        joined = {name: np.concatenate([place[name] for _, place, _ in parts]) for name in names}
        return TexelSamples(
            np.concatenate([observation for observation, _, _ in parts]),
            joined["s"],
            joined["t"],
            np.concatenate([values for _, _, values in parts]),
            joined["row"].astype(np.int32),
            joined["column"].astype(np.int32),
            joined["valid"],
        )

    def _expect_component(self, component: str) -> None:
        if component not in self.components:
            raise KeyError(f"no component {component!r} in {self.folder}; there are {', '.join(self.components)}")

    def _array(self, name: str) -> zarr.Array:
        if name not in self._arrays:
            self._arrays[name] = self._group[name]
        return self._arrays[name]

    def _read_tile(self, name: str, tile: int, observation: int | None = None) -> np.ndarray:
        """Read one tile of an array (tiles, ...) or (observations, tiles, ...)."""
        array = self._array(name)
        lead = () if observation is None else (observation,)
        return self._part(array, (name, observation), lead, len(lead), slice(tile, tile + 1))[0]

    def _read_pixels(self, name: str, view: int, part: slice, light: int | None = None) -> np.ndarray:
        """Read some pixels of an array (pixels, ...) or (lights, pixels, ...)."""
        name = f"pixels/{name}"
        lead = () if light is None else (light,)
        return self._part(self._array(name), (name, view, light), lead, len(lead), part)

    def _part(self, array: zarr.Array, key: tuple, lead: tuple[int, ...], axis: int, part: slice) -> np.ndarray:
        """Read a range along one axis through the one cached chunk of each key, since its neighbours follow."""
        length = array.chunks[axis]
        pieces = []
        for chunk in range(part.start // length, (part.stop - 1) // length + 1):
            with self._lock:
                number, values = self._cache.get(key, (-1, np.empty(0)))
            if number != chunk:
                place: Any = (*lead, slice(chunk * length, (chunk + 1) * length))
                values = array[place]
                with self._lock:
                    self._cache[key] = chunk, values
            low, high = max(part.start - chunk * length, 0), min(part.stop - chunk * length, length)
            pieces.append(values[low:high])
        return pieces[0] if len(pieces) == 1 else np.concatenate(pieces)
