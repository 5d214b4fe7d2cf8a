"""A painting as binary glTF: its plane displaced by the height, colour and normals as textures, gloss as a lobe."""

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.brdf.parameters import gloss_table
from nishiki.colour.colour import srgb_encode
from nishiki.colour.encoding import decode, encode
from nishiki.formats.glb import Glb
from nishiki.formats.picture_tiles import png_bytes
from nishiki.observations.plane import Observations
from nishiki.report.files import read_json
from nishiki.stages.export.gltf_material import GltfMaterial, fitted_material
from nishiki.stages.export.normals import software
from nishiki.stages.export.photographs import CodedErrors, Photographs
from nishiki.stages.export.relief_mesh import block_mean, reliefs
from nishiki.stages.export.scene import ExportedScene

METRES = 1e-3  # of a millimetre; of a pixel where the capture states no scale


def write(context: Context, scene: ExportedScene) -> dict:
    """`painting.glb`; the error of its material against photographs."""
    settings = context.settings.gltf
    albedo, normals, step = textures(scene, settings.texture_px)
    known = np.abs(normals).max(axis=-1) > 0
    mean = float(albedo[known].mean()) if known.any() else 0.5
    material = material_of(context, mean)
    colours = np.rint(255 * srgb_encode(material.base_colour(albedo))).astype(np.uint8)
    coded = np.rint((np.where(known[..., None], normals, [0, 0, 1]) + 1) / 2 * 255).astype(np.uint8)
    vertices, faces = write_glb(context, scene, material, colours, coded)
    return {
        "files": ["exports/painting.glb"],
        "vertices": vertices,
        "faces": faces,
        "pixels_a_texel": step * step,
        "material": {"roughness": material.roughness, "specular": material.strength, "ior": material.index},
        "kinds": {"gltf": {"psnr_db": errors(context, scene, material, colours, coded, step)}},
    }


def textures(scene: ExportedScene, most: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Linear sRGB albedo and unit normals (rows, columns, 3), at most `most` texels a side; pixels along a texel."""
    rows, columns = scene.shape
    step = -(-max(rows, columns) // most)
    high = max(1, scene.band_rows // step) * step
    albedo, normals = [], []
    for top in range(0, rows, high):
        band = slice(top, min(top + high, rows))
        known = scene.known(band)[..., None]
        share = np.maximum(block_mean(known, step), 1e-9)
        albedo.append((block_mean(scene.srgb(band), step) / share).astype(np.float32))
        mean = block_mean(scene.relief_normals(band), step)
        length = np.linalg.norm(mean, axis=-1, keepdims=True)
        normals.append((mean / np.where(length > 0, length, 1)).astype(np.float32))
    return np.concatenate(albedo), np.concatenate(normals), step


def material_of(context: Context, albedo: float) -> GltfMaterial:
    """One lobe for the whole painting: the largest region's, matte where the gloss is left out."""
    parameters = read_json(context.inputs.get("brdf"), "parameters.json")
    if parameters is None:
        return GltfMaterial(1.0, 0.0, 1.5)
    beta, gamma, index, _ = gloss_table(parameters)
    largest = int(np.argmax([region.get("samples", 0) for region in parameters["regions"]]))
    return fitted_material(beta[largest], gamma[largest], float(index[largest]), albedo)


def write_glb(
    context: Context, scene: ExportedScene, material: GltfMaterial, colours: np.ndarray, normals: np.ndarray
) -> tuple[int, int]:
    """The file: its vertices and faces. Vertex normals are those of the plane; the texture holds the relief's."""
    bands = list(reliefs(scene, context.settings.mesh_vertices, colours=None))
    places, uv, triangles = (
        np.concatenate([getattr(band, name) for band in bands]) for name in ("places", "texture", "triangles")
    )
    glb = Glb(extensions={"KHR_materials_ior", "KHR_materials_specular"})
    upright = np.broadcast_to(np.float32([0, 0, 1]), places.shape)
    tangents = np.broadcast_to(np.float32([1, 0, 0, 1]), (len(places), 4))
    attributes = {
        "POSITION": glb.vertices(places * METRES, bounds=True),
        "NORMAL": glb.vertices(upright),
        "TANGENT": glb.vertices(tangents),
        "TEXCOORD_0": glb.vertices(uv),
    }
    number = glb.add(
        "materials",
        pbrMetallicRoughness={
            "baseColorTexture": {"index": glb.texture(png_bytes(colours), mime="image/png")},
            "metallicFactor": 0,
            "roughnessFactor": material.roughness,
        },
        normalTexture={"index": glb.texture(png_bytes(normals), mime="image/png")},
        extensions={
            "KHR_materials_ior": {"ior": material.index},
            "KHR_materials_specular": {
                "specularFactor": material.weight,
                "specularColorFactor": [material.factor] * 3,
            },
        },
    )
    primitive = {"attributes": attributes, "indices": glb.corners(triangles), "material": number}
    glb.add("nodes", mesh=glb.add("meshes", primitives=[primitive]), name=context.stamp["scene"])
    extras = {**context.stamp, "unit": f"1 is 1000 {scene.unit}" if scene.pitch_mm is None else "metres"}
    glb.write(context.output.path("exports/painting.glb"), generator=software(context), extras=extras)
    return len(places), len(triangles)


def errors(
    context: Context,
    scene: ExportedScene,
    material: GltfMaterial,
    colours: np.ndarray,
    coded: np.ndarray,
    step: int,
) -> dict[str, dict[str, float]]:
    """PSNR of the stored material, seen from the front without cast shadows, under fitted and check lights."""
    frames = Observations(context.inputs["ingest"].folder)
    photographs = Photographs(frames, scene)
    hold_out = context.settings.hold_out
    groups = {"fitted": frames.fit_lights(hold_out), "check": frames.check_lights(hold_out)}
    result = {}
    for name, lights in groups.items():
        if not len(lights):
            continue
        found = CodedErrors(len(lights))
        for rows, values, valid in (strip for band in frames.bands() for strip in photographs.strips(band, lights)):
            down = np.arange(rows.start, rows.stop) // step
            across = np.arange(frames.shape[1]) // step
            base = decode(colours[down][:, across].reshape(-1, 3) / 255, "srgb")
            normals = coded[down][:, across].reshape(-1, 3) / 255 * 2 - 1
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            for number, light in enumerate(lights):
                shown = material.shown(base, normals, frames.directions[light])
                found.add(number, encode(shown, "srgb"), values[:, number], valid[:, number])
        result[name] = found.decibels()
    return result
