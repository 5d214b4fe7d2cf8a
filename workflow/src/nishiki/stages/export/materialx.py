"""The surface of a painting as an OpenPBR material in a MaterialX document, for the meshes of `gltf` and `usd`."""

from nishiki.artifacts.stage import Context
from nishiki.formats.materialx import write_materialx
from nishiki.stages.export.look import PaintingSurface


def write(context: Context, surface: PaintingSurface) -> dict:
    """`materialx/painting.mtlx` and its textures; the error of the material against photographs."""
    look = surface.look
    path = context.output.path("exports/materialx/painting.mtlx")
    files = write_materialx(path, look.surface(look.gloss.materialx), facts=context.stamp)
    return {"files": [f"exports/materialx/{name}" for name in files], **surface.losses("materialx")}
