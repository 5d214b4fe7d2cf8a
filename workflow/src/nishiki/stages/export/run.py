"""Export: files of a painting for other programs, and what each of them loses."""

from nishiki.artifacts.stage import Context
from nishiki.stages.export import albedo, gltf, height, iiif, materialx, merl, mitsuba, normals, relight, spectral, usd
from nishiki.stages.export.look import PaintingSurface
from nishiki.stages.export.scene import ExportedScene

WRITERS = {
    "normals": normals.write,
    "height": height.write,
    "albedo": albedo.write,
    "relight": relight.write,
    "spectral": spectral.write,
    "merl": merl.write,
    "iiif": iiif.write,
    "mitsuba": mitsuba.write,
}
SURFACE_WRITERS = {
    "gltf": gltf.write,
    "usd": usd.write,
    "materialx": materialx.write,
}
"""Of formats that have textures and material in common."""


def run(context: Context) -> dict:
    """Write every format that the settings name, each band by band but those of surfaces."""
    scene = ExportedScene(context.inputs)
    surface = PaintingSurface(context, scene)
    losses = {}
    for name in context.progress.over(context.settings.formats, "format"):
        if name in SURFACE_WRITERS:
            losses[name] = SURFACE_WRITERS[name](context, surface)
        else:
            losses[name] = WRITERS[name](context, scene)
    sizes = {
        file: context.output.path(file).stat().st_size for each in losses.values() for file in each.get("files", ())
    }
    return {"losses": losses, "bytes": sizes}
