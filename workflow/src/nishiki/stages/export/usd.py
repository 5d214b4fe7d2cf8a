"""A painting as a package of OpenUSD: the mesh of its relief with the material UsdPreviewSurface."""

from nishiki.artifacts.stage import Context
from nishiki.formats.usd import write_usdz
from nishiki.stages.export.look import PaintingSurface


def write(context: Context, surface: PaintingSurface) -> dict:
    """`painting.usdz`; the error of its material against photographs."""
    look, mesh = surface.look, surface.mesh
    facts = {**context.stamp, "unit": surface.unit}
    path = context.output.path("exports/painting.usdz")
    write_usdz(path, mesh, look.surface(look.gloss.usd), name=context.stamp["scene"], facts=facts)
    return {
        "files": ["exports/painting.usdz"],
        "vertices": len(mesh.positions),
        "faces": len(mesh.triangles),
        **surface.losses("usd"),
    }
