"""ENVI pictures of many bands: a header in text, and float32 samples by rows, in each row by bands (BIL)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

import numpy as np


class EnviWriter:
    """Writes `NAME.img` row by row, and `NAME.hdr` beside it.

    Parameters
    ----------
    path : Path
        Of the samples.
    shape : (int, int)
        Rows and columns.
    wavelengths_nm : sequence of float
        Of the bands.
    description : str
        What the values mean.
    pitch_mm : float or None
        Distance of two pixels.
    """

    def __init__(
        self,
        path: Path,
        shape: tuple[int, int],
        wavelengths_nm: Sequence[float] | np.ndarray,
        *,
        description: str,
        pitch_mm: float | None = None,
    ) -> None:
        self._shape = (*shape, len(wavelengths_nm))
        self._row = 0
        path.with_suffix(".hdr").write_text(
            envi_header(self._shape, wavelengths_nm, description, pitch_mm), encoding="ascii", errors="replace"
        )
        self._file = open(path, "wb")

    def __enter__(self) -> EnviWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()
        if kind is None and self._row != self._shape[0]:
            raise ValueError(f"expected {self._shape[0]} rows, found {self._row}")

    def write(self, rows: np.ndarray) -> None:
        """The next rows (r, columns, bands)."""
        self._file.write(np.ascontiguousarray(rows.transpose(0, 2, 1), "<f4").tobytes())
        self._row += len(rows)


def envi_header(
    shape: tuple[int, int, int],
    wavelengths_nm: Sequence[float] | np.ndarray,
    description: str,
    pitch_mm: float | None,
) -> str:
    """The text of a header."""
    rows, columns, bands = shape
    lines = [
        "ENVI",
        f"description = {{{description.translate(str.maketrans('{}', '()'))}}}",
        f"samples = {columns}",
        f"lines = {rows}",
        f"bands = {bands}",
        "header offset = 0",
        "file type = ENVI Standard",
        "data type = 4",
        "interleave = bil",
        "byte order = 0",
        "wavelength units = Nanometers",
        f"wavelength = {{{', '.join(f'{float(value):g}' for value in wavelengths_nm)}}}",
        "data ignore value = 0",
    ]
    if pitch_mm:
        size = f"{pitch_mm:.9g}, {pitch_mm:.9g}"
        left, top = -columns * pitch_mm / 2, rows * pitch_mm / 2  # of pixel (1, 1), as in our TIFF files
        lines.append(f"pixel size = {{{size}, units=mm}}")
        lines.append(f"map info = {{Arbitrary, 1, 1, {left:.9g}, {top:.9g}, {size}, units=mm}}")
    return "\n".join(lines) + "\n"
