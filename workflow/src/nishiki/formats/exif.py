"""What a camera wrote beside a photograph: exposure, orientation, colour space, model (Exif 2.32, CIPA DC-008)."""

import io
import logging
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

MOST_BYTES = 1 << 16  # of the Exif block of a JPEG or PNG: a JPEG segment holds no more
_FACTS = (272, 274, 33434, 33437, 34665, 34855)  # model, orientation, exposure, aperture, Exif directory, sensitivity
_ADOBE_RGB = b"R03"  # interoperability index of Adobe RGB (DCF 2.0)


@dataclass(frozen=True)
class Exif:
    """Facts that a camera recorded; None or '' where the file does not state them."""

    exposure_s: float | None = None  # exposure time in seconds
    f_number: float | None = None  # focal length over aperture
    iso: float | None = None  # sensitivity
    orientation: int = 1  # 1 to 8, how a viewer would turn the picture (1: not at all)
    colour_space: str = ""  # 'srgb', 'adobe' or ''
    model: str = ""  # of the camera
    # date and time of the exposure as 'YYYY:MM:DD HH:MM:SS' with a fraction of a second where it is stated
    taken: str = ""
    focal_35mm: float | None = None  # focal length in mm of a lens with the same field on 36 x 24 mm


NO_EXIF = Exif()


def exif_of(file: BinaryIO) -> Exif:
    """Read the camera's facts of an open JPEG, PNG, TIFF or TIFF-like raw file; none where they are damaged."""
    try:
        block = _exif_block(file)
        if block is None:
            return NO_EXIF
        import tifffile

        quiet_tifffile()
        with tifffile.TiffFile(block, name="picture") as tiff:
            return exif_of_page(tiff.pages.first)
    except (struct.error, ValueError, OSError, RuntimeError, KeyError, IndexError, TypeError, OverflowError):
        return NO_EXIF


def exif_of_page(page: Any) -> Exif:
    """Read the facts in the directory of a TIFF page of tifffile, and in its Exif directory."""
    tags = {tag.name: tag.value for tag in page.tags if tag.code in _FACTS}
    inner = tags.get("ExifTag")
    values = {**tags, **inner} if isinstance(inner, dict) else tags
    index, place = b"", values.get("InteroperabilityTag")
    if isinstance(place, int):  # a directory whose first field, of 12 bytes after the count, ends in the index
        page.parent.filehandle.seek(place + 10)
        index = page.parent.filehandle.read(3)
    orientation = positive_number(values.get("Orientation"))
    space = "srgb" if values.get("ColorSpace") == 1 else "adobe" if index == _ADOBE_RGB else ""
    taken, fraction = (str(values.get(key) or "").strip() for key in ("DateTimeOriginal", "SubsecTimeOriginal"))
    return Exif(
        exposure_s=positive_number(values.get("ExposureTime")),
        f_number=positive_number(values.get("FNumber")),
        iso=positive_number(values.get("ISOSpeedRatings")),
        focal_35mm=positive_number(values.get("FocalLengthIn35mmFilm")),
        orientation=int(orientation) if orientation and orientation <= 8 else 1,
        colour_space=space,
        model=str(values.get("Model") or "").strip()[:100],
        taken=f"{taken}.{fraction}" if taken and fraction.isdecimal() else taken,
    )


def quiet_tifffile() -> None:
    """Keep tifffile from logging what it makes of damaged files, and that an Exif block has no pixels."""
    logging.getLogger("tifffile").setLevel(logging.CRITICAL + 1)


def positive_number(value: Any) -> float | None:
    """Read a positive finite number from a whole number, a rational (numerator, denominator) or a list of one."""
    if isinstance(value, tuple) and len(value) == 2 and value[1]:
        value = value[0] / value[1]
    elif isinstance(value, tuple) and value:
        value = value[0]
    return float(value) if isinstance(value, (int, float)) and 0 < value < float("inf") else None


def _exif_block(file: BinaryIO) -> BinaryIO | None:
    """Open the TIFF stream that holds the facts: the file itself, or the block inside a JPEG or PNG."""
    file.seek(0)
    start = file.read(12)
    if start[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        file.seek(0)
        return file
    segments = jpeg_segments(file) if start[:2] == b"\xff\xd8" else png_chunks(file) if start[1:4] == b"PNG" else ()
    for mark, place, length in segments:
        file.seek(place)
        content = file.read(min(length, MOST_BYTES)) if mark in (b"\xff\xe1", b"eXIf") else b""
        if mark == b"eXIf" or content.startswith(b"Exif\0\0"):
            return io.BytesIO(content.removeprefix(b"Exif\0\0"))
    return None


def jpeg_segments(file: BinaryIO) -> Iterator[tuple[bytes, int, int]]:
    """Yield (marker of two bytes, place, length) of each segment of a JPEG before its first scan."""
    place = 2
    while True:
        file.seek(place)
        marker = file.read(2)
        while marker == b"\xff\xff":
            place += 1
            marker = b"\xff" + file.read(1)
        if len(marker) < 2 or marker[0] != 0xFF:
            return
        if marker[1] == 0x01 or 0xD0 <= marker[1] < 0xD8:
            place += 2
            continue
        (length,) = struct.unpack(">H", file.read(2))
        yield marker, place + 4, length - 2
        if marker[1] == 0xDA or length < 2:
            return
        place += 2 + length


def png_chunks(file: BinaryIO) -> Iterator[tuple[bytes, int, int]]:
    """Yield (type of four bytes, place, length) of each chunk of a PNG before its pixels."""
    place = 8
    while True:
        file.seek(place)
        heading = file.read(8)
        if len(heading) < 8 or heading[4:] == b"IDAT":
            return
        (length,) = struct.unpack(">I", heading[:4])
        yield heading[4:], place + 8, length
        place += 12 + length
