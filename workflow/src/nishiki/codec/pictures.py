"""Views coded as pictures, one texel a pixel, by the coder of texels: for views that no shared surface carries.

The pixels of a view are cut into tiles of SIDE x SIDE, which its camera alone sees; there is no reflection model. Only
pixels of the object are solved for, so that the outline costs nothing: beyond it stands what is cheapest. The surface
says which pixels show the object; where outline and surface differ is stored beside, one bit a pixel, deflated.
"""

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from nishiki.codec.allocate import EncodedObject
from nishiki.codec.store import CodedReader, inflate
from nishiki.codec.tile_code import Pixels, TileMaps, TileSurface

SIDE = 512  # pixels


def areas_of(shape: tuple[int, int]) -> list[tuple[slice, slice]]:
    """Return rows and columns of each tile of a picture (rows, columns), in their order."""
    down, across = (-(-length // SIDE) for length in shape)
    return [
        (slice(i * SIDE, (i + 1) * SIDE), slice(j * SIDE, (j + 1) * SIDE)) for i in range(down) for j in range(across)
    ]


@dataclass(frozen=True)
class PictureSource:
    """The photographs as tiles, view by view, rows of tiles from the top.

    read: from a view to its photographs (lights, rows, columns, channels) float32 in the capture's encoding, and to the
    pixels (rows, columns) bool that are coded; views: those that are coded, of `count`; shape: rows and columns.
    """

    read: Callable[[int], tuple[np.ndarray, np.ndarray]]
    views: tuple[int, ...]
    count: int
    shape: tuple[int, int]
    channels: int

    @property
    def tiles(self) -> int:
        """Number of tiles of all views."""
        return self.count * len(areas_of(self.shape))

    def pixels(self, tile: int) -> Pixels:
        """Return a tile's object pixels under every light; none of a view that is not coded."""
        view, place = divmod(tile, len(areas_of(self.shape)))
        if view not in self.views:
            nothing = np.zeros(0, np.float32)
            return Pixels(np.zeros(0, np.int32), nothing, nothing, np.zeros((0, self.channels), np.float32))
        photographs, coded = self.read(view)
        area = areas_of(self.shape)[place]
        s, t = np.nonzero(coded[area])
        values = photographs[:, *area][:, s, t]
        observation = np.repeat(np.arange(len(values)) * self.count + view, len(s)).astype(np.int32)
        s, t = (np.tile(at, len(values)).astype(np.float32) for at in (s, t))
        return Pixels(observation, s, t, values.reshape(-1, self.channels))

    def surface(self, tile: int) -> TileSurface:
        """Return no surface."""
        nothing = np.zeros((SIDE, SIDE, 1), np.float32)
        return TileSurface(nothing, nothing, np.zeros((SIDE, SIDE), bool))

    def maps(self, tile: int) -> TileMaps:
        """Return no reflection."""
        nothing = np.broadcast_to(np.float32(0), (SIDE, SIDE, self.channels))
        return TileMaps(nothing, nothing, nothing[..., 0])


def pack_strayed(strayed: Sequence[np.ndarray]) -> list[bytes]:
    """Deflate the pixels where outline and surface differ, (rows, columns) bool a view, tile by tile."""
    return [
        zlib.compress(np.packbits(mask[area]).tobytes(), 9) if mask[area].any() else b""
        for mask in strayed
        for area in areas_of(mask.shape)
    ]


def attach_strayed(pictures: EncodedObject, strayed: Sequence[bytes]) -> EncodedObject:
    """Store deflated parts in the place of the parameters, which pictures have not."""
    return replace(pictures, streams=[(part, own[1]) for part, own in zip(strayed, pictures.streams, strict=True)])


def decode_picture(
    pictures: CodedReader, view: int, light: int, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray] | None:
    """Decode a picture (rows, columns, channels) float32 in the capture's encoding; None of a view that is not coded.

    Pixels beyond the object hold any value. Second, (rows, columns) bool: where outline and surface differ.
    """
    areas = areas_of(shape)
    first = view * len(areas)
    out, strayed = np.zeros((*shape, pictures.channels), np.float32), np.zeros(shape, bool)
    for tile, area in enumerate(areas, first):
        texels, (rows, columns) = pictures.texels(tile), pictures.extents[tile].texels
        if texels is not None:
            whole = np.zeros((SIDE, SIDE, pictures.channels), np.float32)
            whole[rows, columns] = np.moveaxis(texels[:, light], 0, -1)
            out[area] = whole[: out[area].shape[0], : out[area].shape[1]]
        if packed := pictures.stream(tile, 0):
            part = strayed[area]
            bits = np.frombuffer(inflate(packed, part.size // 8 + 1), np.uint8)
            part[:] = np.unpackbits(bits, count=part.size).reshape(part.shape)
    return (out, strayed) if any(each.length for each in pictures.extents[first : first + len(areas)]) else None
