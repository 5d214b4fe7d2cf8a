"""Reflectance: goniometer photographs to reflectances of the cloth, completed at normal incidence."""

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.errors import UserError
from nishiki.goniometry.consistency import FEWEST_PAIRS, reciprocity, typical_albedo
from nishiki.goniometry.coverage import IncidenceCoverage, coverage
from nishiki.goniometry.directions import unit
from nishiki.goniometry.hemisphere import Interpolation, complete, directional_albedo
from nishiki.goniometry.normalise import Averaged, average_repeats
from nishiki.goniometry.readings import Readings, Regions, read_all
from nishiki.goniometry.store import write_reflectances
from nishiki.goniometry.symmetry import departure
from nishiki.goniometry.table import ReflectanceSet
from nishiki.observations.goniometer import Measurements
from nishiki.stages.goniometer_samples.drawing import coverage_plot

LISTED = 60  # directions of light whose coverage is among the diagnostics; all are in the artifact


def run(context: Context) -> dict:
    """Read every photograph's window, divide by the board, average repeats, complete the hemisphere."""
    settings = context.settings
    source = Measurements(context.inputs["ingest"].folder)
    names, averaged, readings = from_table(source) if source.kind == "table" else from_photographs(source, context)
    angles_deg = (
        np.array([shot.angles_deg for shot in source.samples]) if source.kind != "table" else table_angles(source)
    )
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
        normal_deg=settings.normal_deg,
    )
    made = None
    if settings.interpolation != "none":
        measured, made = complete(measured, grid_deg=settings.grid_deg, method=settings.interpolation)
    covered = coverage(measured)
    context.output.path("coverage.svg").write_text(coverage_plot(measured, covered))
    report = {"stamp": context.stamp, "coverage": [light.as_dict() for light in covered]}
    write_reflectances(context.output.folder, measured, more=report)
    return diagnostics(measured, averaged, readings, made, covered)


def table_angles(source: Measurements) -> np.ndarray:
    """(n, 4): theta_i, phi_i, theta_r, phi_r of a given table, degrees."""
    incident, outgoing, _ = source.table
    return np.concatenate([incident, outgoing], axis=1)


def from_table(source: Measurements) -> tuple[tuple[str, ...], Averaged, Readings | None]:
    """The rows of a table of reflectances; those with a value of 0 or below are not valid."""
    values = source.table[2][:, None, :]
    valid = (values > 0).all(axis=2)
    values = np.where(valid[..., None], values, 0.0)
    ones = np.ones(len(values))
    return ("cloth",), average_repeats(table_angles(source), values, np.zeros_like(values), valid, ones), None


def from_photographs(source: Measurements, context: Context) -> tuple[tuple[str, ...], Averaged, Readings]:
    """Names of the regions, and the readings of all photographs."""
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
        sample_deg,
        white_deg,
        white_reflectance=source.white_reflectance,
        window_px=settings.window_px,
        saturated_share=settings.saturated_share,
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
    made: Interpolation | None,
    covered: tuple[IncidenceCoverage, ...],
) -> dict:
    """Plain values for the manifest."""
    values = measured.values[measured.valid]
    noise = measured.noise[measured.valid]
    sets = [
        (measured.incident[ok], measured.outgoing[ok], measured.values[ok, r]) for r, ok in enumerate(measured.valid.T)
    ]
    departures = [departure(*each, measured.symmetry) for each in sets]
    exchanged = [reciprocity(*each, measured.symmetry) for each in sets]
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
        "reciprocity": [apart if pairs >= FEWEST_PAIRS else None for apart, pairs in exchanged],
        "reciprocal_pairs": [pairs for _, pairs in exchanged],
        "albedo": [typical_albedo(*each, measured.symmetry) for each in sets],
        "unusable": (~measured.valid).sum(axis=0).tolist(),
        "least": float(values.min()) if values.size else None,
        "greatest": float(values.max()) if values.size else None,
        "noise_relative": float(np.median(noise[known] / values[known])) if known.any() else None,
        "boards": readings.rules if readings else None,
        "pixels": int(np.median(readings.pixels[readings.valid])) if readings else None,
        "saturated": int((readings.saturated > 0).any(axis=1).sum()) if readings else 0,
        "coverage": [light.as_dict() for light in covered[:LISTED]],
    }
    if made:
        report |= {
            "left_out_error": list(made.left_out),
            "smoothing": list(made.smoothing),
            "basic_measured": made.measured,
            "basic_extrapolated": made.extrapolated,
            "albedo_normal": directional_albedo(made.basic).tolist(),
        }
    return report
