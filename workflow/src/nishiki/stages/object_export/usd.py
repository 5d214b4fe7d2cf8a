"""An object as a package of OpenUSD: its mesh with the material UsdPreviewSurface, whose gloss has one strength."""

from dataclasses import replace

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.formats.usd import write_usdz
from nishiki.stages.object_export.errors import errors
from nishiki.stages.object_export.look import object_look, object_mesh, unit_of


def write(context: Context) -> dict:
    """`object.usdz`; its error against photographs."""
    look = object_look(context)
    look = replace(look, specular=np.full_like(look.specular, np.rint(look.specular.mean())))
    mesh = object_mesh(context, look)
    facts = {**context.stamp, "unit": unit_of(context)}
    path = context.output.path("exports/object.usdz")
    write_usdz(path, mesh, look.surface(), name=context.stamp["scene"], facts=facts)
    return {
        "files": ["exports/object.usdz"],
        "vertices": len(mesh.positions),
        **look.figures(),
        "kinds": {"usd": {"psnr_db": errors(context, look, white_at_grazing=True)}},
    }
