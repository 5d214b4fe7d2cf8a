"""Render a decoded object: captured views, views between them, sums of lights (Miyazaki et al. 2007, eq. 12-16).

The value of a pixel is a bilinear look-up, at the surface point behind its centre, among texels of

    encode(model at the texel, for this camera and lamp) + decoded residual of the texel,

in the capture's own encoding; then decoded to linear light.  This is the very operation that the residual's texels
were solved for, so that a captured view is reproduced up to what the coder threw away.  Work goes tile by tile: only
tiles in view are decoded, each once for all pictures of a batch.
"""

import json
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.atlas.atlas import Atlas
from nishiki.atlas.store import Texels
from nishiki.atlas.surface import texel_points
from nishiki.brdf.texels.model import ENVIRONMENT, POINT, CaptureLamps, ViewLamp, predict, weigh_lender
from nishiki.codec.pictures import decode_picture
from nishiki.codec.store import CodedReader, CodedTexels, Residual
from nishiki.colour.colour import decode as to_linear
from nishiki.colour.colour import encode
from nishiki.errors import UserError
from nishiki.geometry.camera import Camera, load_cameras
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.turn import camera_between, fit_turn, scale_camera
from nishiki.geometry.visibility import Raster, interpolate, rasterise
from nishiki.observations.views import Views, largest_value
from nishiki.render.display import develop
from nishiki.render.object.pixels import DepthMaps, bilinear, extend, find_borders, mix, reduce_blocks
from nishiki.render.object.shots import FreeLighting, LampsInView, LitObject, Neighbours, ObjectPicture, Shot
from nishiki.threads import over_items
from nishiki.threads import threads as given_threads

UNSURE = np.float32(0.02)
"""Weight of a view in which a texel is in the light and here is not, or the other way, and of one that shows it beside
an edge or the border of a shadow: there a small error of the surface shows another place."""
MOST_PLACES, MOST_BANDS = 1 << 14, 4  # in one look-up by OpenCV, which takes fewer than 2**15 and at most 4
FOLD_PX = 12
"""Pixels by which a picture is carried over places turned away from the camera: folds of a hull, and steps that it has
in place of a hollow's rim. No photograph shows them, and the model is black there."""
BATCH_BYTES = 32 << 20  # of pictures in hand while all decoded tiles fit into the cache
LARGE_BATCH_BYTES = 384 << 20  # once they do not: a tile is decoded again for each batch
CACHE_BYTES = 256 << 20
LENDERS = 3  # views that lend to pictures which follow one another


@dataclass(frozen=True)
class DecodedObject:
    """Input of the renderer of one object, and the names of its views and lights."""

    mesh: Mesh
    atlas: Atlas
    cameras: list[Camera]
    residual: Residual
    lighting: CaptureLamps
    texel_triangles: np.ndarray  # (tiles, T, T) int32
    encoding: str
    channels: int
    full_turn: bool
    views: tuple[str, ...]
    lights: tuple[str, ...]
    ceiling: float | None

    @classmethod
    def open(cls, inputs: Mapping[str, Artifact]) -> "DecodedObject":
        """Open the artifacts of cameras, mesh, texels, reflection and residual; ingest gives the ceiling alone."""
        texels, reflection = Texels(inputs["texels"].folder), inputs["object_brdf"]
        lighting = json.loads(reflection.path("object_brdf.json").read_text())["lighting"]
        atlas = texels.atlas
        mesh, cameras = Mesh.load(reflection.path("mesh.npz")), load_cameras(inputs["cameras"].path("cameras.json"))
        if len(mesh.triangles) != len(atlas.chart) or [camera.name for camera in cameras] != list(texels.views):
            raise UserError(
                f"{inputs['texels'].folder}: the texels are of {len(atlas.chart)} triangles and {len(texels.views)} "
                f"views, mesh and cameras of {len(mesh.triangles)} and {len(cameras)}; expected the same ones. Remedy: "
                "give artifacts that were made from one another"
            )
        residual = Residual(inputs["residual"].folder)
        names = tuple(texels.views), tuple(texels.lights)
        ceiling = largest_value(Views(inputs["ingest"].folder)) if "ingest" in inputs else None
        described = texels.encoding, texels.channels, texels.full_turn, *names, ceiling
        return cls(mesh, atlas, cameras, residual, CaptureLamps.from_dict(lighting), texels.triangles, *described)

    def renderer(self, *, mesh: Mesh | None = None, **options) -> "ObjectRenderer":
        """Make a renderer of the object; `mesh`: the same triangles at other places; options as of `ObjectRenderer`."""
        mesh = mesh or self.mesh

        def geometry(tile: int):
            points = texel_points(mesh, self.atlas, self.texel_triangles, slice(tile, tile + 1))
            return tuple(values[0] for values in points)

        return ObjectRenderer(self, (mesh, geometry), **options)

    def numbers(self, names) -> frozenset[int]:
        """Return places of named views in the order of the turn; UserError for unknown names."""
        return frozenset(self.number(name) for name in names)

    def number(self, name: str) -> int:
        """Return place of a named view."""
        if name not in self.views:
            known = ", ".join(self.views[:12]) + (", ..." if len(self.views) > 12 else "")
            raise UserError(f"view {name!r}: expected one of {known}. Remedy: correct the name in the settings")
        return self.views.index(name)

    def light_weights(self, weights: Mapping[str, float]) -> tuple[tuple[int, float], ...]:
        """Return (place, weight) of named lights; the first light alone where none is named."""
        unknown = [name for name in weights if name not in self.lights]
        if unknown:
            raise UserError(
                f"lights: expected names among {', '.join(map(repr, self.lights))}, found {unknown[0]!r}. Remedy: "
                "correct the name in the settings"
            )
        return tuple((self.lights.index(name), float(w)) for name, w in weights.items()) or ((0, 1.0),)


@dataclass
class Prepared:
    """A shot whose pixels are sorted by their tiles."""

    shot: Shot
    raster: Raster
    pixels: np.ndarray  # flat indexes of covered pixels
    s: np.ndarray
    t: np.ndarray
    slots: dict[int, int]  # tile -> place in `first`
    first: np.ndarray
    order: np.ndarray
    lamps: list  # of the shot's lights, as this camera has them
    values: np.ndarray = field(init=False)  # (lights, pixels, channels): in the capture's encoding


@dataclass(frozen=True)
class DecodedTile:
    """A tile, its texels in one row: kd, ks (T * T, channels), sigma (T * T,), places and normals (T * T, 3), residual.

    inside (T, T) bool: of charts. lent: by view and light, what views lend to the latest pictures, (T * T, 2 +
    channels) float32.
    """

    parameters: tuple[np.ndarray, np.ndarray, np.ndarray]
    positions: np.ndarray
    normals: np.ndarray
    inside: np.ndarray
    residual: CodedTexels | None
    lent: dict[tuple[int, int], np.ndarray] = field(default_factory=dict)

    @property
    def nbytes(self) -> int:
        """Size of the arrays, those of `lent` of LENDERS views under one light included."""
        arrays = (*self.parameters, self.positions, self.normals, self.inside)
        lent = LENDERS * (self.parameters[0].nbytes + 2 * self.parameters[2].nbytes)
        return sum(values.nbytes for values in arrays) + (self.residual.nbytes if self.residual else 0) + lent


class ObjectRenderer:
    """A renderer of a decoded object.

    surface: the object's mesh, or the same triangles at other places, and a function from a tile to positions (T, T,
    3), normals (T, T, 3), inside (T, T) on it; without: views that were left out of the fit and may not lend their
    residual to others; level > 0: a preview from the coarse part of the residual; model_only: without the residual;
    own_lamps: light the object in place of the captured ones (the model alone, since a residual belongs to its light);
    rim: pixels by which values are carried on beyond the surface's edge. What was saturated or never seen is not bound
    by any photograph, and a lobe can grow there without limit: pictures are clipped to 0 .. the object's ceiling, the
    largest linear value that the capture could hold, as the camera's were; under own_lamps, of any intensity, the
    ceiling says nothing.
    """

    def __init__(
        self,
        decoded: DecodedObject,
        surface: tuple[Mesh, Callable],
        *,
        without: frozenset[int] = frozenset(),
        level: int = 0,
        model_only: bool = False,
        own_lamps: FreeLighting | None = None,
        rim: int = 2,
    ):
        mesh, self.geometry = surface
        self.mesh = mesh
        self.atlas, self.cameras = decoded.atlas, list(decoded.cameras)
        self.residual, self.lighting, self.ceiling = decoded.residual, decoded.lighting, decoded.ceiling
        self.encoding, self.channels = decoded.encoding, decoded.channels
        self.turn = fit_turn(self.cameras, full_turn=decoded.full_turn)
        self.without, self.level = without, level
        self.own_lamps, self.lit = own_lamps is not None, LitObject(mesh, own_lamps or FreeLighting(()))
        self.model_only, self.rim = model_only or self.own_lamps, rim
        self.pictures = None if self.model_only or level else decoded.residual.pictures
        self._lenders: dict[tuple[int, int], tuple[list, np.ndarray]] = {}  # of the batch, by view and light
        self.threads = given_threads()
        self.depths = DepthMaps(mesh)
        self._cache: OrderedDict[int, DecodedTile] = OrderedDict()
        self._held, self._dropped, self._lock = 0, False, threading.Lock()

    def captured(self, index: int, *, light: int = 0) -> Shot:
        """Render a captured view from its own slot of the residual."""
        slot = Neighbours(np.array([index]), np.ones(1))
        return Shot(self.cameras[index], slot, ((light, 1.0),), captured=index)

    def predicted(self, index: int, *, light: int = 0) -> Shot:
        """Render a captured view without its own residual: interpolated between the other views."""
        return self._shot(self.cameras[index], float(self.turn.position[index]), light, self.without | {index})

    def between(self, index: int, fraction: float, *, scale: Callable | None = None) -> Shot:
        """Render a picture `fraction` of the way from captured view `index` to the next; scale(camera): other size."""
        camera = camera_between(self.cameras, self.turn, index, fraction)
        position = self.turn.locate(index, fraction)
        return self._shot(scale(camera) if scale else camera, position, 0, self.without)

    def _shot(self, camera: Camera, position: float, light: int, without: frozenset[int]) -> Shot:
        return Shot(camera, Neighbours.around(self.turn, position, without=without), ((light, 1.0),))

    def render(self, shots: Iterable[Shot]) -> Iterator[ObjectPicture]:
        """Yield the pictures of the shots, in order; as many at a time as fit into the memory set aside for them."""
        batch, held = [], 0
        for shot in shots:
            prepared = self._prepare(shot)
            size = prepared.raster.triangle.nbytes * 4 + prepared.values.nbytes + prepared.order.nbytes * 3
            if batch and held + size > (LARGE_BATCH_BYTES if self._dropped else BATCH_BYTES):
                yield from self._finish(batch)
                batch, held = [], 0
            batch.append(prepared)
            held += size
        yield from self._finish(batch)

    def _prepare(self, shot: Shot) -> Prepared:
        raster = rasterise(self.mesh, shot.camera)
        pixels = np.flatnonzero(raster.triangle.reshape(-1) >= 0)
        tile, s, t = self.atlas.locate(raster.triangle.reshape(-1)[pixels], raster.barycentric.reshape(-1, 2)[pixels])
        present = np.flatnonzero(np.bincount(tile[tile >= 0], minlength=1))
        places = np.full(int(tile.max(initial=0)) + 2, len(present), np.uint16)  # tile -1 reads the last place
        places[present] = np.arange(len(present))
        first = np.concatenate([[0], np.cumsum(np.bincount(places[tile], minlength=len(present) + 1))])
        order = np.argsort(places[tile], kind="stable")
        slots = {int(number): k for k, number in enumerate(present)}
        if self.own_lamps:
            shot = shot.lit_by(((0, 1.0),))
            lamps: list = [self.lit.seen_by(shot.camera)]
        else:
            lamps = [self.lighting.lamp(shot.camera, light) for light, _ in shot.lights]
        prepared = Prepared(shot, raster, pixels, s, t, slots, first, order, lamps)
        prepared.values = np.zeros((len(shot.lights), len(pixels), self.channels), np.float32)
        return prepared

    def _finish(self, batch: list[Prepared]) -> Iterator[ObjectPicture]:
        if not self.model_only:
            shots = [prepared.shot for prepared in batch if self._blends(prepared.shot)]
            self.depths.prepare([self.cameras[view] for shot in shots for view in shot.views.views])
            keys = {(int(view), light) for shot in shots for view in shot.views.views for light, _ in shot.lights}
            if self.pictures is not None:
                self._lenders = {
                    key: self._lenders.get(key) or self._decode_picture(self.pictures, *key) for key in sorted(keys)
                }
            for flat in self._cache.values():
                for key in flat.lent.keys() - keys:
                    del flat.lent[key]
        tiles = sorted({tile for prepared in batch for tile in prepared.slots})
        over_items(lambda tile: self._draw(tile, batch), tiles, self.threads)
        while batch:
            yield self._picture(batch.pop(0))

    def _blends(self, shot: Shot) -> bool:
        """Test whether neighbours lend by how well they see a texel; pictures lend to all but their own view."""
        return len(shot.views.views) > 1 or (self.pictures is not None and shot.captured is None)

    def _draw(self, tile: int, batch: list[Prepared]) -> None:
        """Draw all pixels of all pictures of a batch that show this tile."""
        flat, drawn = self._tile(tile), []
        for prepared in batch:
            slot = prepared.slots.get(tile)
            if slot is not None:
                order = prepared.order[prepared.first[slot] : prepared.first[slot + 1]]
                drawn.append((prepared, order, *bilinear(prepared.s[order], prepared.t[order], self.atlas.size)))
        for prepared, order, chosen, place, weights in drawn:
            for k in range(len(prepared.lamps)):
                texels = self._texels(prepared, k, flat, chosen)
                prepared.values[k][order] = sum(
                    share[:, None] * texels.take(corner, axis=0) for share, corner in zip(weights, place, strict=True)
                )
        if self._dropped or len(flat.lent) > LENDERS:
            flat.lent.clear()

    def _texels(self, prepared: Prepared, place: int, flat: DecodedTile, chosen: np.ndarray) -> np.ndarray:
        """Compute (m, channels) float32: chosen texels of a tile for this camera under one lamp, encoded.

        place: of the light among those of the shot.
        """
        shot, lamp, light = prepared.shot, prepared.lamps[place], prepared.shot.lights[place][0]
        if isinstance(lamp, LampsInView):
            kd, ks, sigma = (values[chosen] for values in flat.parameters)
            diffuse, gloss = lamp.predict(kd, ks, sigma, flat.positions[chosen], flat.normals[chosen])
            return encode(diffuse + gloss, self.encoding)
        coded, views = encode(sum(self._predict(flat, chosen, shot.camera, lamp)), self.encoding), shot.views
        if not self.model_only and self._blends(shot):
            return self._add_lent(coded, (lamp, light), flat, chosen, views)
        if self.model_only or flat.residual is None:
            return coded
        return coded + flat.residual.look_up(light * len(self.cameras) + int(views.views[0]), chosen)

    def _predict(self, flat: DecodedTile, chosen: np.ndarray | slice, camera: Camera, lamp) -> tuple:
        """Predict diffuse and specular radiance (m, channels) float32 at chosen texels of a tile."""
        kd, ks, sigma = (values[chosen] for values in flat.parameters)
        return predict(kd, ks, sigma, flat.positions[chosen], flat.normals[chosen], camera.centre, lamp)

    def _add_lent(self, coded: np.ndarray, of: tuple, flat: DecodedTile, chosen: np.ndarray, shown: Neighbours):
        """Add to the model of texels (m, channels), in its cast shadows, what views differ from it.

        of: the lamp and the light's number.  A view in which the lamp sees a texel lends little to a picture where it
        does not, and the other way round.
        """
        (lamp, light), weights = of, shown.weights.astype(np.float32)
        lit = self._find_lit(lamp, flat.positions[chosen], flat.normals[chosen])
        lent = np.stack([self._lend((int(view), light), flat)[chosen] for view in shown.views])
        seen = lent[..., 1] * np.where(lent[..., 0] == lit, np.float32(1), UNSURE)
        coded, mixed = coded * lit[:, None], mix(lent[..., 2:], seen, weights)
        if self.pictures is None:  # texels that no view sees were solved for too
            return coded + mixed
        total = (weights[:, None] * seen).sum(axis=0)
        return coded + np.where(total > 0, 1, 0)[:, None] * mixed

    def _lend(self, key: tuple[int, int], flat: DecodedTile) -> np.ndarray:
        """Return (T * T, 2 + channels) float32 in a view and light: lit, how well seen, view minus shadowed model."""
        import cv2

        if key in flat.lent:
            return flat.lent[key]
        (view, light), positions, normals = key, flat.positions, flat.normals
        camera = self.cameras[view]
        lamp = self.lighting.lamp(camera, light)
        lit, seen = self._find_lit(lamp, positions, normals), self.depths.visible(positions, normals, camera)
        diffuse, gloss = self._predict(flat, slice(None), camera, lamp)
        model = encode(diffuse + gloss, self.encoding)
        seen *= weigh_lender(diffuse, lit[:, None] * gloss)
        for border in [find_borders(each > 0, flat.inside) for each in (lit, seen)]:
            seen[border] *= UNSURE
        if self.pictures is not None and self.ceiling is not None:  # the picture ends there, too
            model = np.minimum(model, encode(np.array(self.ceiling, np.float32), self.encoding))
        lent = -model * lit[:, None]
        if self.pictures is None:
            lent += model
            if flat.residual is not None:
                lent += flat.residual.look_up(light * len(self.cameras) + view, np.arange(len(positions)))
        else:
            (picture, bare), places = self._lenders[key], camera.project(positions)[0].astype(np.float32)[:, None]
            for first in range(0, len(places), MOST_PLACES):
                some = slice(first, first + MOST_PLACES)
                for k, values in enumerate(picture):
                    shown = cv2.remap(values, places[some], None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
                    lent[some, MOST_BANDS * k : MOST_BANDS * (k + 1)] += shown.reshape(len(shown), -1)
                seen[some][cv2.remap(bare, places[some], None, cv2.INTER_NEAREST)[:, 0] > 0] = 0
        flat.lent[key] = np.column_stack([lit, seen, lent])
        return flat.lent[key]

    def _find_lit(self, lamp: ViewLamp, positions: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Compute (m,) float32: 1 at points lit by a lamp, 0 in its cast shadow; fitted lighting has no shadows."""
        if lamp.form == ENVIRONMENT:
            return np.ones(len(positions), np.float32)
        return self.lit.visible(lamp.vector, lamp.vector[None], positions, normals, near=lamp.form == POINT)

    def _decode_picture(self, pictures: CodedReader, view: int, light: int) -> tuple[list[np.ndarray], np.ndarray]:
        """Decode a view's picture, MOST_BANDS (rows, columns, n) at a time, and where outline and surface differ."""
        shape = self.cameras[view].rows, self.cameras[view].columns
        found = decode_picture(pictures, view, light, shape)
        values, strayed = found or (np.zeros((*shape, self.channels), np.float32), np.ones(shape, bool))
        bands = [values[..., first : first + MOST_BANDS] for first in range(0, self.channels, MOST_BANDS)]
        return [np.ascontiguousarray(each) for each in bands], strayed.astype(np.uint8)

    def _tile(self, tile: int) -> DecodedTile:
        """Return a tile's decoded parameters and residual and its geometry; cache the most recent ones."""
        with self._lock:
            if tile in self._cache:
                self._cache.move_to_end(tile)
                return self._cache[tile]
        kd, ks, sigma = (np.asarray(values, np.float32) for values in self.residual.parameters(tile))
        positions, normals, inside = self.geometry(tile)
        residual = None
        if not self.model_only and not self.residual.empty(tile):
            residual = self.residual.decode_coded(tile, level=self.level)
        flat = DecodedTile(
            (kd.reshape(-1, self.channels), ks.reshape(-1, self.channels), sigma.reshape(-1)),
            positions.reshape(-1, 3),
            normals.reshape(-1, 3),
            inside,
            residual,
        )
        with self._lock:
            if tile not in self._cache:
                self._cache[tile] = flat
                self._held += flat.nbytes
            while self._held > CACHE_BYTES and len(self._cache) > 1:
                self._held -= self._cache.popitem(last=False)[1].nbytes
                self._dropped = True
        return flat

    def _picture(self, prepared: Prepared) -> ObjectPicture:
        raster, shot = prepared.raster, prepared.shot
        linear = np.zeros((raster.triangle.size, self.channels), np.float32)
        highest = np.inf if self.own_lamps or self.ceiling is None else self.ceiling
        for values, (_, weight) in zip(prepared.values, shot.lights, strict=True):
            seen = to_linear(values, self.encoding)
            linear[prepared.pixels] += np.float32(weight) * np.clip(seen, 0, highest, dtype=np.float32)
        linear = linear.reshape(*raster.triangle.shape, self.channels)
        covered = raster.triangle >= 0
        if shot.captured is None and self.pictures is not None:
            at, away = prepared.pixels, np.zeros(covered.shape, bool)
            shown = raster.triangle.reshape(-1)[at], raster.barycentric.reshape(-1, 2)[at]
            points, normals = (
                interpolate(values, self.mesh.triangles, *shown) for values in (self.mesh.vertices, self.mesh.normals)
            )
            # where the normal is turned away from the camera the surface that shows is wrong
            away.reshape(-1)[at] = np.einsum("nk,nk->n", shot.camera.centre - points, normals) <= 0
            extend(linear, covered & ~away, rings=FOLD_PX, within=away)
            np.clip(linear, 0, highest * sum(abs(weight) for _, weight in shot.lights), out=linear)
        reached = extend(linear, covered, rings=self.rim)
        if shot.captured is not None and self.pictures is not None:
            for place, (light, weight) in enumerate(shot.lights):
                found = decode_picture(self.pictures, shot.captured, light, reached.shape)
                if found is None:
                    break
                reached |= found[1]
                picture = np.float32(weight) * np.clip(to_linear(found[0], self.encoding), 0, highest)
                drawn = reached & ~(covered & found[1])  # beyond the outline the picture holds any value
                linear[drawn] = picture[drawn] + (linear[drawn] if place else 0)
        highest *= sum(abs(weight) for _, weight in shot.lights)
        np.clip(linear, 0, highest, out=linear, where=(reached & ~covered)[..., None])
        return ObjectPicture(linear, covered, reached, raster.triangle, raster.barycentric, raster.depth)

    def normals(self, picture: ObjectPicture, camera: Camera) -> np.ndarray:
        """Return unit normals (rows, columns, 3) float32 as the camera sees them (x right, y up, z to it), else 0."""
        turned = self.mesh.normals @ (np.diag([1.0, -1.0, -1.0]) @ camera.rotation).T
        interpolated = interpolate(turned, self.mesh.triangles, picture.triangle, picture.barycentric)
        length = np.linalg.norm(interpolated, axis=2, keepdims=True)
        return np.where(length > 1e-6, interpolated / np.where(length > 1e-6, length, 1), 0).astype(np.float32)


def places(views: int, frames_per_step: int, *, closed: bool) -> list[tuple[int, float]]:
    """List (view, fraction of the way to the next) of each frame: once round, or there and back in an open turn."""
    steps = views if closed else views - 1
    forth = [(k // frames_per_step, k % frames_per_step / frames_per_step) for k in range(steps * frames_per_step)]
    if closed or views < 2:
        return forth or [(0, 0.0)]
    return [*forth, (views - 2, 1.0), *forth[:0:-1]]


def frames(
    renderer: ObjectRenderer,
    *,
    frames_per_step: int,
    columns: int,
    supersampling: int = 2,
    lights: tuple[tuple[int, float], ...] = ((0, 1.0),),
    background: float = 0.0,
) -> Iterator[np.ndarray]:
    """Yield (rows, columns, 3) uint8 sRGB frames along the turn, each the mean of supersampling² samples a pixel."""
    width = min(columns, renderer.cameras[0].columns)
    factor = width * supersampling / renderer.cameras[0].columns

    def scale(camera):
        return scale_camera(camera, factor)

    along = places(len(renderer.cameras), frames_per_step, closed=renderer.turn.closed)
    shots = (renderer.between(view, fraction, scale=scale).lit_by(lights) for view, fraction in along)
    for picture in renderer.render(shots):
        linear, alpha = reduce_blocks(picture.linear, picture.covered, supersampling)
        yield develop(linear, alpha, background=background).pixels
