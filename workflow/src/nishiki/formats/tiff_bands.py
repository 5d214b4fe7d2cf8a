"""TIFF written by bands of rows: a strip a band, deflate, with unit, scale, colour profile and a value for no data.

33550 and 33922: GeoTIFF (OGC 19-008r4); 42113: GDAL.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

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


def strips(rows: int, band_rows: int) -> Iterator[slice]:
    """Bands of rows from top to bottom, all as high but the last."""
    return (slice(start, min(start + band_rows, rows)) for start in range(0, rows, band_rows))
