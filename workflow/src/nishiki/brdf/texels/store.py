"""Parameters of all tiles in Zarr, one chunk a tile, with checksums."""

from pathlib import Path

import numpy as np
import zarr
from zarr.codecs import ZstdCodec

from nishiki.brdf.texels.parameters import Parameters
from nishiki.formats.stored import open_group

STORE = "parameters.zarr"
NAMES = ("kd", "ks", "sigma", "flags")


class ParameterWriter:
    """Writes the parameters of one artifact; tiles may come from several threads, each tile once."""

    def __init__(self, folder: Path, *, tiles: int, size: int, channels: int, stamp: dict[str, str]):
        self.group = zarr.create_group(Path(folder) / STORE, attributes={"stamp": stamp})
        trailing = {"kd": (channels,), "ks": (channels,), "sigma": (), "flags": ()}
        for name in NAMES:
            self.group.create_array(
                name,
                shape=(tiles, size, size, *trailing[name]),
                chunks=(1, size, size, *trailing[name]),
                dtype="uint8" if name == "flags" else "float32",
                compressors=[ZstdCodec(level=1, checksum=True)],
                config={"write_empty_chunks": True},
            )

    def write(self, tile: int, parameters: Parameters) -> None:
        """One tile."""
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
        """One tile's parameters."""
        return Parameters(**{name: np.asarray(array[tile]) for name, array in self._arrays.items()})
