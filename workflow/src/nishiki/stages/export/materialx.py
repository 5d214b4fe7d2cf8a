"""A surface as an OpenPBR material in a MaterialX document, for the meshes of `gltf` and `usd`."""

from nishiki.artifacts.stage import Context
from nishiki.formats.materialx import write_materialx
from nishiki.stages.export.surface import ExportedSurface


def write(context: Context, surface: ExportedSurface) -> dict:
    """`materialx/painting.mtlx` or `object.mtlx`, and textures; the error of the material against photographs."""
    path = context.output.path(f"exports/materialx/{surface.stem}.mtlx")
    files = write_materialx(path, surface.look_of("materialx"), facts=context.stamp)
    return {"files": [f"exports/materialx/{name}" for name in files], **surface.losses("materialx")}
