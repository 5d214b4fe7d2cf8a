"""The surface of a painting as an OpenPBR material in a MaterialX document, for the meshes of `gltf` and `usd`."""

from nishiki.artifacts.stage import Context
from nishiki.formats.materialx import write_materialx
from nishiki.stages.export.gltf_material import white_at_grazing
from nishiki.stages.export.look import errors, painting_look
from nishiki.stages.export.scene import ExportedScene


def write(context: Context, scene: ExportedScene) -> dict:
    """`materialx/painting.mtlx` and its textures; the error of the material against photographs."""
    look = painting_look(context, scene)
    path = context.output.path("exports/materialx/painting.mtlx")
    files = write_materialx(path, look.surface(), facts=context.stamp)
    return {
        "files": [f"exports/materialx/{name}" for name in files],
        **look.figures(),
        "kinds": {"materialx": {"psnr_db": errors(context, scene, look, white_at_grazing(look.material))}},
    }
