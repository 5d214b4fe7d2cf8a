"""Brdf: Torrance-Sparrow parameters of the scene or of each of its regions."""

import json

import numpy as np

import _project  # noqa: F401
from nishiki.brdf.parameters import described
from nishiki.brdf.scene import fit_scene
from nishiki.brdf.specular_histogram import SpecularHistogram
from nishiki.ingest.observations import Observations
from nishiki.ingest.parcels import parcels
from nishiki.maps import Maps, MapWriter
from nishiki.normals.flags import NO_ESTIMATE
from nishiki.settings.brdf import BrdfSettings
from nishiki.stage import Context, run_stage


def run(context: Context) -> dict:
    """Gather the specular samples of all lights tile by tile, then fit each region once."""
    frames = Observations(context.inputs["ingest"].folder)
    maps = Maps(context.inputs["normals"].folder)
    labels = frames.regions
    histogram = gather(context, frames, maps, labels)
    fits = fit_scene(histogram, lobes=context.settings.lobes)
    parameters = {"method": context.settings.method, "regions": [described(fit) for fit in fits]}
    text = json.dumps(parameters, indent=1, sort_keys=True, allow_nan=False)
    context.output.path("parameters.json").write_text(text + "\n")
    if labels is not None:
        rows, columns = frames.shape
        out = MapWriter(
            context.output.folder, rows=rows, columns=columns, band_rows=frames.band_rows, stamp=context.stamp
        )
        out.write("labels", labels, meaning="row of parameters.json")
    return {
        "regions": len(fits),
        "beta": [fit.beta.tolist() for fit in fits],
        "gamma_deg": [np.degrees(fit.gamma).tolist() for fit in fits],
        "residual": [fit.residual for fit in fits],
        "samples": [fit.samples for fit in fits],
        "flags": [[flag.name for flag in fit.flags] for fit in fits],
    }


def gather(context: Context, frames: Observations, maps: Maps, labels: np.ndarray | None) -> SpecularHistogram:
    """Specular samples of every usable observation, by angle between normal and half vector."""
    settings = context.settings
    lights = frames.fit_lights(settings.hold_out)
    regions = 1 if labels is None else int(labels.max()) + 1
    histogram = SpecularHistogram.empty(regions=regions, refractive_index=settings.refractive_index)
    lowest = np.cos(np.radians(settings.max_slope_deg))
    for band in context.progress.over(frames.bands(), "band"):
        observations, valid = frames.read(band, lights=lights, channel="mean")
        normals = maps.read("normals", band)
        left_out = ((maps.read("flags", band) & NO_ESTIMATE) != 0) | (normals[..., 2] < lowest)
        region = np.where(left_out, -1, 0 if labels is None else labels[band])
        reflectance, sigma = maps.read("reflectance", band).mean(axis=-1), maps.read("sigma", band)
        for parcel in parcels(frames, band, lights):
            area = parcel.rows, parcel.columns
            histogram = histogram.add_tile(
                observations[:, *area] * parcel.scale[:, None, None],
                normals[area],
                reflectance[area],
                parcel.directions,
                usable=valid[:, *area],
                sigma=sigma[area] / np.sqrt(2),
                regions=region[area],
            )
    return histogram


if __name__ == "__main__":
    run_stage(BrdfSettings, run, __doc__)
