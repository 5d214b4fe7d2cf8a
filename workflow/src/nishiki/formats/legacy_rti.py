"""Read relightable images in one file: polynomial texture maps (`.ptm`) and hemispherical harmonics (`.rti`).

`.ptm` of versions 1.1 and 1.2 (T. Malzbender, D. Gelb and H. Wolters (2001), Polynomial texture maps, SIGGRAPH). Six
coefficients of u^2, v^2, u v, u, v, 1, each a byte: coefficient = (byte - bias) scale, for values 0 to 255; u and v
are the x and y of the unit vector to the lamp. PTM_FORMAT_RGB has six for each colour: red, green and blue follow each
other whole. PTM_FORMAT_LRGB has six for a brightness that multiplies a colour of three bytes (divided by 255); the
colours follow as a plane of their own, or pixel by pixel in version 1.1. Rows from the bottom. Not read, because what
was found of them is not enough or contradicts itself: PTM_FORMAT_LUM, PTM_FORMAT_PTM_LUT, PTM_FORMAT_PTM_C_LUT,
PTM_FORMAT_JPEGLS_RGB and _LRGB.

PTM_FORMAT_JPEG_LRGB and _RGB: JPEG streams of one channel, nine (six coefficients, then red, green and blue) or 18 (the
six of red, those of green, those of blue). A stream may hold the difference from another one (its reference, or 255
minus that where its transform is 1; -1 for none), plus 128 and modulo 256; streams are made in the heading's order.
Corrections follow each stream: five bytes a pixel, the place (4 bytes, the highest first, rows as stored) and its
value. Motion vectors, which shift the reference, are not read; no known encoder writes them.

`.rti` (`#HSH1.2`), as RTIViewer and Relight read it (P. Gautron, J. Krivanek, S. Pattanaik and K. Bouatouch (2004), A
novel hemispherical basis for accurate and efficient rendering, EGSR). After lines that begin with `#`: the kind (3 for
these), columns, rows and colours, terms, kind of basis (2: each colour apart) and bytes a value; then the terms' scales
and biases as float32, lowest byte first, and the picture from its top row, each pixel its terms of red, of green and of
blue: coefficient = byte / 255 scale + bias, for values 0 to 1.
"""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nishiki.formats.files import Refused, expect_bound, expect_memory, open_regular
from nishiki.formats.images import read_jpeg_bytes
from nishiki.formats.problems import CaptureError
from nishiki.threads import strips

HEADING_BYTES = 4096  # more than any such heading has
LARGEST = 1e6  # of scales and biases, which belong to values of 0 to 255
WORD = re.compile(rb"[ \t\r\n]*([^ \t\r\n]+)(?=[ \t\r\n])")
LINE_END = re.compile(rb"[ \t]*\r?\n")
REMEDY = "Copy it again, or convert the photographs that it was made from"


class TextHeading:
    """Reader of a heading word by word; name: of the file, size: of it in bytes.

    Refused by all methods where the heading is not as it should be.
    """

    def __init__(self, path: Path):
        self.name = path.name
        try:
            with open(open_regular(path, path.name), "rb") as file:
                self.start = file.read(HEADING_BYTES)
                self.size = file.seek(0, 2)
        except FileNotFoundError:
            raise Refused(path.name, "file is missing", remedy="Correct the path") from None
        except OSError as e:
            raise Refused(path.name, "cannot be read", found=str(e)) from None
        self.place = 0

    def word(self) -> str:
        """Read the next word, of at most 80 characters."""
        match = WORD.match(self.start, self.place)
        if match is None:
            raise Refused(self.name, "the heading ends early", remedy=REMEDY)
        self.place = match.end()
        return match[1][:80].decode("latin-1")

    def integers(self, count: int) -> list[int]:
        """Read the next whole numbers, below a thousand million."""
        return [int(each) for each in self._numbers(count, r"-?[0-9]{1,9}", "whole numbers")]

    def floats(self, count: int) -> list[float]:
        """Read the next numbers, none beyond LARGEST."""
        number = r"[-+]?([0-9]{1,30}\.?[0-9]{0,30}|\.[0-9]{1,30})([eE][-+]?[0-9]{1,3})?"
        values = [float(each) for each in self._numbers(count, number, "numbers")]
        self.expect_sound(values)
        return values

    def expect_sound(self, values: list[float]) -> None:
        """Raise Refused unless all numbers are finite and none is beyond LARGEST."""
        if not all(abs(value) <= LARGEST for value in values):
            expected, found = f"numbers up to {LARGEST:g}", " ".join(f"{value:g}" for value in values)
            raise Refused(self.name, "scales or biases that cannot be", expected=expected, found=found, remedy=REMEDY)

    def _numbers(self, count: int, pattern: str, kind: str) -> list[str]:
        found = [self.word() for _ in range(count)]
        if not all(re.fullmatch(pattern, each) for each in found):
            expected, seen = f"{count} {kind}", " ".join(found)[:80]
            raise Refused(self.name, "not the heading of such a file", expected=expected, found=seen, remedy=REMEDY)
        return found

    def picture_size(self, columns: int, rows: int) -> None:
        """Raise Refused unless the size is valid and within the bounds of pictures."""
        if min(rows, columns) < 1:
            raise Refused(self.name, "a picture without pixels", found=f"{columns} x {rows}", remedy=REMEDY)
        expect_bound(max(rows, columns), "image_side", self.name)
        expect_bound(rows * columns, "image_pixels", self.name)

    def data(self, count: int) -> int:
        """Return the offset of the binary data, at least `count` bytes, after the end of the heading's last line."""
        end = LINE_END.match(self.start, self.place)
        if end is None:
            raise Refused(self.name, "the heading does not end with its line", remedy=REMEDY)
        if self.size < end.end() + count:
            expected, found = f"{end.end() + count} bytes", f"{self.size}"
            raise Refused(self.name, "the file ends early", expected=expected, found=found, remedy=REMEDY)
        return end.end()


ORDER = (3, 5, 4, 1, 2, 0)  # of the file's terms among 1, u, v, u^2, u v, v^2
PLANES = {"PTM_FORMAT_RGB": 18, "PTM_FORMAT_LRGB": 9, "PTM_FORMAT_JPEG_RGB": 18, "PTM_FORMAT_JPEG_LRGB": 9}
PTM_REMEDY = "Save it again as PTM_FORMAT_RGB or PTM_FORMAT_LRGB, or convert the photographs that it was made from"


@dataclass(frozen=True)
class PtmFile:
    """A polynomial texture map; its bytes lie on the disk, those of JPEG streams in memory.

    layout : what it is, for messages; terms : (3 or 1, rows, columns, 6) uint8 of red, green and blue or of the
    brightness; colours : (rows, columns, 3) uint8, or None for RGB; both rows from the bottom. scale, bias : (6,).
    files : names of those that a folder's image was read from, relative to it.
    """

    layout: str
    terms: np.ndarray
    colours: np.ndarray | None
    scale: np.ndarray
    bias: np.ndarray
    files: tuple[str, ...] = ()

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.terms.shape[1], self.terms.shape[2]

    def relight(self, light: np.ndarray) -> np.ndarray:
        """Render (rows, columns, 3) float32 from the top for a unit lamp vector; full brightness is 1, not clipped."""
        u, v, _ = light
        weights = np.array([u * u, v * v, u * v, u, v, 1.0]) * self.scale / 255
        offset, weights = np.float32(-self.bias @ weights), weights.astype(np.float32)
        rows, columns = self.shape
        picture = np.empty((rows, columns, 3), np.float32)
        for band in strips(rows):
            values = (self.terms[:, band].astype(np.float32) @ weights + offset).transpose(1, 2, 0)
            picture[band] = values if self.colours is None else values * (self.colours[band] / np.float32(255))
        return picture[::-1]


def open_ptm(path: Path) -> PtmFile:
    """Read the heading, and the compressed data.

    Refused where the file is none, of another layout, ends early or claims more than is read.
    """
    heading = TextHeading(path)
    version, layout = heading.word(), heading.word()
    if version not in ("PTM_1.1", "PTM_1.2") or layout not in PLANES:
        expected, found = f"PTM_1.2 with {', '.join(PLANES)}", f"{version} with {layout}"
        raise Refused(path.name, "a kind of PTM that is not read", expected=expected, found=found, remedy=PTM_REMEDY)
    columns, rows = heading.integers(2)
    heading.picture_size(columns, rows)
    scale, bias = np.array(heading.floats(6)), np.array(heading.floats(6))
    streams = PtmStreams.of(heading, PLANES[layout]) if "JPEG" in layout else None
    count = streams.bytes if streams else rows * columns * PLANES[layout]
    stored = np.memmap(path, np.uint8, "r", offset=heading.data(count), shape=(count,))
    if streams:
        expect_memory(3 * rows * columns * PLANES[layout], path.name)
        planes = streams.decode(stored, rows, columns, path.name)
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
            for band in strips(rows):  # the file begins with the lowest row
                block = np.empty((band.stop - band.start, columns, 6), np.uint8)
                for place, term in enumerate(ORDER):
                    codes = planes[term][rows - band.stop : rows - band.start, :, colour].astype(np.float64)
                    value = (codes / 255 - bias[term, colour]) * scale[term, colour]
                    block[..., place] = np.clip(np.rint(value * 255 / span[term] + zero[term]), 0, 255)
                file.write(block[::-1].tobytes())


def read_ptm(path: Path) -> Callable[[slice], np.ndarray]:
    """Make a function from rows to their coefficients (rows, columns, 6, 3) of 1, u, v, u^2, u v, v^2.

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


@dataclass(frozen=True)
class PtmStreams:
    """Facts on each stream from the heading. steps : the number of the first stream to make, the second ..."""

    inverted: tuple[bool, ...]
    steps: tuple[int, ...]
    references: tuple[int, ...]
    sizes: tuple[int, ...]
    corrections: tuple[int, ...]

    @classmethod
    def of(cls, heading: TextHeading, count: int) -> "PtmStreams":
        """Read the lists of the heading, for so many streams. Refused where they are inconsistent."""
        heading.integers(1)  # the encoder's quality
        transforms, right, down, order, references, sizes, corrections = (heading.integers(count) for _ in range(7))
        faults = {
            "motion vectors, which are not read": any(right) or any(down),
            "transforms other than 0 and 1": not set(transforms) <= {0, 1},
            "an order that is none": sorted(order) != list(range(count)),
            "sizes that cannot be": min(sizes) < 1 or min(corrections) < 0 or any(n % 5 for n in corrections),
            "a reference that is not made before its stream": any(
                each != -1 and not (0 <= each < count and order[each] < order[stream])
                for stream, each in enumerate(references)
            ),
        }
        for what, present in faults.items():
            if present:
                raise Refused(heading.name, f"compressed streams with {what}", remedy=REMEDY)
        steps = tuple(order.index(step) for step in range(count))
        return cls(tuple(each == 1 for each in transforms), steps, tuple(references), tuple(sizes), tuple(corrections))

    @property
    def bytes(self) -> int:
        """Size in bytes of all streams and their corrections."""
        return sum(self.sizes) + sum(self.corrections)

    def decode(self, stored: np.ndarray, rows: int, columns: int, name: str) -> np.ndarray:
        """Decode (streams, rows, columns) uint8 from the bytes after the heading. Refused where a stream is damaged."""
        planes = np.empty((len(self.sizes), rows, columns), np.uint8)
        lengths = [length for pair in zip(self.sizes, self.corrections, strict=True) for length in pair]
        starts = np.concatenate([[0], np.cumsum(lengths)])
        for stream in self.steps:
            begin, middle, end = starts[2 * stream : 2 * stream + 3]
            plane = planes[stream]
            samples = decode_stream(stored[begin:middle], f"{name}, stream {stream + 1}")
            if samples.shape != (rows, columns, 1):
                expected, found = f"{rows} x {columns} x 1", " x ".join(map(str, samples.shape))
                raise Refused(name, "a JPEG picture of another size", expected=expected, found=found, remedy=REMEDY)
            plane[:] = samples[:, :, 0]
            reference = self.references[stream]
            if reference >= 0:
                plane += (255 - planes[reference] if self.inverted[stream] else planes[reference]) - np.uint8(128)
            fixes = np.array(stored[middle:end]).reshape(-1, 5)
            places = np.ascontiguousarray(fixes[:, :4]).view(">u4")[:, 0]
            if (places >= plane.size).any():
                raise Refused(name, "corrections beyond the picture", found=f"pixel {places.max()}", remedy=REMEDY)
            plane.reshape(-1)[places] = fixes[:, 4]
        return planes


def decode_stream(stream: np.ndarray, name: str) -> np.ndarray:
    """Decode a JPEG picture in memory, (rows, columns, channels) uint8. Refused where it is none."""
    try:
        return read_jpeg_bytes(stream.tobytes(), name)
    except CaptureError as e:
        raise Refused(name, "not a whole JPEG picture", found=str(e), remedy=REMEDY) from None


LARGEST_ORDER = 4  # RTIViewer's: 16 terms
HORIZON = 3.1415 / 2 - 0.15  # radians: viewers take lamps that are lower for this one


@dataclass(frozen=True)
class HshFile:
    """Hemispherical harmonics; layout, files: as of `PtmFile`.

    terms : (rows, columns, 3, terms) uint8, rows from the top; scale, bias : (terms,).
    """

    layout: str
    terms: np.ndarray
    scale: np.ndarray
    bias: np.ndarray
    files: tuple[str, ...] = ()

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.terms.shape[0], self.terms.shape[1]

    def relight(self, light: np.ndarray) -> np.ndarray:
        """Render (rows, columns, 3) float32 from the top for a unit lamp vector; full brightness is 1, not clipped."""
        (harmonics,) = hemispherical_harmonics(np.asarray(light, float)[None], math.isqrt(len(self.scale)))
        weights, offset = (harmonics * self.scale / 255).astype(np.float32), np.float32(harmonics @ self.bias)
        picture = np.empty((*self.shape, 3), np.float32)
        for band in strips(len(picture)):
            picture[band] = self.terms[band].astype(np.float32) @ weights + offset
        return picture


def hemispherical_harmonics(lights: np.ndarray, order: int) -> np.ndarray:
    """Compute the basis (n, order^2) for unit vectors (n, 3) to lamps, in the order of RTIViewer.

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
    """Return the size in bytes of the factors and the picture."""
    return 8 * terms + 3 * terms * rows * columns


def open_hsh(path: Path) -> HshFile:
    """Read the heading. Refused where the file is no such file, ends early or claims more than the bounds."""
    heading = TextHeading(path)
    if not heading.start.startswith(b"#HSH"):
        what, found = "not a file of hemispherical harmonics", repr(heading.start[:8])
        raise Refused(path.name, what, expected="#HSH1.2", found=found, remedy=REMEDY)
    while heading.start[heading.place : heading.place + 1] == b"#":  # a line of comment
        end = heading.start.find(b"\n", heading.place)
        heading.place = end + 1 if end >= 0 else len(heading.start)
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
    return HshFile(f"HSH of {terms} terms", stored, factors[:terms], factors[terms:])
