"""Polynomial texture maps in one file, `.ptm`: PTM_FORMAT_RGB of version 1.2 (Malzbender and others, 2001).

Six coefficients of u^2, v^2, u v, u, v, 1 a colour, each a byte: coefficient = (byte - bias) scale, values 0 to 255.
Red, green and blue follow each other whole; rows from the bottom.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

ORDER = (3, 5, 4, 1, 2, 0)  # of the file's terms among 1, u, v, u^2, u v, v^2
ROWS_AT_A_TIME = 256


def write_ptm(path: Path, planes: Sequence[np.ndarray], scale: np.ndarray, bias: np.ndarray) -> None:
    """Write six pictures (rows, columns, 3) uint8 of the terms 1, u, v, u^2, u v, v^2, which may lie on the disk.

    scale, bias : (6, 3) of every term and colour: coefficient = (byte / 255 - bias) scale, for values 0 to 1. The file
    has one scale and one bias a term, so that bytes are rounded once more.
    """
    low = np.minimum((-bias * scale).min(axis=1), 0)
    high = np.maximum(((1 - bias) * scale).max(axis=1), 0)
    span = np.maximum(high - low, 1e-6)
    zero = np.rint(-low / span * 255)
    rows, columns = planes[0].shape[:2]
    with open(path, "wb") as file:
        file.write(f"PTM_1.2\nPTM_FORMAT_RGB\n{columns}\n{rows}\n".encode("ascii"))
        file.write((" ".join(f"{span[term]:.9g}" for term in ORDER) + "\n").encode("ascii"))
        file.write((" ".join(f"{zero[term]:.0f}" for term in ORDER) + "\n").encode("ascii"))
        for colour in range(3):
            for stop in range(rows, 0, -ROWS_AT_A_TIME):
                block = np.empty((min(ROWS_AT_A_TIME, stop), columns, 6), np.uint8)
                for place, term in enumerate(ORDER):
                    codes = planes[term][stop - len(block) : stop, :, colour].astype(np.float64)
                    value = (codes / 255 - bias[term, colour]) * scale[term, colour]
                    block[..., place] = np.clip(np.rint(value * 255 / span[term] + zero[term]), 0, 255)
                file.write(block[::-1].tobytes())


def read_ptm(path: Path, band_rows: int) -> Iterator[tuple[slice, np.ndarray]]:
    """Bands of rows and their coefficients (rows, columns, 6, 3) of 1, u, v, u^2, u v, v^2, for values 0 to 1.

    Raises ValueError for another format.
    """
    with open(path, "rb") as file:
        lines = [file.readline().decode("ascii").split() for _ in range(6)]
        start = file.tell()
    if lines[0] != ["PTM_1.2"] or lines[1] != ["PTM_FORMAT_RGB"]:
        raise ValueError(f"{path}: expected PTM_1.2 in PTM_FORMAT_RGB, found {lines[:2]}")
    columns, rows = int(lines[2][0]), int(lines[3][0])
    span, zero = (np.array(line, float) for line in lines[4:])
    stored = np.memmap(path, np.uint8, "r", offset=start, shape=(3, rows, columns, 6))
    for top in range(0, rows, band_rows):
        band = slice(top, min(top + band_rows, rows))
        codes = np.asarray(stored[:, rows - band.stop : rows - band.start])[:, ::-1]
        terms = (codes - zero) * span / 255
        yield band, terms[..., np.argsort(ORDER)].transpose(1, 2, 3, 0)
