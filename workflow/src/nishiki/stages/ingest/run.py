"""Ingest: photographs of a sealed capture to linear, white-normalised observations."""

import shutil
from typing import Any

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.capture.folder import load_capture
from nishiki.capture.mosaic import MosaicCapture
from nishiki.capture.seal import capture_digest
from nishiki.capture.turntable import TurntableCapture
from nishiki.colour.colour import illuminant as cie_illuminant
from nishiki.colour.sampling import resample, under_one_lamp
from nishiki.errors import UserError, require
from nishiki.formats.stored import BandedGroup
from nishiki.observations.goniometer_store import STORE as WINDOWS
from nishiki.observations.goniometer_store import write_goniometer
from nishiki.observations.plane import STORE
from nishiki.observations.plane_store import write_observations
from nishiki.observations.region import chosen, usage_of
from nishiki.observations.views import STORE as VIEWS
from nishiki.observations.views_store import geometry_sources, write_views

WRITERS = {"plane": write_observations, "turntable": write_views, "goniometer": write_goniometer}
STORES = {"plane": STORE, "turntable": VIEWS, "goniometer": WINDOWS}


def run(context: Context) -> dict:
    """Decode every photograph once, check it against the seal, and write observations, views or measurements.

    Beside the views of a turntable lie copies of the files of its geometry; of a table of reflectances only the table.
    """
    capture, settings = load_capture(require(context.capture)), context.settings
    if isinstance(capture, MosaicCapture):
        raise UserError(f"{context.capture}: a mosaic. Remedy: name one of its fields")
    write = WRITERS[capture.geometry]
    result = write(capture, context.output.folder, settings=settings, progress=context.progress)
    if isinstance(capture, TurntableCapture):
        for source, name in geometry_sources(chosen(capture, settings.without).capture):
            shutil.copyfile(source, context.output.path(name))
    if getattr(capture, "table", None) is None:
        store = BandedGroup(context.output.folder / STORES[capture.geometry])
        store.update(stamp=context.stamp)  # inside the store, too, stands where it comes from
    curves: dict[str, Any] = {}  # (channels, 61) on 400-700/5 nm, those that the capture has
    for name in ("illuminant", "sensitivities"):
        given = getattr(capture, name)
        if isinstance(given, str):
            curves[name] = cie_illuminant(given)[None]
        elif given is not None:
            curves[name] = resample(given.wavelengths_nm, given.values.T, name=f"{context.capture}: {name}")
    np.savez(context.output.path("curves.npz"), **under_one_lamp(**curves))
    read = usage_of(capture, without=settings.without, channels=settings.channels)
    described = {"capture": capture.settings.model_dump(mode="json"), "read": read}
    return {**described, **result}


digest_of_capture = capture_digest
