"""The components of every observation on disk, one chunk a photograph."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nishiki.errors import UserError
from nishiki.formats.stored import open_made_by
from nishiki.formats.zarr_chunks import chunk_path, read_chunk, write_chunk
from nishiki.formats.zarr_store import BandedGroup
from nishiki.polarisation.polarisation import SeparatedView

STORE = "components.zarr"
FORMAT = 1


class ComponentWriter:
    """Writes `components.zarr`: diffuse, specular (observations, rows, columns, channels) float32, valid uint8."""

    def __init__(
        self,
        folder: Path,
        *,
        views: tuple[str, ...],
        lights: tuple[str, ...],
        shape: tuple[int, int],
        channels: tuple[str, ...],
        stamp: dict[str, str],
    ):
        self.path = Path(folder) / STORE
        group = BandedGroup.create(self.path)
        count = len(views) * len(lights)
        for name, depth, dtype in (
            ("diffuse", len(channels), np.float32),
            ("specular", len(channels), np.float32),
            ("valid", 1, np.uint8),
        ):
            full_shape = (count, *shape, depth)
            group.create_array(name, full_shape, (1, *full_shape[1:]), dtype, compression="zstd")
        group.update(
            format=FORMAT,
            views=list(views),
            lights=list(lights),
            channels=list(channels),
            shape=list(shape),
            stamp=stamp,
        )

    def write(self, observation: int, view: SeparatedView) -> None:
        """Write one observation (light_index * views + view_index)."""
        for name, values in (
            ("diffuse", view.diffuse.astype("<f4", copy=False)),
            ("specular", view.specular.astype("<f4", copy=False)),
            ("valid", view.valid.astype(np.uint8)[..., None]),
        ):
            write_chunk(chunk_path(self.path / name, observation, 0), values, compression="zstd")


class Components:
    """The components of one artifact, for reading; one observation is in memory at a time.

    views, lights, channels: names; shape (rows, columns); observations: lights times views.
    """

    def __init__(self, folder: Path | str):
        """Open `components.zarr`, or the folder that holds it. UserError where it is none."""
        path = Path(folder)
        self.path = path if path.name == STORE else path / STORE
        _, stored = open_made_by("polarise", self.path, "components", FORMAT)
        self.views, self.lights, self.channels = (tuple(stored[name]) for name in ("views", "lights", "channels"))
        self.shape: tuple[int, int] = tuple(stored["shape"])
        self.observations = len(self.views) * len(self.lights)

    def read(self, observation: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """diffuse, specular (rows, columns, channels) float32 (specular may be negative: noise), valid (rows, columns)
        bool of one observation (light_index * views + view_index)."""
        if not 0 <= observation < self.observations:
            raise UserError(f"{self.path}: no observation {observation}; there are {self.observations}")
        diffuse, specular = (
            self._chunk(name, observation, len(self.channels), np.float32) for name in ("diffuse", "specular")
        )
        return diffuse, specular, self._chunk("valid", observation, 1, np.uint8)[..., 0] != 0

    def _chunk(self, name: str, observation: int, depth: int, dtype) -> np.ndarray:
        place = chunk_path(self.path / name, observation, 0)
        return read_chunk(place, (*self.shape, depth), dtype, compression="zstd")
