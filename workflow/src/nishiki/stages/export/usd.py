"""A surface as a package of OpenUSD: its mesh with the material UsdPreviewSurface."""

from nishiki.artifacts.stage import Context
from nishiki.formats.usd import write_usdz
from nishiki.stages.export.surface import ExportedSurface


def write(context: Context, surface: ExportedSurface) -> dict:
    """`painting.usdz` or `object.usdz`; the error of its material against photographs."""
    mesh, file = surface.mesh, f"exports/{surface.stem}.usdz"
    facts = {**context.stamp, "unit": surface.unit}
    write_usdz(context.output.path(file), mesh, surface.look_of("usd"), name=context.stamp["scene"], facts=facts)
    return {"files": [file], "vertices": len(mesh.positions), "faces": len(mesh.triangles), **surface.losses("usd")}
