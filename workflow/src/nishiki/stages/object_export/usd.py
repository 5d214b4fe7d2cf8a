"""An object as a package of OpenUSD: its mesh with the material UsdPreviewSurface, whose gloss has one strength."""

from nishiki.artifacts.stage import Context
from nishiki.formats.usd import write_usdz
from nishiki.stages.object_export.surface import ObjectSurface


def write(context: Context, surface: ObjectSurface) -> dict:
    """`object.usdz`; its error against photographs."""
    facts = {**context.stamp, "unit": surface.unit}
    path, look = context.output.path("exports/object.usdz"), surface.look.of_one_strength().surface()
    write_usdz(path, surface.mesh, look, name=context.stamp["scene"], facts=facts)
    return {
        "files": ["exports/object.usdz"],
        "vertices": len(surface.mesh.positions),
        **surface.losses("usd"),
    }
