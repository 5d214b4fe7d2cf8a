"""Brdf: Torrance-Sparrow parameters of the scene or of each of its regions."""

import json
from collections.abc import Sequence

import numpy as np

from nishiki.artifacts.maps import Maps, MapWriter
from nishiki.artifacts.stage import Context
from nishiki.brdf.gloss_profile import (
    GlossProfile,
    SpecularHistogram,
    blurred_lobes,
    fit_gloss,
    specular_samples,
    unit_of,
)
from nishiki.brdf.scene import describe_ladder, pad_lobes, parameters_at_bounds, without_gloss
from nishiki.brdf.torrance_sparrow import MIRROR
from nishiki.model_selection.decision import Decision, decide_gloss, economy
from nishiki.observations.plane import Observations, parcels
from nishiki.stages.brdf import PAINTING_OUTPUTS
from nishiki.stages.painting_maps import PaintingMaps

UNIT_BANDS, UNIT_STEP = 8, 8  # bands, and rows and columns between the pixels, that tell the unit of the observations


LOWEST = np.cos(np.radians(50))
"""Cosine of the steepest slope of pixels in the fit."""


def run(context: Context) -> dict:
    """Gather the specular samples of all lights tile by tile, then fit each region once."""
    frames = Observations(context.inputs["ingest"].folder)
    painting = PaintingMaps(context.inputs)
    labels = painting.maps.read("finish") if "finish" in painting.maps else frames.regions
    finishes, count = context.inputs["normals"].diagnostics["finishes"], 1 if labels is None else int(labels.max()) + 1
    if len(finishes) != count:  # normals knows of one finish, which is that of every region
        finishes = finishes[:1] * count
    regions, decision = fit_glossy(context, frames, painting, labels, finishes)
    for region, finish in zip(regions, finishes, strict=True):
        body = body_of(finish, context.settings.refractive_index)
        region["transmission"] = body.transmission
        if any(region["beta"]):
            region["refractive_index"] = body.refractive_index
    text = json.dumps({"regions": regions}, indent=1, sort_keys=True, allow_nan=False)
    context.output.path("parameters.json").write_text(text + "\n")
    if labels is not None:
        out = MapWriter.of(context, PAINTING_OUTPUTS, frames.shape, frames.band_rows)
        out.write("labels", labels)
    return {
        "regions": len(regions),
        "gamma_deg": [np.degrees(region["gamma"]).tolist() for region in regions],
        **{name: [region[name] for region in regions] for name in ("beta", "residual", "samples", "flags")},
        "at_bounds": parameters_at_bounds(regions),
        "economy": economy(decision),
    }


def fit_glossy(
    context: Context, frames: Observations, painting: PaintingMaps, labels: np.ndarray | None, finishes: list[dict]
) -> tuple[list[dict], Decision]:
    """Fit regions whose gloss predicts lamps to all their pixels, the others by Lambert alone; decide which."""
    settings = context.settings
    kept = np.array([settings.specular == "keep" or finish["gloss_counts"] for finish in finishes])
    kept &= settings.specular != "drop"
    decision = decide_gloss(finishes, kept, settings.specular)
    context.progress.tell(str(decision))
    regions = [without_gloss(settings.refractive_index, 0) for _ in finishes]
    if kept.any():
        fitted = fit_regions(gather(context, frames, painting, labels, kept, finishes))
        regions = [glossy if keep else none for glossy, none, keep in zip(fitted, regions, kept, strict=True)]
    return pad_lobes(regions), decision


def fit_regions(histogram: SpecularHistogram) -> list[dict]:
    """Fit the parameters of each region: strengths of the lobes for the fit of `normals`."""
    parameters = []
    for region in range(len(histogram.rows)):
        gloss, profile = fit_gloss(histogram, region=region), histogram.profile(region=region)
        parameters.append(
            describe_ladder(
                gloss.beta, gloss.gamma, blurred_lobes(profile, gloss.gamma), profile, gloss.refractive_index
            )
        )
    return parameters


def body_of(finish: dict, refractive_index: float) -> GlossProfile:
    """Return the body below an unknown gloss; a metal has none, but the mean of its colour.

    The share of the surface's loss that the body suffers is that of the joint fit, 0 where there was none.
    """
    lobe = np.zeros(1), np.ones(1)
    if finish["joint"] and "gloss_colour" in finish:
        return GlossProfile(*lobe, MIRROR, 0.0, colour=np.array([np.mean(finish["gloss_colour"])]))
    return GlossProfile(*lobe, refractive_index, float(finish["gloss_transmission"]) if finish["joint"] else 0.0)


def gather(
    context: Context,
    frames: Observations,
    painting: PaintingMaps,
    labels: np.ndarray | None,
    glossy: np.ndarray,
    finishes: Sequence[dict],
) -> SpecularHistogram:
    """Collect specular samples of glossy regions' observations, by angle between normal and half vector.

    glossy (regions,): bool; finishes: what `normals` says of each. The error of normals blurs the gloss where it was
    fitted with them; that of others is one of the model, which does not scatter.
    """
    settings = context.settings
    glosses = [body_of(finish, settings.refractive_index) for finish in finishes]
    joint = np.array([finish["joint"] for finish in finishes])
    lights = frames.fit_lights(settings.hold_out)
    maps = painting.maps
    regions = 1 if labels is None else int(labels.max()) + 1
    histogram = SpecularHistogram.empty(
        regions=regions, refractive_index=settings.refractive_index, value_unit=unit_of(reflectances(frames, maps))
    )
    for band in context.progress.over(frames.bands(), "band"):
        normals = painting.shading_normals(band)
        left_out = normals[..., 2] < LOWEST
        region_index = np.zeros(left_out.shape, int) if labels is None else labels[band].astype(int)
        region = np.where(left_out | ~glossy[region_index], -1, region_index)
        reflectance = maps.read("reflectance", band).mean(axis=-1)
        sigma = np.sqrt(
            joint[region_index] * maps.read("sigma", band) ** 2 / 2 + painting.slopes(band)[..., ::2].mean(axis=-1)
        )
        shading = painting.shading(band)
        for rows, observations, valid in frames.strips(band, lights=lights, channel="mean"):
            strip = slice(rows.start - band.start, rows.stop - band.start)
            for parcel in parcels(frames, rows, lights):
                inner = parcel.rows, parcel.columns
                area = slice(strip.start + inner[0].start, strip.start + inner[0].stop), parcel.columns
                for number in np.flatnonzero(glossy):
                    here = region[area] == number
                    if not here.any():
                        continue
                    samples = specular_samples(
                        (observations[:, *inner][:, here] * parcel.scale[:, None])[..., None],
                        parcel.directions,
                        normals[area][here],
                        reflectance[area][here][:, None],
                        glosses[number],
                        valid=valid[:, *inner][:, here],
                        shading=None if shading is None else shading[area][here],
                    )
                    histogram = histogram.add_samples(*samples, sigma=sigma[area][here], region=number)
    return histogram


def reflectances(frames: Observations, maps: Maps) -> list[np.ndarray]:
    """Return reflectances, means of the channels, of some pixels of at most 2 UNIT_BANDS bands that lie evenly."""
    bands = frames.bands()
    chosen = bands[:: max(1, len(bands) // UNIT_BANDS)]
    return [maps.read("reflectance", band)[::UNIT_STEP, ::UNIT_STEP].mean(axis=-1) for band in chosen]
