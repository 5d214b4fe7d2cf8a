"""Headers of photographs: size, depth, kind, coding, before anything large is allocated.

A damaged or hostile header may claim any size; what it claims is compared with what the file can hold and with the
bounds of `nishiki.formats.bounds`, and only then is the file decoded.
"""

from __future__ import annotations

import os
from pathlib import Path

from nishiki.formats.bounds import BOUNDS, bound, remedy
from nishiki.formats.files import Refused, open_regular
from nishiki.formats.image_header import ImageHeader
from nishiki.formats.picture_process import request_header
from nishiki.formats.problems import CaptureError, Problem, error
from nishiki.formats.text_tables import refusal


def read_header(path: Path, *, name: str | None = None) -> ImageHeader:
    """Header of a photograph; CaptureError (image-missing, image-unreadable, image-truncated, image-unsupported,
    image-absurd) if none.

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


def open_picture_file(path: Path, name: str) -> int:
    """A handle for reading a picture. CaptureError (image-missing, image-unreadable) where there is no regular file."""
    try:
        return open_regular(path, name)
    except FileNotFoundError as e:
        raise CaptureError(error("image-missing", name, "file is missing")) from e
    except Refused as e:
        raise CaptureError(refusal(e, "image-unreadable")) from e


def absurd_claim(header: ImageHeader, bytes_on_disk: int, name: str) -> Problem | None:
    """What is wrong with the size that a header claims, or None."""
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
