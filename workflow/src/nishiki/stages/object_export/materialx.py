"""The surface of an object as an OpenPBR material in a MaterialX document, for the meshes of `gltf` and `usd`."""

from nishiki.artifacts.stage import Context
from nishiki.formats.materialx import write_materialx
from nishiki.stages.object_export.surface import ObjectSurface


def write(context: Context, surface: ObjectSurface) -> dict:
    """`materialx/object.mtlx` and its textures; the error of the material against photographs."""
    path = context.output.path("exports/materialx/object.mtlx")
    files = write_materialx(path, surface.look.surface(), facts=context.stamp)
    return {"files": [f"exports/materialx/{name}" for name in files], **surface.losses("materialx")}
