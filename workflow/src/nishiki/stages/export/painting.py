"""Export: files of a painting for other programs, and what each of them loses."""

from functools import partial

from nishiki.artifacts.stage import Context
from nishiki.stages.export import maps, relight, renderers
from nishiki.stages.export.iiif import write_iiif
from nishiki.stages.export.look import PaintingSurface
from nishiki.stages.export.registry import write_formats, write_gltf, write_mtlx, write_usd
from nishiki.stages.export.scene import ExportedScene

OF_MAPS = {
    "normals": maps.write_normals,
    "height": maps.write_height,
    "albedo": maps.write_albedo,
    "relight": relight.write,
    "spectral": maps.write_spectral,
    "merl": renderers.write_merl,
    "iiif": write_iiif,
    "mitsuba": renderers.write_mitsuba,
}
OF_A_SURFACE = {"gltf": write_gltf, "usd": write_usd, "materialx": write_mtlx}
"""Formats that have textures and material in common; the others are written band by band."""


def run(context: Context) -> dict:
    """Write every format that the settings name."""
    scene = ExportedScene(context.inputs)
    surface = PaintingSurface(context, scene)
    maps_of = {name: partial(write, context, scene) for name, write in OF_MAPS.items()}
    return write_formats(
        context, maps_of | {name: partial(write, context, surface) for name, write in OF_A_SURFACE.items()}
    )
