"""A group of arrays in Zarr format 3, each in bands of whole rows, written and read without the array library.

For the stages of a plane: importing the library takes a third of their start. What is written here any Zarr library
reads, and the other way round as long as the chunks of an array are bands of whole rows (tested).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from nishiki.formats.files import read_json
from nishiki.formats.zarr_chunks import ZSTD_LEVEL, read_chunk, write_chunk

METADATA = "zarr.json"


@dataclass(frozen=True)
class BandedArray:
    """One array; the first axis is divided into chunks, the others are whole.

    folder; shape; chunks: shape of a chunk; dtype; compression: 'none' | 'zstd'; checksum: whether a CRC-32C ends each
    chunk; attrs: what is said of the array.
    """

    folder: Path
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dtype: np.dtype
    compression: str
    checksum: bool
    attrs: dict[str, Any]

    @classmethod
    def of(cls, folder: Path) -> BandedArray:
        """The array in a folder, from its metadata."""
        node = read_json(folder / METADATA)
        codecs = [codec["name"] for codec in node["codecs"]]
        return cls(
            folder,
            tuple(node["shape"]),
            tuple(node["chunk_grid"]["configuration"]["chunk_shape"]),
            np.dtype(node["data_type"]),
            "zstd" if "zstd" in codecs else "none",
            "crc32c" in codecs,
            node.get("attributes", {}),
        )

    @property
    def ndim(self) -> int:
        """Number of axes."""
        return len(self.shape)

    def path(self, band: int) -> Path:
        """File of a chunk."""
        return self.folder.joinpath("c", str(band), *["0"] * (self.ndim - 1))

    def __getitem__(self, rows: slice | Any) -> np.ndarray:
        """Some rows (a slice of step 1), or all (...)."""
        if self.chunks[1:] != self.shape[1:]:
            raise ValueError(f"{self.folder}: chunks of {self.chunks} are no bands of whole rows in {self.shape}")
        start, stop = self._range(rows)
        values = np.empty((stop - start, *self.shape[1:]), self.dtype)
        step = self.chunks[0]
        for band in range(start // step, -(-stop // step) if stop > start else 0):
            top = band * step
            chunk = read_chunk(
                self.path(band), self.chunks, self.dtype, compression=self.compression, checksum=self.checksum
            )
            first, last = max(start, top), min(stop, top + step)
            values[first - start : last - start] = chunk[first - top : last - top]
        return values

    def __setitem__(self, rows: slice | Any, values: np.ndarray) -> None:
        """Write whole chunks: rows from the start of one on, to the end of one or of the array."""
        start, stop = self._range(rows)
        step = self.chunks[0]
        if start % step or (stop % step and stop != self.shape[0]):
            raise ValueError(f"{self.folder}: rows {start} to {stop} are no whole chunks of {step} rows")
        values = np.asarray(values, self.dtype)
        for top in range(start, stop, step):
            part = values[top - start : min(top + step, stop) - start]
            if len(part) < step:  # chunks are whole: the last one is padded
                part = np.concatenate([part, np.zeros((step - len(part), *self.shape[1:]), self.dtype)])
            write_chunk(self.path(top // step), part, compression=self.compression)

    def _range(self, rows: slice | Any) -> tuple[int, int]:
        start, stop, step = (slice(None) if rows is ... else rows).indices(self.shape[0])
        if step != 1:
            raise ValueError(f"{self.folder}: rows {rows} are no slice of step 1")
        return start, max(start, stop)


class BandedGroup:
    """Arrays in one folder, and what is said of them together: `attrs`, which only `update` changes, and writes."""

    def __init__(self, folder: Path | str):
        """Open a group that is there."""
        self.folder = Path(folder)
        self.attrs: Mapping[str, Any] = MappingProxyType(read_json(self.folder / METADATA).get("attributes", {}))

    @classmethod
    def create(cls, folder: Path | str, attributes: dict[str, Any] | None = None) -> BandedGroup:
        """A new group; FileExistsError where there is something."""
        Path(folder).mkdir(parents=True)
        _write_group(Path(folder), attributes or {})
        return cls(folder)

    def update(self, **attributes: Any) -> None:
        """Say more of the group."""
        self.attrs = MappingProxyType({**self.attrs, **attributes})
        _write_group(self.folder, dict(self.attrs))

    def __contains__(self, name: str) -> bool:
        return (self.folder / name / METADATA).is_file()

    def __getitem__(self, name: str) -> BandedArray:
        """An array; KeyError where there is none."""
        if name not in self:
            raise KeyError(name)
        return BandedArray.of(self.folder / name)

    def create_array(
        self,
        name: str,
        shape: tuple[int, ...],
        chunks: tuple[int, ...],
        dtype: Any,
        *,
        compression: str = "none",
        attributes: dict[str, Any] | None = None,
    ) -> BandedArray:
        """A new array, whose chunks end with their CRC-32C. compression: 'none' | 'zstd'."""
        kind = np.dtype(dtype)
        packers = [{"name": "zstd", "configuration": {"level": ZSTD_LEVEL, "checksum": False}}]
        node = {
            "zarr_format": 3,
            "node_type": "array",
            "shape": [int(n) for n in shape],
            "data_type": kind.name,
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [int(n) for n in chunks]}},
            "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
            "fill_value": False if kind.kind == "b" else 0,
            "codecs": [
                {"name": "bytes", "configuration": {"endian": "little"}},
                *(packers if compression == "zstd" else []),
                {"name": "crc32c"},
            ],
            "attributes": attributes or {},
        }
        (self.folder / name).mkdir()
        _write(self.folder / name / METADATA, node)
        return BandedArray.of(self.folder / name)


def _write_group(folder: Path, attributes: dict[str, Any]) -> None:
    _write(folder / METADATA, {"zarr_format": 3, "node_type": "group", "attributes": attributes})


def _write(path: Path, node: dict[str, Any]) -> None:
    path.write_text(json.dumps(node, indent=2, allow_nan=False) + "\n")
