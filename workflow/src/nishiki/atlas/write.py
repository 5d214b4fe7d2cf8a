"""Write texel stacks and pixel samples: one view at a time, tile by tile within it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zarr
from zarr.codecs import ZstdCodec

from nishiki.artifacts.declaration import Output, output_of
from nishiki.atlas.atlas import Atlas
from nishiki.atlas.store import ATLAS, FORMAT, STORE
from nishiki.atlas.surface import PixelPlaces, object_pixels, pixel_places, sample_view, texel_points, texel_triangles
from nishiki.formats.stored import channel_bits
from nishiki.geometry.camera import Camera
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.visibility import Raster, rasterise
from nishiki.threads import in_threads

READ_AHEAD_MIB = 64
"""Memory that a reader keeps for one quantity over all observations."""


@dataclass(frozen=True)
class ViewGeometry:
    """The part of the object that one view shows under any light."""

    view: int
    raster: Raster
    shown: np.ndarray  # (rows, columns) bool
    places: PixelPlaces  # of the pixels in the atlas
    start: int  # of the pixels in the store


class Source(NamedTuple):
    """The photographs of an artifact: names of lights and components, and views left out of fits."""

    lights: tuple[str, ...]
    components: tuple[str, ...]
    channels: int
    encoding: str
    full_turn: bool
    hold_out: tuple[str, ...] = ()


class TexelsWriter:
    """A writer of one artifact's texels. First `view`, then `pictures` for each of its lights, view after view."""

    def __init__(
        self,
        folder: Path,
        outputs: Sequence[Output],
        mesh: Mesh,
        atlas: Atlas,
        cameras: list[Camera],
        source: Source,
        *,
        stamp: dict[str, str],
    ):
        self.outputs, self.mesh, self.atlas, self.cameras = outputs, mesh, atlas, cameras
        lights, components, channels, encoding, full_turn, hold_out = source
        self.lights, self.components, self.channels, self.hold_out = lights, components, channels, hold_out
        self.views, self.observations = len(cameras), len(cameras) * len(lights)
        texel_bytes = atlas.size**2 * channels * 4 * self.observations
        self.together = int(np.clip((READ_AHEAD_MIB << 20) // texel_bytes, 1, max(1, atlas.tiles)))
        self.chunk = int(np.clip((READ_AHEAD_MIB << 20) // (4 * channels * self.observations), 4096, 65536))
        self.offsets = np.zeros((self.views, atlas.tiles + 1), np.int64)
        self.length = 0
        self.group: Any = zarr.create_group(
            Path(folder) / STORE,
            attributes={
                "format": FORMAT,
                "stamp": stamp,
                "tiles": atlas.tiles,
                "size": atlas.size,
                "channels": channels,
                "views": [camera.name for camera in cameras],
                "lights": list(lights),
                "components": list(components),
                "hold_out": list(hold_out),
                "encoding": encoding,
                "full_turn": full_turn,
                "cameras": [camera.as_dict() for camera in cameras],
            },
        )
        atlas.save(Path(folder) / ATLAS)
        for output in outputs:
            for name in dict.fromkeys(output.name.replace("COMPONENT", component) for component in components):
                self._create(name)
        self._write_geometry()

    def _create(self, name: str) -> None:
        """Create a declared array, empty along its pixels; one tile of one observation is together in a chunk."""
        tiles, size = self.atlas.tiles, self.atlas.size
        lengths = {"tile": tiles, "bound": tiles + 1, "row": size, "column": size, "channel": self.channels, "3": 3}
        lengths |= {"observation": self.observations, "view": self.views, "light": len(self.lights), "pixel": 0}
        chunks = lengths | {"tile": self.together, "observation": 1, "light": 1, "pixel": self.chunk}
        output = output_of(self.outputs, name)
        axes = output.axes.split()
        self.group.create_array(
            name,
            shape=[lengths[axis] for axis in axes],
            chunks=[chunks[axis] for axis in axes],
            dtype=output.dtype,
            compressors=[ZstdCodec(level=1, checksum=True)],
            attributes=output.attributes,
            config={"write_empty_chunks": True},
        )

    def _write_geometry(self) -> None:
        triangles = texel_triangles(self.atlas)
        tiles, size = self.atlas.tiles, self.atlas.size
        self.positions = np.empty((tiles, size, size, 3), np.float32)
        self.normals, self.inside = np.empty_like(self.positions), np.empty((tiles, size, size), bool)
        for part in self.groups():
            geometry = texel_points(self.mesh, self.atlas, triangles, part)
            self.positions[part], self.normals[part], self.inside[part] = geometry
            self.group["positions"][part], self.group["normals"][part] = geometry[:2]
        self.sums = np.zeros((tiles, size, size, self.channels), np.float32)
        self.counts = np.zeros((tiles, size, size), np.uint16)

    def groups(self) -> list[slice]:
        """List the tiles that are stored together."""
        return [slice(k, min(k + self.together, self.atlas.tiles)) for k in range(0, self.atlas.tiles, self.together)]

    def view(self, index: int, silhouette: np.ndarray | None) -> ViewGeometry:
        """Rasterise a view and store where its object pixels lie; silhouette (rows, columns) bool where known."""
        camera = self.cameras[index]
        raster = rasterise(self.mesh, camera)
        shown = object_pixels(self.mesh, camera, raster, silhouette)
        places = pixel_places(self.atlas, raster, shown)
        start, count = self.length, len(places.row)
        # Whole chunks for each view: no chunk is written twice.
        self.length += -(-count // self.chunk) * self.chunk
        for name in ("row", "column", "s", "t"):
            array = self.group[f"pixels/{name}"]
            array.resize((self.length,))
            array[start : start + count] = getattr(places, name)
        for name in ("valid", *(f"values/{c}" for c in self.components)):
            array = self.group[f"pixels/{name}"]
            array.resize((len(self.lights), self.length, *array.shape[2:]))
        self.offsets[index] = start + places.offsets
        return ViewGeometry(index, raster, shown, places, start)

    def pictures(
        self,
        view: ViewGeometry,
        light: int,
        pictures: dict[str, np.ndarray],
        valid: np.ndarray,
        saturated: np.ndarray | None = None,
    ) -> dict:
        """Store the pictures of one view under one light; return the counts visible and inside.

        pictures (rows, columns, channels) linear by component, valid (rows, columns) bool; saturated (rows, columns,
        channels) bool: the total is a lower bound.
        """
        places, camera = view.places, self.cameras[view.view]
        observation = light * self.views + view.view
        part = slice(view.start, view.start + len(places.row))
        self.group["pixels/valid"][light, part] = valid[places.row, places.column]
        for name in self.components:
            self.group[f"pixels/values/{name}"][light, part] = pictures[name][places.row, places.column]
        held = camera.name in self.hold_out
        known = valid if saturated is None else valid | saturated.any(axis=-1)
        usable = np.zeros_like(valid) if held else view.shown & known
        marks = [] if saturated is None or not saturated.any() else [saturated.astype(np.float32)]

        def one(group: slice) -> int:
            results = sample_view(
                self.positions[group],
                self.normals[group],
                self.inside[group],
                camera=camera,
                depth=np.where(usable, view.raster.depth, np.float32(np.inf)),
                pictures=[*(pictures[name] for name in self.components), *marks],
            )
            seen = results[0].visible.astype(np.uint8)
            if marks:
                saturated_bits = (results.pop().values > 0) * channel_bits(self.channels)
                seen |= np.bitwise_or.reduce(saturated_bits, axis=-1) << 1
            self.group["visible"][observation, group] = seen
            for name, sampled in zip(self.components, results, strict=True):
                self.group[f"values/{name}"][observation, group] = sampled.values
                if name == "total":
                    self.sums[group] += sampled.values * (seen == 1)[..., None]
                    self.counts[group] += seen == 1
            return int((seen == 1).sum())

        return {"visible": sum(in_threads(one, self.groups())), "inside": int(self.inside.sum())}

    def finish(self) -> np.ndarray:
        """Close the index of the pixels; return the mean colour of each texel, (tiles, T, T, channels) float32.

        The mean is over the observations that show the texel, NaN where none does.
        """
        self.group["pixels/offsets"][...] = self.offsets
        with np.errstate(invalid="ignore"):
            return np.where(self.counts[..., None] > 0, self.sums / self.counts[..., None], np.float32(np.nan))
