"""Export: files of a painting for other programs, and what each of them loses."""

from nishiki.artifacts.stage import Context
from nishiki.stages.export import albedo, gltf, height, iiif, materialx, merl, mitsuba, normals, relight, spectral, usd
from nishiki.stages.export.scene import ExportedScene

WRITERS = {
    "normals": normals.write,
    "height": height.write,
    "albedo": albedo.write,
    "relight": relight.write,
    "spectral": spectral.write,
    "gltf": gltf.write,
    "mitsuba": mitsuba.write,
    "merl": merl.write,
    "iiif": iiif.write,
    "usd": usd.write,
    "materialx": materialx.write,
}


def run(context: Context) -> dict:
    """Write every format that the settings name, each band by band."""
    scene = ExportedScene(context.inputs)
    losses = {name: WRITERS[name](context, scene) for name in context.progress.over(context.settings.formats, "format")}
    sizes = {
        file: context.output.path(file).stat().st_size for each in losses.values() for file in each.get("files", ())
    }
    return {"losses": losses, "bytes": sizes}
