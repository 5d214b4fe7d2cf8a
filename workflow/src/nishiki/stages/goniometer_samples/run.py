"""Reflectance: goniometer photographs to reflectances of the cloth, completed at normal incidence."""

from dataclasses import replace

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.errors import UserError
from nishiki.goniometry import hemisphere
from nishiki.goniometry.directions import departure, disc, images, unit
from nishiki.goniometry.readings import Averaged, Readings, Regions, average_repeats, read_all
from nishiki.goniometry.table import ReflectanceSet, write_reflectances
from nishiki.observations.goniometer_store import Measurements
from nishiki.report.svg import GRID, INK, PALETTE, SOFT, Drawing
from nishiki.stages.goniometer_samples import OUTPUTS


def run(context: Context) -> dict:
    """Read every photograph's window, divide by the board, average repeats, complete the hemisphere."""
    settings = context.settings
    source = Measurements(context.inputs["ingest"].folder)
    if source.kind == "table":
        incident, outgoing, values = source.table
        angles_deg, values = np.concatenate([incident, outgoing], axis=1), values[:, None, :]
        valid = np.all(values > 0, axis=2)
        values = np.where(valid[..., None], values, 0.0)
        names, readings = ("cloth",), None
        averaged = average_repeats(angles_deg, values, np.zeros_like(values), valid, np.ones(len(values)))
    else:
        angles_deg = np.array([shot.angles_deg for shot in source.samples])
        names, averaged, readings = from_photographs(source, context)
    theta_i, phi_i, theta_r, phi_r = np.radians(angles_deg[averaged.rows].T)
    measured = ReflectanceSet(
        unit(theta_i, phi_i),
        unit(theta_r, phi_r),
        averaged.values,
        averaged.noise,
        averaged.valid,
        regions=names,
        channels=source.channels,
        symmetry=source.symmetry if settings.symmetry == "auto" else settings.symmetry,
        weave=source.weave,
        threads_per_cm=source.threads_per_cm,
        normal_deg=settings.normal_deg,
    )
    made, symmetry_errors = None, None
    if measured.symmetry == "unknown":
        symmetry_errors = hemisphere.choose_symmetry(measured)
        measured = replace(measured, symmetry=next(iter(symmetry_errors), "quarter"))
        if len(symmetry_errors) < 2:
            context.progress.tell("two mirror planes are assumed: the views are too few to compare symmetries")
    if settings.interpolation != "none":
        measured, made = hemisphere.complete(measured, grid_deg=settings.grid_deg)
    covered = hemisphere.coverage(measured)
    context.output.path("coverage.svg").write_text(coverage_plot(measured, covered))
    report = {"stamp": context.stamp, "coverage": [light.as_dict() for light in covered]}
    write_reflectances(context.output.folder, OUTPUTS, measured, more=report)
    return diagnostics(measured, averaged, readings, made, covered) | {"symmetry_errors": symmetry_errors}


def from_photographs(source: Measurements, context: Context) -> tuple[tuple[str, ...], Averaged, Readings]:
    """Read names of the regions, and the readings of all photographs."""
    settings, attributes = context.settings, source.attributes
    if source.regions is None and settings.window_px > max(attributes["shape"]):
        raise UserError(
            f"window_px: {settings.window_px}, expected at most {max(attributes['shape'])}, the window that ingest "
            "kept. Remedy: a smaller window_px, or a greater goniometer.crop_px in a new capture."
        )
    regions, names = None, ("cloth",)
    if source.regions is not None:
        numbers = tuple(int(n) for n in np.unique(source.regions) if n)
        names = tuple(attributes["region_names"].get(str(n), f"region {n}") for n in numbers)
        pitches = attributes["pixel_pitch_mm"], attributes["regions_pitch_mm"]
        scale = pitches[0] / pitches[1] if all(pitches) else 1.0
        regions = Regions(source.regions, numbers, attributes["upright"], scale)
    sample_deg = np.array([shot.angles_deg for shot in source.samples])
    white_deg = np.array([[np.nan if a is None else a for a in shot.angles_deg] for shot in source.whites])
    reading = read_all(
        lambda i: source.read(source.samples[i]),
        lambda i: source.read(source.whites[i]),
        (sample_deg, white_deg),
        white_reflectance=source.white_reflectance,
        window_px=settings.window_px,
        regions=regions,
        tick=lambda i: context.progress(i + 1, len(source.samples), source.samples[i].file),
    )
    if not reading.valid.any(axis=0).all():
        empty = names[int(np.flatnonzero(~reading.valid.any(axis=0))[0])]
        raise UserError(
            f"region '{empty}': no photograph can be used ({int(reading.pixels.sum())} pixels in view in all). Remedy: "
            "check the label picture, goniometer.upright, the dark frames and the exposure."
        )
    exposures = np.array([shot.exposure_s or 1.0 for shot in source.samples])
    return names, average_repeats(sample_deg, reading.values, reading.noise, reading.valid, exposures), reading


def diagnostics(
    measured: ReflectanceSet,
    averaged: Averaged,
    readings: Readings | None,
    made: hemisphere.Interpolation | None,
    covered: tuple[hemisphere.IncidenceCoverage, ...],
) -> dict:
    """Return plain values for the manifest."""
    values = measured.values[measured.valid]
    noise = measured.noise[measured.valid]
    sets = [
        (measured.incident[ok], measured.outgoing[ok], measured.values[ok, r]) for r, ok in enumerate(measured.valid.T)
    ]
    departures = [departure(*each, measured.symmetry) for each in sets]
    exchanged = [hemisphere.reciprocity(*each, measured.symmetry) for each in sets]
    known = noise > 0
    report = {
        "directions": len(measured),
        "repeated": int((averaged.repeats > 1).sum()),
        "normal_incidence": int(measured.normal_incidence.sum()),
        "incidences": len(covered),
        "regions": list(measured.regions),
        "channels": list(measured.channels),
        "symmetry": measured.symmetry,
        "weave": measured.weave,
        "symmetry_departure": [size for size, _ in departures],
        "symmetry_images": [count for _, count in departures],
        "reciprocity": [apart if pairs >= hemisphere.FEWEST_PAIRS else None for apart, pairs in exchanged],
        "reciprocal_pairs": [pairs for _, pairs in exchanged],
        "albedo": [hemisphere.typical_albedo(*each, measured.symmetry) for each in sets],
        "unusable": (~measured.valid).sum(axis=0).tolist(),
        "least": float(values.min()) if values.size else None,
        "greatest": float(values.max()) if values.size else None,
        "noise_relative": float(np.median(noise[known] / values[known])) if known.any() else None,
        "boards": readings.rules if readings else None,
        "pixels": int(np.median(readings.pixels[readings.valid])) if readings else None,
        "saturated": int((readings.saturated > 0).any(axis=1).sum()) if readings else 0,
    }
    if made:
        report |= {
            "left_out_error": list(made.left_out),
            "smoothing": list(made.smoothing),
            "basic_measured": made.measured,
            "basic_extrapolated": made.extrapolated,
            "albedo_normal": hemisphere.directional_albedo(made.basic).tolist(),
        }
    return report


MOST_DISCS = 24
"""Maximum number of discs in the drawing; of more directions of light an even selection is drawn."""
SIZE, RADIUS, ACROSS = 170, 66, 4


def coverage_plot(measured: ReflectanceSet, lights: tuple[hemisphere.IncidenceCoverage, ...]) -> str:
    """Draw SVG text: a disc a direction of light; normal in the middle, horizon at the rim, weft to the right, warp up.

    Filled dots: measured; open: their mirror images, where the light allows; crosses: measured but not usable; the
    diamond is the light.
    """
    count = min(MOST_DISCS, len(lights))
    chosen = [lights[i] for i in np.unique(np.linspace(0, len(lights) - 1, count).round().astype(int))]
    width, height = ACROSS * SIZE, -(-len(chosen) // ACROSS) * SIZE + 24
    drawing = Drawing(width, height, "views measured for each direction of light", alone=True)
    for i, light in enumerate(chosen):
        _disc(drawing, measured, light, (i % ACROSS + 0.5) * SIZE, (i // ACROSS + 0.5) * SIZE)
    left_out = f"; {len(lights) - len(chosen)} directions of light not shown" if len(chosen) < len(lights) else ""
    note = f"filled: measured, open: by symmetry, cross: not usable, diamond: light; circles at 30, 60, 90°{left_out}"
    drawing.text(6, height - 8, note, size=10, colour=SOFT)
    return drawing.finish()


def _disc(drawing: Drawing, measured: ReflectanceSet, light: hemisphere.IncidenceCoverage, x: float, y: float) -> None:
    def places(directions: np.ndarray) -> list[tuple[float, float]]:
        flat = disc(directions) * RADIUS
        return list(zip((x + flat[:, 0]).tolist(), (y - flat[:, 1]).tolist(), strict=True))

    for part in (1, 2, 3):
        drawing.circle(x, y, RADIUS * part / 3, stroke=GRID)
    lit = unit(*np.radians([light.theta_deg, light.phi_deg]))
    usable = measured.valid[light.rows].all(axis=1)
    views = measured.outgoing[light.rows]
    for image in [m for m in images(measured.symmetry) if np.allclose(m @ lit, lit, atol=1e-6)][1:]:
        for a, b in places(views[usable] @ image.T):
            drawing.circle(a, b, 1.4, stroke=PALETTE[0], width=0.3)
    for a, b in places(views[usable]):
        drawing.circle(a, b, 1.6, fill=PALETTE[0])
    for a, b in places(views[~usable]):
        drawing.path(f"M{a - 2:.1f} {b - 2:.1f}l4 4m0 -4l-4 4", stroke=PALETTE[1])
    ((a, b),) = places(lit[None])
    drawing.diamond(a, b, 5, stroke=INK, width=1.2)
    title = f"light {light.theta_deg:g}°, {light.phi_deg:g}°: {light.views} views"
    drawing.text(x, y + RADIUS + 13, title, anchor="middle", size=10)
