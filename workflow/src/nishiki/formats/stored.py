"""Opening Zarr stores and .npz files that others may have made: looked through first, then opened for reading.

A store says itself how large its arrays are and by which codecs they are unpacked; one of a stranger may claim any size
or, in Zarr's older format, a codec that runs code on reading. Only what this project writes is opened: Zarr 3, plain
numbers, the codecs `bytes`, `zstd` and `crc32c`; arrays without pickled objects.
"""

import math
import os
import struct
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from nishiki.errors import UserError
from nishiki.formats.files import Refused, expect_bound, expect_memory, open_regular, read_json, walk
from nishiki.formats.zarr_store import BandedGroup

TYPES = frozenset("bool int8 int16 int32 int64 uint8 uint16 uint32 uint64 float16 float32 float64".split())
CODECS = frozenset(("bytes", "zstd", "crc32c"))
METADATA = "zarr.json"
OLD = frozenset((".zarray", ".zgroup", ".zattrs", ".zmetadata"))
REMEDY = "Run the stage that made it again; stores of other programs are not read"
_ZSTD_MAGIC, _ZSTD_SKIPPED = 0xFD2FB528, range(0x184D2A50, 0x184D2A60)
_LONGEST_HEADER = 18  # bytes of a zstd frame: magic number 4, flags 1, window 1, dictionary 4, size 8
_BUFFER = 512  # bytes read about a header: many small blocks cost no call each, large ones are stepped over


def open_group(path: Path | str) -> Any:
    """Open a Zarr group for reading. UserError where it is none, or not as this project writes it (`expect_store`)."""
    import zarr

    expect_store(Path(path))
    return _opened(zarr.open_group, path)


def open_bands(path: Path | str) -> BandedGroup:
    """Open a group of arrays in bands of rows for reading, without the array library; otherwise as `open_group`."""
    expect_store(Path(path), library=False)
    return _opened(lambda folder, **_: BandedGroup(folder), path)


def open_made_by(stage: str, path: Path, what: str, version: int, opening: Callable = open_group) -> tuple[Any, dict]:
    """Open a store of a stage with its attributes; UserError where there is none, or one of another format version.

    what: what it holds, for messages; opening: `open_group` or `open_bands`.
    """
    try:
        group = opening(path)
    except FileNotFoundError as error:
        raise UserError(f"{path}: no {what} here; run {stage} first") from error
    stored = dict(group.attrs)
    if stored.get("format") != version:
        raise UserError(f"{path}: {what} of format {stored.get('format')}, expected {version}; run {stage} again")
    return group, stored


def open_array(path: Path | str) -> Any:
    """Open a Zarr array for reading, as `open_group`."""
    import zarr

    expect_store(Path(path))
    return _opened(zarr.open_array, path)


def _opened(opening: Callable[..., Any], path: Path | str) -> Any:
    try:
        return opening(path, mode="r", zarr_format=3)
    except Exception as error:  # whatever metadata that are wrong in themselves make the library stumble over
        raise UserError(f"{path}: Zarr store cannot be opened ({str(error)[:200]}). {REMEDY}") from None


def expect_store(path: Path, *, library: bool = True) -> None:
    """Raise UserError unless every node of a Zarr store is one that may be opened.

    Checked are its size, type and codecs, that it has no links, and no chunk that unpacks to more than its array says.
    FileNotFoundError where there is no store.

    library: the array library has to be able to open every array, too.
    """
    if not (path / METADATA).is_file():
        raise FileNotFoundError(f"{path}: no Zarr store here")
    files: dict[str, list[str]] = {}
    for name, entry in walk(path, "store_files"):
        if not entry.is_file(follow_symlinks=False) or entry.name in OLD:
            what = "an older format of Zarr" if entry.name in OLD else "a link, a pipe or a device"
            raise Refused(f"{path}/{name}", f"{what} in a Zarr store", remedy=REMEDY)
        if entry.name == METADATA:
            files.setdefault(name.removesuffix(METADATA), [])
    expect_bound(len(files), "store_arrays", str(path))
    for node in files:
        _expect_node(path / node, library=library)


def _expect_node(folder: Path, *, library: bool) -> None:
    file = folder / METADATA
    node = read_json(file)
    if node.get("zarr_format") != 3 or node.get("node_type") not in ("array", "group"):
        raise Refused(str(file), "not the metadata of a Zarr 3 array or group", remedy=REMEDY)
    if not isinstance(node.get("attributes", {}), dict) or node.get("consolidated_metadata"):
        raise Refused(str(file), "attributes that are no block, or consolidated metadata", remedy=REMEDY)
    if node["node_type"] == "array":
        _expect_array(folder, node, library=library)


def _expect_array(folder: Path, node: dict[str, Any], *, library: bool) -> None:
    file = str(folder / METADATA)
    try:
        shape, chunk = node["shape"], node["chunk_grid"]["configuration"]["chunk_shape"]
        codecs = [codec["name"] for codec in node["codecs"]]
        separator = node["chunk_key_encoding"].get("configuration", {}).get("separator", "/")
        plain = node["chunk_grid"]["name"] == "regular" and node["chunk_key_encoding"]["name"] == "default"
        sizes = [*shape, *chunk]
        dtype = node["data_type"]
        plain = plain and separator == "/" and not node.get("storage_transformers")
        plain = plain and dtype in TYPES and codecs[0] == "bytes" and set(codecs) <= CODECS and len(codecs) <= 4
        plain = plain and all(type(n) is int and n >= 0 for n in sizes) and len(shape) == len(chunk) <= 32
        plain = plain and min(chunk, default=1) > 0
    except (KeyError, TypeError, AttributeError, IndexError):
        plain = False
    if not plain:
        found = f"data type {node.get('data_type')!r:.60}, codecs {node.get('codecs')!r:.120}"
        raise Refused(file, "an array that this project does not write", found=found, remedy=REMEDY)
    item = np.dtype(dtype).itemsize
    counts = [-(-n // c) for n, c in zip(shape, chunk, strict=True)]
    expect_bound(math.prod(chunk) * item, "store_chunk_bytes", file)
    expect_bound(math.prod(shape) * item, "store_array_bytes", file)
    expect_bound(math.prod(counts), "store_chunks", file)
    expect_memory(math.prod(chunk) * item, file)
    chunks = _expect_chunks(folder, math.prod(chunk) * item, packed="zstd" in codecs, check=4 * ("crc32c" in codecs))
    if 100 * chunks + 1000 < math.prod(counts):  # those that are missing would be made up, one by one
        expected, found = f"{math.prod(counts)} chunks", f"{chunks}"
        raise Refused(file, "most of an array is missing", expected=expected, found=found, remedy=REMEDY)
    if 100 * chunks < math.prod(counts):
        expect_memory(math.prod(shape) * item, file)
    if library:
        import zarr

        _opened(zarr.open_array, folder)


def _expect_chunks(folder: Path, unpacked: int, *, packed: bool, check: int) -> int:
    """How many chunk files an array has; Refused where one would unpack to more than the array says.

    check: bytes of the checksum after what is packed.
    """
    place, count = folder / "c", 0
    if not place.exists():
        return 0
    for name, entry in walk(place, "store_files") if place.is_dir() else ():
        count += 1
        if packed:
            with os.fdopen(open_regular(entry.path, name), "rb", buffering=_BUFFER) as file:
                claimed = _content_size(file, os.fstat(file.fileno()).st_size - check)
        else:
            claimed = entry.stat(follow_symlinks=False).st_size
        if claimed is None or claimed > unpacked + 16:  # checksums inside the packed part
            found = "an unknown size" if claimed is None else f"{claimed} bytes"
            expected = f"at most {unpacked} bytes"
            raise Refused(f"{place}/{name}", "chunk of another size", expected=expected, found=found, remedy=REMEDY)
    return count + place.is_file()


def _content_size(file: BinaryIO, end: int) -> int | None:
    """Return how long the first `end` bytes of a file are unpacked, None where they do not say so.

    Only headers are read: that of a block of at most 128 KiB says where the next one is.
    """
    place, total = 0, 0
    try:
        while place < end:
            head = _piece(file, place, end)
            (magic,) = struct.unpack_from("<I", head)
            if magic in _ZSTD_SKIPPED:
                place += 8 + struct.unpack_from("<I", head, 4)[0]
                continue
            frame = _zstd_frame(file, place, end, head) if magic == _ZSTD_MAGIC else None
            if frame is None:
                return None
            size, place = frame
            total += size
    except (struct.error, IndexError):
        return None
    return total


def _piece(file: BinaryIO, place: int, end: int) -> bytes:
    """Read from `place`: as many bytes as the longest header has, fewer where `end` comes first."""
    if place >= end:
        return b""
    file.seek(place)
    return file.read(min(_LONGEST_HEADER, end - place))


def _zstd_frame(file: BinaryIO, place: int, end: int, head: bytes) -> tuple[int, int] | None:
    """Return the content size of the frame at `place`, whose first bytes are `head`, and where the next one begins.

    None where it does not tell its size, or ends before its last block begins.
    """
    flags = head[4]
    single, size_bytes = flags >> 5 & 1, (0, 2, 4, 8)[flags >> 6]
    if not size_bytes:
        if not single:
            return None
        size_bytes = 1
    start = 5 + (not single) + (0, 1, 2, 4)[flags & 3]
    if start + size_bytes > len(head):
        return None
    size = int.from_bytes(head[start : start + size_bytes], "little") + (256 if size_bytes == 2 else 0)
    place += start + size_bytes
    last = False
    while not last:
        header = _piece(file, place, end)[:3]
        if len(header) < 3:
            return None
        block = int.from_bytes(header, "little")
        last = bool(block & 1)
        place += 3 + (1 if block >> 1 & 3 == 1 else block >> 3)  # a run is one byte, however long
    return size, place + 4 * (flags >> 2 & 1)


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
