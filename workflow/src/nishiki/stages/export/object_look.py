"""Convert an object's appearance for formats of scenes: one texture for all charts, colour, roughness and gloss.

The lobe K_s / n.v (1 + a^2 / (4 s^2))^-2, relative to a white that faces the lamp, is for small angles
that of Trowbridge and Reitz:

    alpha = 2 s,      w F0 = 4 alpha^2 K_s

Without a white board albedo is relative to a lamp of unknown strength and may be above 1: `lamp_strength` divides it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.atlas.atlas import Atlas
from nishiki.atlas.store import Texels
from nishiki.brdf.slopes import isotropic_lobe
from nishiki.brdf.texels.model import POINT, ViewLamp, factors, predict
from nishiki.colour.colour import decode, encode, srgb_encode
from nishiki.evaluate.object_photographs import Photographs
from nishiki.formats.textured_surface import INDEX, NORMAL_REFLECTANCE, SurfaceLook, TexturedMesh, quantise, sample
from nishiki.geometry.visibility import rasterise
from nishiki.render.display import three_channels
from nishiki.render.object.renderer import DecodedObject
from nishiki.stages.export.registry import METRES, CodedErrors, ExportedSurface, GltfLook

GAP = 2  # texels between two charts


@dataclass(frozen=True)
class TextureAtlas:
    """One texture for all charts."""

    shape: tuple[int, int]  # rows and columns of the texture
    origin: np.ndarray  # (tiles, 2) int64 ndarray: row and column of the first texel of each tile
    # (f, 3, 2) float64 ndarray: row and column of the corners of each triangle, in texels from the texture's first; NaN
    # where it has no place
    corners: np.ndarray

    @property
    def placed(self) -> np.ndarray:
        """(f,) bool: triangles with a place."""
        return np.isfinite(self.corners).all(axis=(1, 2))


def texture_atlas(atlas: Atlas) -> TextureAtlas:
    """Pack each chart whole, so that look-ups inside a triangle never cross a seam, on shelves, highest first."""
    stride = atlas.size - 1
    first, shared = np.unique(atlas.chart_grid[:, 0], return_inverse=True)
    blocks = np.zeros((len(first), 2), np.int64)
    np.maximum.at(blocks, shared, atlas.chart_grid[:, 1:].astype(np.int64) * stride + 1)
    width = int(max(blocks[:, 1].max(), np.ceil(np.sqrt(1.15 * np.prod(blocks + GAP, axis=1).sum()))))
    place = np.zeros_like(blocks)
    top = left = height = 0
    for block in np.lexsort((-blocks[:, 1], -blocks[:, 0])):
        rows, columns = blocks[block]
        if left + columns > width:
            top, left, height = top + height + GAP, 0, 0
        place[block] = top, left
        left, height = left + columns + GAP, max(height, rows)
    of_chart = place[shared]
    corners = np.full(atlas.corners.shape, np.nan)
    inside = atlas.chart >= 0
    corners[inside] = atlas.corners[inside] + of_chart[atlas.chart[inside]][:, None, :]
    origin = of_chart[atlas.tile_chart] + atlas.tile_place.astype(np.int64) * stride
    return TextureAtlas((int(top + height), width), origin, corners)


def fill_gaps(texture: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Fill unknown texels of the texture (rows, columns, channels) with the nearest known ones."""
    if known.all() or not known.any():
        return texture
    from scipy import ndimage

    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return texture[tuple(nearest)]


ALPHA_PER_SIGMA = 2.0
PRIOR = 0.04  # squared irradiance that the model's own albedo counts as
LEAST_ALPHA = 0.03**2  # roughness below which viewers show nothing of distant lamps


@dataclass(frozen=True)
class ObjectLook:
    """Textures of an object."""

    decoded: DecodedObject  # decoded, layout: the object, and the places of its charts in the textures
    layout: TextureAtlas
    # colour, roughness, specular: (rows, columns, 3) or (rows, columns) uint8 ndarray: base colour, sRGB; square root
    # of alpha; share of the reflectance along the normal
    colour: np.ndarray
    roughness: np.ndarray
    specular: np.ndarray
    factor: float  # the reflectance of share 1, as a factor of that of glass (0.04)
    scale: float  # strength of the lamp with which albedo is at most 1
    clipped: float  # share of the texels that are brighter than white nevertheless

    @property
    def normal_reflectance(self) -> float:
        """F0 where the share is 1."""
        return min(self.factor * NORMAL_REFLECTANCE, 1.0)

    def surface(self) -> SurfaceLook:
        """Convert the look to the terms of USD and MaterialX."""
        return SurfaceLook(self.colour, self.roughness, self.normal_reflectance, weight=self.specular)

    def with_mean_strength(self) -> "ObjectLook":
        """Return the look with the mean strength everywhere, the only choice in USD.

        Roughness keeps the height of each texel's highlight, w F0 / (4 alpha^2): a weaker gloss is a wider one.
        """
        mean = np.rint(self.specular.mean())
        wider = np.sqrt(np.sqrt(mean / np.maximum(self.specular, 0.5))) if mean else 1.0
        roughness = np.clip(self.roughness * wider, 255 * np.sqrt(LEAST_ALPHA), 255)
        return replace(self, roughness=np.rint(roughness).astype(np.uint8), specular=np.full_like(self.specular, mean))

    def figures(self) -> dict:
        """Return the look's figures for the diagnostics."""
        placed = self.layout.placed
        return {
            "faces": int(placed.sum()),
            "placed": float(placed.mean()),
            "texture": list(self.layout.shape),
            "clipped": self.clipped,
            "lamp_strength": self.scale,
        }


def object_look(context: Context) -> ObjectLook:
    """Compute textures from the decoded parameters."""
    decoded = DecodedObject.open(context.inputs)
    layout = texture_atlas(decoded.atlas)
    texels = Texels(context.inputs["texels"].folder)
    texels.turn_normals(decoded.mesh)
    albedo, alpha, reflectance = textures(decoded, texels, layout)
    scale = max(float(np.percentile(albedo.max(axis=-1), 99.5)), 1.0)
    albedo, reflectance = albedo / scale, reflectance / scale
    factor = max(float(np.percentile(reflectance, 99.5)) / NORMAL_REFLECTANCE, 1.0)
    colour, roughness = quantise(srgb_encode(albedo)), quantise(np.sqrt(alpha))
    specular = quantise(np.clip(reflectance / NORMAL_REFLECTANCE / factor, 0, 1))
    clipped = float(np.mean((albedo > 1).any(axis=-1)))
    return ObjectLook(decoded, layout, colour, roughness, specular, factor, scale, clipped)


def object_mesh(context: Context, look: ObjectLook) -> TexturedMesh:
    """Return the mesh in metres where its unit is known, with a vertex for each place in the textures."""
    layout, mesh = look.layout, look.decoded.mesh
    placed = layout.placed
    flat = np.column_stack([mesh.triangles[placed].ravel(), layout.corners[placed].reshape(-1, 2)])
    unique, numbers = np.unique(flat, axis=0, return_inverse=True)
    vertex = unique[:, 0].astype(np.int64)
    normals = mesh.normals[vertex] / np.linalg.norm(mesh.normals[vertex], axis=1, keepdims=True)
    positions = mesh.vertices[vertex] * METRES.get(context.inputs["mesh"].diagnostics.get("unit"), 1.0)
    places = (unique[:, :0:-1] + 0.5) / np.array(layout.shape[::-1])
    return TexturedMesh(positions, normals, places, numbers.reshape(-1, 3))


def textures(decoded: DecodedObject, texels: Texels, layout: TextureAtlas) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute albedo (rows, columns, 3), alpha and w F0 (rows, columns) of the texture from the decoded parameters."""

    def look(tile: int) -> np.ndarray:
        kd, ks, sigma = decoded.residual.parameters(tile)
        positions, normals, _ = texels.geometry(tile)
        kd = body_colour(decoded, texels, tile, (kd, ks, sigma), (positions, normals))
        alpha = np.clip(ALPHA_PER_SIGMA * sigma, LEAST_ALPHA, 1)
        return np.dstack([three_channels(kd), alpha, 4 * alpha**2 * ks.mean(axis=-1)])

    filled = in_charts(decoded, layout, 5, look)
    return filled[..., :3], filled[..., 3], filled[..., 4]


def model_textures(decoded: DecodedObject, layout: TextureAtlas) -> dict[str, np.ndarray]:
    """Compute kd, ks (rows, columns, 3) and sigma (rows, columns, 1) of the decoded model, float32, gaps filled."""

    def parameters(tile: int) -> np.ndarray:
        kd, ks, sigma = decoded.residual.parameters(tile)
        return np.dstack([three_channels(kd), three_channels(ks), sigma])

    filled = np.maximum(np.nan_to_num(in_charts(decoded, layout, 7, parameters)), 0)
    return {"kd": filled[..., :3], "ks": filled[..., 3:6], "sigma": filled[..., 6:]}


def in_charts(
    decoded: DecodedObject, layout: TextureAtlas, channels: int, of_tile: Callable[[int], np.ndarray]
) -> np.ndarray:
    """Assemble the texture (rows, columns, channels) float32 from tiles (T, T, channels), gaps filled."""
    texture, known = np.zeros((*layout.shape, channels), np.float32), np.zeros(layout.shape, bool)
    for tile, (row, column) in enumerate(layout.origin):
        values, inside = of_tile(tile), decoded.texel_triangles[tile] >= 0
        window = (slice(row, row + len(values)), slice(column, column + len(values)))
        texture[window][inside] = values[inside]
        known[window] |= inside
    return fill_gaps(texture, known)


def body_colour(
    decoded: DecodedObject,
    texels: Texels,
    tile: int,
    parameters: tuple[np.ndarray, np.ndarray, np.ndarray],
    surface: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Fit albedo (T, T, channels) of a tile by least squares from all views of a texel.

    From the diffuse light where polarisers separated it, else from all light less the model's gloss.

    The model's own K_d is smooth where the residual holds the detail. It stands where no view sees a texel, and weighs
    as much as a view that is lit to a fifth. parameters: kd, ks, sigma; surface: positions and normals.
    """
    kd, ks, sigma = parameters
    above, below = PRIOR * kd, np.full(kd.shape, PRIOR)
    separated = "diffuse" in texels.components
    values = texels.read("diffuse" if separated else "total", tile)
    for number, seen in enumerate(texels.visible(tile)):
        if not seen.any():
            continue
        light, view = divmod(number, len(decoded.views))
        camera = decoded.cameras[view]
        lamp = decoded.lighting.lamp(camera, light)
        points = (surface[0][seen], surface[1][seen], camera.centre, lamp)
        irradiance, _ = factors(*points, kd.shape[-1])
        gloss = 0 if separated else predict(kd[seen], ks[seen], sigma[seen], *points)[1]
        above[seen] += irradiance * (values[number][seen] - gloss)
        below[seen] += irradiance**2
    return np.maximum(above / below, 0)


@dataclass(frozen=True)
class SeenPoints:
    """Surface points behind the covered pixels of a captured view, under its first light."""

    # positions, normals: (n, 3) float64 ndarray: of the points, in the cameras' world; normals of unit length
    positions: np.ndarray
    normals: np.ndarray
    places: np.ndarray  # (n, 2) float64 ndarray: row and column in the textures, in texels
    centre: np.ndarray  # (3,) float64 ndarray: the camera's place
    lamp: ViewLamp  # the light
    covered: np.ndarray  # (rows, columns) bool ndarray: the pixels, in whose order the points come

    @classmethod
    def of(cls, look: ObjectLook, view: int) -> "SeenPoints":
        """Collect the points of triangles that have a place in the textures."""
        decoded, layout = look.decoded, look.layout
        camera, mesh = decoded.cameras[view], decoded.mesh
        raster = rasterise(mesh, camera)
        covered = raster.triangle >= 0
        covered[covered] = layout.placed[raster.triangle[covered]]
        triangle, shares = raster.triangle[covered], raster.barycentric[covered].astype(np.float64)
        shares = np.column_stack([shares, 1 - shares.sum(axis=1)])[..., None]
        positions = np.sum(mesh.vertices[mesh.triangles[triangle]] * shares, axis=1)
        normals = np.sum(mesh.normals[mesh.triangles[triangle]] * shares, axis=1)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        places = np.sum(layout.corners[triangle] * shares, axis=1)
        return cls(positions, normals, places, camera.centre, decoded.lighting.lamp(camera, 0), covered)

    def factors(self) -> tuple[np.ndarray, np.ndarray]:
        """Compute irradiance (n, 3) and lamp strength in the gloss (n,), as in `nishiki.brdf.texels.model`."""
        irradiance, angles = factors(self.positions, self.normals, self.centre, self.lamp, 3)
        return irradiance, angles[:, 0]

    def cosines(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Compute cosines (n,) of normal with half vector, light and view, at least 0, and of view with half vector."""
        near = self.lamp.form == POINT  # surroundings without a highlight have no direction
        light = self.lamp.vector - self.positions if near else np.broadcast_to(self.lamp.vector, self.positions.shape)
        light, towards = (
            vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9)
            for vectors in (light, self.centre - self.positions)
        )
        half = light + towards
        half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-9)
        cos_phi, cos_i, cos_r = (np.maximum(np.sum(self.normals * each, axis=1), 0) for each in (half, light, towards))
        return cos_phi, cos_i, cos_r, np.sum(half * towards, axis=1)


Shown = Callable[[SeenPoints], np.ndarray]
"""Function to the linear values (n, 3) that a program displays at visible points."""


def show_in(look: ObjectLook, name: str) -> Shown:
    """Render a viewer's picture of `gltf`, `usd` or `materialx`, light and view without cast shadows."""
    said = look.with_mean_strength() if name == "usd" else look
    alpha, strength = (said.roughness / 255) ** 2, said.specular / 255
    stored = np.concatenate([decode(look.colour / 255, "srgb"), alpha[..., None], strength[..., None]], axis=-1)

    def draw(points: SeenPoints) -> np.ndarray:
        texels = sample(stored, points.places)
        irradiance, strength = points.factors()
        cos_phi, cos_i, cos_r, cos_q = points.cosines()
        normal = texels[:, 4] * look.normal_reflectance
        grazing = texels[:, 4] if name == "gltf" else 1.0
        reflected = normal + (grazing - normal) * (1 - cos_q) ** 5
        gloss = np.pi * reflected * isotropic_lobe(cos_phi, cos_i, cos_r, texels[:, 3]) * cos_i * strength
        return look.scale * ((1 - reflected[:, None]) * texels[:, :3] * irradiance + gloss[:, None])

    return draw


class ObjectSurface(ExportedSurface):
    """Mesh, look and errors common to formats of scenes."""

    stem = "object"

    @cached_property
    def look(self) -> ObjectLook:
        """Textures."""
        return object_look(self.context)

    @cached_property
    def mesh(self) -> TexturedMesh:
        """Mesh in metres where its unit is known."""
        return object_mesh(self.context, self.look)

    @cached_property
    def model(self) -> dict[str, np.ndarray]:
        """Textures of the decoded model, as of `model_textures`."""
        return model_textures(self.look.decoded, self.look.layout)

    def compare(self, shown: Mapping[str, Shown]) -> dict[str, dict]:
        """Compute the PSNR of displayed values against photographs."""
        decoded, settings, count = self.look.decoded, self.context.settings, len(self.look.decoded.views)
        left_out = decoded.numbers(settings.hold_out)
        seen = [view for view in range(count) if view not in left_out]
        spread = [seen[k * len(seen) // settings.views] for k in range(min(settings.views, len(seen)))]
        photographs = Photographs(self.context.inputs)
        result: dict[str, dict[str, dict[str, float]]] = {name: {} for name in shown}
        for group, views in (("fitted", spread), ("check", sorted(left_out))):
            if not views:
                continue
            found = {name: CodedErrors(len(views)) for name in shown}
            for number, view in enumerate(views):
                linear, valid = photographs.read(view, 0)
                points = SeenPoints.of(self.look, view)
                compared = encode(three_channels(linear)[points.covered], decoded.encoding)
                for name, draw in shown.items():
                    found[name].add(number, encode(draw(points), decoded.encoding), compared, valid[points.covered])
            for name, each in found.items():
                result[name][group] = each.decibels()
        return result

    @property
    def unit(self) -> str:
        """Length of 1 unit in a file."""
        unit = self.context.inputs["mesh"].diagnostics.get("unit")
        return "metres" if unit in METRES else f"{unit} of the cameras"

    def look_of(self, name: str) -> SurfaceLook:
        """Return textures and material in a format's terms; the gloss has one strength in USD."""
        return (self.look.with_mean_strength() if name == "usd" else self.look).surface()

    @property
    def gltf_look(self) -> GltfLook:
        """Look in the terms of glTF."""
        look = self.look
        return GltfLook(look.colour, look.roughness, look.specular, look.factor, INDEX)

    def figures(self, name: str) -> dict:
        """Return an object's figures for the diagnostics of any format."""
        return self.look.figures()

    def errors(self, formats: list[str]) -> dict[str, dict]:
        """Compute the PSNR of the stored textures against photographs, in each format."""
        return self.compare({name: show_in(self.look, name) for name in formats})
