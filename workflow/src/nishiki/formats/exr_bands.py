"""OpenEXR by bands of rows, so that neither a writer nor a checker holds a whole picture: scan lines, ZIP blocks of 16.

The library in use takes and gives whole pictures only. Layout of the file: OpenEXR File Layout (Academy Software
Foundation); a block is split into even and odd bytes, differenced, and packed by zlib.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

import numpy as np

MAGIC, VERSION, LONG_NAMES = 20000630, 2, 0x400
BLOCK_ROWS = 16
ZIP = 3
FLOAT = 2  # the only type of sample that is written here
Attribute = str | float | Sequence[float]


class ExrWriter:
    """Writes one scan-line picture of float32 channels, rows from top to bottom.

    Parameters
    ----------
    path : Path
        File to make; it is complete once the `with` block ends.
    names : sequence of str
        Names of the channels, in the order of the last axis of what is written.
    rows, columns : int
        Size of the picture.
    attributes : mapping of str to str, float or sequence of float
        Header: texts, numbers, and eight numbers for `chromaticities`.
    """

    def __init__(
        self, path: Path, names: Sequence[str], rows: int, columns: int, attributes: Mapping[str, Attribute]
    ) -> None:
        self._order = sorted(range(len(names)), key=lambda k: names[k].encode("utf-8"))
        self._shape = (rows, columns, len(names))
        self._waiting = np.empty((0, columns, len(names)), np.float32)
        self._row = 0
        self._offsets: list[int] = []
        self._file: BinaryIO = open(path, "wb")
        self._file.write(_header([names[k] for k in self._order], rows, columns, attributes))
        self._table = self._file.tell()
        self._file.write(bytes(8 * -(-rows // BLOCK_ROWS)))

    def __enter__(self) -> ExrWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._file:
            if kind is None:
                self._finish()

    def write(self, band: np.ndarray) -> None:
        """The next rows (r, columns, channels)."""
        values = np.concatenate([self._waiting, np.asarray(band, np.float32)])
        blocks = len(values) // BLOCK_ROWS
        for number in range(blocks):
            self._block(values[number * BLOCK_ROWS : (number + 1) * BLOCK_ROWS])
        self._waiting = values[blocks * BLOCK_ROWS :]

    def _block(self, rows: np.ndarray) -> None:
        raw = np.ascontiguousarray(rows[..., self._order].transpose(0, 2, 1), "<f4").tobytes()
        packed = zlib.compress(_differenced(raw), 4)
        self._offsets.append(self._file.tell())
        data = packed if len(packed) < len(raw) else raw
        self._file.write(struct.pack("<ii", self._row, len(data)) + data)
        self._row += len(rows)

    def _finish(self) -> None:
        if len(self._waiting):
            self._block(self._waiting)
        if self._row != self._shape[0]:
            raise ValueError(f"expected {self._shape[0]} rows, found {self._row}")
        self._file.seek(self._table)
        self._file.write(struct.pack(f"<{len(self._offsets)}Q", *self._offsets))


def read_blocks(path: Path) -> Iterator[np.ndarray] | None:
    """The blocks (rows, channels, columns) of a file that `ExrWriter` wrote; None where the file is of another kind."""
    with open(path, "rb") as file:
        magic, version = struct.unpack("<ii", file.read(8))
        if magic != MAGIC or version & ~LONG_NAMES != VERSION:
            return None
        header: dict[str, bytes] = {}
        while name := _text(file):
            _text(file)
            (size,) = struct.unpack("<i", file.read(4))
            header[name] = file.read(size)
        start = file.tell()
    types = _types(header["channels"])
    if header["compression"] != bytes([ZIP]) or set(types) != {FLOAT}:
        return None
    left, top, right, bottom = struct.unpack("<4i", header["dataWindow"])
    return _blocks(path, start, bottom - top + 1, len(types), right - left + 1)


def _blocks(path: Path, start: int, rows: int, channels: int, columns: int) -> Iterator[np.ndarray]:
    count = -(-rows // BLOCK_ROWS)
    with open(path, "rb") as file:
        file.seek(start)
        offsets = struct.unpack(f"<{count}Q", file.read(8 * count))
        for number, offset in enumerate(offsets):
            file.seek(offset)
            _, size = struct.unpack("<ii", file.read(8))
            high = min(BLOCK_ROWS, rows - number * BLOCK_ROWS)
            data = file.read(size)
            raw = data if size == 4 * high * channels * columns else _summed(zlib.decompress(data))
            yield np.frombuffer(raw, "<f4").reshape(high, channels, columns)


def _header(names: Sequence[str], rows: int, columns: int, attributes: Mapping[str, Attribute]) -> bytes:
    window = struct.pack("<4i", 0, 0, columns - 1, rows - 1)
    channels = b"".join(name.encode("utf-8") + b"\0" + struct.pack("<iBxxxii", FLOAT, 0, 1, 1) for name in names)
    fixed = [
        ("channels", "chlist", channels + b"\0"),
        ("compression", "compression", bytes([ZIP])),
        ("dataWindow", "box2i", window),
        ("displayWindow", "box2i", window),
        ("lineOrder", "lineOrder", b"\0"),
        ("pixelAspectRatio", "float", struct.pack("<f", 1)),
        ("screenWindowCenter", "v2f", bytes(8)),
        ("screenWindowWidth", "float", struct.pack("<f", 1)),
    ]
    given = [(name, *_attribute(value)) for name, value in attributes.items()]
    long = any(len(name.encode("utf-8")) > 31 for name in (*names, *attributes))
    parts = [struct.pack("<ii", MAGIC, VERSION | (LONG_NAMES if long else 0))]
    for name, kind, value in sorted([*fixed, *given]):
        parts.append(name.encode("utf-8") + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value)
    return b"".join(parts) + b"\0"


def _attribute(value: Attribute) -> tuple[str, bytes]:
    if isinstance(value, str):
        return "string", value.encode("utf-8")
    if isinstance(value, int | float):
        return "float", struct.pack("<f", value)
    return "chromaticities", struct.pack("<8f", *value)


def _differenced(raw: bytes) -> bytes:
    """Even bytes before odd ones, each but the first as its difference from the one before, plus 128."""
    data = np.frombuffer(raw, np.uint8)
    split = np.concatenate([data[::2], data[1::2]])
    split[1:] = np.diff(split) + np.uint8(128)
    return split.tobytes()


def _summed(packed: bytes) -> bytes:
    """The inverse of `_differenced`."""
    split = np.frombuffer(packed, np.uint8).copy()
    split[1:] -= np.uint8(128)
    split = np.add.accumulate(split, dtype=np.uint8)
    data = np.empty_like(split)
    half = (len(split) + 1) // 2
    data[::2], data[1::2] = split[:half], split[half:]
    return data.tobytes()


def _types(channels: bytes) -> list[int]:
    """Type of each channel of a chlist."""
    types, place = [], 0
    while channels[place]:
        place = channels.index(b"\0", place) + 1
        types.append(struct.unpack_from("<i", channels, place)[0])
        place += 16
    return types


def _text(file: BinaryIO) -> str:
    letters = bytearray()
    while (letter := file.read(1)) not in (b"\0", b""):
        letters += letter
    return letters.decode("utf-8")
