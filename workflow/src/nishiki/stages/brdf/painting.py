"""Brdf: Torrance-Sparrow parameters of the scene or of each of its regions."""

import json

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.artifacts.maps import Maps, MapWriter, shading_normals
from nishiki.artifacts.stage import Context
from nishiki.brdf.fit import fit_lobe
from nishiki.brdf.gloss_profile import (
    LADDER,
    GlossProfile,
    SpecularHistogram,
    blurred_lobes,
    fit_gloss,
    specular_samples,
    unit_of,
)
from nishiki.brdf.scene import (
    brightest_light_samples,
    described,
    described_brightest,
    described_ladder,
    fit_scene,
    of_equal_lobes,
    parameters_at_bounds,
    thin,
    without_gloss,
)
from nishiki.brdf.slopes import slope_covariance
from nishiki.model_selection.decision import Decision, economy
from nishiki.model_selection.gloss import Evidence, decide_gloss, gloss_evidence
from nishiki.observations.parcels import parcels, sample
from nishiki.observations.plane import Observations
from nishiki.photometric.flags import NO_ESTIMATE

SAMPLE_PIXELS = 5000  # that decide whether the scene shows gloss
UNIT_BANDS, UNIT_STEP = 8, 8  # bands, and rows and columns between the pixels, that tell the unit of the observations


def run(context: Context) -> dict:
    """Gather the specular samples of all lights tile by tile, then fit each region once."""
    frames = Observations(context.inputs["ingest"].folder)
    maps = Maps(context.inputs["normals"].folder)
    labels = frames.regions
    if context.settings.method == "paper":
        regions, decision = fit_brightest(context, frames, maps, labels), None
    else:
        regions, decision = fit_glossy(context, frames, maps, labels)
    parameters = {
        "method": context.settings.method,
        "regions": regions,
        "transmission": body_transmission(context.inputs["normals"]),
    }
    text = json.dumps(parameters, indent=1, sort_keys=True, allow_nan=False)
    context.output.path("parameters.json").write_text(text + "\n")
    if labels is not None:
        rows, columns = frames.shape
        out = MapWriter(
            context.output.folder, rows=rows, columns=columns, band_rows=frames.band_rows, stamp=context.stamp
        )
        out.write("labels", labels, meaning="row of parameters.json")
    return {
        "regions": len(regions),
        "gamma_deg": [np.degrees(region["gamma"]).tolist() for region in regions],
        **{name: [region[name] for region in regions] for name in ("beta", "residual", "samples", "flags")},
        "at_bounds": parameters_at_bounds(regions),
        "economy": economy(decision),
    }


def fit_glossy(
    context: Context, frames: Observations, maps: Maps, labels: np.ndarray | None
) -> tuple[list[dict], Decision]:
    """Every region that shows gloss fitted to all its pixels, the others Lambert alone; and what was decided."""
    settings = context.settings
    if settings.specular == "auto":
        evidence = gloss_of_regions(context, frames, maps, labels)
    else:
        keep = settings.specular == "keep"
        evidence = [Evidence(keep, "set", 0.0, 0.0, 0.0, 0.0, 0)] * (1 if labels is None else int(labels.max()) + 1)
    decision = decide_gloss(evidence, settings.specular)
    context.progress.tell(str(decision))
    regions = [without_gloss(settings.refractive_index, gloss.samples) for gloss in evidence]
    if any(gloss.keep for gloss in evidence):
        histogram = gather(context, frames, maps, labels, np.array([gloss.keep for gloss in evidence]))
        fitted = fit_regions(histogram, settings.lobes)
        regions = [
            glossy if gloss.keep else none for glossy, none, gloss in zip(fitted, regions, evidence, strict=True)
        ]
    return of_equal_lobes(regions), decision


def fit_regions(histogram: SpecularHistogram, lobes: int | str) -> list[dict]:
    """Parameters of each region: strengths of the lobes that `normals` fits with, or one or two lobes of any width."""
    if lobes != "ladder":
        return [described(fit) for fit in fit_scene(histogram, lobes=lobes)]
    parameters = []
    for region in range(len(histogram.rows)):
        gloss, profile = fit_gloss(histogram, region=region), histogram.profile(region=region)
        parameters.append(
            described_ladder(
                gloss.beta, gloss.gamma, blurred_lobes(profile, gloss.gamma), profile, gloss.refractive_index
            )
        )
    return parameters


def body_transmission(normals: Artifact) -> float:
    """Share of the surface's loss that the body's light suffers: as the joint fit took it, 0 where there was none."""
    diagnostics = normals.diagnostics
    return float(diagnostics["gloss_transmission"]) if diagnostics["refined"] else 0.0


def gloss_of_regions(context: Context, frames: Observations, maps: Maps, labels: np.ndarray | None) -> list[Evidence]:
    """Return evidence of gloss of each region, from a sample of the scene's pixels."""
    settings = context.settings
    lights = frames.fit_lights(settings.hold_out)
    transmission = body_transmission(context.inputs["normals"])
    nothing = GlossProfile(np.zeros(LADDER.size), LADDER, settings.refractive_index, transmission)
    parts = []
    for piece in sample(frames, lights, SAMPLE_PIXELS):
        normals, known = piece.of(shading_normals(maps, piece.band)), piece.of(maps.read("flags", piece.band))
        flat = normals[..., 2] < np.cos(np.radians(settings.max_slope_deg))
        reflectance = piece.of(maps.read("reflectance", piece.band)).mean(axis=-1)[..., None]
        everywhere = np.broadcast_to(((known & NO_ESTIMATE) == 0) & ~flat, piece.valid.shape)
        samples = specular_samples(
            piece.observations[..., None],
            piece.parcel.directions,
            normals,
            reflectance,
            nothing,
            valid=everywhere,
            shading=piece.of(shading_of(maps, piece.band)) if "shading" in maps else None,
        )
        sigma = np.broadcast_to(piece.of(maps.read("sigma", piece.band)) / np.sqrt(2), piece.valid.shape)
        region = np.zeros(everywhere.shape, int) if labels is None else piece.of(labels[piece.band]) + 0 * everywhere
        parts.append([values.ravel() for values in (*samples, piece.valid, sigma, region)])
    phi, residual, attenuation, usable, sigma, region = (np.concatenate(values) for values in zip(*parts, strict=True))
    count = 1 if labels is None else int(labels.max()) + 1
    chosen = [region == k for k in range(count)]
    return [
        gloss_evidence(
            phi[pixels], residual[pixels], attenuation[pixels], usable[pixels],
            sigma=sigma[pixels], refractive_index=settings.refractive_index,
        )
        for pixels in chosen
    ]  # fmt: skip


def fit_brightest(context: Context, frames: Observations, maps: Maps, labels: np.ndarray | None) -> list[dict]:
    """Return the published fit (Tominaga and Tanaka 2004, eq. 14-18) of each region: the brightest light of each pixel,
    thinned samples, one lobe."""
    settings = context.settings
    lights = frames.fit_lights(settings.hold_out)
    count = 1 if labels is None else int(labels.max()) + 1
    gathered = [[] for _ in range(count)]
    for band in context.progress.over(frames.bands(), "band"):
        observations, valid = frames.read(band, lights=lights, channel="mean")
        known = (maps.read("flags", band) & NO_ESTIMATE) == 0
        normals, albedo = shading_normals(maps, band), maps.read("reflectance", band).mean(axis=-1)
        for region, samples in enumerate(gathered):
            inside = known if labels is None else known & (labels[band] == region)
            brightest = brightest_light_samples(
                observations,
                normals,
                albedo,
                frames.directions[lights],
                usable=valid & inside,
                refractive_index=settings.refractive_index,
                smoothing=settings.smoothing_px,
                shading=shading_of(maps, band),
            )
            kept = thin(brightest[0], per_bin=500)
            samples.append([values[kept] for values in brightest])
    return [published_fit(samples, settings.refractive_index) for samples in gathered]


def published_fit(samples: list, refractive_index: float) -> dict:
    """Return one region's samples of all bands, thinned once more and fitted by Levenberg-Marquardt."""
    phi, value, attenuation = (np.concatenate(values) for values in zip(*samples, strict=True))
    kept = thin(phi)
    phi, value, attenuation = phi[kept], value[kept], attenuation[kept]
    if phi.size < 3:
        nothing = (0.0, 0.1, np.full((2, 2), np.inf), 0.0, False)
        return described_brightest(phi, value, attenuation, nothing, refractive_index)
    fitted = fit_lobe(phi, value, attenuation, start=(1.0, 0.1))
    return described_brightest(phi, value, attenuation, fitted, refractive_index)


def gather(
    context: Context, frames: Observations, maps: Maps, labels: np.ndarray | None, glossy: np.ndarray
) -> SpecularHistogram:
    """Specular samples of every usable observation of the glossy regions, by angle between normal and half vector."""
    settings = context.settings
    lights = frames.fit_lights(settings.hold_out)
    regions = 1 if labels is None else int(labels.max()) + 1
    histogram = SpecularHistogram.empty(
        regions=regions, refractive_index=settings.refractive_index, value_unit=unit_of(reflectances(frames, maps))
    )
    lowest = np.cos(np.radians(settings.max_slope_deg))
    transmission = body_transmission(context.inputs["normals"])
    for band in context.progress.over(frames.bands(), "band"):
        observations, valid = frames.read(band, lights=lights, channel="mean")
        normals = shading_normals(maps, band)
        left_out = ((maps.read("flags", band) & NO_ESTIMATE) != 0) | (normals[..., 2] < lowest)
        region_index = np.zeros(left_out.shape, int) if labels is None else labels[band].astype(int)
        region = np.where(left_out | ~glossy[region_index], -1, region_index)
        reflectance = maps.read("reflectance", band).mean(axis=-1)
        sigma = np.sqrt(maps.read("sigma", band) ** 2 / 2 + slope_variance(maps, band))
        shading = shading_of(maps, band)
        for parcel in parcels(frames, band, lights):
            area = parcel.rows, parcel.columns
            histogram = histogram.add_tile(
                observations[:, *area] * parcel.scale[:, None, None],
                normals[area],
                reflectance[area],
                parcel.directions,
                usable=valid[:, *area],
                sigma=sigma[area],
                regions=region[area],
                shading=None if shading is None else shading[area],
                transmission=transmission,
            )
    return histogram


def slope_variance(maps: Maps, band: slice) -> np.ndarray:
    """Variance of the slopes within the pixels of a band, mean of both axes, from the normals beside them too."""
    first = max(band.start - 1, 0)
    covariance = slope_covariance(shading_normals(maps, slice(first, band.stop + 1)))
    return 0.5 * (covariance[..., 0] + covariance[..., 2])[band.start - first :][: band.stop - band.start]


def shading_of(maps: Maps, band: slice) -> np.ndarray | None:
    """Return body shading of the normals stage; None where its solver knows Lambert's law only."""
    return maps.read("shading", band) if "shading" in maps else None


def reflectances(frames: Observations, maps: Maps) -> list[np.ndarray]:
    """Return reflectances, means of the channels, of some pixels of at most 2 UNIT_BANDS bands that lie evenly."""
    bands = frames.bands()
    chosen = bands[:: max(1, len(bands) // UNIT_BANDS)]
    return [maps.read("reflectance", band)[::UNIT_STEP, ::UNIT_STEP].mean(axis=-1) for band in chosen]
