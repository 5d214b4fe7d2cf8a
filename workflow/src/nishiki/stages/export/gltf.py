"""A painting as binary glTF: its plane displaced by the height, colour and normals as textures, gloss as a lobe."""

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.formats.glb import Glb
from nishiki.formats.picture_tiles import png_bytes
from nishiki.formats.textured_surface import TexturedMesh
from nishiki.stages.export.look import PaintingLook, errors, painting_look, painting_mesh, unit_of
from nishiki.stages.export.normals import software
from nishiki.stages.export.scene import ExportedScene


def write(context: Context, scene: ExportedScene) -> dict:
    """`painting.glb`; the error of its material against photographs."""
    look = painting_look(context, scene)
    mesh = write_glb(context, scene, look)
    return {
        "files": ["exports/painting.glb"],
        "vertices": len(mesh.positions),
        "faces": len(mesh.triangles),
        **look.figures(),
        "kinds": {"gltf": {"psnr_db": errors(context, scene, look, look.material)}},
    }


def write_glb(context: Context, scene: ExportedScene, look: PaintingLook) -> TexturedMesh:
    """The file; its mesh."""
    mesh, material = painting_mesh(context, scene), look.material
    glb = Glb(extensions={"KHR_materials_ior", "KHR_materials_specular"})
    tangents = np.broadcast_to(np.float32([1, 0, 0, 1]), (len(mesh.positions), 4))
    attributes = {
        "POSITION": glb.vertices(mesh.positions, bounds=True),
        "NORMAL": glb.vertices(mesh.normals),
        "TANGENT": glb.vertices(tangents),
        "TEXCOORD_0": glb.vertices(mesh.texture),
    }
    number = glb.add(
        "materials",
        pbrMetallicRoughness={
            "baseColorTexture": {"index": glb.texture(png_bytes(look.colours), mime="image/png")},
            "metallicFactor": 0,
            "roughnessFactor": material.roughness,
        },
        normalTexture={"index": glb.texture(png_bytes(look.normals), mime="image/png")},
        extensions={
            "KHR_materials_ior": {"ior": material.index},
            "KHR_materials_specular": {
                "specularFactor": material.weight,
                "specularColorFactor": [material.factor] * 3,
            },
        },
    )
    primitive = {"attributes": attributes, "indices": glb.corners(mesh.triangles), "material": number}
    glb.add("nodes", mesh=glb.add("meshes", primitives=[primitive]), name=context.stamp["scene"])
    extras = {**context.stamp, "unit": unit_of(scene)}
    glb.write(context.output.path("exports/painting.glb"), generator=software(context), extras=extras)
    return mesh
