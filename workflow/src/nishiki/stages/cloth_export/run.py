"""Cloth_export: files of a draped cloth for other programs, and what each of them loses."""

from nishiki.artifacts.stage import Context
from nishiki.stages.cloth_export import bsdf, gltf, mitsuba
from nishiki.stages.cloth_export.scene import ExportedCloth

WRITERS = {"gltf": gltf.write, "mitsuba": mitsuba.write, "bsdf": bsdf.write}


def run(context: Context) -> dict:
    """Write every format that the settings name."""
    cloth = ExportedCloth.of(context.inputs)
    losses = {name: WRITERS[name](context, cloth) for name in context.progress.over(context.settings.formats, "format")}
    sizes = {file: context.output.path(file).stat().st_size for each in losses.values() for file in each["files"]}
    about = {"region": cloth.region, "model": cloth.model, "surface": cloth.draped.about}
    return {**about, "losses": losses, "bytes": sizes}
