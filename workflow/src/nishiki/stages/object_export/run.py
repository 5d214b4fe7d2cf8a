"""Object_export: files of an object for other programs, and what each of them loses."""

from nishiki.artifacts.stage import Context
from nishiki.stages.export import materialx, usd
from nishiki.stages.object_export import gltf, iiif, kintsugi, mitsuba
from nishiki.stages.object_export.surface import ObjectSurface

WRITERS = {
    "gltf": gltf.write,
    "usd": usd.write,
    "materialx": materialx.write,
    "mitsuba": mitsuba.write,
    "iiif": iiif.write,
    "kintsugi": kintsugi.write,
}


def run(context: Context) -> dict:
    """Write every format that the settings name."""
    surface = ObjectSurface(context)
    losses = {
        name: WRITERS[name](context, surface) for name in context.progress.over(context.settings.formats, "format")
    }
    sizes = {file: context.output.path(file).stat().st_size for each in losses.values() for file in each["files"]}
    return {"losses": losses, "bytes": sizes}
