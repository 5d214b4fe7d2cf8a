"""No NaN or infinity leaves a stage unless the file itself says where and why.

Every floating-point array that a stage wrote (Zarr, npz) is read once more before the artifact is finished, and every
JSON and CSV file; the writer of EXR takes finite values only. NaN is let through in Zarr arrays only whose attribute
`nan` says what it means there (an error map has no error where there is no truth); infinity never.
"""

import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from nishiki.errors import NotFinite
from nishiki.formats.files import read_json
from nishiki.formats.zarr_store import METADATA, BandedArray
from nishiki.threads import in_threads

CELL = re.compile(r"(?:^|[,;\t ])[+-]?(?:nan|inf|infinity)(?=$|[,;\t ])", re.IGNORECASE | re.MULTILINE)
Place = tuple[int, ...]


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
        if path.name == METADATA:
            yield from _zarr(path, path.parent.relative_to(folder).as_posix())
        elif path.suffix == ".npz":
            yield from _npz(path, name)
        elif path.suffix == ".json":
            yield from _words(path, name, r"[:,\[\s](?:NaN|-?Infinity)(?=[,\]}\s]|$)")
        elif path.suffix in (".csv", ".tsv"):
            yield from _words(path, name, CELL)


def _names(folder: Path) -> Iterator[str]:
    """Files below a folder that hold values, chunks of Zarr arrays apart: they have no suffix, and are many."""
    start = len(str(folder)) + 1
    for root, _, names in os.walk(folder):
        for name in names:
            if name.endswith((".json", ".npz", ".csv", ".tsv")):
                yield f"{root[start:]}/{name}" if root[start:] else name


def _zarr(path: Path, name: str) -> Iterator[str]:
    node = read_json(path)
    if node.get("node_type") != "array" or not str(node.get("data_type")).startswith("float"):
        return
    array = BandedArray.of(path.parent)

    def block(place: Place) -> tuple[Place, np.ndarray]:
        return tuple(number * size for number, size in zip(place, array.chunks, strict=True)), array.chunk(place)

    written = (place for place in array.places() if array.path(*place).is_file())
    yield _described(name, in_threads(block, written), nan_means=bool(array.attrs.get("nan")))


def _sum_is_finite(values: np.ndarray) -> bool:
    """Check whether values are finite by their sum: one pass without a mask. An overflow costs a second look only."""
    with np.errstate(all="ignore"):
        return bool(np.isfinite(np.sum(values, dtype=np.float32 if values.dtype.itemsize == 2 else None)))


def _npz(path: Path, name: str) -> Iterator[str]:
    with np.load(path, allow_pickle=False) as stored:
        for key in stored.files:
            values = stored[key]
            if values.dtype.kind in "fc":
                yield _described(f"{name}: {key}", [((0,) * values.ndim, values)])


def _words(path: Path, name: str, pattern: str | re.Pattern) -> Iterator[str]:
    match = re.search(pattern, path.read_text(encoding="utf-8", errors="replace"))
    if match:
        yield f"{name}: {match.group(0).strip(' ,:[')!r} at character {match.start()}"


def _described(name: str, blocks: Iterable[tuple[Place, np.ndarray]], *, nan_means: bool = False) -> str:
    """Describe the forbidden values of parts of an array, each with the index of its first value; empty without any."""
    tests = {"infinite": np.isinf} | ({} if nan_means else {"NaN": np.isnan})
    counts, firsts = Counter[str](), dict[str, Place]()
    for start, values in blocks:
        for word, test in tests.items() if not _sum_is_finite(values) else ():
            if len(places := np.argwhere(test(values))):
                counts[word] += len(places)
                firsts.setdefault(word, tuple((places[0] + np.array(start, int)).tolist()))
    words = ", ".join(f"{counts[word]} {word}, the first at {place}" for word, place in firsts.items())
    return f"{name}: {words}" if words else ""
