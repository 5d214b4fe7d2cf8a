"""An object as binary glTF."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.formats.glb import Glb
from nishiki.formats.picture_tiles import png_bytes
from nishiki.stages.export.normals import software
from nishiki.stages.object_export.look import INDEX
from nishiki.stages.object_export.surface import ObjectSurface

EXTENSIONS = ("KHR_materials_ior", "KHR_materials_specular")


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
    glb = Glb(extensions=set(EXTENSIONS))
    add_object(glb, context, surface, lambda _, picture: glb.texture(png_bytes(picture), mime="image/png"))
    extras = {**context.stamp, "unit": surface.unit}
    glb.write(context.output.path("exports/object.glb"), generator=software(context), extras=extras)


def add_object(
    glb: Glb,
    context: Context,
    surface: ObjectSurface,
    texture: Callable[[str, np.ndarray], int],
    *,
    extras: Mapping[str, Any] | None = None,
) -> None:
    """Mesh and material of the object; texture: number of a named picture; extras: of the material."""
    mesh, look = surface.mesh, surface.look
    attributes = {
        "POSITION": glb.vertices(mesh.positions, bounds=True),
        "NORMAL": glb.vertices(mesh.normals),
        "TEXCOORD_0": glb.vertices(mesh.texture),
    }
    nothing, full = np.zeros_like(look.roughness), np.full_like(look.roughness, 255)
    pictures = {
        "albedo": look.colour,
        "orm": np.stack([full, look.roughness, nothing], axis=-1),
        "strength": np.stack([full, full, full, look.specular], axis=-1),
    }
    colour, roughness, strength = ({"index": texture(*each)} for each in pictures.items())
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
        extras=extras,
    )
    primitive = {"attributes": attributes, "indices": glb.corners(mesh.triangles), "material": material}
    glb.add("nodes", mesh=glb.add("meshes", primitives=[primitive]), name=context.stamp["scene"])
