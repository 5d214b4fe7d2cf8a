"""All that a decoder needs as one string of bytes: header, start states, index, then the tiles' streams.

    magic (4) | length of header (4, little endian) | header, start states, index, compressed | streams, tile by tile

The index holds, per tile, its extent and the length of each stream; a tile without streams takes no byte beyond it.
"""

from __future__ import annotations

import json
import struct
import zlib
from dataclasses import dataclass

import numpy as np

from nishiki.codec.allocate import EncodedObject
from nishiki.codec.design import Design
from nishiki.codec.entropy import Model
from nishiki.codec.extent import Extent
from nishiki.codec.training import pack, unpack
from nishiki.errors import UserError

MAGIC = b"NWT1"
FRAME = 1250  # bytes of header and of the store's own files, about
FRAME_OF_TILE = 6.5  # bytes of the index, about
MOST_DESIGN = 1 << 24  # bytes of the description, inflated


@dataclass(frozen=True)
class Contents:
    """design, models and, per tile, extents and lengths (tiles, streams); offset: of the first stream."""

    design: Design
    models: tuple[Model, Model]
    extents: list[Extent]
    lengths: np.ndarray
    offset: int

    def place(self, tile: int, stream: int) -> tuple[int, int]:
        """First byte and number of bytes of a tile's stream."""
        before = int(self.lengths[:tile].sum() + self.lengths[tile, :stream].sum())
        return self.offset + before, int(self.lengths[tile, stream])


def pack_object(encoded: EncodedObject) -> tuple[bytes, dict[str, int]]:
    """The bytes and how many of them each part takes: header, start_states, index, parameters, residual."""
    header = json.dumps(encoded.design.as_dict(), separators=(",", ":"), sort_keys=True).encode()
    states = [pack(model) for model in encoded.models]
    lengths = np.array([[len(s) for s in tile] for tile in encoded.streams], np.uint32).reshape(
        len(encoded.streams), -1
    )
    extents = np.array([e.row_of_numbers() for e in encoded.extents], np.uint16).reshape(-1, 6)
    index = zlib.compress(_planes(extents) + _planes(lengths), 9)
    header = zlib.compress(header, 9)
    counts = struct.pack("<7I", len(header), len(states[0]), len(states[1]), len(index), *lengths.shape, 0)
    head = counts + header + states[0] + states[1] + index
    streams = [b"".join(tile[k] for tile in encoded.streams) for k in range(lengths.shape[1])]
    data = MAGIC + struct.pack("<I", len(head)) + head + b"".join(s for tile in encoded.streams for s in tile)
    parts = {
        "header": 8 + len(counts) + len(header),
        "start_states": len(states[0]) + len(states[1]),
        "index": len(index),
        "parameters": len(streams[0]) if streams else 0,
        "residual": sum(len(s) for s in streams[1:]),
    }
    return data, parts


def frame_bytes(tiles: int) -> int:
    """About how many bytes header, index and the store's own files take, before anything is coded."""
    return round(FRAME + FRAME_OF_TILE * tiles)


def head_length(first: bytes) -> int:
    """Bytes before the streams, from the first eight. UserError where they are not those of a residual."""
    if len(first) < 8 or first[:4] != MAGIC:
        raise UserError(f"residual: expected bytes that begin with {MAGIC!r}, found {first[:4]!r}; run the stage again")
    return 8 + struct.unpack("<I", first[4:8])[0]


def unpack_head(data: bytes) -> Contents:
    """Inverse of `pack_object` but for the streams; data: at least the first `head_length` bytes."""
    end = head_length(data)
    if len(data) < 36:
        raise UserError(f"residual: header of {end} bytes expected, found {len(data)}; run the stage again")
    sizes = struct.unpack("<7I", data[8:36])
    parts, at = [], 36
    for size in sizes[:4]:
        parts.append(data[at : at + size])
        at += size
    if at != end or len(data) < end:
        raise UserError(f"residual: header of {end} bytes expected, found {at}; run the stage again")
    try:
        tiles, streams = sizes[4:6]
        design = Design.from_dict(json.loads(_inflated(parts[0], MOST_DESIGN)))
        raw = _inflated(parts[3], tiles * (12 + 4 * streams))
    except (zlib.error, ValueError, KeyError, TypeError, RecursionError) as error:
        raise UserError(f"residual: header damaged ({error}); run the stage again") from None
    numbers = _joined_planes(raw[: 12 * tiles], np.uint16, (tiles, 6))
    extents = [Extent(*(int(v) for v in row)) for row in numbers]
    lengths = _joined_planes(raw[12 * tiles :], np.uint32, (tiles, streams)).astype(np.int64)
    return Contents(design, (unpack(parts[1]), unpack(parts[2])), extents, lengths, end)


def _inflated(data: bytes, most: int) -> bytes:
    """Deflated bytes, at most so many: a few of a stranger's could unfold to any number."""
    stream = zlib.decompressobj()
    inflated = stream.decompress(data, max(most, 1))
    if not stream.eof or len(inflated) > most:
        raise ValueError(f"cut off, or larger than {most} bytes")
    return inflated


def _planes(values: np.ndarray) -> bytes:
    """Bytes by significance, column after column: small numbers leave planes of zeros, which compress to nothing."""
    columns = np.ascontiguousarray(values.T)
    return np.ascontiguousarray(columns.view(np.uint8).reshape(-1, values.itemsize).T).tobytes()


def _joined_planes(data: bytes, dtype, shape: tuple[int, int]) -> np.ndarray:
    size = np.dtype(dtype).itemsize
    planes = np.frombuffer(data, np.uint8).reshape(size, -1)
    return np.ascontiguousarray(planes.T).view(dtype).reshape(shape[::-1]).T
