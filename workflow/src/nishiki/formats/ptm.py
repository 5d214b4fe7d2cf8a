"""Polynomial texture maps in one file, `.ptm` of versions 1.1 and 1.2 (Malzbender and others, 2001).

Six coefficients of u^2, v^2, u v, u, v, 1, each a byte: coefficient = (byte - bias) scale, for values 0 to 255; u and v
are the x and y of the unit vector to the lamp. PTM_FORMAT_RGB has six for each colour: red, green and blue follow each
other whole. PTM_FORMAT_LRGB has six for a brightness that multiplies a colour of three bytes (divided by 255); the
colours follow as a plane of their own, or pixel by pixel in version 1.1. PTM_FORMAT_JPEG_RGB and PTM_FORMAT_JPEG_LRGB
have them as JPEG streams, see `ptm_jpeg`. Rows from the bottom. Not read, because what was found of them is not enough
or contradicts itself: PTM_FORMAT_LUM, PTM_FORMAT_PTM_LUT, PTM_FORMAT_PTM_C_LUT, PTM_FORMAT_JPEGLS_RGB and _LRGB.
Reference: T. Malzbender, D. Gelb and H. Wolters (2001), Polynomial texture maps, SIGGRAPH.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nishiki.formats.files import Refused, expect_memory
from nishiki.formats.ptm_jpeg import PtmStreams
from nishiki.formats.text_heading import TextHeading

ORDER = (3, 5, 4, 1, 2, 0)  # of the file's terms among 1, u, v, u^2, u v, v^2
ROWS_AT_A_TIME = 256
PLANES = {"PTM_FORMAT_RGB": 18, "PTM_FORMAT_LRGB": 9, "PTM_FORMAT_JPEG_RGB": 18, "PTM_FORMAT_JPEG_LRGB": 9}
REMEDY = "Save it again as PTM_FORMAT_RGB or PTM_FORMAT_LRGB, or convert the photographs that it was made from"


@dataclass(frozen=True)
class PtmFile:
    """A polynomial texture map; its bytes lie on the disk, those of JPEG streams in memory.

    layout : PTM_FORMAT_...; terms : (3 or 1, rows, columns, 6) uint8 of red, green and blue or of the brightness;
    colours : (rows, columns, 3) uint8, or None for RGB; both rows from the bottom. scale, bias : (6,).
    """

    layout: str
    terms: np.ndarray
    colours: np.ndarray | None
    scale: np.ndarray
    bias: np.ndarray

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.terms.shape[1], self.terms.shape[2]

    def shown(self, light: np.ndarray) -> np.ndarray:
        """(rows, columns, 3) float32 from the top, for a unit vector to the lamp; full brightness is 1, not clipped."""
        u, v, _ = light
        weights = np.array([u * u, v * v, u * v, u, v, 1.0]) * self.scale / 255
        offset, weights = np.float32(-self.bias @ weights), weights.astype(np.float32)
        rows, columns = self.shape
        picture = np.empty((rows, columns, 3), np.float32)
        for start in range(0, rows, ROWS_AT_A_TIME):
            band = slice(start, start + ROWS_AT_A_TIME)
            values = (self.terms[:, band].astype(np.float32) @ weights + offset).transpose(1, 2, 0)
            picture[band] = values if self.colours is None else values * (self.colours[band] / np.float32(255))
        return picture[::-1]


def open_ptm(path: Path) -> PtmFile:
    """Read the heading, and what is compressed.

    Refused where the file is none, of another layout, ends early or claims more than is read.
    """
    heading = TextHeading(path)
    version, layout = heading.word(), heading.word()
    if version not in ("PTM_1.1", "PTM_1.2") or layout not in PLANES:
        expected, found = f"PTM_1.2 with {', '.join(PLANES)}", f"{version} with {layout}"
        raise Refused(path.name, "a kind of PTM that is not read", expected=expected, found=found, remedy=REMEDY)
    columns, rows = heading.integers(2)
    heading.picture_size(columns, rows)
    scale, bias = np.array(heading.floats(6)), np.array(heading.floats(6))
    streams = PtmStreams.of(heading, PLANES[layout]) if "JPEG" in layout else None
    count = streams.bytes if streams else rows * columns * PLANES[layout]
    stored = np.memmap(path, np.uint8, "r", offset=heading.data(count), shape=(count,))
    if streams:
        expect_memory(3 * rows * columns * PLANES[layout], path.name)
        planes = streams.decoded(stored, rows, columns, path.name)
        if layout == "PTM_FORMAT_JPEG_RGB":
            return PtmFile(layout, np.moveaxis(planes.reshape(3, 6, rows, columns), 1, -1), None, scale, bias)
        planes = np.moveaxis(planes, 0, -1)
        return PtmFile(layout, planes[None, ..., :6], planes[..., 6:], scale, bias)
    if layout == "PTM_FORMAT_RGB":
        return PtmFile(layout, stored.reshape(3, rows, columns, 6), None, scale, bias)
    if version == "PTM_1.1":
        mixed = stored.reshape(rows, columns, 9)
        return PtmFile(layout, mixed[None, ..., :6], mixed[..., 6:], scale, bias)
    terms, colours = stored[: 6 * rows * columns], stored[6 * rows * columns :]
    return PtmFile(layout, terms.reshape(1, rows, columns, 6), colours.reshape(rows, columns, 3), scale, bias)


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


def read_ptm(path: Path) -> Callable[[slice], np.ndarray]:
    """A function from some rows to their coefficients (rows, columns, 6, 3) of 1, u, v, u^2, u v, v^2.

    They are for values 0 to 1. Of PTM_FORMAT_RGB; Refused by `open_ptm`, ValueError for another layout.
    """
    stored = open_ptm(path)
    if stored.colours is not None:
        raise ValueError(f"{path}: expected PTM_FORMAT_RGB, found {stored.layout}")
    height = stored.shape[0]

    def coefficients(rows: slice) -> np.ndarray:
        codes = np.asarray(stored.terms[:, height - rows.stop : height - rows.start])[:, ::-1]
        terms = (codes - stored.bias) * stored.scale / 255
        return terms[..., np.argsort(ORDER)].transpose(1, 2, 3, 0)

    return coefficients
