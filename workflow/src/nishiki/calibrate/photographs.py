"""Photographs that a calibration reads: files or folders, as codes, all of one size."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nishiki.capture.layouts import photographs_in
from nishiki.capture.taking import channel_names
from nishiki.errors import UserError
from nishiki.formats.image_header import ImageHeader
from nishiki.formats.image_headers import read_header
from nishiki.formats.images import read_codes

LUMA = np.array([0.299, 0.587, 0.114], np.float32)


def list_photographs(names: Sequence[str], *, least: int = 1, what: str = "photographs") -> list[Path]:
    """Files as given, folders replaced by the photographs in them in natural order; masks in folders are left out.

    UserError where a name is no file, two are called alike, they are fewer than `least`, or sizes differ.
    """
    paths: list[Path] = []
    for name in names:
        path = Path(name)
        if path.is_dir():
            paths += photographs_in(path)
        elif path.is_file():
            paths.append(path)
        else:
            raise UserError(f"{name}: no such file or folder. Remedy: correct the path of the {what}")
    if len(paths) < least:
        raise UserError(f"{what}: expected at least {least}, found {len(paths)}")
    headers = [read_header(path) for path in paths]
    sizes = {(h.rows, h.columns, h.channels, h.sample) for h in headers}
    if len(sizes) > 1:
        raise UserError(
            f"{what}: expected one size, depth and number of channels, found "
            f"{'; '.join(f'{c} x {r}, {n} channels of {s}' for r, c, n, s in sorted(sizes))}. Remedy: give the "
            "photographs of one camera with one setting"
        )
    return paths


def read_channels(path: Path, header: ImageHeader | None = None) -> np.ndarray:
    """Codes (rows, columns, channels) float32, an alpha channel apart: as stored, or linear where the file states a
    curve."""
    header = header or read_header(path)
    codes = read_codes(path, channel_names(header), header=header).astype(np.float32)
    if header.coding is None or header.coding.linear:
        return codes
    full = full_scale_of(path)
    return (full * header.coding.curve.decode(codes / full)).astype(np.float32)


def read_grey(path: Path) -> np.ndarray:
    """Codes (rows, columns) float32: luma of colour, else the mean of the channels."""
    codes = read_channels(path)
    return codes @ LUMA if codes.shape[2] == 3 else codes.mean(axis=2)


def full_scale_of(path: Path) -> float:
    """Largest code that a photograph's samples can hold; 1 for float."""
    return {"uint8": 255.0, "uint16": 65535.0, "float32": 1.0}[read_header(path).sample]
