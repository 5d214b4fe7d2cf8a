"""An object as binary glTF."""

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.formats.glb import Glb
from nishiki.formats.picture_tiles import png_bytes
from nishiki.stages.export.normals import software
from nishiki.stages.object_export.look import INDEX
from nishiki.stages.object_export.surface import ObjectSurface


def write(context: Context, surface: ObjectSurface) -> dict:
    """`object.glb`; its error against photographs."""
    write_glb(context, surface)
    return {
        "files": ["exports/object.glb"],
        "vertices": len(surface.mesh.positions),
        **surface.losses("gltf"),
    }


def write_glb(context: Context, surface: ObjectSurface) -> None:
    """The file."""
    mesh, look = surface.mesh, surface.look
    glb = Glb(extensions={"KHR_materials_ior", "KHR_materials_specular"})
    attributes = {
        "POSITION": glb.vertices(mesh.positions, bounds=True),
        "NORMAL": glb.vertices(mesh.normals),
        "TEXCOORD_0": glb.vertices(mesh.texture),
    }
    nothing = np.zeros_like(look.roughness)
    white = np.full_like(look.colour, 255)
    colour, roughness, strength = (
        {"index": glb.texture(png_bytes(picture), mime="image/png")}
        for picture in (
            look.colour,
            np.stack([nothing, look.roughness, nothing], axis=-1),
            np.concatenate([white, look.specular[..., None]], axis=-1),
        )
    )
    material = glb.add(
        "materials",
        pbrMetallicRoughness={
            "baseColorTexture": colour,
            "metallicRoughnessTexture": roughness,
            "metallicFactor": 0,
        },
        extensions={
            "KHR_materials_ior": {"ior": INDEX},
            "KHR_materials_specular": {"specularTexture": strength, "specularColorFactor": [look.factor] * 3},
        },
    )
    primitive = {"attributes": attributes, "indices": glb.corners(mesh.triangles), "material": material}
    glb.add("nodes", mesh=glb.add("meshes", primitives=[primitive]), name=context.stamp["scene"])
    extras = {**context.stamp, "unit": surface.unit}
    glb.write(context.output.path("exports/object.glb"), generator=software(context), extras=extras)
