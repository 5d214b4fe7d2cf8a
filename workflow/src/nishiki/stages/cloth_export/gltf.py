"""A draped cloth as binary glTF: the mesh with tangents along the weft, and one material fitted to the model."""

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.formats.glb import Glb
from nishiki.formats.picture_tiles import png_bytes
from nishiki.stages.cloth_export.against_model import errors
from nishiki.stages.cloth_export.gltf_cloth import GltfCloth, coded_error, fitted_cloth
from nishiki.stages.cloth_export.scene import ExportedCloth

ALONG_TANGENT = np.uint8([[[255, 128, 255]]])
"""The texel of KHR_materials_anisotropy that says: along the tangent, with the whole strength."""


def write(context: Context, cloth: ExportedCloth) -> dict:
    """`cloth.glb`; how far its material is from the model."""
    material = fitted_cloth(cloth.brdf)
    write_glb(context, cloth, material)
    return {
        "files": ["exports/cloth.glb"],
        "vertices": len(cloth.draped.surface.mesh.vertices),
        "faces": len(cloth.draped.surface.mesh.triangles),
        "material": material.as_dict(),
        "fit_rms": coded_error(material, cloth.brdf),
        "against_model": errors(cloth, material),
    }


def write_glb(context: Context, cloth: ExportedCloth, material: GltfCloth) -> None:
    """The file. Its tangents run along the weft, their bitangents along the warp."""
    surface, uv = cloth.draped.surface, cloth.draped.uv
    mesh = surface.mesh
    normals = mesh.normals / np.linalg.norm(mesh.normals, axis=1, keepdims=True)
    properties = material.material()
    glb = Glb(extensions=set(properties["extensions"]))
    attributes = {
        "POSITION": glb.vertices(mesh.vertices, bounds=True),
        "NORMAL": glb.vertices(normals),
        "TANGENT": glb.vertices(np.column_stack([surface.weft, np.ones(len(surface.weft))])),
    }
    if uv is not None:
        attributes["TEXCOORD_0"] = glb.vertices(np.column_stack([uv[:, 0], 1 - uv[:, 1]]))  # from the top
        # What the extension assumes without a texture. Blender takes tangents from the mesh only where there is one.
        along = {"index": glb.texture(png_bytes(ALONG_TANGENT), mime="image/png")}
        properties["extensions"]["KHR_materials_anisotropy"]["anisotropyTexture"] = along
    number = glb.add("materials", name=f"{cloth.region} {cloth.model}", **properties)
    primitive = {"attributes": attributes, "indices": glb.corners(mesh.triangles), "material": number}
    glb.add("nodes", mesh=glb.add("meshes", primitives=[primitive]), name=context.stamp["scene"])
    unit = "metres" if cloth.shown.mesh is None else "of the file, taken as metres"
    extras = {**context.stamp, "unit": unit, "region": cloth.region, "model": cloth.model}
    glb.write(context.output.path("exports/cloth.glb"), generator=f"Nishiki {context.stamp['version']}", extras=extras)
