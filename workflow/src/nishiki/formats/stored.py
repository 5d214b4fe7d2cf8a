"""Opening Zarr stores and .npz files that others may have made: looked through first, then opened for reading.

A store says itself how large its arrays are and by which codecs they are unpacked; one of a stranger may claim any size
or, in Zarr's older format, a codec that runs code on reading. Only what this project writes is opened: Zarr 3, plain
numbers, the codecs `bytes`, `zstd` and `crc32c`; arrays without pickled objects.
"""

import math
import os
import zipfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

import numpy as np

from nishiki.errors import UserError
from nishiki.formats.files import Refused, expect_bound, expect_memory, open_regular, read_json, walk
from nishiki.formats.zarr_store import METADATA, BandedArray, BandedGroup

TYPES = frozenset("bool int8 int16 int32 int64 uint8 uint16 uint32 uint64 float16 float32 float64".split())
PACKERS: tuple[list[str], ...] = ([], ["zstd"], ["crc32c"], ["zstd", "crc32c"])
"""Codecs after `bytes`."""
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
    """Raise UserError unless every node of a Zarr store is one that may be opened.

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
    """Refused unless a node is a group or a plain array; chunks: number of its files."""
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
    """Load an .npz; UserError: missing, damaged, pickled objects, or beyond what is read. name: for messages."""
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
    """One array, once its heading is known to claim no more than the member holds."""
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
    """UserError in place of what entries that are missing or of a wrong kind make a reader stumble over."""
    try:
        yield
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
        cause = f"{type(error).__name__}: {str(error)[:120]}"
        raise UserError(
            f"{where}: what describes the data is damaged, or of another program ({cause}). {REMEDY}"
        ) from None
