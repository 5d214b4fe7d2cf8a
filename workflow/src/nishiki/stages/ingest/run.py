"""Ingest: photographs of a sealed capture to linear, white-normalised observations."""

import shutil
from dataclasses import asdict

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.capture.folder import Capture, load_capture
from nishiki.capture.goniometer import GoniometerCapture
from nishiki.capture.seal import capture_digest
from nishiki.capture.turntable import TurntableCapture
from nishiki.colour.colour import illuminant as cie_illuminant
from nishiki.colour.sampling import resample
from nishiki.formats.zarr_store import BandedGroup
from nishiki.observations.goniometer_store import STORE as WINDOWS
from nishiki.observations.goniometer_store import write_goniometer
from nishiki.observations.plane_store import STORE, write_observations
from nishiki.observations.region import chosen, usage_of
from nishiki.observations.views_store import STORE as VIEWS
from nishiki.observations.views_store import geometry_sources, write_views


def run(context: Context) -> dict:
    """Decode every photograph once, check it against the seal, and write observations, views or measurements."""
    capture = load_capture(context.capture)
    if capture.geometry == "turntable":
        return run_views(capture, context)
    if capture.geometry == "goniometer":
        return run_goniometer(capture, context)
    result = write_observations(capture, context.output.folder, settings=context.settings, progress=context.progress)
    stamp_store(context, STORE)
    write_curves(capture, context)
    return {**described(capture, context), **asdict(result)}


def run_views(capture: TurntableCapture, context: Context) -> dict:
    """Write the views of a turntable or of a polarisation series, and copies of the files of its geometry."""
    result = write_views(capture, context.output.folder, settings=context.settings, progress=context.progress)
    for source, name in geometry_sources(chosen(capture, context.settings.without).capture):
        shutil.copyfile(source, context.output.path(name))
    stamp_store(context, VIEWS)
    write_curves(capture, context)
    return {**described(capture, context), **asdict(result)}


def run_goniometer(capture: GoniometerCapture, context: Context) -> dict:
    """Write the windows of a goniometer's photographs, or its table."""
    result = write_goniometer(capture, context.output.folder, settings=context.settings, progress=context.progress)
    if capture.table is None:
        stamp_store(context, WINDOWS)
    write_curves(capture, context)
    return {**described(capture, context), **asdict(result)}


def described(capture: Capture | TurntableCapture | GoniometerCapture, context: Context) -> dict:
    """Return what the capture says of itself, and what was read of it."""
    block = context.settings
    read = usage_of(
        capture, without=block.without, channels=block.channels, tile_mib=block.tile_mib, white_block=block.white_block
    )
    return {"capture": capture.settings.model_dump(mode="json"), "read": read.as_dict()}


def stamp_store(context: Context, store: str) -> None:
    """Say inside the store where it comes from."""
    BandedGroup(context.output.folder / store).update(stamp=context.stamp)


def write_curves(capture: Capture | TurntableCapture | GoniometerCapture, context: Context) -> None:
    """curves.npz: illuminant (61,) and sensitivities (channels, 61) on 400-700/5 nm, those that the capture has."""
    curves = {}
    for name in ("illuminant", "sensitivities"):
        given = getattr(capture, name)
        if isinstance(given, str):
            curves[name] = cie_illuminant(given)
        elif given is not None:
            values = resample(given.wavelengths_nm, given.values.T, name=f"{context.capture}: {name}")
            curves[name] = values[0] if name == "illuminant" else values
    np.savez(context.output.path("curves.npz"), **curves)


digest_of_capture = capture_digest
