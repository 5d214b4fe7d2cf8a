"""Decoding photographs: channels in the order red, green, blue; the stored codes, nothing applied to them."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from nishiki.formats.exr import match_channels
from nishiki.formats.image_header import ImageHeader
from nishiki.formats.image_headers import absurd_claim, open_picture_file, read_header
from nishiki.formats.picture_process import hold, request_codes, request_header
from nishiki.formats.problems import CaptureError, error

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
    """Stored codes (rows, columns, channels) uint8, uint16 or float32, channels in the order of their names.

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
    """Codes (rows, columns, channels) uint8 of a JPEG picture in memory. CaptureError as `read_codes`."""
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
    """CaptureError (channels-differ) unless the file has these channels, an alpha channel apart."""
    count = len(channels)
    if header.channels == count or (header.alpha and header.channels == count + 1):
        return
    if header.kind == "exr":
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
