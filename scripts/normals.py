"""Normals: photometric stereo on the selected lights, with uncertainty, and the reflectance of each channel."""

from collections import Counter

import numpy as np

import _project  # noqa: F401
from nishiki.ingest.observations import Observations
from nishiki.maps import Maps, MapWriter
from nishiki.normals import flags as bits
from nishiki.normals.reflectance import diffuse_reflectance
from nishiki.normals.solve import estimate_normals
from nishiki.settings.normals import NormalsSettings
from nishiki.stage import Context, run_stage

QUANTITIES = {
    "albedo": ("float32", "relative to white, intensity"),
    "sigma": ("float32", "radians, rms error of the direction"),
    "lights_used": ("uint16", "lights"),
    "condition": ("float32", "of the weighted 3 x 3 normal matrix"),
    "residual": ("float32", "rms, relative to white"),
    "flags": ("uint8", "bits, see docs/stages/normals.md"),
}


def run(context: Context) -> dict:
    """Solve band by band; memory does not grow with the number of rows."""
    frames = Observations(context.inputs["ingest"].folder)
    separate = context.inputs.get("separate")
    selection = Maps(separate.folder) if separate else None
    lights = frames.fit_lights(context.settings.hold_out)
    rows, columns = frames.shape
    maps = MapWriter(context.output.folder, rows=rows, columns=columns, band_rows=frames.band_rows, stamp=context.stamp)
    normals = maps.create("normals", (3,), unit="unit vector, x right, y up, z to the camera")
    reflectance = maps.create(
        "reflectance", (len(frames.channels),), unit="relative to white", channels=frames.channels
    )
    arrays = {name: maps.create(name, dtype=dtype, unit=unit) for name, (dtype, unit) in QUANTITIES.items()}
    counts: Counter[str] = Counter()
    sigmas = []
    for band in context.progress.over(frames.bands(), "band"):
        observations, valid = frames.read(band, lights=lights)
        usable = _usable(selection, band, len(lights), valid)
        intensity = observations[..., 0] if observations.shape[-1] == 1 else observations.mean(axis=-1)
        field = estimate_normals(
            intensity,
            frames.directions[lights],
            usable=usable,
            solver=context.settings.solver,
            max_condition=context.settings.max_condition,
        )
        normals[band] = field.normals
        reflectance[band] = diffuse_reflectance(
            observations, frames.directions[lights], field.normals, usable=usable
        ).reflectance
        for name, array in arrays.items():
            array[band] = getattr(field, name)
        counts.update(_counts(field))
        sigmas.append(field.sigma[field.valid][::17])
    sigma = np.degrees(np.concatenate(sigmas)) if sigmas else np.zeros(0)
    return {
        "lights": [frames.lights[j] for j in lights],
        "pixels": rows * columns,
        **dict(counts),
        "sigma_median_deg": float(np.median(sigma)) if sigma.size else None,
        "sigma_p95_deg": float(np.percentile(sigma, 95)) if sigma.size else None,
    }


def _usable(selection: Maps | None, band: slice, lights: int, valid: np.ndarray) -> np.ndarray:
    if selection is None:
        return valid
    packed = np.moveaxis(selection.read("usable", band), -1, 0)
    return np.unpackbits(packed, axis=0, count=lights, bitorder="little").astype(bool)


def _counts(field) -> dict[str, int]:
    found = {"valid_pixels": int(field.valid.sum())}
    for bit, name in bits.NAMES.items():
        found[f"flagged_{name}"] = int(((field.flags & bit) != 0).sum())
    return found


if __name__ == "__main__":
    run_stage(NormalsSettings, run, __doc__)
