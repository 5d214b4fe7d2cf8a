"""Pictures written by bands of rows, so that no writer holds a whole one: TIFF, OpenEXR, and ENVI of many bands.

TIFF: a strip a band, deflate, with unit, scale (33550 and 33922: GeoTIFF, OGC 19-008r4), profile and a value for no
data (42113: GDAL). OpenEXR (File Layout, Academy Software Foundation): scan lines in ZIP blocks of 16, each split into
even and odd bytes, differenced, and packed by zlib; the library takes whole pictures only. ENVI: a header in text, and
float32 samples by rows, in each row by bands (BIL).
"""

import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from nishiki.errors import NotFinite
from nishiki.threads import in_threads, strips


class EnviWriter:
    """Writes `NAME.img` row by row, and `NAME.hdr` beside it.

    Parameters
    ----------
    path : Path
        Of the samples.
    shape : (int, int)
        Rows and columns.
    wavelengths_nm : sequence of float
        Of the bands.
    description : str
        What the values mean.
    pitch_mm : float or None
        Distance of two pixels.
    """

    def __init__(
        self,
        path: Path,
        shape: tuple[int, int],
        wavelengths_nm: Sequence[float] | np.ndarray,
        *,
        description: str,
        pitch_mm: float | None = None,
    ) -> None:
        self._shape = (*shape, len(wavelengths_nm))
        self._row = 0
        path.with_suffix(".hdr").write_text(
            envi_header(self._shape, wavelengths_nm, description, pitch_mm), encoding="ascii", errors="replace"
        )
        self._file = open(path, "wb")

    def __enter__(self) -> "EnviWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()
        if kind is None and self._row != self._shape[0]:
            raise ValueError(f"expected {self._shape[0]} rows, found {self._row}")

    def write(self, rows: np.ndarray) -> None:
        """Write the next rows (r, columns, bands)."""
        self._file.write(np.ascontiguousarray(rows.transpose(0, 2, 1), "<f4").tobytes())
        self._row += len(rows)


def envi_header(
    shape: tuple[int, int, int], wavelengths_nm: Sequence[float] | np.ndarray, description: str, pitch_mm: float | None
) -> str:
    """Compose the text of a header."""
    rows, columns, bands = shape
    lines = [
        "ENVI",
        f"description = {{{description.translate(str.maketrans('{}', '()'))}}}",
        f"samples = {columns}",
        f"lines = {rows}",
        f"bands = {bands}",
        "header offset = 0",
        "file type = ENVI Standard",
        "data type = 4",
        "interleave = bil",
        "byte order = 0",
        "wavelength units = Nanometers",
        f"wavelength = {{{', '.join(f'{float(value):g}' for value in wavelengths_nm)}}}",
        "data ignore value = 0",
    ]
    if pitch_mm:
        size = f"{pitch_mm:.9g}, {pitch_mm:.9g}"
        left, top = -columns * pitch_mm / 2, rows * pitch_mm / 2  # of pixel (1, 1), as in our TIFF files
        lines.append(f"pixel size = {{{size}, units=mm}}")
        lines.append(f"map info = {{Arbitrary, 1, 1, {left:.9g}, {top:.9g}, {size}, units=mm}}")
    return "\n".join(lines) + "\n"


CLASSIC_LIMIT = 3 << 30
"""Bytes of samples up to which offsets of 32 bits do, with room for data that deflate makes larger."""


def write_tiff(
    path: Path,
    bands: Iterable[np.ndarray],
    shape: tuple[int, int, int],
    *,
    description: str,
    software: str,
    pitch_mm: float | None = None,
    icc: bytes = b"",
    nodata: str = "",
) -> None:
    """Write one picture, rows from top to bottom; BigTIFF where the samples could pass 4 GiB.

    Parameters
    ----------
    path : Path
        File to make.
    bands : iterable of (r, columns, samples) or (r, columns) uint8, uint16 or float32
        All as high as the first but the last. ValueError where they are not `shape` together.
    shape : (int, int, int)
        Rows, columns, samples a pixel (1 or 3).
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
    import tifffile

    bands = iter(bands)
    first = next(bands)
    rows, columns, samples = shape
    dtype = first.dtype.newbyteorder("<")
    scale: dict[str, Any] = {}
    extra: list[tuple[int, int, int, Any, bool]] = [(42113, 2, 0, nodata, True)] if nodata else []
    if pitch_mm:
        scale = {"resolution": (10 / pitch_mm, 10 / pitch_mm), "resolutionunit": "CENTIMETER"}
        # The middle of the picture is the origin, y points up: a map for programs that read maps.
        left, top = -columns * pitch_mm / 2, rows * pitch_mm / 2
        extra += [
            (33550, 12, 3, (pitch_mm, pitch_mm, 0.0), True),
            (33922, 12, 6, (0.0, 0.0, 0.0, left, top, 0.0), True),
        ]

    def packed() -> Iterator[bytes]:
        row = 0
        for band in chain([first], bands):
            values = np.ascontiguousarray(band, dtype).reshape(-1, columns, samples)
            if len(values) != min(len(first), rows - row):
                raise ValueError(f"expected {min(len(first), rows - row)} rows, found {len(values)}")
            row += len(values)
            if dtype.kind == "u":  # whole numbers as differences along a row
                values = np.concatenate([values[:, :1], np.diff(values, axis=1)], axis=1)
            yield zlib.compress(values.tobytes(), 4)
        if row != rows:
            raise ValueError(f"expected {rows} rows, found {row}")

    size = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
    with tifffile.TiffWriter(path, bigtiff=size > CLASSIC_LIMIT, byteorder="<") as tiff:
        tiff.write(
            packed(), shape=shape if samples > 1 else shape[:2], dtype=dtype, rowsperstrip=len(first),
            photometric="rgb" if samples == 3 else "minisblack", compression="zlib", predictor=dtype.kind == "u",
            description=description.encode(), software=software.encode(), iccprofile=icc or None, extratags=extra,
            metadata=None, **scale,
        )  # fmt: skip


MAGIC, VERSION, LONG_NAMES = 20000630, 2, 0x400
BLOCK_ROWS = 16  # of ZIP compression, fixed by the format
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
        self._path, self._file = path, open(path, "wb")
        self._file.write(_header([names[k] for k in self._order], rows, columns, attributes))
        self._table = self._file.tell()
        self._file.write(bytes(8 * -(-rows // BLOCK_ROWS)))

    def __enter__(self) -> "ExrWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._file:
            if kind is None:
                self._finish()

    def write(self, band: np.ndarray) -> None:
        """Write the next rows (r, columns, channels). NotFinite, which is a defect, where one of them is not."""
        band = np.asarray(band, np.float32)
        if not np.isfinite(band).all():
            raise NotFinite(f"{self._path}: values that are not finite below row {self._row}")
        values = np.concatenate([self._waiting, band])
        whole = len(values) // BLOCK_ROWS * BLOCK_ROWS
        self._put(values[:whole])
        self._waiting = values[whole:]

    def _put(self, values: np.ndarray) -> None:
        """Write rows in blocks, the last of which may be lower."""
        for rows, stored in in_threads(self._packed, [values[part] for part in strips(len(values), BLOCK_ROWS)]):
            self._offsets.append(self._file.tell())
            self._file.write(struct.pack("<ii", self._row, len(stored)) + stored)
            self._row += rows

    def _packed(self, rows: np.ndarray) -> tuple[int, bytes]:
        raw = np.ascontiguousarray(rows[..., self._order].transpose(0, 2, 1), "<f4").tobytes()
        data = np.frombuffer(raw, np.uint8)
        split = np.concatenate([data[::2], data[1::2]])  # even bytes before odd ones, each less the one before, + 128
        split[1:] = np.diff(split) + np.uint8(128)
        return len(rows), min(zlib.compress(split.tobytes(), 4), raw, key=len)

    def _finish(self) -> None:
        self._put(self._waiting)
        if self._row != self._shape[0]:
            raise ValueError(f"expected {self._shape[0]} rows, found {self._row}")
        self._file.seek(self._table)
        self._file.write(struct.pack(f"<{len(self._offsets)}Q", *self._offsets))


def _header(names: Sequence[str], rows: int, columns: int, attributes: Mapping[str, Attribute]) -> bytes:
    window = struct.pack("<4i", 0, 0, columns - 1, rows - 1)
    # type of samples (2: float32), linear or not, sampling
    channels = b"".join(name.encode("utf-8") + b"\0" + struct.pack("<iBxxxii", 2, 0, 1, 1) for name in names)
    fixed = [
        ("channels", "chlist", channels + b"\0"),
        ("compression", "compression", b"\x03"),  # ZIP
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
