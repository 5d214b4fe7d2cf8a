"""An object as binary glTF: mesh, colour, roughness and strength of the gloss as textures.

The simplified Torrance-Sparrow lobe K_s / n.v exp(-a^2 / (2 s^2)) (Miyazaki et al., 2007, eq. 8), relative to a white
that faces the lamp, becomes the lobe of Trowbridge and Reitz with the same peak and the same width at half of it:

    alpha = s sqrt(2 ln 2) / sqrt(sqrt 2 - 1),      w F0 = 4 alpha^2 K_s

Without a white board albedo is relative to a lamp of unknown strength and may be above 1: `lamp_strength` divides it.
"""

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.atlas.store import Texels
from nishiki.brdf.texels.lighting import POINT, Lamp
from nishiki.brdf.texels.model import factors, predict
from nishiki.colour.colour import srgb_encode
from nishiki.colour.encoding import decode, encode
from nishiki.evaluate.object_photographs import Photographs
from nishiki.formats.glb import Glb
from nishiki.formats.picture_tiles import png_bytes
from nishiki.geometry.raster import rasterise
from nishiki.render.display import three_channels
from nishiki.render.object.decoded_object import DecodedObject
from nishiki.stages.export.gltf_material import ggx
from nishiki.stages.export.normals import software
from nishiki.stages.export.photographs import CodedErrors
from nishiki.stages.object_export.texture_atlas import TextureAtlas, fill_gaps, sample, texture_atlas

ALPHA_PER_SIGMA = float(np.sqrt(2 * np.log(2) / (np.sqrt(2) - 1)))
INDEX = 1.5
NORMAL_REFLECTANCE = ((INDEX - 1) / (INDEX + 1)) ** 2
METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
PRIOR = 0.04  # squared irradiance that the model's own albedo counts as
LEAST_ALPHA = 0.03**2  # roughness below which viewers show nothing of distant lamps


def write(context: Context) -> dict:
    """`object.glb`; its error against photographs."""
    decoded = DecodedObject.open(context.inputs)
    layout = texture_atlas(decoded.atlas)
    albedo, alpha, reflectance = textures(decoded, Texels(context.inputs["texels"].folder), layout)
    scale = max(float(np.percentile(albedo.max(axis=-1), 99.5)), 1.0)
    albedo, reflectance = albedo / scale, reflectance / scale
    factor = max(float(np.percentile(reflectance, 99.5)) / NORMAL_REFLECTANCE, 1.0)
    pictures = {
        "colour": coded(srgb_encode(albedo)),
        "roughness": coded(np.stack([0 * alpha, np.sqrt(alpha), 0 * alpha], axis=-1)),
        "specular": coded(np.clip(reflectance / NORMAL_REFLECTANCE / factor, 0, 1)),
    }
    vertices = write_glb(context, decoded, layout, pictures, factor)
    return {
        "files": ["exports/object.glb"],
        "vertices": vertices,
        "faces": int(layout.placed.sum()),
        "placed": float(layout.placed.mean()),
        "texture": list(layout.shape),
        "clipped": float(np.mean((albedo > 1).any(axis=-1))),
        "lamp_strength": scale,
        "kinds": {"gltf": {"psnr_db": errors(context, decoded, layout, pictures, factor, scale)}},
    }


def coded(values: np.ndarray) -> np.ndarray:
    """Eight bits of values in 0 to 1."""
    return np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)


def textures(decoded: DecodedObject, texels: Texels, layout: TextureAtlas) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Albedo (rows, columns, 3), alpha and w F0 (rows, columns) of the whole texture, from the decoded parameters."""
    albedo = np.zeros((*layout.shape, 3), np.float32)
    alpha, reflectance = (np.zeros(layout.shape, np.float32) for _ in range(2))
    known = np.zeros(layout.shape, bool)
    for tile, (row, column) in enumerate(layout.origin):
        kd, ks, sigma = decoded.residual.parameters(tile)
        positions, normals, inside = texels.geometry(tile)
        kd = body_colour(decoded, texels, tile, (kd, ks, sigma), (positions, normals))
        window = (slice(row, row + len(kd)), slice(column, column + len(kd)))
        width = np.clip(ALPHA_PER_SIGMA * sigma, LEAST_ALPHA, 1)
        for texture, values in (
            (albedo, three_channels(kd)),
            (alpha, width),
            (reflectance, 4 * width**2 * ks.mean(axis=-1)),
        ):
            texture[window][inside] = values[inside]
        known[window] |= inside
    stacked = np.concatenate([albedo, alpha[..., None], reflectance[..., None]], axis=-1)
    filled = fill_gaps(stacked, known)
    return filled[..., :3], filled[..., 3], filled[..., 4]


def body_colour(
    decoded: DecodedObject,
    texels: Texels,
    tile: int,
    parameters: tuple[np.ndarray, np.ndarray, np.ndarray],
    surface: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """(T, T, channels) albedo of a tile by least squares from all views that see a texel: from the diffuse light where
    polarisers separated it, else from all light less the model's gloss.

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


def write_glb(
    context: Context, decoded: DecodedObject, layout: TextureAtlas, pictures: dict[str, np.ndarray], factor: float
) -> int:
    """The file; its number of vertices: those of the mesh, once for each place in the textures."""
    placed, mesh = layout.placed, decoded.mesh
    flat = np.column_stack([mesh.triangles[placed].ravel(), layout.corners[placed].reshape(-1, 2)])
    unique, numbers = np.unique(flat, axis=0, return_inverse=True)
    vertex = unique[:, 0].astype(np.int64)
    unit = context.inputs["mesh"].diagnostics.get("unit")
    normals = mesh.normals[vertex] / np.linalg.norm(mesh.normals[vertex], axis=1, keepdims=True)
    glb = Glb(extensions={"KHR_materials_ior", "KHR_materials_specular"})
    attributes = {
        "POSITION": glb.vertices(mesh.vertices[vertex] * METRES.get(unit, 1.0), bounds=True),
        "NORMAL": glb.vertices(normals),
        "TEXCOORD_0": glb.vertices((unique[:, :0:-1] + 0.5) / np.array(layout.shape[::-1])),
    }
    numbers_of = {
        name: {"index": glb.texture(png_bytes(picture), mime="image/png")}
        for name, picture in pictures.items()
        if name != "specular"
    }
    strength = np.concatenate([np.full((*layout.shape, 3), 255, np.uint8), pictures["specular"][..., None]], axis=-1)
    material = glb.add(
        "materials",
        pbrMetallicRoughness={
            "baseColorTexture": numbers_of["colour"],
            "metallicRoughnessTexture": numbers_of["roughness"],
            "metallicFactor": 0,
        },
        extensions={
            "KHR_materials_ior": {"ior": INDEX},
            "KHR_materials_specular": {
                "specularTexture": {"index": glb.texture(png_bytes(strength), mime="image/png")},
                "specularColorFactor": [factor] * 3,
            },
        },
    )
    primitive = {"attributes": attributes, "indices": glb.corners(numbers.reshape(-1, 3)), "material": material}
    glb.add("nodes", mesh=glb.add("meshes", primitives=[primitive]), name=context.stamp["scene"])
    extras = {**context.stamp, "unit": "metres" if unit in METRES else f"{unit} of the cameras"}
    glb.write(context.output.path("exports/object.glb"), generator=software(context), extras=extras)
    return len(unique)


def errors(
    context: Context,
    decoded: DecodedObject,
    layout: TextureAtlas,
    pictures: dict[str, np.ndarray],
    factor: float,
    scale: float,
) -> dict[str, dict[str, float]]:
    """PSNR of the stored textures against photographs, in the capture's encoding: left-out views and some others."""
    settings, count = context.settings, len(decoded.views)
    left_out = decoded.numbers(settings.hold_out)
    seen = [view for view in range(count) if view not in left_out]
    spread = [seen[k * len(seen) // settings.views] for k in range(min(settings.views, len(seen)))]
    photographs = Photographs(context.inputs)
    base = decode(pictures["colour"] / 255, "srgb")
    alpha = (pictures["roughness"][..., 1] / 255) ** 2
    weight = pictures["specular"] / 255
    stored = np.concatenate([base, alpha[..., None], weight[..., None]], axis=-1)
    result = {}
    for name, views in (("fitted", spread), ("check", sorted(left_out))):
        if not views:
            continue
        found = CodedErrors(len(views))
        for number, view in enumerate(views):
            linear, valid = photographs.read(view, 0)
            shown, covered = shaded(decoded, layout, stored, factor, view)
            compared = encode(three_channels(linear)[covered], decoded.encoding)
            found.add(number, encode(scale * shown, decoded.encoding), compared, valid[covered])
        result[name] = found.decibels()
    return result


def shaded(
    decoded: DecodedObject, layout: TextureAtlas, stored: np.ndarray, factor: float, view: int
) -> tuple[np.ndarray, np.ndarray]:
    """What a viewer of glTF shows of a captured view under its first light: (n, 3) of the covered pixels, and those."""
    camera, mesh = decoded.cameras[view], decoded.mesh
    raster = rasterise(mesh, camera)
    covered = raster.triangle >= 0
    covered[covered] = layout.placed[raster.triangle[covered]]
    triangle, shares = raster.triangle[covered], raster.barycentric[covered].astype(np.float64)
    shares = np.column_stack([shares, 1 - shares.sum(axis=1)])[..., None]
    positions = np.sum(mesh.vertices[mesh.triangles[triangle]] * shares, axis=1)
    normals = np.sum(mesh.normals[mesh.triangles[triangle]] * shares, axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    texels = sample(stored, np.sum(layout.corners[triangle] * shares, axis=1))
    lamp = decoded.lighting.lamp(camera, 0)
    irradiance, angles = factors(positions, normals, camera.centre, lamp, 3)
    light, towards = direction_to(lamp, positions), camera.centre - positions
    towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    half = light + towards
    half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-9)
    cosines = (np.maximum(np.sum(normals * each, axis=1), 0) for each in (half, light, towards))
    cos_phi, cos_i, cos_r = cosines
    normal = min(factor * NORMAL_REFLECTANCE, 1.0)
    reflected = texels[:, 4] * (normal + (1 - normal) * (1 - np.sum(half * towards, axis=1)) ** 5)
    gloss = np.pi * reflected * ggx(cos_phi, cos_i, cos_r, texels[:, 3]) * cos_i * angles[:, 0]
    return (1 - reflected[:, None]) * texels[:, :3] * irradiance + gloss[:, None], covered


def direction_to(lamp: Lamp, positions: np.ndarray) -> np.ndarray:
    """(n, 3) unit vectors to a lamp; 0 for surroundings without a highlight."""
    vectors = lamp.vector - positions if lamp.form == POINT else np.broadcast_to(lamp.vector, positions.shape)
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9)
