"""Pictures read on a coarse grid, as linear light: enough to compare photographs of one scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nishiki.formats.image_headers import read_header
from nishiki.formats.images import read_codes


def read_coarse(path: Path, side: int, encoding: str | None = None) -> np.ndarray:
    """Read the mean of the channels over equal blocks, (rows, columns) float64 linear, 1 at full scale.

    side : blocks along the longer side of the picture; encoding : `linear`, `srgb`, or None for what the file states.
    CaptureError where the picture cannot be decoded.
    """
    import cv2

    header = read_header(path)
    names = header.names or tuple(f"c{i}" for i in range(header.channels - header.alpha))
    codes = read_codes(path, names, header=header)
    top = np.iinfo(codes.dtype).max if codes.dtype.kind == "u" else 1.0
    scale = min(side / max(header.rows, header.columns), 1.0)
    size = max(round(header.columns * scale), 1), max(round(header.rows * scale), 1)
    small = cv2.resize(codes.astype(np.float32) / np.float32(top), size, interpolation=cv2.INTER_AREA)
    return header.coding_used(encoding or "file").curve.decode(small.reshape(size[1], size[0], -1).mean(axis=2))
