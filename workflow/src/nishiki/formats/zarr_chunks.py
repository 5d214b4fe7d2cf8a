"""Chunk files of a Zarr v3 array, written and read without the array library in between.

A chunk is its bytes, little-endian, optionally compressed with zstd, followed by their CRC-32C: what Zarr's codecs
`bytes`, `zstd` and `crc32c` make. Whole-array reading through zarr gives the same values (tested); going past it takes
about a third of the time for the thousands of large chunks of a capture.
"""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np

from nishiki.errors import UserError

ZSTD_LEVEL = 1
CHECKSUM_BYTES = 4
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
            _write_all(file, part, path)


def _write_all(file: io.RawIOBase, part: bytes, path: Path) -> None:
    """Write all of `part`: a disk that becomes full takes a piece first, and tells the reason when the rest comes."""
    rest = memoryview(part)
    while rest:
        try:
            rest = rest[file.write(rest) :]
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(path)) from None


def read_chunk(path: Path, shape: tuple, dtype: np.dtype, *, compression: str, checksum: bool = True) -> np.ndarray:
    """Read one chunk and verify its checksum; UserError where it is missing or damaged.

    checksum: whether a CRC-32C ends it; a zstd frame may have one of its own instead.
    """
    with _opened(path) as file:
        length = os.fstat(file.fileno()).st_size
        payload, end = file.read(max(length - CHECKSUM_BYTES * checksum, 0)), file.read()
    if checksum:
        _expect_checksum(payload, end, path)
    if compression == "zstd":
        payload = _unpacked(payload, path)
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


def _unpacked(payload: bytes, path: Path) -> bytes:
    from numcodecs.zstd import Zstd

    try:
        return Zstd().decode(payload)
    except RuntimeError as error:
        raise UserError(f"{path}: part of a stored array is damaged ({error}). {REMEDY}") from None
