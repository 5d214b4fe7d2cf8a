"""Hemispherical harmonics in one file, `.rti` (`#HSH1.2`), as RTIViewer and Relight read it.

After lines that begin with `#`: the kind (3 for these), columns, rows and colours, terms, kind of basis (2: each colour
apart) and bytes a value; then the terms' scales and biases as float32, lowest byte first, and the picture from its top
row, each pixel its terms of red, of green and of blue: coefficient = byte / 255 scale + bias, for values 0 to 1.
Reference: P. Gautron, J. Krivanek, S. Pattanaik and K. Bouatouch (2004), A novel hemispherical basis for accurate and
efficient rendering, EGSR.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nishiki.formats.files import Refused
from nishiki.formats.text_heading import REMEDY, TextHeading

LARGEST_ORDER = 4  # RTIViewer's: 16 terms
HORIZON = 3.1415 / 2 - 0.15  # radians: viewers take lamps that are lower for this one
ROWS_AT_A_TIME = 256


@dataclass(frozen=True)
class HshFile:
    """terms : (rows, columns, 3, terms) uint8 on the disk, rows from the top; scale, bias : (terms,)."""

    terms: np.ndarray
    scale: np.ndarray
    bias: np.ndarray

    @property
    def layout(self) -> str:
        """What the file is, for messages."""
        return f"HSH of {len(self.scale)} terms"

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.terms.shape[0], self.terms.shape[1]

    def shown(self, light: np.ndarray) -> np.ndarray:
        """(rows, columns, 3) float32 from the top, for a unit vector to the lamp; full brightness is 1, not clipped."""
        (harmonics,) = hemispherical_harmonics(np.asarray(light, float)[None], math.isqrt(len(self.scale)))
        weights, offset = (harmonics * self.scale / 255).astype(np.float32), np.float32(harmonics @ self.bias)
        picture = np.empty((*self.shape, 3), np.float32)
        for start in range(0, len(picture), ROWS_AT_A_TIME):
            band = slice(start, start + ROWS_AT_A_TIME)
            picture[band] = self.terms[band].astype(np.float32) @ weights + offset
        return picture


def hemispherical_harmonics(lights: np.ndarray, order: int) -> np.ndarray:
    """(n, order^2) values of the basis for unit vectors (n, 3) to lamps, in the order of RTIViewer.

    Gautron and others (2004), eq. 5: Legendre functions of 2 cos(theta) - 1. Of a degree those with cos(m phi) come
    first, the largest m first, then those with sin(m phi); all with m above 0 have the sign that viewers give them.
    """
    from scipy.special import lpmv

    azimuth = np.arctan2(lights[:, 1], lights[:, 0])
    cosine = np.cos(np.minimum(np.arccos(np.clip(lights[:, 2], -1, 1)), HORIZON))
    values = []
    for degree in range(order):
        for signed in range(degree, -degree - 1, -1):
            m = abs(signed)
            ratio = math.factorial(degree - m) / math.factorial(degree + m)
            factor = math.sqrt((2 * degree + 1) * ratio / (2 * math.pi)) * (math.sqrt(2) if m else 1)
            turn = np.cos(m * azimuth) if signed >= 0 else np.sin(m * azimuth)
            sign = -1 if m else 1  # of viewers, beside the (-1)^m of Condon and Shortley that lpmv has
            values.append(sign * factor * turn * lpmv(m, degree, 2 * cosine - 1))
    return np.stack(values, axis=1)


def _bytes(terms: int, rows: int, columns: int) -> int:
    """Of the factors and the picture."""
    return 8 * terms + 3 * terms * rows * columns


def open_hsh(path: Path) -> HshFile:
    """Read the heading. Refused where the file is none, of another kind, ends early or claims more than is read."""
    heading = TextHeading(path)
    if not heading.start.startswith(b"#HSH"):
        what, found = "not a file of hemispherical harmonics", repr(heading.start[:8])
        raise Refused(path.name, what, expected="#HSH1.2", found=found, remedy=REMEDY)
    heading.skip_comments()
    (kind,), (columns, rows, colours), (terms, basis, width) = (heading.integers(n) for n in (1, 3, 3))
    if (kind, colours, basis, width) != (3, 3, 2, 1) or terms not in [2, *(n * n for n in range(1, LARGEST_ORDER + 1))]:
        expected = "kind 3, 3 colours, 1, 4, 9 or 16 terms, basis 2, 1 byte a value"
        found = f"kind {kind}, {colours} colours, {terms} terms, basis {basis}, {width} bytes"
        raise Refused(path.name, "a kind of .rti that is not read", expected=expected, found=found, remedy=REMEDY)
    heading.picture_size(columns, rows)
    # Some files state the degree, 1 or 2, in place of the number of terms; of 1 the length of the file decides.
    if terms == 2 or (terms == 1 and heading.size >= heading.place + _bytes(4, rows, columns)):
        terms = (terms + 1) ** 2
    begin = heading.data(_bytes(terms, rows, columns))
    factors = np.fromfile(path, "<f4", 2 * terms, offset=begin).astype(np.float64)
    heading.expect_sound(factors.tolist())
    stored = np.memmap(path, np.uint8, "r", offset=begin + 8 * terms, shape=(rows, columns, 3, terms))
    return HshFile(stored, factors[:terms], factors[terms:])
