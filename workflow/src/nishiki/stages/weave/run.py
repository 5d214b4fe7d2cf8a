"""Weave: cross-sections of a cloth from its reflectances in the planes of warp and weft, its surface as a mesh."""

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.brdf.cloth.store import save_brdf
from nishiki.brdf.cloth.yarn_fit import Measured
from nishiki.geometry.mesh import Mesh, write_ply
from nishiki.goniometry.table import Reflectances
from nishiki.render.display import write_png
from nishiki.report.svg import GRID, PALETTE, SOFT, Drawing, outline
from nishiki.weave.fit import WeaveFit, fit_weave, planes_of
from nishiki.weave.section import WovenSurface, shade
from nishiki.weave.store import describe, describe_yarns, write_weave, yarns_file
from nishiki.weave.yarn_search import search_yarns
from nishiki.weave.yarn_weave import bindings


def run(context: Context) -> dict:
    """Fit each region; write its model, drawings, surface and picture."""
    settings = context.settings
    reflectances = Reflectances(context.inputs["goniometer_samples"].folder)
    regions, diagnostics = {}, {}
    for number, name in enumerate(reflectances.regions):
        context.progress.tell(f"region {name}")
        planes = planes_of(reflectances, region=number, relative_error=settings.relative_error)
        contact = None if settings.contact_deg is None else float(np.radians(settings.contact_deg))
        candidates = bindings(reflectances.weave, harness=settings.harness)
        candidates = candidates or bindings("unknown", harness=settings.harness)  # a satin of 6 does not exist
        ratio = settings.spacing_ratio or reflectances.spacing_ratio
        search = search_yarns(Measured.of(reflectances, number), candidates, spacing_ratio=ratio)
        weave, harness = search.best.binding.weave, search.best.binding.harness
        fit = fit_weave(
            *planes,
            harness=harness,
            reading=settings.reading,
            contact=contact,
            index=settings.refractive_index,
            confidence=settings.confidence,
        )
        yarns = describe_yarns(search, confidence=settings.confidence)
        regions[name] = describe(fit, planes, weave=weave, harness=harness, yarns=yarns)
        save_brdf(context.output.path(yarns_file(name)), search.best.brdf)
        suffix = f"_{name}" if len(reflectances.regions) > 1 else ""
        slopes = {name: entry["value"] for name, entry in yarns["parameters"].items()}
        picture(context, fit, suffix, search.best.weave.surface(), slopes)
        diagnostics[name] = report(fit, weave, harness, [plane.measured for plane in planes]) | {"yarns": yarns}
    write_weave(context.output.folder, regions)
    return {"regions": diagnostics}


def picture(context: Context, fit: WeaveFit, suffix: str, surface: WovenSurface, slopes: dict[str, float]) -> None:
    """Write drawings of both kinds of sections, the mesh and its picture; slopes: of the yarns, degrees."""
    for name, section in (("weft", fit.model.weft), ("warp", fit.model.warp)):
        points, _ = section.profile(800)
        note = (
            f"steepest flank {np.degrees(section.theta_a):.0f}°, height {section.height / section.period:.3f} of the "
        )
        steep = f"slopes seen from above: mean {slopes[f'mean_slope_{name}']:.0f}°, "
        steep += f"a tenth above {slopes[f'p90_slope_{name}']:.0f}°"
        drawings = {"published": (points, section.period, note + "period"), "section": (*cut(surface, name), steep)}
        for kind, drawn in drawings.items():
            drawing = draw_section(*drawn, title=f"section along the {name}")
            context.output.path(f"{kind}_{name}{suffix}.svg").write_text(drawing + "\n", encoding="utf-8")
    mesh = Mesh.of(*surface.mesh())
    write_ply(context.output.path(f"weave{suffix}.ply"), mesh, stamp=context.stamp, unit="spacing of the warp yarns")
    write_png(context.output.path(f"weave{suffix}.png"), shade(surface), stamp=context.stamp)


def report(fit: WeaveFit, weave: str, harness: int, measured: list[bool]) -> dict:
    """Return the data of the manifest."""
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


def cut(surface: WovenSurface, plane: str) -> tuple[np.ndarray, float]:
    """Return points (n, 2) of the surface along the middle of its first yarn of that system, and the period."""
    height, along = (surface.height, surface.x) if plane == "weft" else (surface.height.T, surface.y)
    middle = (len(height) - 1) // (2 * surface.pattern.shape[plane == "warp"])
    return np.column_stack([along, height[middle]]), float(along[-1])


def draw_section(
    points: np.ndarray, period: float, note: str, *, title: str, repeats: int = 2, width: int = 640
) -> str:
    """Draw SVG text: `repeats` periods of a section (n, 2), equal scales of both axes; the surface's body is filled."""
    train = np.concatenate([np.add(points, (k * period, 0.0)) for k in range(repeats)])
    low, high = np.nanmin(train[:, 1]), np.nanmax(train[:, 1])
    scale = (width - 20) / (repeats * period)
    height = (high - low) * scale + 46
    base = height - 26
    line = outline(10 + train[:, 0] * scale, base - (train[:, 1] - low) * scale)
    drawing = Drawing(width, height, title, alone=True)
    left, right = 10 + train[0, 0] * scale, 10 + train[-1, 0] * scale
    drawing.path(f"{line}L{right:.1f} {base + 12:.1f}L{left:.1f} {base + 12:.1f}Z", fill=GRID)
    drawing.path(line, stroke=PALETTE[0], width=1.8)
    drawing.text(10, height - 8, title)
    drawing.text(width - 10, height - 8, note, anchor="end", size=11, colour=SOFT)
    return drawing.finish()
