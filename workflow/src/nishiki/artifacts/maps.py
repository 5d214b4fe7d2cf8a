"""Store maps of a plane scene in Zarr by bands of rows, and divide a stage over several jobs.

Chunks carry a checksum, and chunks of fill value are written like any other: a missing chunk is damage, not data.
Measured floats hardly shrink under zstd (to 0.8), which takes as long as all else that writing does, so they are stored
as they are; counts, flags and bits are packed.

A stage that can be divided consists of `map_tiles`, which does a share of the work (`context.share(...)` of its bands),
and `merge`, which turns the *tallies* of all shares into the diagnostics. Undivided, the stage is one share. A part
writes its files and the tally of its share; the stage that joins the parts takes over their files and merges their
tallies, so that the artifact has the same bytes however the work was divided. The division is part of no key.
"""

import json
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.artifacts.declaration import Output, output_of
from nishiki.artifacts.provenance import file_digest
from nishiki.errors import UserError
from nishiki.formats.stored import BandedArray, BandedGroup, open_group

STORE = "maps.zarr"


class MapWriter:
    """Write the maps of one artifact."""

    def __init__(
        self,
        folder: Path,
        outputs: Sequence[Output] = (),
        *,
        rows: int,
        columns: int,
        band_rows: int,
        stamp: dict[str, str],
    ):
        self.shape, self.outputs = (rows, columns), outputs
        self.band_rows = band_rows
        self.group = BandedGroup.create(Path(folder) / STORE, {"stamp": stamp})

    @classmethod
    def of(cls, context: Any, outputs: Sequence[Output], shape: tuple[int, int], band_rows: int) -> "MapWriter":
        """Write the declared arrays of a running stage."""
        rows, columns = shape
        place = {"folder": context.output.folder, "stamp": context.stamp}
        return cls(outputs=outputs, rows=rows, columns=columns, band_rows=band_rows, **place)

    def create(
        self, name: str, trailing: tuple[int, ...] = (), *, dtype: str = "float32", **attributes: Any
    ) -> BandedArray:
        """Create an array (rows, columns, *trailing) with type, unit and meaning as the stage declares them.

        `nan` states the meaning of NaN; an array without this attribute may not hold one (`nishiki.artifacts.stage`).
        """
        rows, columns = self.shape
        if self.outputs:
            declared = output_of(self.outputs, name)
            dtype, attributes = declared.dtype, declared.attributes | attributes
        return self.group.create_array(
            name,
            (rows, columns, *trailing),
            (min(self.band_rows, rows), columns, *trailing),
            dtype,
            compression="none" if np.dtype(dtype).kind == "f" else "zstd",
            attributes=attributes,
        )

    def write(self, name: str, values: np.ndarray, **attributes: Any) -> None:
        """Write a whole map at once."""
        values = np.asarray(values)
        made = self.create(name, values.shape[2:], dtype=str(values.dtype), **attributes)
        made[...] = values.astype(made.dtype, copy=False)


class Maps:
    """The maps of one artifact, for reading."""

    def __init__(self, folder: Path):
        self.group = open_group(Path(folder) / STORE)

    def __contains__(self, name: str) -> bool:
        return name in self.group

    def read(self, name: str, rows: slice = slice(None)) -> np.ndarray:
        """Read a map, or a band of its rows."""
        return self.group[name][rows]

    def attributes(self, name: str) -> dict:
        """Return the attributes that a map was written with."""
        return self.group[name].attrs


def shading_normals(maps: Maps, rows: slice = slice(None)) -> np.ndarray:
    """Read the normals of the body shading for some rows: the stage's own maps of them, else its normals."""
    return maps.read("shading_normals" if "shading_normals" in maps else "normals", rows)


BAND_VALUES = 1 << 20  # pixels that are read together, about


def shrink(
    read: Callable[[slice], np.ndarray],
    shape: tuple[int, ...],
    block: int,
    how: Literal["mean", "largest", "middle"] = "mean",
) -> np.ndarray:
    """Reduce a map to one value for each square block of pixels, by bands of rows.

    Parameters
    ----------
    read : callable
        Function of a slice of rows that returns values (r, columns, ...).
    shape : (int, int)
        Rows and columns of the map. The last row and column of blocks may be cut.
    block : int
        Pixels along a side of a block.
    how : {'mean', 'largest', 'middle'}, optional
        Mean or largest of the values that are no NaN, as float32, NaN where there is none; or the pixel in the middle.
    """

    def reduce_block(values: np.ndarray) -> np.ndarray:
        if how == "middle":
            places = (np.minimum(np.arange(0, side, block) + block // 2, side - 1) for side in values.shape[:2])
            return values[np.ix_(*places)]
        values = values.astype(np.float32, copy=False)
        if block == 1:
            return values
        pad = [(0, -values.shape[0] % block), (0, -values.shape[1] % block)] + [(0, 0)] * (values.ndim - 2)
        values = np.pad(values, pad, constant_values=np.nan)
        tiles = values.reshape(values.shape[0] // block, block, values.shape[1] // block, block, *values.shape[2:])
        known = np.isfinite(tiles)
        if how == "largest":
            return np.where(known.any(axis=(1, 3)), np.where(known, tiles, -np.inf).max(axis=(1, 3)), np.nan)
        count = known.sum(axis=(1, 3))
        total = np.where(known, tiles, 0).sum(axis=(1, 3), dtype=np.float64)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan).astype(np.float32)

    step = max(1, BAND_VALUES // (shape[1] * block)) * block
    out = np.empty(0)
    for start in range(0, shape[0], step):
        part = reduce_block(np.asarray(read(slice(start, min(start + step, shape[0])))))
        out = out if start else np.empty((-(-shape[0] // block), *part.shape[1:]), part.dtype)
        out[start // block : start // block + len(part)] = part
    return out


TALLY, TALLY_ARRAYS = "tally.json", "tally.npz"
Item = TypeVar("Item")


@dataclass(frozen=True)
class StagePart:
    """Part `number` of `total`, counted from 1."""

    number: int = 1
    total: int = 1

    def __str__(self) -> str:
        return f"{self.number}-of-{self.total}"

    @classmethod
    def parse(cls, text: str) -> "StagePart":
        """Parse `2/4`. Raises UserError for anything else."""
        number, _, total = text.partition("/")
        if not (number.isdigit() and total.isdigit() and 1 <= int(number) <= int(total)):
            raise UserError(f"--part: expected number/total as in 2/4, found {text!r}")
        return cls(int(number), int(total))

    def share(self, items: Sequence[Item]) -> Sequence[Item]:
        """Return the part's items: contiguous, and equal in number to those of other parts but for one."""
        first, end = (len(items) * n // self.total for n in (self.number - 1, self.number))
        return items[first:end]


@dataclass(frozen=True)
class TiledStage:
    """A stage that can be divided."""

    # context -> tally of the share, a dict of numbers, texts, lists and arrays; its entry `same` holds what does not
    # depend on the share
    map_tiles: Callable[[Any], dict[str, Any]]
    # (context, tallies in the order of the shares) -> diagnostics
    merge: Callable[[Any, list[dict[str, Any]]], dict[str, Any]]

    def __call__(self, context: Any) -> dict[str, Any]:
        """Return the diagnostics of the stage, undivided or joined from its parts; of a part only which one it is."""
        if context.parts:
            tallies = [read_tally(part.folder) for part in context.parts]
            join(context.parts, context.output.folder)
        else:
            tallies = [self.map_tiles(context)]
        if context.part is not None:
            write_tally(context.output.folder, tallies[0])
            return {"part": str(context.part)}
        if any(tally["same"] != tallies[0]["same"] for tally in tallies):
            raise UserError(
                "the parts of this stage disagree. Remedy: use the same installation on all nodes, and run again"
            )
        return self.merge(context, tallies)


def write_tally(folder: Path, tally: dict[str, Any]) -> None:
    """Keep a tally in a folder: arrays in one file, everything else as JSON."""
    arrays: dict[str, Any] = {name: value for name, value in tally.items() if isinstance(value, np.ndarray)}
    rest = {name: value for name, value in tally.items() if name not in arrays}
    (folder / TALLY).write_text(json.dumps(rest, sort_keys=True, allow_nan=False) + "\n")
    np.savez(folder / TALLY_ARRAYS, **arrays)


def read_tally(folder: Path) -> dict[str, Any]:
    """Read a tally as it was written."""
    with np.load(folder / TALLY_ARRAYS) as arrays:
        return {**json.loads((folder / TALLY).read_text()), **arrays}


def in_order(
    parts: Sequence[Artifact], *, key: str, code: str, upstream: dict[str, dict[str, str]]
) -> tuple[Artifact, ...]:
    """Sort parts by their shares; upstream: keys and digests of the artifacts that the stage reads.

    Raises UserError where they are not all parts of one stage, made alike.
    """
    numbered = {StagePart.parse(part.manifest["part"]): part for part in parts}
    total = next(iter(numbered)).total
    if len(numbered) != len(parts) or set(numbered) != {StagePart(number, total) for number in range(1, total + 1)}:
        raise UserError(f"expected parts 1 to {total}, found {', '.join(map(str, numbered))}")
    expected = (key, code, upstream)
    origins = {part.folder: (part.key, part.manifest["code"], part.manifest["upstream"]) for part in parts}
    foreign = [folder for folder, what in origins.items() if what != expected]
    if foreign:
        raise UserError(f"{foreign[0]}: made from other settings, inputs or code. Remedy: delete it, run again")
    return tuple(numbered[part] for part in sorted(numbered, key=lambda part: part.number))


def join(parts: Sequence[Artifact], folder: Path) -> None:
    """Take over the files of all parts; a file that several have must be the same in all.

    Raises UserError naming a file that differs.
    """
    for part in parts:
        for name in part.manifest["files"]:
            if name in (TALLY, TALLY_ARRAYS):
                continue
            target = folder / name
            if not target.exists():
                target.parent.mkdir(parents=True, exist_ok=True)
                try:
                    os.link(part.path(name), target)
                except OSError:  # another file system, or one without hard links
                    shutil.copyfile(part.path(name), target)
            elif file_digest(target) != file_digest(part.path(name)):
                raise UserError(
                    f"{part.path(name)}: differs between two parts of the stage. Remedy: delete them and run again"
                )
