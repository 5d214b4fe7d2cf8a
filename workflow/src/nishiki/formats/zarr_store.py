"""A group of arrays in Zarr format 3, and their chunks, written and read without the array library.

A chunk is its bytes, little-endian, optionally compressed with zstd, followed by their CRC-32C: what Zarr's codecs
`bytes`, `zstd` and `crc32c` make. What is written here any Zarr library reads, and the other way round (tested).
Importing the library takes a third of the start of a stage, and reading through it three times as long for the
thousands of large chunks of a capture.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Any

import google_crc32c
import numpy as np

from nishiki.errors import UserError
from nishiki.formats.files import expect_memory, read_json

ZSTD_LEVEL = 1  # the quickest
CHECKSUM_BYTES = 4  # of CRC-32C
PACKED_BYTES = 1 << 10  # by which zstd makes small chunks larger at most
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
    """Read one chunk and verify its checksum; UserError where it is missing, damaged, or of another size.

    checksum: whether a CRC-32C ends it; a zstd frame may have one of its own instead. Whatever the file holds, memory
    is bounded by the shape.
    """
    kind = np.dtype(dtype).newbyteorder("<")
    size = int(np.prod(shape)) * kind.itemsize
    try:
        with path.open("rb") as file:
            content = np.frombuffer(file.read(size * (1 + (compression == "zstd")) + PACKED_BYTES), np.uint8)
    except FileNotFoundError as e:
        raise UserError(f"{path}: part of a stored array is missing. {REMEDY}") from e
    payload = content[: len(content) - CHECKSUM_BYTES] if checksum else content
    if checksum and google_crc32c.value(payload) != int.from_bytes(content[-CHECKSUM_BYTES:], "little"):
        raise UserError(f"{path}: part of a stored array is damaged (checksum differs). {REMEDY}")
    found = len(payload) if compression == "none" else _stated_size(payload[:18].tobytes())
    if found != size:
        raise UserError(f"{path}: part of a stored array has {found} bytes, expected {size}. {REMEDY}")
    if compression == "zstd":
        from numcodecs.zstd import Zstd

        try:
            payload = Zstd().decode(payload, np.empty(size, np.uint8))
        except (RuntimeError, ValueError) as error:
            raise UserError(f"{path}: part of a stored array is damaged ({error}). {REMEDY}") from None
    return payload.view(kind).reshape(shape)


def _stated_size(start: bytes) -> int | None:
    """Bytes that a zstd frame with these first bytes says it unpacks to (RFC 8878, 3.1.1.1); None if it does not."""
    if len(start) < 6:
        return None
    single, flag = start[4] >> 5 & 1, start[4] >> 6
    first, count = 6 - single + (0, 1, 2, 4)[start[4] & 3], (single, 2, 4, 8)[flag]
    return int.from_bytes(start[first : first + count], "little") + 256 * (flag == 1) if count else None


METADATA = "zarr.json"


@dataclass(frozen=True)
class BandedArray:
    """One array: any part of it is read; it is written in bands of whole rows, each a chunk.

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

    def path(self, *place: int) -> Path:
        """File of a chunk by its place in the grid; axes that are left out have one chunk."""
        return self.folder.joinpath("c", *map(str, place), *["0"] * (self.ndim - len(place)))

    def places(self, ranges: Sequence[range] | None = None) -> Iterable[tuple[int, ...]]:
        """Places in the grid of the chunks that hold these indices of each axis, or of all."""
        spans = zip(ranges or map(range, self.shape), self.chunks, strict=True)
        return product(*(range(each.start // size, -(-each.stop // size) if each else 0) for each, size in spans))

    def chunk(self, place: tuple[int, ...]) -> np.ndarray:
        """Read the chunk at a place of the grid. UserError where it is missing or damaged.

        Zarr libraries leave out chunks of zeros, ours does not.
        """
        path = self.path(*place)
        if not self.checksum and not path.is_file():
            return np.zeros(self.chunks, self.dtype)
        return read_chunk(path, self.chunks, self.dtype, compression=self.compression, checksum=self.checksum)

    def __getitem__(self, key: Any) -> np.ndarray:
        """Read a part: an index or a slice of step 1 for each of the first axes, or all (...)."""
        keys = () if key is ... else key if isinstance(key, tuple) else (key,)
        slices = [each if isinstance(each, slice) else slice(each, each + 1) for each in keys]
        slices += [slice(None)] * (self.ndim - len(keys))
        ranges = [range(length)[each] for length, each in zip(self.shape, slices, strict=True)]
        if any(each.step != 1 for each in ranges):
            raise ValueError(f"{self.folder}: {key} is no index or slice of step 1")
        values = np.zeros([len(each) for each in ranges], self.dtype)
        expect_memory(values.nbytes, str(self.folder))
        starts = [each.start for each in ranges]
        for place in self.places(ranges):
            corner = [number * size for number, size in zip(place, self.chunks, strict=True)]
            ends = [first + size for first, size in zip(corner, self.chunks, strict=True)]
            both = [
                (max(each.start, first), min(each.stop, end))
                for each, first, end in zip(ranges, corner, ends, strict=True)
            ]
            values[_within(both, starts)] = self.chunk(place)[_within(both, corner)]
        return values[tuple(slice(None) if isinstance(each, slice) else 0 for each in keys)]

    def __setitem__(self, rows: slice | Any, values: np.ndarray) -> None:
        """Write whole chunks: rows from the start of one on, to the end of one or of the array."""
        start, stop, _ = (slice(None) if rows is ... else rows).indices(self.shape[0])
        step = self.chunks[0]
        if start % step or (stop % step and stop != self.shape[0]):
            raise ValueError(f"{self.folder}: rows {start} to {stop} are no whole chunks of {step} rows")
        values = np.asarray(values, self.dtype)
        for top in range(start, stop, step):
            part = values[top - start : min(top + step, stop) - start]
            if len(part) < step:  # chunks are whole: the last one is padded
                part = np.concatenate([part, np.zeros((step - len(part), *self.shape[1:]), self.dtype)])
            write_chunk(self.path(top // step), part, compression=self.compression)


def _within(parts: Sequence[tuple[int, int]], origin: Sequence[int]) -> tuple[slice, ...]:
    return tuple(slice(start - first, stop - first) for (start, stop), first in zip(parts, origin, strict=True))


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

    def names(self) -> list[str]:
        """Names of its arrays."""
        return sorted(path.parent.name for path in self.folder.glob(f"*/{METADATA}"))

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
