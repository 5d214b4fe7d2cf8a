"""A painting as a package of OpenUSD: the mesh of its relief with the material UsdPreviewSurface."""

from nishiki.artifacts.stage import Context
from nishiki.formats.usd import write_usdz
from nishiki.stages.export.gltf_material import white_at_grazing
from nishiki.stages.export.look import errors, painting_look, painting_mesh, unit_of
from nishiki.stages.export.scene import ExportedScene


def write(context: Context, scene: ExportedScene) -> dict:
    """`painting.usdz`; the error of its material against photographs."""
    look, mesh = painting_look(context, scene), painting_mesh(context, scene)
    facts = {**context.stamp, "unit": unit_of(scene)}
    path = context.output.path("exports/painting.usdz")
    write_usdz(path, mesh, look.surface(), name=context.stamp["scene"], facts=facts)
    return {
        "files": ["exports/painting.usdz"],
        "vertices": len(mesh.positions),
        "faces": len(mesh.triangles),
        **look.figures(),
        "kinds": {"usd": {"psnr_db": errors(context, scene, look, white_at_grazing(look.material))}},
    }
