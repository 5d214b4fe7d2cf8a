"""Decoding photographs: channels in the order red, green, blue; the stored codes, nothing applied to them."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np

from nishiki.formats.image_header import ImageHeader
from nishiki.formats.image_headers import expect_end, jpeg_scan, read_header
from nishiki.formats.problems import CaptureError, error

Region = tuple[int, int, int, int]  # row, column, rows, columns
MOST_SCANS = 200  # of a JPEG; progressive ones have about ten


def read_codes(
    path: Path,
    channels: tuple[str, ...],
    *,
    header: ImageHeader | None = None,
    luma: bool = False,
    region: Region | None = None,
    name: str | None = None,
    alpha: bool = False,
) -> np.ndarray:
    """Stored codes (rows, columns, channels) uint8, uint16 or float32, channels in the order of their names.

    luma: for a JPEG decode its luma plane only, (rows, columns, 1); half the time of colour. An alpha channel is
    dropped, or follows the others where alpha is asked for. Raises CaptureError (image-missing, image-unreadable,
    image-truncated, image-absurd, channels-differ).
    """
    name = name or path.name
    header = header or read_header(path, name=name)
    expect_channels(header, channels, name)
    if header.kind == "raw":
        from nishiki.formats.raw import read_raw

        codes = read_raw(path, name)
    else:
        try:
            codes = _decode(path, header, channels, luma and header.kind == "jpeg", alpha)
        except Exception as e:  # whatever a damaged file makes a decoder stumble over, its own error classes included
            found = (str(e) or type(e).__name__)[:300]
            remedy = "Copy the file again from the camera or the archive"
            raise CaptureError(error("image-truncated", name, "cannot be decoded", found=found, remedy=remedy)) from e
    if codes.shape[:2] != (header.rows, header.columns):
        found = f"{codes.shape[0]} x {codes.shape[1]}, header {header.rows} x {header.columns}"
        raise CaptureError(error("image-truncated", name, "decoded size differs from the header's", found=found))
    if str(codes.dtype) != header.sample:
        found = f"{codes.dtype}, header {header.sample}"
        raise CaptureError(error("image-truncated", name, "decoded samples are of another type", found=found))
    if region is not None:
        row, column, rows, columns = region
        codes = np.ascontiguousarray(codes[row : row + rows, column : column + columns])
    return codes


def expect_channels(header: ImageHeader, channels: tuple[str, ...], name: str) -> None:
    """CaptureError (channels-differ) unless the file has these channels, an alpha channel apart."""
    count = len(channels)
    if header.channels == count or (header.alpha and header.channels == count + 1):
        return
    if header.kind == "exr":
        from nishiki.formats.exr import match_channels

        try:
            match_channels(header.names, channels)
            return
        except ValueError:
            pass
    found = f"{header.channels} ({', '.join(header.names)})" if header.names else f"{header.channels}"
    expected = f"{count} ({', '.join(channels)})"
    remedy = "Leave it out if the other photographs have these channels, else list its own under camera.channels"
    raise CaptureError(
        error("channels-differ", name, "number of channels", expected=expected, found=found, remedy=remedy)
    )


def _decode(path: Path, header: ImageHeader, channels: tuple[str, ...], luma: bool, alpha: bool) -> np.ndarray:
    if header.kind == "exr":
        from nishiki.formats.exr import read_exr

        return read_exr(path, channels)
    data = np.fromfile(path, np.uint8)
    if header.kind == "png":
        check_png(data)
    elif header.kind == "jpeg":
        check_jpeg(data)
    elif header.kind == "tiff":
        from nishiki.formats.tiff import decode_tiff, opencv_reads

        stored = data.tobytes()
        if not opencv_reads(stored):
            return _select_channels(decode_tiff(stored), len(channels), alpha)
    return _select_channels(_opencv(data, header, luma, alpha), len(channels) if not luma else 1, alpha)


def _opencv(data: np.ndarray, header: ImageHeader, luma: bool, alpha: bool) -> np.ndarray:
    import cv2

    if header.pages > 1:
        done, pages = cv2.imdecodemulti(data, cv2.IMREAD_UNCHANGED)
        if not done:
            raise ValueError("pages cannot be decoded")
        return np.concatenate([_to_rgb(page) for page in pages], axis=2)
    if header.kind == "jpeg":
        # EXIF orientation would turn frames against their mask; IMREAD_UNCHANGED ignores it too but is slower.
        flag = cv2.IMREAD_GRAYSCALE if luma or header.channels == 1 else cv2.IMREAD_COLOR_RGB
        pixels = cv2.imdecode(data, flag | cv2.IMREAD_IGNORE_ORIENTATION)
        if pixels is not None:
            return pixels[:, :, None] if pixels.ndim == 2 else pixels
    elif header.kind == "png" and header.channels == 2 and not alpha:
        pixels = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    else:
        pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ValueError("image data are damaged")
    return _to_rgb(pixels)


def _to_rgb(pixels: np.ndarray) -> np.ndarray:
    """OpenCV's blue, green, red(, alpha) to red, green, blue(, alpha); always three dimensions."""
    import cv2

    if pixels.ndim == 2:
        return pixels[:, :, None]
    if pixels.shape[2] == 3:
        return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)
    return cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGBA) if pixels.shape[2] == 4 else pixels


def _select_channels(codes: np.ndarray, count: int, alpha: bool) -> np.ndarray:
    """The first channels, and an alpha channel that follows them where it is asked for; OpenCV decodes grey as three
    colours where there is one."""
    if codes.shape[2] < count:
        raise ValueError(f"{codes.shape[2]} channels were decoded where {count} are needed")
    if alpha and count == 1 and codes.shape[2] == 4:
        return codes[:, :, ::3]
    return codes[:, :, : count + alpha]


def check_png(data: np.ndarray) -> None:
    """ValueError unless every chunk is whole, has its checksum and the last one is there: decoders let some pass."""
    view, place, tag = memoryview(data.data), 8, b""
    while tag != b"IEND":
        if place + 12 > len(view):
            raise EOFError(f"PNG ends after {len(view)} bytes, within its data")
        (length,) = struct.unpack(">I", view[place : place + 4])
        if place + 12 + length > len(view):
            raise EOFError(f"PNG ends after {len(view)} bytes, within its data")
        tag = bytes(view[place + 4 : place + 8])
        (checksum,) = struct.unpack(">I", view[place + 8 + length : place + 12 + length])
        if zlib.crc32(view[place + 4 : place + 8 + length]) != checksum:
            raise ValueError(f"PNG chunk {tag.decode('latin-1')} at byte {place} has a wrong checksum")
        place += 12 + length


def check_jpeg(data: np.ndarray) -> None:
    """EOFError unless the end marker follows the scan: decoders fill what is missing with grey. ValueError where it has
    more scans than any encoder writes: each is a pass over the whole picture, however few bytes it has.

    Within the coded scan 0xFF is never followed by 0xD9, so an end marker after the start of scan is the real one.
    """
    stored = data.tobytes()
    file = io.BytesIO(stored)
    _, start = jpeg_scan(file)
    expect_end(file, start, b"\xff\xd9", "JPEG")
    if stored.count(b"\xff\xda", start) > MOST_SCANS:
        raise ValueError(f"JPEG of more than {MOST_SCANS} scans")
