"""A group of arrays in Zarr format 3, and their chunks, written and read without the array library.

A chunk is its bytes, little-endian, optionally compressed with zstd, followed by their CRC-32C: what Zarr's codecs
`bytes`, `zstd` and `crc32c` make. What is written here any Zarr library reads, and the other way round as long as the
chunks of an array are bands of whole rows (tested). Importing the library takes a third of the start of a stage, and
reading through it three times as long for the thousands of large chunks of a capture.
"""

import io
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import google_crc32c
import numpy as np

from nishiki.errors import UserError
from nishiki.formats.files import read_json

ZSTD_LEVEL = 1  # the quickest
CHECKSUM_BYTES = 4  # of CRC-32C
REMEDY = "Run the stage that made it again"


def chunk_path(array_folder: Path, light: int, band: int) -> Path:
    """File of the chunk of one light and band of an array (lights, rows, columns, channels) chunked over both."""
    return array_folder / "c" / str(light) / str(band) / "0" / "0"


def write_chunk(path: Path, values: np.ndarray, *, compression: str) -> None:
    """Write one whole chunk of little-endian values. Raises OSError with the file's name where the disk lacks space."""
    bare = np.ascontiguousarray(values, values.dtype.newbyteorder("<")).reshape(-1).view(np.uint8)  # no copy
    payload: Any = bare
    if compression == "zstd":
        from numcodecs.zstd import Zstd

        payload = bytes(Zstd(level=ZSTD_LEVEL).encode(payload))
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb", buffering=0) as file:
        for part in (payload, google_crc32c.value(payload).to_bytes(4, "little")):
            rest = memoryview(part)
            while rest:  # a disk that becomes full takes a piece first, and tells the reason when the rest comes
                try:
                    rest = rest[file.write(rest) :]
                except OSError as error:
                    raise OSError(error.errno, error.strerror, str(path)) from None


def read_chunk(path: Path, shape: tuple, dtype: np.dtype, *, compression: str, checksum: bool = True) -> np.ndarray:
    """Read one chunk and verify its checksum; UserError where it is missing or damaged.

    checksum: whether a CRC-32C ends it; a zstd frame may have one of its own instead.
    """
    with _opened(path) as file:
        payload, end = file.read(max(os.fstat(file.fileno()).st_size - CHECKSUM_BYTES * checksum, 0)), file.read()
    if checksum:
        _expect_checksum(payload, end, path)
    if compression == "zstd":
        from numcodecs.zstd import Zstd

        try:
            payload = Zstd().decode(payload)
        except RuntimeError as error:
            raise UserError(f"{path}: part of a stored array is damaged ({error}). {REMEDY}") from None
    values = np.frombuffer(payload, np.dtype(dtype).newbyteorder("<"))
    if values.size != np.prod(shape):
        raise UserError(f"{path}: {values.size} values, expected {tuple(shape)}. {REMEDY}")
    return values.reshape(shape)


def read_chunk_into(path: Path, values: np.ndarray) -> None:
    """Read one chunk that is not compressed into a contiguous array of its size; otherwise as `read_chunk`."""
    payload = values.reshape(-1).view(np.uint8)
    with _opened(path) as file:
        length, end = file.readinto(payload.data), file.read()
    if length != len(payload):
        raise UserError(f"{path}: {length} bytes, expected {len(payload)}. {REMEDY}")
    _expect_checksum(payload, end, path)
    if values.dtype != values.dtype.newbyteorder("<"):
        values.byteswap(inplace=True)


def _opened(path: Path) -> io.FileIO:
    try:
        return path.open("rb", buffering=0)
    except FileNotFoundError as e:
        raise UserError(f"{path}: part of a stored array is missing. {REMEDY}") from e


def _expect_checksum(payload: Any, end: bytes, path: Path) -> None:
    if len(end) != CHECKSUM_BYTES or google_crc32c.value(payload) != int.from_bytes(end, "little"):
        raise UserError(f"{path}: part of a stored array is damaged (checksum differs). {REMEDY}")


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
    def of(cls, folder: Path) -> "BandedArray":
        """Open the array in a folder, from its metadata."""
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
        """Read some rows (a slice of step 1), or all (...)."""
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
    def create(cls, folder: Path | str, attributes: dict[str, Any] | None = None) -> "BandedGroup":
        """Create a group; FileExistsError where there is something."""
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
        """Open an array; KeyError where there is none."""
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
        """Create an array whose chunks end with their CRC-32C; chunks may exist. compression: 'none' | 'zstd'."""
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
        (self.folder / name).mkdir(exist_ok=True)
        _write(self.folder / name / METADATA, node)
        return BandedArray.of(self.folder / name)


def _write_group(folder: Path, attributes: dict[str, Any]) -> None:
    _write(folder / METADATA, {"zarr_format": 3, "node_type": "group", "attributes": attributes})


def _write(path: Path, node: dict[str, Any]) -> None:
    path.write_text(json.dumps(node, indent=2, allow_nan=False) + "\n")
