"""TIFF as scientific cameras write it: the directory, and images of any number of channels.

OpenCV decodes ordinary TIFF; what it does not (more than four samples a pixel, planes apart) is decoded here from
strips or tiles, uncompressed or deflate. Field numbers from the TIFF 6.0 specification (Adobe, 1992) and BigTIFF.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from io import BytesIO
from typing import BinaryIO, Literal

import numpy as np

from nishiki.formats.image_header import ImageHeader, Sample

_NUMBERS = frozenset((1, 3, 4, 6, 8, 9, 13, 16, 18))  # kinds of field that hold whole numbers
_TYPES = {1: "B", 2: "c", 3: "H", 4: "I", 5: "II", 6: "b", 8: "h", 9: "i", 11: "f", 12: "d", 13: "I", 16: "Q", 18: "Q"}
_WIDTH, _LENGTH, _BITS, _COMPRESSION, _PHOTOMETRIC, _STRIPS, _SAMPLES = 256, 257, 258, 259, 262, 273, 277
_ROWS_PER_STRIP, _STRIP_BYTES, _PLANAR, _PREDICTOR = 278, 279, 284, 317
_TILE_WIDTH, _TILE_LENGTH, _TILES, _TILE_BYTES, _EXTRA, _FORMAT = 322, 323, 324, 325, 338, 339
_READ = {_WIDTH, _LENGTH, _BITS, _COMPRESSION, _PHOTOMETRIC, _STRIPS, _SAMPLES, _ROWS_PER_STRIP, _STRIP_BYTES, _PLANAR}
_MANY = {_STRIPS, _STRIP_BYTES, _TILES, _TILE_BYTES}
_READ |= {_PREDICTOR, _TILE_WIDTH, _TILE_LENGTH, _TILES, _TILE_BYTES, _EXTRA, _FORMAT}
_DEFLATE = (8, 32946)
MAX_PAGES = 256
MOST_PIECES = 1 << 18  # strips or tiles of a page
PACKED_RATIO = 4000  # LZW: codes of 12 bits for at most 4096 bytes, deflate 1032


@dataclass(frozen=True)
class Directory:
    """One page: its fields by number, and the file's byte order ('<' or '>')."""

    fields: dict[int, tuple]
    order: Literal["<", ">"]

    def one(self, field: int, default: int | None = None) -> int:
        values = self.fields.get(field)
        if values:
            return int(values[0])
        if default is None:
            raise ValueError(f"TIFF field {field} is missing")
        return default

    @property
    def channels(self) -> int:
        # a palette of 256 colours decodes to three channels
        return 3 if self.one(_PHOTOMETRIC, 1) == 3 else self.one(_SAMPLES, 1)

    @property
    def sample(self) -> Sample:
        bits, form = self.one(_BITS, 1), self.one(_FORMAT, 1)
        known: dict[tuple[int, int], Sample] = {
            (1, 1): "uint8",
            (2, 1): "uint8",
            (4, 1): "uint8",
            (8, 1): "uint8",
            (16, 1): "uint16",
            (32, 3): "float32",
        }
        if len(set(self.fields.get(_BITS, (1,)))) != 1 or (bits, form) not in known:
            raise ValueError(
                f"TIFF samples of {bits} bits in format {form}; unsigned 8 and 16 bits and float 32 are read"
            )
        return known[bits, form]

    @property
    def by_opencv(self) -> bool:
        """Whether OpenCV decodes it: up to four samples, interleaved."""
        return self.channels in (1, 3, 4) and (self.channels == 1 or self.one(_PLANAR, 1) == 1)


def tiff_header(file: BinaryIO) -> ImageHeader:
    """Header over all pages; pages must be of equal size and depth. ValueError where the directory is damaged."""
    pages = read_directories(file)
    first = pages[0]
    shapes = {(p.one(_LENGTH), p.one(_WIDTH), p.channels, p.sample) for p in pages}
    packed = {p.one(_COMPRESSION, 1) for p in pages} != {1}
    if len(shapes) != 1:
        raise ValueError(f"TIFF pages of different size or depth: {sorted(shapes)[:3]}")
    end = file.seek(0, 2)
    for page in pages:
        offsets, counts = _pieces(page)
        if any(o + c > end for o, c in zip(offsets, counts, strict=True)):
            raise EOFError(f"image data beyond the end of the file ({end} bytes)")
    alpha = first.channels in (2, 4) and first.fields.get(_EXTRA, (0,))[0] in (1, 2)
    rows, columns, channels, sample = shapes.pop()
    return ImageHeader(
        "tiff", rows, columns, channels * len(pages), sample, alpha and len(pages) == 1, len(pages),
        stored_bytes=sum(map(_stored_bytes, pages)), ratio=PACKED_RATIO if packed else 1,
    )  # fmt: skip


def _stored_bytes(page: Directory) -> int:
    """Of a page's samples before compression. ValueError where its pieces are out of proportion to it."""
    rows, columns, samples = page.one(_LENGTH), page.one(_WIDTH), page.one(_SAMPLES, 1)
    if page.one(_TILE_WIDTH, 0) > columns + 65536 or page.one(_TILE_LENGTH, 0) > rows + 65536:
        raise ValueError(f"TIFF tiles of {page.one(_TILE_LENGTH, 0)} x {page.one(_TILE_WIDTH, 0)} samples")
    if _TILES in page.fields and min(page.one(_TILE_WIDTH, 0), page.one(_TILE_LENGTH, 0)) < 1:
        raise ValueError("TIFF tiles without a size")
    if page.one(_ROWS_PER_STRIP, 1) < 1:
        raise ValueError("TIFF strips without rows")
    return rows * (columns * samples * page.one(_BITS, 1) // 8)


def read_directories(file: BinaryIO) -> list[Directory]:
    """Every page's directory; thumbnails (reduced-resolution pages) are passed over."""
    file.seek(0)
    start = file.read(16)
    order: Literal["<", ">"] = "<" if start[:2] == b"II" else ">"
    big = struct.unpack(order + "H", start[2:4])[0] == 43
    (offset,) = struct.unpack(order + ("Q" if big else "I"), start[8:16] if big else start[4:8])
    pages: list[Directory] = []
    seen: set[int] = set()
    while offset:
        if offset in seen or len(seen) >= MAX_PAGES:
            raise ValueError("TIFF directories form a circle or are too many")
        seen.add(offset)
        fields, offset = _read_directory(file, offset, order, big)
        if not fields.pop(254, (0,))[0] & 1:
            pages.append(Directory(fields, order))
    if not pages:
        raise ValueError("TIFF without an image")
    return pages


def _read_directory(file: BinaryIO, offset: int, order: str, big: bool) -> tuple[dict[int, tuple], int]:
    count_format, entry_format, inline = ("Q", "HHQ8s", 8) if big else ("H", "HHI4s", 4)
    if offset >= 1 << 62:
        raise ValueError(f"TIFF directory at byte {offset}")
    file.seek(offset)
    (count,) = struct.unpack(order + count_format, file.read(struct.calcsize("=" + count_format)))
    if count > 4096:
        raise ValueError(f"TIFF directory of {count} fields")
    size = struct.calcsize("=" + entry_format)
    entries = file.read(size * count)
    (following,) = struct.unpack(order + ("Q" if big else "I"), file.read(inline))
    fields = {}
    for i in range(count):
        tag, kind, values, data = struct.unpack(order + entry_format, entries[i * size : (i + 1) * size])
        if tag not in _READ | {254} or kind not in _NUMBERS:
            continue
        if values > (MOST_PIECES if tag in _MANY else 1 << 12):
            raise ValueError(f"TIFF field {tag} of {values} values")
        code = _TYPES[kind] * values
        length = struct.calcsize("=" + code)
        if length > inline:
            place = struct.unpack(order + ("Q" if big else "I"), data)[0]
            if place >= 1 << 62:
                raise ValueError(f"TIFF field {tag} lies at byte {place}")
            file.seek(place)
            data = file.read(length)
        fields[tag] = struct.unpack(order + code, data[:length])
    return fields, following


def _pieces(page: Directory) -> tuple[tuple, tuple]:
    tiled = _TILES in page.fields
    offsets = page.fields.get(_TILES if tiled else _STRIPS)
    counts = page.fields.get(_TILE_BYTES if tiled else _STRIP_BYTES)
    if offsets is None or counts is None or len(offsets) != len(counts):
        raise ValueError("TIFF without the places of its image data")
    return offsets, counts


def decode_tiff_page(data: bytes, page: Directory) -> np.ndarray:
    """Pixels (rows, columns, channels) of one page, from strips or tiles, uncompressed or deflate.

    ValueError where the compression or predictor is another one or the data are short.
    """
    rows, columns, channels = page.one(_LENGTH), page.one(_WIDTH), page.one(_SAMPLES, 1)
    compression, predictor = page.one(_COMPRESSION, 1), page.one(_PREDICTOR, 1)
    if compression not in (1, *_DEFLATE) or predictor not in (1, 2) or (predictor == 2 and page.sample == "float32"):
        raise ValueError(f"TIFF of {channels} channels with compression {compression}; save it uncompressed or deflate")
    dtype = np.dtype({"uint8": "u1", "uint16": "u2", "float32": "f4"}[page.sample]).newbyteorder(page.order)
    if page.one(_BITS, 1) < 8:
        raise ValueError("TIFF of less than 8 bits with planes apart")
    height = page.one(_TILE_LENGTH, 0) or min(page.one(_ROWS_PER_STRIP, rows), rows)
    width = page.one(_TILE_WIDTH, 0) or columns
    apart = page.one(_PLANAR, 1) == 2
    depth, planes = (1, channels) if apart else (channels, 1)
    out = np.empty((rows, columns, channels), dtype.newbyteorder("="))
    across, down = -(-columns // width), -(-rows // height)
    offsets, counts = _pieces(page)
    if len(offsets) != across * down * planes:
        raise ValueError(f"TIFF with {len(offsets)} pieces where {across * down * planes} are needed")
    for i, (offset, count) in enumerate(zip(offsets, counts, strict=True)):
        plane, place = divmod(i, across * down)
        top, left = place // across * height, place % across * width
        # strips end with the image, tiles are padded
        piece_rows = height if _TILES in page.fields else min(height, rows - top)
        needed = piece_rows * width * depth * dtype.itemsize
        block = data[offset : offset + count]
        if needed > 4 * out.nbytes + (1 << 24):
            raise ValueError(f"TIFF piece of {needed} bytes in an image of {out.nbytes}")
        block = zlib.decompressobj().decompress(block, needed) if compression in _DEFLATE else block[:needed]
        if len(block) != needed:
            raise ValueError("TIFF image data are cut off")
        pixels = np.frombuffer(block, dtype).reshape(piece_rows, width, depth).astype(out.dtype)
        if predictor == 2:
            pixels = np.cumsum(pixels, axis=1, dtype=out.dtype)
        part = slice(plane, plane + 1) if apart else slice(None)
        target = out[top : top + piece_rows, left : left + width, part]
        target[...] = pixels[: target.shape[0], : target.shape[1]]
    return out


def decode_tiff(data: bytes) -> np.ndarray:
    """All pages side by side as channels: (rows, columns, channels)."""
    pages = read_directories(BytesIO(data))
    return np.concatenate([decode_tiff_page(data, page) for page in pages], axis=2)


def opencv_reads(data: bytes) -> bool:
    """Whether OpenCV decodes every page of this TIFF."""
    return all(page.by_opencv for page in read_directories(BytesIO(data)))
