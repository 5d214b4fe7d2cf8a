"""What a viewer shows of an exported object, against the photographs."""

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.brdf.texels.lighting import POINT, Lamp
from nishiki.brdf.texels.model import factors
from nishiki.brdf.trowbridge_reitz import isotropic_lobe
from nishiki.colour.encoding import decode, encode
from nishiki.evaluate.object_photographs import Photographs
from nishiki.geometry.raster import rasterise
from nishiki.render.display import three_channels
from nishiki.stages.export.photographs import CodedErrors
from nishiki.stages.object_export.look import ObjectLook
from nishiki.stages.object_export.texture_atlas import sample


def errors(context: Context, look: ObjectLook, *, white_at_grazing: bool) -> dict[str, dict[str, float]]:
    """PSNR of the stored textures against photographs, in the capture's encoding: left-out views and some others.

    white_at_grazing : whether the format reflects all grazing light, whatever the share of the reflectance.
    """
    decoded, settings, count = look.decoded, context.settings, len(look.decoded.views)
    left_out = decoded.numbers(settings.hold_out)
    seen = [view for view in range(count) if view not in left_out]
    spread = [seen[k * len(seen) // settings.views] for k in range(min(settings.views, len(seen)))]
    photographs = Photographs(context.inputs)
    base = decode(look.colour / 255, "srgb")
    alpha = (look.roughness / 255) ** 2
    weight = look.specular / 255
    stored = np.concatenate([base, alpha[..., None], weight[..., None]], axis=-1)
    result = {}
    for name, views in (("fitted", spread), ("check", sorted(left_out))):
        if not views:
            continue
        found = CodedErrors(len(views))
        for number, view in enumerate(views):
            linear, valid = photographs.read(view, 0)
            shown, covered = shaded(look, stored, view, white_at_grazing=white_at_grazing)
            compared = encode(three_channels(linear)[covered], decoded.encoding)
            found.add(number, encode(look.scale * shown, decoded.encoding), compared, valid[covered])
        result[name] = found.decibels()
    return result


def shaded(look: ObjectLook, stored: np.ndarray, view: int, *, white_at_grazing: bool) -> tuple[np.ndarray, np.ndarray]:
    """What a viewer shows of a captured view under its first light: (n, 3) of the covered pixels, and those."""
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
    texels = sample(stored, np.sum(layout.corners[triangle] * shares, axis=1))
    lamp = decoded.lighting.lamp(camera, 0)
    irradiance, angles = factors(positions, normals, camera.centre, lamp, 3)
    light, towards = direction_to(lamp, positions), camera.centre - positions
    towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    half = light + towards
    half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-9)
    cosines = (np.maximum(np.sum(normals * each, axis=1), 0) for each in (half, light, towards))
    cos_phi, cos_i, cos_r = cosines
    normal = texels[:, 4] * look.normal_reflectance
    grazing = 1.0 if white_at_grazing else texels[:, 4]
    reflected = normal + (grazing - normal) * (1 - np.sum(half * towards, axis=1)) ** 5
    gloss = np.pi * reflected * isotropic_lobe(cos_phi, cos_i, cos_r, texels[:, 3]) * cos_i * angles[:, 0]
    return (1 - reflected[:, None]) * texels[:, :3] * irradiance + gloss[:, None], covered


def direction_to(lamp: Lamp, positions: np.ndarray) -> np.ndarray:
    """(n, 3) unit vectors to a lamp; 0 for surroundings without a highlight."""
    vectors = lamp.vector - positions if lamp.form == POINT else np.broadcast_to(lamp.vector, positions.shape)
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9)
