"""A painting as binary glTF: its plane displaced by the height, colour and normals as textures, gloss as a lobe."""

from typing import Any

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.formats.glb import Glb
from nishiki.formats.picture_tiles import png_bytes
from nishiki.stages.export.look import PaintingSurface
from nishiki.stages.export.normals import software
from nishiki.stages.export.region_gloss import RegionGloss


def write(context: Context, surface: PaintingSurface) -> dict:
    """`painting.glb`; the error of its material against photographs."""
    write_glb(context, surface)
    return {
        "files": ["exports/painting.glb"],
        "vertices": len(surface.mesh.positions),
        "faces": len(surface.mesh.triangles),
        **surface.losses("gltf"),
    }


def write_glb(context: Context, surface: PaintingSurface) -> None:
    """The file."""
    mesh, look = surface.mesh, surface.look
    glb = Glb(extensions={"KHR_materials_ior", "KHR_materials_specular"})
    tangents = np.broadcast_to(np.float32([1, 0, 0, 1]), (len(mesh.positions), 4))
    attributes = {
        "POSITION": glb.vertices(mesh.positions, bounds=True),
        "NORMAL": glb.vertices(mesh.normals),
        "TANGENT": glb.vertices(tangents),
        "TEXCOORD_0": glb.vertices(mesh.texture),
    }
    colours = {"index": glb.texture(png_bytes(look.colours), mime="image/png")}
    normals = {"index": glb.texture(png_bytes(look.normals), mime="image/png")}
    roughness, specular = gloss_properties(glb, look.gloss.gltf)
    number = glb.add(
        "materials",
        pbrMetallicRoughness={"baseColorTexture": colours, "metallicFactor": 0, **roughness},
        normalTexture=normals,
        extensions={
            "KHR_materials_ior": {"ior": look.gloss.gltf.materials[0].index},
            "KHR_materials_specular": specular,
        },
    )
    primitive = {"attributes": attributes, "indices": glb.corners(mesh.triangles), "material": number}
    glb.add("nodes", mesh=glb.add("meshes", primitives=[primitive]), name=context.stamp["scene"])
    extras = {**context.stamp, "unit": surface.unit}
    glb.write(context.output.path("exports/painting.glb"), generator=software(context), extras=extras)


def gloss_properties(glb: Glb, gloss: RegionGloss) -> tuple[dict, dict]:
    """Properties of roughness and of KHR_materials_specular: textures where they differ from texel to texel."""
    material, roughness, weight = gloss.materials[0], gloss.roughness, gloss.weight
    rough: dict[str, Any] = {"roughnessFactor": roughness}
    specular: dict[str, Any] = {"specularFactor": float(material.weight)}
    if isinstance(roughness, np.ndarray):
        green = np.stack([np.zeros_like(roughness), roughness, np.zeros_like(roughness)], axis=-1)
        rough = {"metallicRoughnessTexture": {"index": glb.texture(png_bytes(green), mime="image/png")}}
    if weight is not None:
        alpha = np.stack([*[np.full_like(weight, 255)] * 3, weight], axis=-1)
        specular = {"specularTexture": {"index": glb.texture(png_bytes(alpha), mime="image/png")}}
    return rough, {**specular, "specularColorFactor": [float(material.factor)] * 3}
