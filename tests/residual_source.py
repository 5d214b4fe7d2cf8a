"""The sphere's tiles as the residual's coder wants them."""

import numpy as np
from turned_sphere import camera_of

from nishiki.brdf.texels.model import CaptureLamps
from nishiki.codec.tile_code import CodedScene, Pixels, TileMaps, TileSurface
from nishiki.colour.colour import encode
from nishiki.geometry.camera import Camera


class SphereSource:
    """Tiles of `turned_sphere.tiles_of_sphere`, in an encoding, without held-out views."""

    def __init__(self, tiles, *, encoding="linear", without=()):
        self.held, self.encoding, self.without = tiles, encoding, without
        self.tiles, self.size = len(tiles), tiles[0].kd.shape[0]

    def pixels(self, tile):
        t = self.held[tile]
        kept = ~np.isin(t.observation, self.without)
        values = encode(t.values[kept], self.encoding)
        return Pixels(t.observation[kept], t.s[kept], t.t[kept], values)

    def surface(self, tile):
        t = self.held[tile]
        return TileSurface(t.positions, t.normals, np.ones(t.kd.shape[:2], bool))

    def maps(self, tile):
        t = self.held[tile]
        return TileMaps(t.kd, t.ks, t.width)


def scene_of(views):
    """Cameras of the sphere's pictures, a lamp at each."""
    lighting, centres, lamps = CaptureLamps("camera"), [], []
    for view in range(views):
        place, axes = camera_of(view, views)
        camera = Camera(str(view), np.eye(3), axes, -axes @ place, 8, 8)
        centres.append(place)
        lamps.append(lighting.lamp(camera, 0))
    return CodedScene(np.array(centres), lamps)
