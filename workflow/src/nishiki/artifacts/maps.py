"""Maps of a plane scene in Zarr: one array a quantity, one chunk a band of rows, written and read by bands.

Chunks carry a checksum, and chunks of fill value are written like any other: a missing chunk is damage, not data.
Measured floats hardly shrink under zstd (to 0.8), which takes as long as all else that writing does, so they are stored
as they are; counts, flags and bits are packed.
"""

from pathlib import Path
from typing import Any

import numpy as np

from nishiki.formats.stored import open_bands
from nishiki.formats.zarr_store import BandedArray, BandedGroup

STORE = "maps.zarr"


class MapWriter:
    """Writes the maps of one artifact."""

    def __init__(self, folder: Path, *, rows: int, columns: int, band_rows: int, stamp: dict[str, str]):
        self.shape = (rows, columns)
        self.band_rows = band_rows
        self.group = BandedGroup.create(Path(folder) / STORE, {"stamp": stamp})

    def create(
        self, name: str, trailing: tuple[int, ...] = (), *, dtype: str = "float32", **attributes: Any
    ) -> BandedArray:
        """An array (rows, columns, *trailing); `attributes` say unit and meaning; `nan`, what a NaN means in it: an
        array without this attribute may not hold one (`nishiki.artifacts.finite`)."""
        rows, columns = self.shape
        return self.group.create_array(
            name,
            (rows, columns, *trailing),
            (min(self.band_rows, rows), columns, *trailing),
            dtype,
            compression="none" if np.dtype(dtype).kind == "f" else "zstd",
            attributes=attributes,
        )

    def write(self, name: str, values: np.ndarray, **attributes: Any) -> None:
        """A whole map at once."""
        values = np.asarray(values)
        self.create(name, values.shape[2:], dtype=str(values.dtype), **attributes)[...] = values


class Maps:
    """The maps of one artifact, for reading."""

    def __init__(self, folder: Path):
        self.group = open_bands(Path(folder) / STORE)

    def __contains__(self, name: str) -> bool:
        return name in self.group

    def read(self, name: str, rows: slice = slice(None)) -> np.ndarray:
        """A map, or a band of its rows."""
        return self.group[name][rows]

    def attributes(self, name: str) -> dict:
        """What was said of a map when it was written."""
        return self.group[name].attrs


def directional_shading(maps: Maps) -> bool:
    """Whether the body shading of normals holds the shadows that surroundings throw: none are cast on top of it."""
    return "shading" in maps and maps.group["shading"].shape[-1] > 3


def shading_normals(maps: Maps, rows: slice = slice(None)) -> np.ndarray:
    """Normals of the body shading, of some rows: the stage's own maps of them where it made any, else its normals."""
    return maps.read("shading_normals" if "shading_normals" in maps else "normals", rows)
