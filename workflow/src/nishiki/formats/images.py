"""Read photographs: their headers before anything large is allocated, and the stored codes, unchanged.

A damaged or hostile header may claim any size; what it claims is compared with what the file can hold and with the
bounds of `nishiki.formats.files`, and only then is the file decoded. Channels come in the order red, green, blue."""

import os
from contextlib import suppress
from pathlib import Path

import numpy as np

from nishiki.formats.files import BOUNDS, Refused, bound, open_regular, remedy
from nishiki.formats.picture_files import NO_EXIF, Exif, ImageHeader, match_channels
from nishiki.formats.picture_process import hold, request_codes, request_header
from nishiki.formats.problems import CaptureError, Problem, error, refuse
from nishiki.formats.text_tables import refusal


def read_header(path: Path, *, name: str | None = None) -> ImageHeader:
    """Read the header of a photograph.

    CaptureError: image-missing, image-unreadable, image-truncated, image-unsupported, image-absurd.

    Files that are cut off are found without decoding them: by the end marker of JPEG, the last chunk of PNG and the
    places of the strips of TIFF. name: how to call the file in messages (default: its own name).
    """
    name = name or path.name
    handle = open_picture_file(path, name)
    try:
        header = request_header(handle, path.suffix, name)
        problem = absurd_claim(header, os.fstat(handle).st_size, name)
    finally:
        os.close(handle)
    if problem:
        raise CaptureError(problem)
    return header


def read_exif(path: Path, *, name: str | None = None) -> Exif:
    """Read the camera's facts of a photograph; an empty record where there are none, or the file is damaged."""
    try:
        return read_header(path, name=name).exif
    except CaptureError:
        return NO_EXIF


def open_picture_file(path: Path, name: str) -> int:
    """Open a picture. CaptureError (image-missing, image-unreadable) where there is no regular file."""
    try:
        return open_regular(path, name)
    except FileNotFoundError as e:
        raise CaptureError(error("image-missing", name, "file is missing")) from e
    except Refused as e:
        raise CaptureError(refusal(e, "image-unreadable")) from e


def absurd_claim(header: ImageHeader, bytes_on_disk: int, name: str) -> Problem | None:
    """Return the problem of the size claimed by a header, or None."""
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


LEAST_SHIFT = 0.5  # pixels: smaller displacements, which the light imitates on smooth relief, are left alone
COARSE = 40  # blocks along the longer side of a picture that is looked at as a whole
Region = tuple[int, int, int, int]  # row, column, rows, columns


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
    """Read codes (rows, columns, channels) uint8, uint16 or float32, channels in the order of their names.

    luma: for a JPEG decode its luma plane only, (rows, columns, 1); half the time of colour. An alpha channel is
    dropped, or follows the others where alpha is asked for. Raises CaptureError (image-missing, image-unreadable,
    image-truncated, image-unsupported, image-absurd, channels-differ).
    """
    name = name or path.name
    header = header or read_header(path, name=name)
    expect_channels(header, channels, name)
    handle = open_picture_file(path, name)
    try:
        wanted = {"channels": channels, "luma": luma, "region": region}
        codes = request_codes(handle, header, path.suffix, name, wanted)
    finally:
        os.close(handle)
    count = 1 if codes.shape[2] == 1 else len(channels) + (alpha and header.alpha)
    return codes if codes.shape[2] == count else codes[:, :, :count]


def read_jpeg_bytes(content: bytes, name: str) -> np.ndarray:
    """Decode codes (rows, columns, channels) uint8 of a JPEG picture in memory. CaptureError as `read_codes`."""
    handle = hold(content)
    try:
        header = request_header(handle, ".jpg", name)
        problem = absurd_claim(header, len(content), name)
        if problem or header.kind != "jpeg":
            raise CaptureError(problem or error("image-unreadable", name, "not a JPEG picture"))
        return request_codes(handle, header, ".jpg", name, {"channels": (), "luma": False, "region": None})
    finally:
        os.close(handle)


def expect_channels(header: ImageHeader, channels: tuple[str, ...], name: str) -> None:
    """Raise CaptureError (channels-differ) unless the file has these channels, an alpha channel apart."""
    count = len(channels)
    if header.channels == count or (header.alpha and header.channels == count + 1):
        return
    if header.kind == "exr":
        with suppress(ValueError):
            match_channels(header.names, channels)
            return
    found = f"{header.channels} ({', '.join(header.names)})" if header.names else f"{header.channels}"
    expected = f"{count} ({', '.join(channels)})"
    remedy = "Leave it out if the other photographs have these channels, else list its own under camera.channels"
    refuse("channels-differ", name, "number of channels", expected=expected, found=found, remedy=remedy)


def read_coarse(path: Path, encoding: str | None = None) -> np.ndarray:
    """Read the mean of the channels over equal blocks, (rows, columns) float64 linear, 1 at full scale.

    encoding : `linear`, `srgb`, or None for what the file states; COARSE blocks lie along the longer side.
    CaptureError where the picture cannot be decoded.
    """
    import cv2

    header = read_header(path)
    names = header.names or tuple(f"c{i}" for i in range(header.channels - header.alpha))
    codes = read_codes(path, names, header=header)
    top = np.iinfo(codes.dtype).max if codes.dtype.kind == "u" else 1.0
    scale = min(COARSE / max(header.rows, header.columns), 1.0)
    size = max(round(header.columns * scale), 1), max(round(header.rows * scale), 1)
    small = cv2.resize(codes.astype(np.float32) / np.float32(top), size, interpolation=cv2.INTER_AREA)
    return header.choose_coding(encoding or "file").curve.decode(small.reshape(size[1], size[0], -1).mean(axis=2))
