"""The surface of an object as an OpenPBR material in a MaterialX document, for the meshes of `gltf` and `usd`."""

from nishiki.artifacts.stage import Context
from nishiki.formats.materialx import write_materialx
from nishiki.stages.object_export.errors import errors
from nishiki.stages.object_export.look import object_look


def write(context: Context) -> dict:
    """`materialx/object.mtlx` and its textures; the error of the material against photographs."""
    look = object_look(context)
    path = context.output.path("exports/materialx/object.mtlx")
    files = write_materialx(path, look.surface(), facts=context.stamp)
    return {
        "files": [f"exports/materialx/{name}" for name in files],
        **look.figures(),
        "kinds": {"materialx": {"psnr_db": errors(context, look, white_at_grazing=True)}},
    }
