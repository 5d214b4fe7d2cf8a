"""Normals: photometric stereo on the selected lights, with uncertainty, and the reflectance of each channel."""

from collections import Counter

import numpy as np

import _project  # noqa: F401
from nishiki.ingest.observations import Observations
from nishiki.ingest.parcels import Parcel, parcels
from nishiki.maps import Maps, MapWriter
from nishiki.normals import flags as bits
from nishiki.normals.reflectance import diffuse_reflectance
from nishiki.normals.solve import estimate_normals
from nishiki.settings.normals import NormalsSettings
from nishiki.stage import Context, run_stage

MAPS = {
    "normals": ("float32", "unit vector, x right, y up, z to the camera"),
    "reflectance": ("float32", "relative to white, per channel"),
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
    arrays = create_maps(context, frames)
    counts: Counter[str] = Counter()
    sigmas = []
    for band in context.progress.over(frames.bands(), "band"):
        observations, valid = frames.read(band, lights=lights)
        usable = read_usable(selection, band, len(lights), valid)
        found = {name: np.empty((*valid.shape[1:], *array.shape[2:]), array.dtype) for name, array in arrays.items()}
        for parcel in parcels(frames, band, lights):
            area = np.s_[:, parcel.rows, parcel.columns]
            for name, values in solve(observations[area], usable[area], parcel, context.settings).items():
                found[name][area[1:]] = values
        for name, array in arrays.items():
            array[band] = found[name]
        inside = frames.mask[band]
        counts.update(count_flags(found["flags"], inside))
        sigmas.append(found["sigma"][inside & ((found["flags"] & bits.NO_ESTIMATE) == 0)][::17])
    return {"lights": [frames.lights[j] for j in lights], **dict(counts), **percentiles(np.concatenate(sigmas))}


def create_maps(context: Context, frames: Observations) -> dict:
    """The arrays of the artifact."""
    rows, columns = frames.shape
    maps = MapWriter(context.output.folder, rows=rows, columns=columns, band_rows=frames.band_rows, stamp=context.stamp)
    maps.group.attrs["pixel_pitch_mm"] = frames.pixel_pitch_mm
    trailing = {"normals": (3,), "reflectance": (len(frames.channels),)}
    return {
        name: maps.create(name, trailing.get(name, ()), dtype=dtype, unit=unit) for name, (dtype, unit) in MAPS.items()
    }


def solve(observations: np.ndarray, usable: np.ndarray, parcel: Parcel, settings: NormalsSettings) -> dict:
    """Maps of one parcel by name."""
    if (parcel.scale != 1).any():
        observations = observations * parcel.scale[:, None, None, None]
    intensity = observations[..., 0] if observations.shape[-1] == 1 else observations.mean(axis=-1)
    field = estimate_normals(
        intensity, parcel.directions, usable=usable, solver=settings.solver, max_condition=settings.max_condition
    )
    found = {name: getattr(field, name) for name in MAPS if name != "reflectance"}
    if observations.shape[-1] == 1:
        return found | {"reflectance": field.albedo[..., None]}
    diffuse = diffuse_reflectance(observations, parcel.directions, field.normals, usable=usable)
    return found | {"reflectance": diffuse.reflectance}


def read_usable(selection: Maps | None, band: slice, lights: int, valid: np.ndarray) -> np.ndarray:
    """Samples (lights, rows, columns) that separate chose; all valid ones where it was left out."""
    if selection is None:
        return valid
    packed = np.moveaxis(selection.read("usable", band), -1, 0)
    return np.unpackbits(packed, axis=0, count=lights, bitorder="little").view(bool)


def count_flags(flags: np.ndarray, inside: np.ndarray) -> dict[str, int]:
    """Pixels of the object, those with an estimate, and those with each flag."""
    of_object = flags[inside]
    valid = int(((of_object & bits.NO_ESTIMATE) == 0).sum())
    named = {f"flagged_{name}": int(((of_object & bit) != 0).sum()) for bit, name in bits.NAMES.items()}
    return {"object_pixels": int(inside.sum()), "valid_pixels": valid, **named}


def percentiles(sigma: np.ndarray) -> dict[str, float | None]:
    """Median and 95th percentile of the standard error of the direction, degrees, over a sample of the pixels."""
    if not sigma.size:
        return {"sigma_median_deg": None, "sigma_p95_deg": None}
    middle, high = np.degrees(np.percentile(sigma, [50, 95]))
    return {"sigma_median_deg": float(middle), "sigma_p95_deg": float(high)}


if __name__ == "__main__":
    run_stage(NormalsSettings, run, __doc__)
