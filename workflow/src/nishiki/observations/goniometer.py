"""Reading what a goniometer measured: linear light of one photograph's window at a time, or the given table."""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np

from nishiki.errors import UserError
from nishiki.formats.files import read_json
from nishiki.formats.stored import load_arrays, open_group, understood
from nishiki.formats.zarr_store import chunk_path, read_chunk
from nishiki.goniometry.directions import Symmetry
from nishiki.goniometry.readings import Photograph
from nishiki.observations.blocks import block_edges, positions
from nishiki.observations.goniometer_store import FORMAT, NAMES, STORE, TABLE
from nishiki.observations.linearise import StoredArrays


@dataclass(frozen=True)
class Shot:
    """A frame: theta_i, phi_i, theta_r, phi_r, None where not given; exposure_s or None; place: number in the store."""

    file: str
    angles_deg: tuple[float | None, ...]
    exposure_s: float | None
    place: int


class Measurements(StoredArrays):
    """The ingested measurements of one capture, opened for reading.

    kind: 'photographs' or 'table'; channels: names; samples, whites: the photographs (none of a table); symmetry,
    weave, threads_per_cm: as the capture states; attributes: everything stored.
    """

    def __init__(self, folder: Path | str):
        """Open the artifact of ingest. UserError where it holds no measurements of a goniometer."""
        self.folder = Path(folder)
        try:
            stored = read_json(self.folder / NAMES)
        except UserError as e:
            raise UserError(f"{self.folder}: no ingested measurements of a goniometer here; run ingest first") from e
        if stored.get("format") != FORMAT:
            version = stored.get("format")
            raise UserError(f"{self.folder}: measurements of format {version}, expected {FORMAT}; run ingest again")
        self.attributes: dict = stored
        with understood(self.folder / NAMES):
            self.kind: str = stored["kind"]
            self.channels: tuple[str, ...] = tuple(stored["channels"])
            self.dtype = np.dtype(stored.get("dtype"))  # none of a table
            self.symmetry: Symmetry = stored["symmetry"]
            self.weave: str = stored["weave"]
            self.threads_per_cm: list[float] | None = stored.get("threads_per_cm")
            shots = [
                (row["role"], Shot(row["file"], tuple(row["angles_deg"]), row["exposure_s"], i))
                for i, row in enumerate(stored["frames"])
            ]
            self.samples: tuple[Shot, ...] = tuple(shot for role, shot in shots if role == "sample")
            self.whites: tuple[Shot, ...] = tuple(shot for role, shot in shots if role == "white")
        self._block = lru_cache(maxsize=2)(self._read_block)
        self._dark = lru_cache(maxsize=8)(self._dark_level)

    @cached_property
    def table(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """incident_deg, outgoing_deg (n, 2) and values (n, channels) of a given table."""
        stored = load_arrays(self.folder / TABLE)
        return stored["incident_deg"], stored["outgoing_deg"], stored["values"]

    @cached_property
    def white_reflectance(self) -> np.ndarray:
        """(channels,) float64."""
        return np.array(self.attributes["white_reflectance"])

    def read(self, shot: Shot) -> Photograph:
        """One photograph's window. UserError where the store is damaged."""
        depth = self.attributes["frames_a_chunk"]
        codes = self._block(shot.place // depth)[shot.place % depth]
        linear = self.lut[codes] if codes.dtype.kind == "u" else codes
        linear = linear - self._dark(self.attributes["frames"][shot.place]["dark"])
        if shot.exposure_s is not None:
            linear = linear / np.float32(shot.exposure_s)
        finite = np.isfinite(linear).all(axis=2)
        limit = self.attributes["saturation_code"]
        saturated = (codes >= limit).any(axis=2) if limit is not None else np.zeros(codes.shape[:2], bool)
        usable = finite if self.defect is None else finite & ~self.defect
        return Photograph(np.where(finite[..., None], linear, np.float32(0)), saturated & finite, usable)

    def _read_block(self, place: int) -> np.ndarray:
        shape = (self.attributes["frames_a_chunk"], *self.attributes["shape"], len(self.channels))
        path = chunk_path(self.folder / STORE / "codes", place, 0)
        return read_chunk(path, shape, self.dtype, compression="zstd")

    def _dark_level(self, place: int) -> np.ndarray:
        """Dark level over the window, bilinear between the centres of its blocks."""
        level = self._group["dark"][place]
        for axis, length in enumerate(self.attributes["shape"]):
            if level.shape[axis] > 1:
                lower, weight = positions(block_edges(length, self.attributes["white_block"]), 0, length)
                weight = weight.reshape((-1, 1, 1) if axis == 0 else (1, -1, 1))
                level = np.take(level, lower, axis) * (1 - weight) + np.take(level, lower + 1, axis) * weight
        return level.astype(np.float32)

    @cached_property
    def _group(self):
        try:
            return open_group(self.folder / STORE)
        except FileNotFoundError as e:
            raise UserError(f"{self.folder}: {STORE} is missing; run ingest again") from e
