"""Size, depth and kind of a photograph from its first bytes, and whether it ends, before anything large is allocated.

A damaged or hostile header may claim any size; what it claims is compared with what the file can hold and with the
bounds of `nishiki.formats.bounds`, and only then is the file decoded.
"""

from __future__ import annotations

import io
import os
import struct
from pathlib import Path
from typing import BinaryIO

from nishiki.formats.bounds import BOUNDS, bound, remedy
from nishiki.formats.files import Refused, open_regular
from nishiki.formats.image_header import RAW_SUFFIXES, ImageHeader, Sample
from nishiki.formats.problems import CaptureError, Problem, error
from nishiki.formats.text_tables import refusal

DEFLATE_RATIO = 1040  # deflate cannot shrink more than 1032:1, so a larger claim is damage or a decompression bomb
TAIL, BLOCK = 1 << 12, 1 << 20  # bytes in which the end of a picture is looked for first, and in turn
JPEG_RATIO = 3000  # a progressive JPEG of one even grey needs one bit for 64 samples, or for 768 with coarse colour


def read_header(path: Path, *, name: str | None = None) -> ImageHeader:
    """Header of a photograph; CaptureError (image-missing, image-unreadable, image-truncated, image-absurd) if none.

    Files that are cut off are found without decoding them: by the end marker of JPEG, the last chunk of PNG and the
    places of the strips of TIFF. name: how to call the file in messages (default: its own name).
    """
    name = name or path.name
    try:
        with os.fdopen(open_regular(path, name), "rb") as file:
            start = file.read(32)
            if path.suffix.lower() in RAW_SUFFIXES:
                from nishiki.formats.raw import read_raw_header

                header = read_raw_header(path, name)
            else:
                header = _parse(file, start, path, name)
            bytes_on_disk = file.seek(0, 2)
    except FileNotFoundError as e:
        raise CaptureError(error("image-missing", name, "file is missing")) from e
    except Refused as e:
        raise CaptureError(refusal(e, "image-unreadable")) from e
    problem = _absurd(header, bytes_on_disk, name)
    if problem:
        raise CaptureError(problem)
    return header


def jpeg_header(content: bytes) -> ImageHeader:
    """Header of a JPEG picture in memory. ValueError where it is none, or cannot hold the size that it claims."""
    try:
        header = _jpeg(io.BytesIO(content))
    except (struct.error, EOFError) as e:
        raise ValueError(str(e)) from None
    if header.stored_bytes > header.ratio * len(content):
        raise ValueError(f"{header.rows} x {header.columns} in {len(content)} bytes")
    return header


def _parse(file: BinaryIO, start: bytes, path: Path, name: str) -> ImageHeader:
    try:
        if start.startswith(b"\x89PNG\r\n\x1a\n"):
            return _png(file)
        if start.startswith(b"\xff\xd8"):
            return _jpeg(file)
        if start[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
            from nishiki.formats.tiff import tiff_header

            return tiff_header(file)
        if start.startswith(b"\x76\x2f\x31\x01"):
            from nishiki.formats.exr import exr_header

            return exr_header(path)
    except (struct.error, IndexError, KeyError, ValueError, EOFError, OSError, OverflowError, RuntimeError) as e:
        what = "image is cut off, or its header is damaged"
        found, remedy = str(e) or type(e).__name__, "Copy the file again from the camera or the archive"
        raise CaptureError(error("image-truncated", name, what, found=found, remedy=remedy)) from e
    expected = "PNG, JPEG, TIFF, OpenEXR or camera raw"
    found = f"{start[:8]!r}" if start else "an empty file"
    remedy = "Copy the file again from the camera or the archive, or move it away"
    raise CaptureError(error("image-unreadable", name, "not an image", expected=expected, found=found, remedy=remedy))


def _absurd(header: ImageHeader, bytes_on_disk: int, name: str) -> Problem | None:
    size = f"{header.rows} x {header.columns} x {header.channels}"
    if min(header.rows, header.columns, header.channels) < 1:
        return error("image-absurd", name, "image without pixels", found=size)
    claims = {
        "image_side": max(header.rows, header.columns),
        "image_pixels": header.rows * header.columns,
        "image_bytes": max(header.decoded_bytes, header.stored_bytes),
        "image_file_bytes": bytes_on_disk,
        "memory_bytes": 2 * header.decoded_bytes + bytes_on_disk,
    }
    for limit, claimed in claims.items():
        if claimed > bound(limit):
            what, unit = "image header claims an absurd size", BOUNDS[limit].unit
            expected, found = f"at most {bound(limit)} {unit}", f"{size}, {claimed} {unit}"
            return error("image-absurd", name, what, expected=expected, found=found, remedy=remedy(limit))
    if header.ratio and header.stored_bytes > header.ratio * bytes_on_disk:
        found = f"{size} in {bytes_on_disk} bytes"
        return error("image-absurd", name, "image cannot hold the size that its header claims", found=found)
    return None


def _png(file: BinaryIO) -> ImageHeader:
    file.seek(8)
    length, tag = struct.unpack(">I4s", file.read(8))
    if tag != b"IHDR" or length != 13:
        raise ValueError("no IHDR chunk")
    columns, rows, depth, colour = struct.unpack(">IIBB", file.read(10))
    if depth not in (1, 2, 4, 8, 16):
        raise ValueError(f"samples of {depth} bits")
    channels = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}[colour]
    expect_end(file, file.tell(), b"\0\0\0\0IEND\xaeB`\x82", "PNG")
    sample: Sample = "uint16" if depth == 16 else "uint8"
    stored = rows * (columns * (1 if colour == 3 else channels) * depth // 8)
    return ImageHeader(
        "png", rows, columns, channels, sample, alpha=colour in (4, 6), stored_bytes=stored, ratio=DEFLATE_RATIO
    )


def _jpeg(file: BinaryIO) -> ImageHeader:
    header, start = jpeg_scan(file)
    expect_end(file, start, b"\xff\xd9", "JPEG")
    return header


def jpeg_scan(file: BinaryIO) -> tuple[ImageHeader, int]:
    """Header from the start of frame, and the place of the start of scan, over whole segments: a thumbnail in the EXIF
    segment has both of its own. EOFError, ValueError or struct.error where there is none."""
    file.seek(2)
    header = None
    while True:
        marker = file.read(2)
        while len(marker) == 2 and marker == b"\xff\xff":
            marker = b"\xff" + file.read(1)
        if len(marker) < 2 or marker[0] != 0xFF:
            raise EOFError("JPEG without a scan" if header else "no start of frame")
        if marker[1] in (0x01, *range(0xD0, 0xD8)):
            continue
        if marker[1] == 0xDA and header:
            return header, file.tell() - 2
        (length,) = struct.unpack(">H", file.read(2))
        if length < 2:
            raise ValueError(f"JPEG segment of {length} bytes")
        following = file.tell() + length - 2
        if 0xC0 <= marker[1] <= 0xCF and marker[1] not in (0xC4, 0xC8, 0xCC) and not header:
            depth, rows, columns, channels = struct.unpack(">BHHB", file.read(6))
            if depth != 8 or channels not in (1, 3):
                raise ValueError(f"JPEG of {depth} bits and {channels} components; 8 bits and 1 or 3 are read")
            stored = rows * columns * channels
            header = ImageHeader("jpeg", rows, columns, channels, "uint8", stored_bytes=stored, ratio=JPEG_RATIO)
        file.seek(following)


def expect_end(file: BinaryIO, start: int, mark: bytes, form: str) -> None:
    """EOFError unless a mark stands between `start` and the end of the file, nearly always in its last bytes: some
    programs append data of their own. Nothing but the end of the picture may have the bytes of the mark."""
    end = file.seek(0, 2)
    for place in (max(start, end - TAIL), *range(start, end, BLOCK)):
        file.seek(place)
        if mark in file.read(BLOCK + len(mark)):
            return
    raise EOFError(f"{form} ends after {end} bytes, without its end marker")
