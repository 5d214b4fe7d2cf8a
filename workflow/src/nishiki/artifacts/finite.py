"""No NaN or infinity leaves a stage unless the file itself says where and why.

Every floating-point array that a stage wrote (Zarr, npz, EXR) is read once more before the artifact is finished, and
every JSON and CSV file. NaN is let through in Zarr arrays only whose attribute `nan` says what it means there (an error
map has no error where there is no truth); infinity never.
"""

import json
import math
import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.formats.banded_pictures import BLOCK_ROWS, read_blocks
from nishiki.threads import in_threads

BLOCK = 1 << 26  # bytes of an array looked at together
CELL = re.compile(r"(?:^|[,;\t ])[+-]?(?:nan|inf|infinity)(?=$|[,;\t ])", re.IGNORECASE | re.MULTILINE)


class NotFinite(Exception):
    """A stage wrote a NaN or an infinity: a defect of the program, not of the input."""


def expect_finite(folder: Path, stage: str) -> None:
    """Look at everything that a stage wrote below `folder`.

    Raises NotFinite naming the stage and for each array the number of such values and the first index.
    """
    texts = [text for text in problems(Path(folder)) if text]
    if texts:
        raise NotFinite(
            f"{stage} wrote values that are not finite, which is a defect of this program: {'; '.join(texts)}. "
            "Nothing of this stage is kept; please report it with the capture or its settings"
        )


def problems(folder: Path) -> Iterator[str]:
    """Yield a text for each array or file below `folder` that holds a forbidden value."""
    for name in sorted(_names(folder)):
        path = folder / name
        if path.name == "zarr.json":
            yield from _zarr(path, path.parent.relative_to(folder).as_posix())
        elif path.suffix == ".npz":
            yield from _npz(path, name)
        elif path.suffix == ".exr":
            yield from _exr(path, name)
        elif path.suffix == ".json":
            yield from _words(path, name, r"[:,\[\s](?:NaN|-?Infinity)(?=[,\]}\s]|$)")
        elif path.suffix in (".csv", ".tsv"):
            yield from _words(path, name, CELL)


def _names(folder: Path) -> Iterator[str]:
    """Files below a folder that hold values, chunks of Zarr arrays apart: they have no suffix, and are many."""
    start = len(str(folder)) + 1
    for root, _, names in os.walk(folder):
        for name in names:
            if name.endswith((".json", ".npz", ".exr", ".csv", ".tsv")):
                yield f"{root[start:]}/{name}" if root[start:] else name


def _zarr(path: Path, name: str) -> Iterator[str]:
    metadata = json.loads(path.read_bytes())
    if metadata.get("node_type") != "array" or not str(metadata.get("data_type")).startswith(("float", "complex")):
        return
    if _chunk_files_are_finite(path.parent, metadata):
        return
    import zarr

    array = zarr.open_array(path.parent, mode="r")
    yield _described(name, _counted(_blocks(array)), nan_means=bool(array.attrs.get("nan")))


def _chunk_files_are_finite(folder: Path, metadata: dict) -> bool:
    """Check that every chunk file of an array is finite without the array library, which takes four times as long.

    Return False where this cannot be decided: other codecs, or a chunk without a file.
    """
    codecs = [codec["name"] for codec in metadata["codecs"]]
    little = metadata["codecs"][0].get("configuration", {}).get("endian", "little") == "little"
    known = codecs[:1] == ["bytes"] and little and codecs[1:] in ([], ["zstd"], ["crc32c"], ["zstd", "crc32c"])
    chunks = metadata["chunk_grid"]["configuration"]["chunk_shape"]
    chunk_count = math.prod(-(-size // chunk) for size, chunk in zip(metadata["shape"], chunks, strict=True))
    files = [Path(root, name) for root, _, names in os.walk(folder) for name in names if name != "zarr.json"]
    if not known or len(files) != chunk_count:
        return False
    dtype = np.dtype(metadata["data_type"]).newbyteorder("<")

    def finite(path: Path) -> bool:
        payload = path.read_bytes()
        payload = payload[:-4] if "crc32c" in codecs else payload
        if "zstd" in codecs:
            from numcodecs.zstd import Zstd

            payload = Zstd().decode(payload)
        return _sum_is_finite(np.frombuffer(payload, dtype))

    return all(in_threads(finite, files))


def _sum_is_finite(values: np.ndarray) -> bool:
    """Check whether values are finite by their sum: one pass without a mask. An overflow costs a second look only."""
    with np.errstate(all="ignore"):
        return bool(np.isfinite(np.sum(values, dtype=np.float32 if values.dtype.itemsize == 2 else None)))


def _npz(path: Path, name: str) -> Iterator[str]:
    with np.load(path, allow_pickle=False) as stored:
        for key in stored.files:
            values = stored[key]
            if values.dtype.kind in "fc":
                yield _described(f"{name}: {key}", _counted([((0,) * values.ndim, values)]))


def _exr(path: Path, name: str) -> Iterator[str]:
    blocks = read_blocks(path)
    if blocks is not None:
        yield _described(name, _counted(((BLOCK_ROWS * number, 0, 0), block) for number, block in enumerate(blocks)))
        return
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as stored:
        for key, channel in stored.channels().items():
            if channel.pixels.dtype.kind == "f":
                yield _described(f"{name}: {key}", _counted([((0,) * channel.pixels.ndim, channel.pixels)]))


def _words(path: Path, name: str, pattern: str | re.Pattern) -> Iterator[str]:
    match = re.search(pattern, path.read_text(encoding="utf-8", errors="replace"))
    if match:
        yield f"{name}: {match.group(0).strip(' ,:[')!r} at character {match.start()}"


def _blocks(array: Any) -> Iterator[tuple[tuple[int, ...], np.ndarray]]:
    """Parts of a Zarr array along its first axis, whole chunks each, with the index of their first value."""
    if not array.ndim:
        yield (), np.asarray(array[...])
        return
    row = max(1, array.dtype.itemsize * int(np.prod(array.shape[1:], dtype=np.int64)))
    step = max(1, BLOCK // row // array.chunks[0]) * array.chunks[0]
    for first in range(0, array.shape[0], step):
        yield (first,) + (0,) * (array.ndim - 1), array[first : first + step]


def _counted(
    blocks: Iterable[tuple[tuple[int, ...], np.ndarray]],
) -> tuple[int, int, tuple[int, ...] | None, tuple[int, ...] | None]:
    """Count NaN and infinities, with the index of the first of each."""
    nans = infinities = 0
    first_nan = first_infinity = None
    for start, values in blocks:
        if _sum_is_finite(values):
            continue
        missing, endless = np.isnan(values), np.isinf(values)
        if missing.any() and first_nan is None:
            first_nan = _index(missing, start)
        if endless.any() and first_infinity is None:
            first_infinity = _index(endless, start)
        nans, infinities = nans + int(missing.sum()), infinities + int(endless.sum())
    return nans, infinities, first_nan, first_infinity


def _index(mask: np.ndarray, start: tuple[int, ...]) -> tuple[int, ...]:
    place = np.unravel_index(int(np.argmax(mask)), mask.shape)
    return tuple(int(a) + b for a, b in zip(place, start, strict=True))


def _described(name: str, counted: tuple, *, nan_means: bool = False) -> str:
    nans, infinities, first_nan, first_infinity = counted
    parts = [f"{infinities} infinite, the first at {first_infinity}"] if infinities else []
    if nans and not nan_means:
        parts.append(f"{nans} NaN, the first at {first_nan}")
    return f"{name}: {', '.join(parts)}" if parts else ""
