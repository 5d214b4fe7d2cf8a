"""TIFF written by bands of rows: a strip a band, deflate, with unit, scale, colour profile and a value for no data.

OpenCV writes whole pictures and none of these fields. BigTIFF, where the samples could pass 4 GiB. Field numbers: TIFF
6.0 (Adobe, 1992); 33550 and 33922: GeoTIFF (OGC 19-008r4); 42113: GDAL.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

import numpy as np

ASCII, SHORT, LONG, RATIONAL, UNDEFINED, DOUBLE, LONG8 = 2, 3, 4, 5, 7, 12, 16
_CODES = {SHORT: "H", LONG: "I", DOUBLE: "d", LONG8: "Q"}
_BYTES = {ASCII: 1, SHORT: 2, LONG: 4, RATIONAL: 8, UNDEFINED: 1, DOUBLE: 8, LONG8: 8}
CLASSIC_LIMIT = 3 << 30
"""Bytes of samples up to which offsets of 32 bits do, with room for data that deflate makes larger."""
_Field = tuple[int, int, bytes]  # number, type, value


class TiffWriter:
    """Writes one picture, rows from top to bottom.

    Parameters
    ----------
    path : Path
        File to make; it is complete once the `with` block ends.
    shape : (int, int, int)
        Rows, columns, samples a pixel (1 or 3).
    dtype : str
        `uint8`, `uint16` or `float32`.
    band_rows : int
        Rows of every band but the last.
    description : str
        What the values mean.
    software : str
        Program and version.
    pitch_mm : float or None
        Distance of two pixels; None where the capture states no scale.
    icc : bytes
        Colour profile; empty: none.
    nodata : str
        Value that stands for no data; empty: every value is data.
    """

    def __init__(
        self,
        path: Path,
        shape: tuple[int, int, int],
        dtype: str,
        *,
        band_rows: int,
        description: str,
        software: str,
        pitch_mm: float | None = None,
        icc: bytes = b"",
        nodata: str = "",
    ) -> None:
        self._shape, self._dtype, self._band_rows = shape, np.dtype(dtype).newbyteorder("<"), band_rows
        self._big = int(np.prod(shape, dtype=np.int64)) * self._dtype.itemsize > CLASSIC_LIMIT
        self._fields = self._described(description, software, pitch_mm, icc, nodata)
        self._strips: list[tuple[int, int]] = []
        self._row = 0
        self._file: BinaryIO = open(path, "wb")
        self._file.write(b"II" + (struct.pack("<HHHQ", 43, 8, 0, 0) if self._big else struct.pack("<HI", 42, 0)))

    def __enter__(self) -> TiffWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._file:
            if kind is None:
                self._finish()

    def write(self, band: np.ndarray) -> None:
        """The next rows (r, columns, samples) or, of one sample a pixel, (r, columns)."""
        rows, columns, samples = self._shape
        values = np.ascontiguousarray(band, self._dtype).reshape(-1, columns, samples)
        if len(values) != min(self._band_rows, rows - self._row):
            raise ValueError(f"expected {min(self._band_rows, rows - self._row)} rows, found {len(values)}")
        if self._dtype.kind == "u":
            values = np.concatenate([values[:, :1], np.diff(values, axis=1)], axis=1)
        data = zlib.compress(values.tobytes(), 4)
        self._strips.append((self._file.tell(), len(data)))
        self._file.write(data)
        self._row += len(values)

    def _described(
        self, description: str, software: str, pitch_mm: float | None, icc: bytes, nodata: str
    ) -> list[_Field]:
        rows, columns, samples = self._shape
        bits, form = 8 * self._dtype.itemsize, 3 if self._dtype.kind == "f" else 1
        fields = [
            _numbers(256, LONG, columns),
            _numbers(257, LONG, rows),
            _numbers(258, SHORT, *[bits] * samples),
            _numbers(259, SHORT, 8),  # deflate
            _numbers(262, SHORT, 2 if samples == 3 else 1),
            (270, ASCII, description.encode("utf-8") + b"\0"),
            _numbers(277, SHORT, samples),
            _numbers(278, LONG, self._band_rows),
            _numbers(284, SHORT, 1),  # samples of a pixel together
            (305, ASCII, software.encode("utf-8") + b"\0"),
            _numbers(317, SHORT, 2 if self._dtype.kind == "u" else 1),  # whole numbers as differences along a row
            _numbers(339, SHORT, *[form] * samples),
        ]
        if pitch_mm:
            per_centimetre = struct.pack("<II", round(10e4 / pitch_mm), 10_000)
            fields += [(282, RATIONAL, per_centimetre), (283, RATIONAL, per_centimetre), _numbers(296, SHORT, 3)]
            # The middle of the picture is the origin, y points up: a map for programs that read maps.
            left, top = -columns * pitch_mm / 2, rows * pitch_mm / 2
            fields += [
                (33550, DOUBLE, struct.pack("<3d", pitch_mm, pitch_mm, 0)),
                (33922, DOUBLE, struct.pack("<6d", 0, 0, 0, left, top, 0)),
            ]
        if icc:
            fields.append((34675, UNDEFINED, icc))
        if nodata:
            fields.append((42113, ASCII, nodata.encode() + b"\0"))
        return fields

    def _finish(self) -> None:
        if self._row != self._shape[0]:
            raise ValueError(f"expected {self._shape[0]} rows, found {self._row}")
        kind = LONG8 if self._big else LONG
        fields = [
            *self._fields,
            _numbers(273, kind, *(place for place, _ in self._strips)),
            _numbers(279, kind, *(size for _, size in self._strips)),
        ]
        inline, form = (8, "<HHQ") if self._big else (4, "<HHI")
        entries = []
        for number, kind, value in sorted(fields):
            entry = struct.pack(form, number, kind, len(value) // _BYTES[kind])
            if len(value) > inline:
                place = self._aligned()
                self._file.write(value)
                value = struct.pack("<Q" if self._big else "<I", place)
            entries.append(entry + value.ljust(inline, b"\0"))
        directory = self._aligned()
        self._file.write(struct.pack("<Q" if self._big else "<H", len(entries)) + b"".join(entries) + bytes(inline))
        self._file.seek(8 if self._big else 4)
        self._file.write(struct.pack("<Q" if self._big else "<I", directory))

    def _aligned(self) -> int:
        """The present place, after a byte of filling where it is odd."""
        self._file.write(bytes(self._file.tell() % 2))
        return self._file.tell()


def strips(rows: int, band_rows: int) -> Iterator[slice]:
    """Bands of rows from top to bottom, all as high but the last."""
    return (slice(start, min(start + band_rows, rows)) for start in range(0, rows, band_rows))


def _numbers(number: int, kind: int, *values: int) -> _Field:
    return number, kind, struct.pack(f"<{len(values)}{_CODES[kind]}", *values)
