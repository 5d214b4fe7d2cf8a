"""The headers of an OpenEXR file read by themselves, before its library allocates what they claim.

Layout from the OpenEXR file format specification (openexr.com): magic number, version with flags, then for every part
attributes `name\\0 type\\0 size value`, ended by an empty name; several parts are ended by an empty header.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import BinaryIO

_LONG_NAMES, _TILED, _DEEP, _PARTS = 0x400, 0x200, 0x800, 0x1000
_SAMPLE_BYTES = {0: 4, 1: 2, 2: 4}  # unsigned int, half, float
_RATIO = {0: 1, 1: 130, 2: 1040, 3: 1040}  # none, run lengths, deflate of one and of 16 rows; others have no bound
MOST_ATTRIBUTES, MOST_PARTS, MOST_CHANNELS = 1000, 64, 1024
MOST_ATTRIBUTE_BYTES = 1 << 24


@dataclass(frozen=True)
class ExrPart:
    """window: x and y of the first, x and y of the last pixel; channels: (name, bytes a sample, subsampled); ratio: how
    many times smaller than its pixels the coded part can be, 0: without bound."""

    window: tuple[int, int, int, int]
    channels: tuple[tuple[str, int, bool], ...]
    ratio: int

    @property
    def rows(self) -> int:
        return self.window[3] - self.window[1] + 1

    @property
    def columns(self) -> int:
        return self.window[2] - self.window[0] + 1

    @property
    def stored_bytes(self) -> int:
        """Of its pixels before compression, subsampling apart."""
        return self.rows * self.columns * sum(size for _, size, subsampled in self.channels if not subsampled)


def read_parts(file: BinaryIO) -> list[ExrPart]:
    """Every part's header. ValueError, EOFError or struct.error where one is damaged, deep, or larger than is read."""
    file.seek(4)
    (version,) = struct.unpack("<I", file.read(4))
    if version & 0xFF != 2 or version & ~(0xFF | _LONG_NAMES | _TILED | _DEEP | _PARTS):
        raise ValueError(f"version {version & 0xFF} with flags {version >> 8:#x}; version 2 is read")
    if version & _DEEP:
        raise ValueError("deep images (several samples a pixel) are not read")
    parts: list[ExrPart] = []
    while True:
        attributes = _attributes(file, 255 if version & _LONG_NAMES else 31)
        if attributes:
            parts.append(_part(attributes))
        if not version & _PARTS or not attributes:
            break
        if len(parts) > MOST_PARTS:
            raise ValueError(f"more than {MOST_PARTS} parts")
    if not parts:
        raise ValueError("no part in the file")
    return parts


def _attributes(file: BinaryIO, longest: int) -> dict[str, tuple[str, bytes]]:
    found: dict[str, tuple[str, bytes]] = {}
    while name := _text(file, longest):
        kind = _text(file, longest)
        (size,) = struct.unpack("<i", file.read(4))
        if not 0 <= size <= MOST_ATTRIBUTE_BYTES or len(found) >= MOST_ATTRIBUTES:
            raise ValueError(f"attribute {name[:40]!r} of {size} bytes, number {len(found) + 1}")
        value = file.read(size)
        if len(value) != size:
            raise EOFError(f"attribute {name[:40]!r} is cut off")
        found[name] = (kind, value)
    return found


def _text(file: BinaryIO, longest: int) -> str:
    letters = bytearray()
    while (letter := file.read(1)) != b"\0":
        if not letter or len(letters) >= longest:
            raise EOFError("header is cut off, or a name is too long")
        letters += letter
    return letters.decode("latin-1")


def _part(attributes: dict[str, tuple[str, bytes]]) -> ExrPart:
    missing = [name for name in ("channels", "compression", "dataWindow") if name not in attributes]
    if missing:
        raise ValueError(f"header without {', '.join(missing)}")
    if attributes.get("type", ("", b""))[1].startswith(b"deep"):
        raise ValueError("deep images (several samples a pixel) are not read")
    window = struct.unpack("<iiii", attributes["dataWindow"][1])
    (compression,) = struct.unpack("<B", attributes["compression"][1])
    part = ExrPart(window, _channels(attributes["channels"][1]), _RATIO.get(compression, 0))
    if part.rows < 1 or part.columns < 1:
        raise ValueError(f"data window {window}")
    if "tiles" in attributes:
        width, height, _ = struct.unpack("<IIB", attributes["tiles"][1])
        if not (0 < width <= max(part.columns, 8192) and 0 < height <= max(part.rows, 8192)):
            raise ValueError(f"tiles of {height} x {width} in an image of {part.rows} x {part.columns}")
    return part


def _channels(value: bytes) -> tuple[tuple[str, int, bool], ...]:
    found: list[tuple[str, int, bool]] = []
    place = 0
    while place < len(value) and value[place]:
        end = value.index(b"\0", place)
        kind, _, across, down = struct.unpack("<iB3xii", value[end + 1 : end + 17])
        if kind not in _SAMPLE_BYTES or len(found) >= MOST_CHANNELS:
            raise ValueError(f"channel {len(found) + 1} of type {kind}")
        found.append((value[place:end].decode("latin-1"), _SAMPLE_BYTES[kind], (across, down) != (1, 1)))
        place = end + 17
    if not found:
        raise ValueError("no channels")
    return tuple(found)
