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


def create_array(group: Any, name: str, shape: tuple, chunks: tuple, dtype: Any, *, compression: str = "none") -> Any:
    """A Zarr array whose chunks this module can write. compression: 'none' | 'zstd'."""
    from zarr.codecs import Crc32cCodec, ZstdCodec

    packers = [ZstdCodec(level=ZSTD_LEVEL)] if compression == "zstd" else []
    return group.create_array(
        name,
        shape=shape,
        chunks=chunks,
        dtype=dtype,
        compressors=[*packers, Crc32cCodec()],
        filters=None,
        config={"write_empty_chunks": True},
    )


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


def read_chunk(path: Path, shape: tuple, dtype: np.dtype, *, compression: str) -> np.ndarray:
    """Read one chunk and verify its checksum; UserError where it is missing or damaged."""
    remedy = "Run ingest again"
    try:
        with path.open("rb", buffering=0) as file:
            length = os.fstat(file.fileno()).st_size
            payload, checksum = file.read(max(length - 4, 0)), file.read()
    except FileNotFoundError as e:
        raise UserError(f"{path}: part of the ingested frames is missing. {remedy}") from e
    if len(checksum) != 4 or google_crc32c.value(payload) != int.from_bytes(checksum, "little"):
        raise UserError(f"{path}: part of the ingested frames is damaged (checksum differs). {remedy}")
    if compression == "zstd":
        from numcodecs.zstd import Zstd

        payload = Zstd().decode(payload)
    values = np.frombuffer(payload, np.dtype(dtype).newbyteorder("<"))
    if values.size != np.prod(shape):
        raise UserError(f"{path}: {values.size} values, expected {tuple(shape)}. {remedy}")
    return values.reshape(shape)
