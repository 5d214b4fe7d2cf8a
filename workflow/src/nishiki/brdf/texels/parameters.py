"""Hold the reflection parameters of an object's tiles, and store them in Zarr with one chunk a tile."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntFlag
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.codecs import ZstdCodec

from nishiki.artifacts.declaration import Output
from nishiki.formats.stored import open_group


class TexelFlag(IntFlag):
    """Bits of `flags` in parameters.zarr."""

    OUTSIDE = 1  # of the chart: filled, never looked at
    UNSEEN = 2  # no usable observation (hidden, or saturated in every view): K_d too is from the neighbours
    ONCE = 4  # a single usable observation
    NO_HIGHLIGHT = 8  # no view within sigma of the mirror direction
    KS_UNCONSTRAINED = 16  # its views show next to nothing of the lobe: K_s and sigma are the neighbours'


@dataclass(frozen=True)
class Parameters:
    """A tile's parameters: kd, ks (T, T, channels), sigma (T, T) radians, flags (T, T) uint8 of TexelFlag; no NaN."""

    kd: np.ndarray
    ks: np.ndarray
    sigma: np.ndarray
    flags: np.ndarray


STORE = "parameters.zarr"
NAMES = ("kd", "ks", "sigma", "flags")


class ParameterWriter:
    """A writer of one artifact's parameters; tiles may come from several threads, each tile once."""

    def __init__(
        self, folder: Path, outputs: Iterable[Output], shape: tuple[int, int, int, int], *, stamp: dict[str, str]
    ):
        """Create the declared arrays; shape: tiles, rows, columns, and channels of `kd` and `ks`."""
        self.group: Any = zarr.create_group(Path(folder) / STORE, attributes={"stamp": stamp})
        for output in outputs:
            size = shape if output.name in ("kd", "ks") else shape[:3]
            self.group.create_array(
                output.name,
                shape=size,
                chunks=(1, *size[1:]),
                dtype=output.dtype,
                attributes=output.attributes,
                compressors=[ZstdCodec(level=1, checksum=True)],
                config={"write_empty_chunks": True},
            )

    def write(self, tile: int, parameters: Parameters) -> None:
        """Write one tile."""
        for name in NAMES:
            self.group[name][tile] = getattr(parameters, name)


class ParameterMaps:
    """The parameters of one artifact, for reading."""

    def __init__(self, folder: Path):
        group = open_group(Path(folder) / STORE)
        self._arrays = {name: group[name] for name in NAMES}
        self.tiles, self.size = self._arrays["sigma"].shape[:2]
        self.channels = self._arrays["kd"].shape[-1]

    def read(self, tile: int) -> Parameters:
        """Read one tile's parameters."""
        return Parameters(**{name: np.asarray(array[tile]) for name, array in self._arrays.items()})
