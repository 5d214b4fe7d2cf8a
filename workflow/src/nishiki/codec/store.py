"""Store the coded residual of an object as one string of bytes, and the decoded one in Zarr, read tile by tile.

    magic (4) | length of header (4, little endian) | header, start states, index, compressed | streams, tile by tile

The index holds, per tile, its extent and the length of each stream; a tile without streams takes no byte beyond it.
"""

import hashlib
import json
import struct
import threading
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zarr
from zarr.codecs import Crc32cCodec

from nishiki.codec.allocate import EncodedObject
from nishiki.codec.design import Design, Extent
from nishiki.codec.entropy import Model, decode, pack, unpack
from nishiki.codec.tile_code import decode_parameters, decode_residual
from nishiki.errors import UserError
from nishiki.formats.stored import open_array

MAGIC = b"NWT1"
FRAME = 1250  # bytes of header and of the store's own files, about
FRAME_OF_TILE = 6.5  # bytes of the index, about
MOST_DESIGN = 1 << 24  # bytes of the description, inflated


@dataclass(frozen=True)
class Contents:
    """A store's contents: design, models, per tile extents, lengths (tiles, streams); offset: of the first stream."""

    design: Design
    models: tuple[Model, Model]
    extents: list[Extent]
    lengths: np.ndarray
    offset: int

    def place(self, tile: int, stream: int) -> tuple[int, int]:
        """Return first byte and number of bytes of a tile's stream."""
        before = int(self.lengths[:tile].sum() + self.lengths[tile, :stream].sum())
        return self.offset + before, int(self.lengths[tile, stream])


def pack_object(encoded: EncodedObject) -> tuple[bytes, dict[str, int]]:
    """Pack an object; return the bytes and their number by part.

    The parts are header, start_states, index, parameters, residual.
    """
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
    """Estimate the bytes of header, index and the store's own files, before anything is coded."""
    return round(FRAME + FRAME_OF_TILE * tiles)


def head_length(first: bytes) -> int:
    """Read the number of bytes before the streams from the first eight. UserError where they are not a residual's."""
    if len(first) < 8 or first[:4] != MAGIC:
        raise UserError(f"residual: expected bytes that begin with {MAGIC!r}, found {first[:4]!r}; run the stage again")
    return 8 + struct.unpack("<I", first[4:8])[0]


def unpack_head(data: bytes) -> Contents:
    """Invert `pack_object` except for the streams; data: at least the first `head_length` bytes."""
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
        design = Design.from_dict(json.loads(inflate(parts[0], MOST_DESIGN)))
        raw = inflate(parts[3], tiles * (12 + 4 * streams))
    except (zlib.error, ValueError, KeyError, TypeError, RecursionError) as error:
        raise UserError(f"residual: header damaged ({error}); run the stage again") from None
    numbers = _joined_planes(raw[: 12 * tiles], np.uint16, (tiles, 6))
    extents = [Extent(*(int(v) for v in row)) for row in numbers]
    lengths = _joined_planes(raw[12 * tiles :], np.uint32, (tiles, streams)).astype(np.int64)
    return Contents(design, (unpack(parts[1]), unpack(parts[2])), extents, lengths, end)


def inflate(data: bytes, most: int) -> bytes:
    """Inflate to at most `most` bytes: a damaged or hostile file could expand without limit."""
    stream = zlib.decompressobj()
    inflated = stream.decompress(data, max(most, 1))
    if not stream.eof or len(inflated) > most:
        raise ValueError(f"cut off, or larger than {most} bytes")
    return inflated


def _planes(values: np.ndarray) -> bytes:
    """Sort bytes by significance, column after column: small numbers leave planes of zeros that compress to nothing."""
    columns = np.ascontiguousarray(values.T)
    return np.ascontiguousarray(columns.view(np.uint8).reshape(-1, values.itemsize).T).tobytes()


def _joined_planes(data: bytes, dtype, shape: tuple[int, int]) -> np.ndarray:
    size = np.dtype(dtype).itemsize
    planes = np.frombuffer(data, np.uint8).reshape(size, -1)
    return np.ascontiguousarray(planes.T).view(dtype).reshape(shape[::-1]).T


STORE, PICTURES = "residual.zarr", "pictures.zarr"
REPORT = "residual.json"
CHUNK = 1 << 16


def write_residual(
    folder: Path, encoded: EncodedObject, pictures: EncodedObject | None = None, *, stamp: dict[str, str], report: dict
) -> dict[str, int]:
    """Write `residual.zarr`, `pictures.zarr` if there are any, and `residual.json` to a folder; return bytes by part.

    The report holds the SHA-256 of the arrays' metadata, which no chunk's checksum covers.
    """
    parts = _write_coded(Path(folder) / STORE, encoded, stamp)
    if pictures is not None:
        size = _write_coded(Path(folder) / PICTURES, pictures, stamp)["total"]
        parts |= {"pictures": size, "total": parts["total"] + size}
    text = json.dumps(
        {**report, "bytes": parts, "metadata_sha256": _metadata_sha256(Path(folder))},
        indent=1, sort_keys=True, allow_nan=False,
    )  # fmt: skip
    (Path(folder) / REPORT).write_text(text + "\n")
    return parts


def _metadata_sha256(folder: Path) -> str:
    """Hash the metadata of the arrays of an artifact."""
    files = [folder / name / "zarr.json" for name in (STORE, PICTURES) if name == STORE or (folder / name).is_dir()]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def _write_coded(path: Path, encoded: EncodedObject, stamp: dict[str, str]) -> dict[str, int]:
    """Write an object as bytes in equal chunks of at most 64 KiB with a CRC-32C each; return the bytes by part.

    Coded bytes do not compress further, and a last chunk that is not full would be stored in full.
    """
    data, parts = pack_object(encoded)
    array = zarr.create_array(
        path,
        shape=(len(data),),
        chunks=(-(-len(data) // -(-len(data) // CHUNK)),),
        dtype="uint8",
        filters=None,
        compressors=[Crc32cCodec()],
        attributes={"stamp": stamp},
        config={"write_empty_chunks": True},
        zarr_format=3,
    )
    array[:] = np.frombuffer(data, np.uint8)
    stored = sum(p.stat().st_size for p in path.rglob("*") if p.is_file())
    return {**parts, "container": stored - len(data), "total": stored}


@dataclass(frozen=True)
class CodedTexels:
    """Values of n coded observations of k coded texels, and zeros for all others."""

    values: np.ndarray  # (n + 1, k + 1, C) float32
    observation: np.ndarray  # (M,)
    texel: np.ndarray  # (T * T,) int64: place in them of each observation and texel of the tile

    @property
    def nbytes(self) -> int:
        """Size of the arrays."""
        return self.values.nbytes + self.observation.nbytes + self.texel.nbytes

    def look_up(self, observation: int, texels: np.ndarray) -> np.ndarray:
        """Return the values (m, C) of an observation at flat numbers of texels (m,)."""
        return self.values[self.observation[observation], self.texel[texels]]


class CodedReader:
    """A coded object in an array, for reading; safe from several threads.

    tiles; size (T); observations (M), channels; design: as coded; extents: of the tiles.
    """

    def __init__(self, path: Path):
        """Open the array. UserError where its header is damaged."""
        self.path, self._array = path, open_array(path)
        self._lock, self._chunk = threading.Lock(), (-1, b"")
        self._contents = unpack_head(self._read(0, head_length(self._read(0, 8))))
        self.design = self._contents.design
        self.extents, self.models = self._contents.extents, self._contents.models
        self.tiles, self.size = len(self.extents), self.design.tile_size
        self.channels = self.design.channels
        self.observations = self.design.views * self.design.lights

    def texels(self, tile: int, level: int = 0) -> np.ndarray | None:
        """Decode texels (C, observations, rows, columns) float32 in a tile's extent; None where nothing is stored.

        level: so many of the finest bands are left out.
        """
        design, extent, stream = self.design, self.extents[tile], self.stream(tile, 1)
        if not stream:
            return None
        shape, levels = design.residual_shape(extent), design.plane(extent).levels
        return decode_residual(decode(stream, shape, levels, self.models[1], drop=level), design, extent)

    def stream_bytes(self, tile: int) -> tuple[int, ...]:
        """Count the bytes of each stream of a tile: parameters, residual."""
        return tuple(int(n) for n in self._contents.lengths[tile])

    def stream(self, tile: int, stream: int) -> bytes:
        """Read the coded bytes of one stream of a tile, in the order of `stored`."""
        start, length = self._contents.place(tile, stream)
        return self._read(start, length) if length else b""

    def _read(self, start: int, length: int) -> bytes:
        """Read some bytes of the array through the chunk read last; a damaged chunk raises UserError."""
        size = self._array.chunks[0]
        pieces = []
        for number in range(start // size, (start + length - 1) // size + 1):
            with self._lock:
                held = self._chunk
            if held[0] != number:
                held = number, self._array[number * size : (number + 1) * size].tobytes()
                with self._lock:
                    self._chunk = held
            low = max(start - number * size, 0)
            pieces.append(held[1][low : start + length - number * size])
        data = b"".join(pieces)
        if len(data) != length:
            raise UserError(f"{self.path}: {length} bytes at {start} expected, found {len(data)}; run again")
        return data


class Residual(CodedReader):
    """The residual and the reflection parameters of an artifact, for reading; safe from several threads.

    bytes: by part; report: of `residual.json`; pictures: the views that are coded as such, None where none is.
    """

    def __init__(self, folder: Path | str):
        """Open the artifact's folder. UserError where it holds no residual, or its description is damaged."""
        folder = Path(folder)
        try:
            self.report = json.loads((folder / REPORT).read_text())
            found = _metadata_sha256(folder)
        except FileNotFoundError as error:
            raise UserError(f"{folder}: {error.filename} is missing. Remedy: run the stage residual") from None
        except ValueError as error:
            raise UserError(f"{folder / REPORT}: not valid JSON ({error}); run the stage residual again") from None
        if found != self.report.get("metadata_sha256"):
            raise UserError(f"{folder}: zarr.json of {STORE} or {PICTURES} is damaged; run the stage residual again")
        super().__init__(folder / STORE)
        self.bytes = dict(self.report["bytes"])
        self.pictures = CodedReader(folder / PICTURES) if (folder / PICTURES).is_dir() else None

    def parameters(self, tile: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Decode kd, ks (T, T, C), sigma (T, T) float32, as the encoder's own prediction used them."""
        kd, ks = np.zeros((2, self.size, self.size, self.channels), np.float32)
        sigma = np.ones((self.size, self.size), np.float32)
        extent, design = self.extents[tile], self.design
        if design.model and extent.length:
            shape, stream = design.parameter_shape(extent), self.stream(tile, 0)
            levels = design.parameter_plane(extent).levels
            values = decode(stream, shape, levels, self.models[0]) if stream else np.zeros(shape, np.int32)
            maps = decode_parameters(values, design, extent)
            kd[extent.texels], ks[extent.texels], sigma[extent.texels] = maps.kd, maps.ks, maps.sigma
        return kd, ks, sigma

    def decode(self, tile: int, *, level: int = 0) -> np.ndarray:
        """Decode the residual (M, T, T, C) float32 in the capture's encoding, zero in views that do not see the tile.

        level: so many of the finest bands are left out (and not even read): a blurred preview.
        """
        coded = self.decode_coded(tile, level=level)
        every = coded.values[coded.observation][:, coded.texel]
        return every.reshape(self.observations, self.size, self.size, self.channels)

    def decode_coded(self, tile: int, *, level: int = 0) -> CodedTexels:
        """Decode only the observations and texels that are coded: a third of the memory of `decode`, or less."""
        design, extent = self.design, self.extents[tile]
        places = extent.observations(design.views, design.lights)
        rows, columns = (range(self.size)[part] for part in extent.texels)
        values = np.zeros((len(places) + 1, len(rows) * len(columns) + 1, self.channels), np.float32)
        if (texels := self.texels(tile, level)) is not None:
            values[:-1, :-1] = np.moveaxis(texels.reshape(*texels.shape[:2], -1), 0, -1)
        observation = np.full(self.observations, len(places))
        observation[places] = np.arange(len(places))
        texel = np.full((self.size, self.size), values.shape[1] - 1)
        texel[extent.texels] = np.arange(values.shape[1] - 1).reshape(len(rows), len(columns))
        return CodedTexels(values, observation, texel.reshape(-1))

    def empty(self, tile: int) -> bool:
        """Check whether nothing is stored for a tile's residual: the model suffices."""
        return not self._contents.lengths[tile, 1:].any()
