"""Pictures written by bands of rows, so that no writer holds a whole one: TIFF, OpenEXR, ENVI, JPEG and deep zooms.

TIFF: a strip a band, deflate, with unit, scale (33550 and 33922: GeoTIFF, OGC 19-008r4), profile and a value for no
data (42113: GDAL). OpenEXR (File Layout, Academy Software Foundation): scan lines in ZIP blocks of 16, each split into
even and odd bytes, differenced, and packed by zlib; the library takes whole pictures only. ENVI: a header in text, and
float32 samples by rows, in each row by bands (BIL).

Two layouts of a deep zoom: Microsoft's as OpenLIME reads it (`NAME.dzi`, `NAME_files/LEVEL/COLUMN_ROW.jpg`; level 0 is
the largest that fits into one tile, not a single pixel), and that of IIIF's Image API 3.0 at level 0 (`info.json`,
`REGION/SIZE/0/default.jpg`).
"""

import json
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from itertools import chain
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from nishiki.errors import NotFinite, UserError
from nishiki.threads import in_threads, strips


class EnviWriter(AbstractContextManager["EnviWriter"]):
    """Writer of `NAME.img` row by row, and of `NAME.hdr` beside it.

    Parameters
    ----------
    path : Path
        File with the samples.
    shape : (int, int)
        Rows and columns.
    wavelengths_nm : sequence of float
        Wavelengths of the bands.
    description : str
        Meaning of the values.
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
        rows, columns, bands = self._shape
        lines = [
            "ENVI",
            f"description = {{{description.translate(str.maketrans('{}', '()'))}}}",
            *(f"samples = {columns}", f"lines = {rows}", f"bands = {bands}", "header offset = 0"),
            *("file type = ENVI Standard", "data type = 4", "interleave = bil", "byte order = 0"),
            "wavelength units = Nanometers",
            f"wavelength = {{{', '.join(f'{float(value):g}' for value in wavelengths_nm)}}}",
            "data ignore value = 0",
        ]
        if pitch_mm:
            size = f"{pitch_mm:.9g}, {pitch_mm:.9g}"
            left, top = -columns * pitch_mm / 2, rows * pitch_mm / 2  # of pixel (1, 1), as in our TIFF files
            lines.append(f"pixel size = {{{size}, units=mm}}")
            lines.append(f"map info = {{Arbitrary, 1, 1, {left:.9g}, {top:.9g}, {size}, units=mm}}")
        path.with_suffix(".hdr").write_text("\n".join(lines) + "\n", encoding="ascii", errors="replace")
        self._file = open(path, "wb")

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


CLASSIC_LIMIT = 3 << 30
"""Largest size of samples, in bytes, for 32-bit offsets, with room for data that deflate enlarges."""


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
        Meaning of the values.
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

    def pack_bands() -> Iterator[bytes]:
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
            pack_bands(), shape=shape if samples > 1 else shape[:2], dtype=dtype, rowsperstrip=len(first),
            photometric="rgb" if samples == 3 else "minisblack", compression="zlib", predictor=dtype.kind == "u",
            description=description.encode(), software=software.encode(), iccprofile=icc or None, extratags=extra,
            metadata=None, **scale,
        )  # fmt: skip


MAGIC, VERSION, LONG_NAMES = 20000630, 2, 0x400
BLOCK_ROWS = 16  # of ZIP compression, fixed by the format
Attribute = str | float | Sequence[float]


class ExrWriter(AbstractContextManager["ExrWriter"]):
    """Writer of one scan-line picture of float32 channels, rows from top to bottom.

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
        for rows, stored in in_threads(self._pack, [values[part] for part in strips(len(values), BLOCK_ROWS)]):
            self._offsets.append(self._file.tell())
            self._file.write(struct.pack("<ii", self._row, len(stored)) + stored)
            self._row += rows

    def _pack(self, rows: np.ndarray) -> tuple[int, bytes]:
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


TILE, OVERLAP = 254, 1
IIIF_TILE, IIIF_WHOLE = 512, 1024  # tiles without overlap; longest side of the whole picture in one file
Samples = np.ndarray  # (rows, columns, 3) uint8, R, G, B; may lie on the disk


def picture_on_disk(path: Path, rows: int, columns: int) -> Samples:
    """Make an empty picture in a file, written and read by bands."""
    return np.memmap(path, np.uint8, "w+", shape=(rows, columns, 3))


def write_jpeg(path: Path, picture: Samples, quality: int) -> None:
    """Write one JPEG file with full resolution of all three channels."""
    path.write_bytes(jpeg_bytes(picture, quality))


def jpeg_bytes(picture: Samples, quality: int, *, halved: bool = False) -> bytes:
    """Encode a JPEG with Huffman codes of its own.

    Parameters
    ----------
    picture : (rows, columns, 3) uint8
        Red, green, blue, or three channels of any meaning.
    quality : int
        Of libjpeg, 0 .. 100.
    halved : bool
        Whether the differences of colour have half the resolution; else all three channels have the full one.

    Returns
    -------
    bytes
        Content of the file.
    """
    import cv2

    sampling = cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420 if halved else cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444
    options = [
        *(cv2.IMWRITE_JPEG_QUALITY, quality),
        *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling),
        *(cv2.IMWRITE_JPEG_OPTIMIZE, 1),
    ]
    return _encode(".jpg", picture[..., ::-1], options)


def png_bytes(picture: np.ndarray, level: int | None = None) -> bytes:
    """Encode a PNG.

    Parameters
    ----------
    picture : (rows, columns) or (rows, columns, samples) uint8 or uint16
        Grey, or red, green, blue, and alpha where there is a fourth sample.
    level : int or None
        Compression of zlib, 0 .. 9; None: the library's usual one.

    Returns
    -------
    bytes
        Content of the file.
    """
    import cv2

    order = [2, 1, 0, 3][: picture.shape[2]] if picture.ndim == 3 and picture.shape[2] > 1 else slice(None)
    return _encode(".png", picture[..., order], [] if level is None else [cv2.IMWRITE_PNG_COMPRESSION, level])


def _encode(kind: str, picture: np.ndarray, options: list[int]) -> bytes:
    import cv2

    done, coded = cv2.imencode(kind, np.ascontiguousarray(picture), options)
    if not done:
        raise UserError(
            f"picture of {' x '.join(map(str, picture.shape))}: cannot be stored as {kind}. Remedy: shrink it"
        )
    return coded.tobytes()


def read_jpeg(path: Path) -> Samples:
    """Read the samples of a JPEG file."""
    import cv2

    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None:
        raise ValueError(f"{path}: not a picture")
    return np.ascontiguousarray(picture[..., ::-1])


def write_deep_zoom(folder: Path, name: str, picture: Samples, scratch: Path, quality: int) -> None:
    """Write tiles of all levels, the first a single tile, the last at full resolution. scratch: for smaller copies."""
    rows, columns = picture.shape[:2]
    levels = (-(-max(rows, columns) // TILE) - 1).bit_length()
    (folder / f"{name}.dzi").write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<Image xmlns="http://schemas.microsoft.com/deepzoom/2008" Format="jpg" Overlap="{OVERLAP}" '
        f'TileSize="{TILE}"><Size Width="{columns}" Height="{rows}"/></Image>\n'
    )
    present = picture
    for level in range(levels, -1, -1):
        here = folder / f"{name}_files" / str(level)
        here.mkdir(parents=True)
        for row, column, window in _tiles(*present.shape[:2]):
            (here / f"{column}_{row}.jpg").write_bytes(jpeg_bytes(present[window], quality))
        if level:
            present = _halve(present, scratch / f"{name}_{level - 1}")


def write_iiif_image(folder: Path, address: str, picture: Samples, scratch: Path, quality: int) -> None:
    """Write tiles of all levels at full, half, quarter ... size, named as by a server of the Image API 3.0.

    address: of the folder on the web, which info.json must state. scratch: for smaller copies. The whole picture is
    there in two sizes, that of the last tile and `iiif_size`; more of it has to be put together from tiles.
    """
    import cv2

    rows, columns = picture.shape[:2]
    factors, present = [1], picture
    width, height = iiif_size(rows, columns)
    while True:
        factor = factors[-1]
        high, wide = present.shape[:2]
        for top in range(0, high, IIIF_TILE):
            for left in range(0, wide, IIIF_TILE):
                tile = present[top : top + IIIF_TILE, left : left + IIIF_TILE]
                x, y = left * factor, top * factor
                region = f"{x},{y},{min(IIIF_TILE * factor, columns - x)},{min(IIIF_TILE * factor, rows - y)}"
                _iiif_file(folder, region, f"{tile.shape[1]},{tile.shape[0]}").write_bytes(jpeg_bytes(tile, quality))
        if width <= wide < 2 * width:
            whole = cv2.resize(np.asarray(present), (width, height), interpolation=cv2.INTER_AREA)
        if max(high, wide) <= IIIF_TILE:
            break
        factors.append(2 * factor)
        present = _halve(present, scratch / f"factor_{2 * factor}")
    wholes = {present.shape[1::-1]: present, (width, height): whole}  # viewers ask for both
    for (wide, high), shown in wholes.items():
        _iiif_file(folder, "full", f"{wide},{high}").write_bytes(jpeg_bytes(shown, quality))
    _iiif_file(folder, "full", "max").write_bytes(jpeg_bytes(whole, quality))
    info = {
        "@context": "http://iiif.io/api/image/3/context.json", "id": address, "type": "ImageService3",
        "protocol": "http://iiif.io/api/image", "profile": "level0", "width": columns, "height": rows,
        "maxWidth": IIIF_WHOLE, "sizes": [{"width": wide, "height": high} for wide, high in wholes],
        "tiles": [{"width": IIIF_TILE, "scaleFactors": factors}],
    }  # fmt: skip
    (folder / "info.json").write_text(json.dumps(info, indent=1) + "\n", encoding="utf-8")


def read_iiif_tiles(folder: Path, rows: int, columns: int) -> Iterator[tuple[tuple[slice, slice], Samples]]:
    """Yield tiles of `write_iiif_image` at full resolution with their windows, decoded."""
    for top in range(0, rows, IIIF_TILE):
        for left in range(0, columns, IIIF_TILE):
            high, wide = min(IIIF_TILE, rows - top), min(IIIF_TILE, columns - left)
            path = folder / f"{left},{top},{wide},{high}" / f"{wide},{high}" / "0" / "default.jpg"
            yield (slice(top, top + high), slice(left, left + wide)), read_jpeg(path)


def iiif_size(rows: int, columns: int) -> tuple[int, int]:
    """Compute width and height of `write_iiif_image`'s larger whole picture: at most IIIF_WHOLE pixels a side."""
    share = min(1.0, IIIF_WHOLE / max(rows, columns))
    return max(1, round(columns * share)), max(1, round(rows * share))


def _iiif_file(folder: Path, region: str, size: str) -> Path:
    here = folder / region / size / "0"
    here.mkdir(parents=True, exist_ok=True)
    return here / "default.jpg"


def read_full_resolution(folder: Path, name: str, rows: int, columns: int) -> Iterator[tuple[slice, Samples]]:
    """Yield bands of the last level of a deep zoom, a row of tiles each, decoded."""
    level = max(int(path.name) for path in (folder / f"{name}_files").iterdir())
    band = np.empty((0, columns, 3), np.uint8)
    for row, column, window in _tiles(rows, columns):
        tile = read_jpeg(folder / f"{name}_files/{level}/{column}_{row}.jpg")
        top, left = row * TILE, column * TILE
        high, wide = min(TILE, rows - top), min(TILE, columns - left)
        if column == 0:
            band = np.empty((high, columns, 3), np.uint8)
        inner = tile[top - window[0].start :, left - window[1].start :][:high, :wide]
        band[:, left : left + wide] = inner
        if left + wide == columns:
            yield slice(top, top + high), band


def _tiles(rows: int, columns: int) -> Iterator[tuple[int, int, tuple[slice, slice]]]:
    """Yield row and column of every tile, and its window with the overlap."""
    for row in range(-(-rows // TILE)):
        for column in range(-(-columns // TILE)):
            yield row, column, (_window(row, rows), _window(column, columns))


def _window(number: int, size: int) -> slice:
    return slice(max(number * TILE - OVERLAP, 0), min((number + 1) * TILE + OVERLAP, size))


def _halve(picture: Samples, path: Path) -> Samples:
    """Reduce to half the size, rounded up: averages of four."""
    import cv2

    rows, columns = picture.shape[:2]
    half = picture_on_disk(path, -(-rows // 2), -(-columns // 2))
    for part in strips(rows):
        band = np.asarray(picture[part])
        band = cv2.copyMakeBorder(band, 0, len(band) % 2, 0, columns % 2, cv2.BORDER_REPLICATE)
        means = cv2.resize(band, (band.shape[1] // 2, len(band) // 2), interpolation=cv2.INTER_AREA)
        half[part.start // 2 : part.start // 2 + len(means)] = means
    return half
