"""Weave: cross-sections of a cloth from its reflectances in the planes of warp and weft, its surface as a mesh."""

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.geometry.mesh import Mesh
from nishiki.geometry.mesh_files import write_ply
from nishiki.goniometry.store import Reflectances
from nishiki.render.output import write_png
from nishiki.stages.weave.drawing import draw_section
from nishiki.weave.fit import WeaveFit, fit_weave
from nishiki.weave.planes import planes_of
from nishiki.weave.store import describe, write_weave
from nishiki.weave.surface import USUAL, harness_of, make_surface, shade


def run(context: Context) -> dict:
    """Fit each region; write its model, drawings, surface and picture."""
    settings = context.settings
    reflectances = Reflectances(context.inputs["goniometer_samples"].folder)
    regions, diagnostics = {}, {}
    for number, name in enumerate(reflectances.regions):
        context.progress.tell(f"region {name}")
        planes = planes_of(
            reflectances, region=number, relative_error=settings.relative_error, oblique=settings.oblique
        )
        contact = None if settings.contact_deg is None else float(np.radians(settings.contact_deg))
        fit = fit_weave(
            *planes,
            harness=USUAL[reflectances.weave] if settings.harness is None else settings.harness,
            reading=settings.reading,
            lobe=settings.lobe,
            contact=contact,
            index=settings.refractive_index,
            confidence=settings.confidence,
        )
        weave, harness = harness_of(fit.model.weft, reflectances.weave)
        harness = settings.harness if settings.harness is not None else harness
        regions[name] = describe(fit, planes, weave=weave, harness=harness)
        picture(context, fit, f"_{name}" if len(reflectances.regions) > 1 else "", weave, harness)
        diagnostics[name] = report(fit, weave, harness, [plane.measured for plane in planes])
    write_weave(context.output.folder, regions)
    return {"regions": diagnostics}


def picture(context: Context, fit: WeaveFit, suffix: str, weave: str, harness: int) -> None:
    """Drawings of both sections, the mesh and its picture."""
    model = fit.model
    for name, section in (("weft", model.weft), ("warp", model.warp)):
        drawing = draw_section(section, title=f"section along the {name}")
        context.output.path(f"section_{name}{suffix}.svg").write_text(drawing + "\n", encoding="utf-8")
    ratio = context.settings.spacing_ratio
    surface = make_surface(model.weft, model.warp, weave=weave, harness=harness, spacing_ratio=ratio)
    mesh = Mesh.of(*surface.mesh())
    write_ply(context.output.path(f"weave{suffix}.ply"), mesh, stamp=context.stamp, unit="spacing of the warp yarns")
    write_png(context.output.path(f"weave{suffix}.png"), shade(surface), stamp=context.stamp)


def report(fit: WeaveFit, weave: str, harness: int, measured: list[bool]) -> dict:
    """What stands in the manifest."""
    return {
        "weave": weave,
        "harness": harness,
        "parameters": {name: float(f"{value:.6g}") for name, value in fit.model.parameters().items()},
        "intervals": {name: [float(f"{end:.6g}") for end in ends] for name, ends in fit.intervals.items()},
        "rms_rel": fit.rms_rel,
        "free": fit.identifiability.free,
        "weak": fit.identifiability.weak,
        "weak_error": fit.identifiability.weak_error,
        "at_bounds": fit.at_bounds,
        "measured": all(measured),
    }
