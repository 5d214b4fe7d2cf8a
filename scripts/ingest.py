"""Ingest: photographs of a sealed capture to linear, white-normalised observations."""

import numpy as np
import zarr

import _project  # noqa: F401
from nishiki.capture.folder import Capture, load_capture
from nishiki.capture.seal import capture_digest
from nishiki.ingest.store import STORE, write_observations
from nishiki.settings.ingest import IngestSettings
from nishiki.spectra.colour import illuminant as cie_illuminant
from nishiki.spectra.sampling import resample
from nishiki.stage import Context, run_stage


def run(context: Context) -> dict:
    """Decode every photograph once, check it against the seal, and write the observations."""
    capture = load_capture(context.capture)
    result = write_observations(capture, context.output.folder, settings=context.settings, progress=context.progress)
    stamp_store(context)
    write_curves(capture, context)
    return {"capture": capture.settings.model_dump(mode="json"), **result.as_dict()}


def stamp_store(context: Context) -> None:
    """Say inside the store where it comes from."""
    zarr.open_group(context.output.folder / STORE, mode="r+").attrs["stamp"] = context.stamp


def write_curves(capture: Capture, context: Context) -> None:
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


if __name__ == "__main__":
    run_stage(IngestSettings, run, __doc__, digest_of_capture=capture_digest)
