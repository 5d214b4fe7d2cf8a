"""Zarr stores and .npz files: written and read without the array library, and looked through before they are opened.

A chunk is its bytes, little-endian, optionally compressed with zstd, followed by their CRC-32C: what Zarr's codecs
`bytes`, `zstd` and `crc32c` make. What is written here any Zarr library reads, and the other way round (tested).
Importing the library takes a third of the start of a stage, and reading through it three times as long for the
thousands of large chunks of a capture.

A store says itself how large its arrays are and by which codecs they are unpacked; one of a stranger may claim any size
or, in Zarr's older format, a codec that runs code on reading. Only what this project writes is opened: Zarr 3, plain
numbers, the codecs `bytes`, `zstd` and `crc32c`; arrays without pickled objects.
"""

import json
import math
import os
import zipfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from io import BytesIO
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

import google_crc32c
import numpy as np

from nishiki.errors import UserError
from nishiki.formats.files import Refused, expect_bound, expect_memory, open_regular, read_json, walk

ZSTD_LEVEL = 1  # the quickest
CHECKSUM_BYTES = 4  # of CRC-32C
PACKED_BYTES = 1 << 10  # by which zstd makes small chunks larger at most
RUN_AGAIN = "Run the stage that made it again"


def chunk_path(array_folder: Path, light: int, band: int) -> Path:
    """Return the file of one light and band of an array (lights, rows, columns, channels) chunked over both."""
    return array_folder / "c" / str(light) / str(band) / "0" / "0"


def write_chunk(path: Path, values: np.ndarray, *, compression: str) -> None:
    """Write one whole chunk of little-endian values. Raises OSError with the file's name where the disk is full."""
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
        raise UserError(f"{path}: part of a stored array is missing. {RUN_AGAIN}") from e
    payload = content[: len(content) - CHECKSUM_BYTES] if checksum else content
    if checksum and google_crc32c.value(payload) != int.from_bytes(content[-CHECKSUM_BYTES:], "little"):
        raise UserError(f"{path}: part of a stored array is damaged (checksum differs). {RUN_AGAIN}")
    found = len(payload) if compression == "none" else _stated_size(payload[:18].tobytes())
    if found != size:
        raise UserError(f"{path}: part of a stored array has {found} bytes, expected {size}. {RUN_AGAIN}")
    if compression == "zstd":
        from numcodecs.zstd import Zstd

        try:
            payload = Zstd().decode(payload, np.empty(size, np.uint8))
        except (RuntimeError, ValueError) as error:
            raise UserError(f"{path}: part of a stored array is damaged ({error}). {RUN_AGAIN}") from None
    return payload.view(kind).reshape(shape)


def _stated_size(start: bytes) -> int | None:
    """Return the unpacked size in bytes from a zstd frame's first bytes (RFC 8878, 3.1.1.1); None if not stated."""
    if len(start) < 6:
        return None
    single, flag = start[4] >> 5 & 1, start[4] >> 6
    first, count = 6 - single + (0, 1, 2, 4)[start[4] & 3], (single, 2, 4, 8)[flag]
    return int.from_bytes(start[first : first + count], "little") + 256 * (flag == 1) if count else None


METADATA = "zarr.json"


@dataclass(frozen=True)
class BandedArray:
    """One array, any part of which can be read; it is written in bands of whole rows, each a chunk.

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
        """Return the file of a chunk by its place in the grid; axes that are omitted have one chunk."""
        return self.folder.joinpath("c", *map(str, place), *["0"] * (self.ndim - len(place)))

    def places(self, ranges: Sequence[range] | None = None) -> Iterable[tuple[int, ...]]:
        """List grid places of the chunks that hold these indices of each axis, or of all."""
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
    """Arrays in one folder and their common attributes: `attrs`, changed and written only by `update`."""

    def __init__(self, folder: Path | str):
        """Open an existing group."""
        self.folder = Path(folder)
        self.attrs: Mapping[str, Any] = MappingProxyType(read_json(self.folder / METADATA).get("attributes", {}))

    @classmethod
    def create(cls, folder: Path | str, attributes: dict[str, Any] | None = None) -> "BandedGroup":
        """Create a group; FileExistsError where the folder exists."""
        Path(folder).mkdir(parents=True)
        _write_group(Path(folder), attributes or {})
        return cls(folder)

    def update(self, **attributes: Any) -> None:
        """Add attributes to the group."""
        self.attrs = MappingProxyType({**self.attrs, **attributes})
        _write_group(self.folder, dict(self.attrs))

    def names(self) -> list[str]:
        """List names of its arrays."""
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


TYPES = frozenset("bool int8 int16 int32 int64 uint8 uint16 uint32 uint64 float16 float32 float64".split())
PACKERS: tuple[list[str], ...] = ([], ["zstd"], ["crc32c"], ["zstd", "crc32c"])
"""Allowed codecs after `bytes`."""
OPTIONS = frozenset(("endian", "level", "checksum"))
OLD = frozenset((".zarray", ".zgroup", ".zattrs", ".zmetadata"))
REMEDY = "Run the stage that made it again; stores of other programs are not read"


def open_group(path: Path | str) -> BandedGroup:
    """Open a Zarr group for reading. UserError where it is none, or not as this project writes it (`expect_store`)."""
    expect_store(Path(path))
    return BandedGroup(path)


def open_made_by(stage: str, path: Path, what: str, version: int) -> tuple[BandedGroup, dict]:
    """Open a store of a stage with its attributes; UserError where there is none, or one of another format version.

    what: what it holds, for messages.
    """
    try:
        group = open_group(path)
    except FileNotFoundError as error:
        raise UserError(f"{path}: no {what} here; run {stage} first") from error
    stored = dict(group.attrs)
    if stored.get("format") != version:
        raise UserError(f"{path}: {what} of format {stored.get('format')}, expected {version}; run {stage} again")
    return group, stored


def open_array(path: Path | str) -> BandedArray:
    """Open a Zarr array for reading, as `open_group`."""
    expect_store(Path(path))
    return BandedArray.of(Path(path))


def expect_store(path: Path) -> None:
    """Raise UserError unless every node of a Zarr store is safe to open.

    Checked are its size, type and codecs, and that it has no links; chunks when they are read. FileNotFoundError where
    there is no store.
    """
    if not (path / METADATA).is_file():
        raise FileNotFoundError(f"{path}: no Zarr store here")
    nodes, chunks = [], Counter[str]()
    for name, entry in walk(path, "store_files"):
        if not entry.is_file(follow_symlinks=False) or entry.name in OLD:
            what = "an older format of Zarr" if entry.name in OLD else "a link, a pipe or a device"
            raise Refused(f"{path}/{name}", f"{what} in a Zarr store", remedy=REMEDY)
        if entry.name == METADATA:
            nodes.append(name.removesuffix(METADATA))
        else:
            chunks[f"/{name}".partition("/c/")[0].removeprefix("/")] += 1
    expect_bound(len(nodes), "store_arrays", str(path))
    for node in nodes:
        _expect_node(path / node, chunks[node.rstrip("/")])


def _expect_node(folder: Path, chunks: int) -> None:
    """Raise Refused unless a node is a group or a plain array; chunks: number of its files."""
    file = str(folder / METADATA)
    node = read_json(file)
    if node.get("zarr_format") != 3 or node.get("node_type") not in ("array", "group"):
        raise Refused(file, "not the metadata of a Zarr 3 array or group", remedy=REMEDY)
    if not isinstance(node.get("attributes", {}), dict) or node.get("consolidated_metadata"):
        raise Refused(file, "attributes that are no block, or consolidated metadata", remedy=REMEDY)
    if node["node_type"] == "group":
        return
    try:
        shape, chunk = node["shape"], node["chunk_grid"]["configuration"]["chunk_shape"]
        first, *packers = [codec["name"] for codec in node["codecs"]]
        options = {key: value for codec in node["codecs"] for key, value in codec.get("configuration", {}).items()}
        keys = node["chunk_key_encoding"]
        plain = node["chunk_grid"]["name"] == "regular" and keys["name"] == "default" and first == "bytes"
        plain &= keys.get("configuration", {}).get("separator", "/") == "/" and not node.get("storage_transformers")
        plain &= node["data_type"] in TYPES and packers in PACKERS and node.get("fill_value", 0) == 0
        plain &= options.keys() <= OPTIONS and options.get("endian", "little") == "little"
        plain &= all(type(n) is int and n >= 0 for n in (*shape, *chunk)) and len(shape) == len(chunk) <= 32
        plain &= min(chunk, default=1) > 0
    except (KeyError, TypeError, AttributeError, ValueError):
        plain = False
    if not plain:
        found = f"data type {node.get('data_type')!r:.60}, codecs {node.get('codecs')!r:.120}"
        raise Refused(file, "an array that this project does not write", found=found, remedy=REMEDY)
    item = np.dtype(node["data_type"]).itemsize
    count = math.prod(-(-n // c) for n, c in zip(shape, chunk, strict=True))
    expect_bound(math.prod(chunk) * item, "store_chunk_bytes", file)
    expect_bound(math.prod(shape) * item, "store_array_bytes", file)
    expect_bound(count, "store_chunks", file)
    expect_memory(math.prod(chunk) * item, file)
    if 100 * chunks + 1000 < count:  # those that are missing would be made up, one by one
        expected, found = f"{count} chunks", f"{chunks}"
        raise Refused(file, "most of an array is missing", expected=expected, found=found, remedy=REMEDY)


def load_arrays(path: Path | str | BytesIO, *, name: str | None = None) -> dict[str, np.ndarray]:
    """Load an .npz; UserError: missing, damaged, pickled objects, or beyond the bounds. name: for messages."""
    file = name or str(path)
    try:
        stream = path if isinstance(path, BytesIO) else os.fdopen(open_regular(path, file), "rb")
        with stream, zipfile.ZipFile(stream) as archive:
            members = archive.infolist()
            total = sum(member.file_size for member in members)
            expect_bound(total, "arrays_bytes", file)
            expect_bound(len(members), "store_arrays", file)
            expect_memory(total, file)
            return {m.filename.removesuffix(".npy"): _member(archive, m) for m in members}
    except FileNotFoundError:
        raise UserError(f"{file}: file not found") from None
    except UserError:
        raise
    except Exception as error:  # a damaged archive makes its readers fail in many ways
        raise UserError(f"{file}: arrays cannot be read ({str(error)[:200]}). {REMEDY}") from None


def _member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """Read one array, once its heading claims no more than the member holds."""
    with archive.open(member) as stream:
        version = np.lib.format.read_magic(stream)
        read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        if version not in read:
            raise ValueError(f"array of format {version}")
        shape, _, dtype = read[version](stream)
        if dtype.hasobject or math.prod(shape) * dtype.itemsize > member.file_size or min(shape, default=0) < 0:
            raise ValueError(f"array {member.filename[:60]!r} of {shape} {dtype} in {member.file_size} bytes")
    with archive.open(member) as stream:
        return np.lib.format.read_array(stream, allow_pickle=False)


@contextmanager
def understood(where: Path | str) -> Iterator[None]:
    """Convert errors from missing or wrong entries of a store to UserError."""
    try:
        yield
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
        cause = f"{type(error).__name__}: {str(error)[:120]}"
        raise UserError(
            f"{where}: what describes the data is damaged, or of another program ({cause}). {REMEDY}"
        ) from None


def channel_bits(channels: int) -> np.ndarray:
    """List the bits (channels,) uint8 by which a store marks channels; from the seventh on they share one."""
    return (1 << np.minimum(np.arange(channels), 6)).astype(np.uint8)


def plain(value: Any) -> Any:
    """Return a value as JSON holds it: dataclasses as dictionaries, arrays and tuples as lists."""
    if is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [plain(each) for each in value] if isinstance(value, list | tuple) else value


def tuples(value: Any) -> Any:
    """Return a value with tuples in place of lists, at any depth."""
    return tuple(tuples(each) for each in value) if isinstance(value, list | tuple) else value


class PlainFields:
    """Base of dataclasses of numbers, words, tuples and float64 arrays, with conversion to plain values."""

    def as_dict(self) -> dict[str, Any]:
        """Return its fields by name, for JSON."""
        return plain(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """Restore what `as_dict` returned; keys beyond the fields are ignored."""
        names = {field.name: field.type for field in fields(cls)}  # type: ignore[arg-type]
        return cls(
            **{
                name: np.array(values[name], np.float64) if kind is np.ndarray else tuples(values[name])
                for name, kind in names.items()
            }
        )


class ArrayFields:
    """Base of dataclasses of arrays, numbers and words, with conversion to arrays."""

    def as_arrays(self) -> dict[str, np.ndarray]:
        """Return its fields by name."""
        return {field.name: np.asarray(getattr(self, field.name)) for field in fields(self)}  # type: ignore[arg-type]

    @classmethod
    def from_arrays(cls, arrays: Any) -> Self:
        """Restore what `as_arrays` returned, from any mapping; arrays of no dimension become numbers or words."""
        values = {field.name: np.asarray(arrays[field.name]) for field in fields(cls)}  # type: ignore[arg-type]
        return cls(**{name: value if value.ndim else value.item() for name, value in values.items()})
