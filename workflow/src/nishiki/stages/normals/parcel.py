"""Normals of one parcel: from the selected lights, together with a gloss where there is one; and the choice of the fit.

What the joint fit of normals and gloss needs is imported where it is used: it takes 50 ms.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from nishiki.artifacts.maps import Maps
from nishiki.brdf.torrance_sparrow import LAMBERT
from nishiki.model_selection.decision import Decision
from nishiki.observations.parcels import Parcel, parcels
from nishiki.observations.plane import Observations
from nishiki.photometric import flags as bits
from nishiki.photometric.body_colour import body_intensity
from nishiki.photometric.flags import FEW_LIGHTS
from nishiki.photometric.light_selection import unpack_lights
from nishiki.photometric.reflectance import diffuse_reflectance, mean_of_channels
from nishiki.photometric.relighting import MODELS, fit_relighting
from nishiki.photometric.solve import estimate_normals, shading_of_mean
from nishiki.stages.normals import NormalsSettings

if TYPE_CHECKING:
    from nishiki.brdf.gloss_profile import GlossProfile
    from nishiki.model_selection.relighting import Fitted, Sampled
    from nishiki.photometric.gloss_scene import GlossTile, SceneGloss


MAPS = {
    "normals": ("float32", "unit vector, x right, y up, z to the camera"),
    "reflectance": ("float32", "relative to white, per channel"),
    "albedo": ("float32", "relative to white, intensity"),
    "sigma": ("float32", "radians, rms error of the direction"),
    "correction_sigma": ("float32", "radians, the part of sigma that comes from what ingest put right"),
    "lights_used": ("uint16", "lights"),
    "condition": ("float32", "of the weighted 3 x 3 normal matrix"),
    "shading": ("float32", "weights (a, b, d) of c, c^2 and c x^8, or with e_x, e_y; see docs/stages/normals.md"),
    "shading_normals": ("float32", "unit vector of the body shading, where it was fitted for relighting"),
    "residual": ("float32", "rms, relative to white"),
    "flags": ("uint8", "bits, see docs/stages/normals.md"),
}

WEIGHTED = 0.01  # mean change of the samples, relative, from which the shading is fitted to the mean of the channels


def scaled(observations: np.ndarray, parcel: Parcel) -> np.ndarray:
    """Return observations as if the lamps were as far from the parcel as from the centre."""
    return observations * parcel.scale[:, None, None, None] if (parcel.scale != 1).any() else observations


def solve(
    observations: np.ndarray,
    usable: np.ndarray,
    valid: np.ndarray,
    parcel: Parcel,
    settings: NormalsSettings,
    gloss: GlossProfile | None,
) -> dict:
    """Maps of one parcel by name: from the selected lights, then, with a gloss, fitted together with it."""
    observations = scaled(observations, parcel)
    if observations.shape[-1] == 1:
        intensity = observations[..., 0]
    elif settings.solver == "least_squares":  # as published: the mean of the channels
        intensity = mean_of_channels(observations)
    else:
        intensity = body_intensity(observations, valid)
    field = estimate_normals(
        intensity,
        parcel.directions,
        usable=usable,
        valid=valid,
        solver=settings.solver,
        max_condition=settings.max_condition,
    )
    if field.shading is not None and observations.shape[-1] > 1:
        field = with_shading_of_mean(field, intensity, observations, parcel, usable, valid, settings)
    maps = {name: getattr(field, name) for name in MAPS if hasattr(field, name)}
    if observations.shape[-1] == 1 and field.shading is None:
        maps["reflectance"] = field.albedo[..., None]
    else:
        maps["reflectance"] = diffuse_reflectance(
            observations,
            parcel.directions,
            field.normals,
            usable=usable,
            method=settings.reflectance,
            shading=field.shading,
        ).reflectance
    if field.shading is None:
        del maps["shading"]
    if gloss is None:
        return maps
    from nishiki.photometric.gloss import refine_normals

    fit = refine_normals(
        observations,
        parcel.directions,
        normals=field.normals,
        gloss=gloss,
        valid=valid,
        flags=field.flags,
        reflectance=maps["reflectance"],
        max_condition=settings.max_condition,
    )
    kept = (fit.flags & (bits.NO_ESTIMATE | bits.FALLBACK)) != 0
    lambert = {"shading": np.array(LAMBERT, np.float32)}  # the joint fit has a body of its own
    return {
        name: fit.flags
        if name == "flags"
        else np.where(aligned(kept, values), values, lambert[name] if name in lambert else getattr(fit, name))
        for name, values in maps.items()
    }


def with_shading_of_mean(field, intensity, observations, parcel: Parcel, usable, valid, settings):
    """The field with the body shading of the channels' mean where the intensity that made the normals is another.

    There gloss was weighted down for the normals; light is predicted with all of it.
    """
    mean = mean_of_channels(observations)
    shading = shading_of_mean(
        intensity, mean, parcel.directions, field, usable=usable, valid=valid, least_change=WEIGHTED
    )
    return replace(field, shading=shading)


def relit(observations: np.ndarray, valid: np.ndarray, parcel: Parcel, maps: dict, model: str) -> dict:
    """The maps that predict lamps, fitted again to the samples of a parcel; with many lights `plain` keeps its own."""
    if model == "plain" and len(parcel.directions) > FEW_LIGHTS:
        return {}
    return fit_relighting(
        scaled(observations, parcel),
        parcel.directions,
        maps["normals"],
        valid=valid,
        scatter=maps["residual"] / np.maximum(maps["albedo"], 1e-9),
        reflectance=maps["reflectance"],
        shading=maps["shading"],
        known=(maps["flags"] & bits.NO_ESTIMATE) == 0,
        model=model,
    )


def aligned(mask: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the mask (rows, columns) with as many axes as the map."""
    return mask.reshape(mask.shape + (1,) * (values.ndim - 2))


SAMPLE_BANDS, SAMPLE_PIXELS = 12, 20_000  # of the scene, for its gloss
RELIGHTING_PIXELS = 2000  # likewise, for the model that predicts lamps
SMALL_PARCEL = 1024  # pixels


def choose_fit(
    frames: Observations,
    selection: Maps | None,
    lights: np.ndarray,
    gloss: SceneGloss | None,
    settings: NormalsSettings,
) -> tuple[GlossProfile | None, str | None, list[Decision | None]]:
    """Return gloss of the joint fit, or None; the model of relighting, or None where there is none; what was decided.

    Captured lamps that are left out in turn decide, on a sample of the pixels, where the settings leave it open.
    """
    models = () if settings.solver == "least_squares" else MODELS
    profile = gloss.profile if gloss is not None and gloss.significant else None
    errors, refinement = None, None
    if settings.refine != "gloss" and (profile is not None or (models and settings.relighting == "auto")):
        errors = prediction_errors(frames, selection, lights, profile, models, settings)
    if gloss is not None:
        from nishiki.model_selection.relighting import decided

        joint, refinement = decided(gloss, settings.refine, errors)
        if joint:
            return gloss.profile, None, [refinement]
    if not models:
        return None, None, [refinement]
    if settings.relighting != "auto" or errors is None:
        return None, MODELS[0] if settings.relighting == "auto" else settings.relighting, [refinement]
    from nishiki.model_selection.relighting import choose_model

    model, relighting = choose_model(errors)
    return None, model, [refinement, relighting]


def prediction_errors(
    frames: Observations,
    selection: Maps | None,
    lights: np.ndarray,
    profile: GlossProfile | None,
    models: tuple[str, ...],
    settings: NormalsSettings,
) -> dict[str, np.ndarray] | None:
    """CIEDE2000 (lights,) of lamps left out in turn, by candidate; None without pixels or with too few lights."""
    from nishiki.model_selection.relighting import FEWEST, Fitted, left_out_errors

    def fit(piece: Sampled) -> dict[str, Fitted]:
        given = piece.observations, piece.usable, piece.valid, piece.parcel
        maps = solve(*given, settings, None)
        fits = {"plain": Fitted(maps)}
        for name in models:
            fits[name] = Fitted(maps | relit(piece.observations, piece.valid, piece.parcel, maps, name))
        if profile is not None:
            fits["joint"] = Fitted(solve(*given, settings, profile), profile)
        return fits

    bands = sample_bands(frames, RELIGHTING_PIXELS)
    pieces = sampled_pixels(frames, selection, lights, bands, RELIGHTING_PIXELS) if len(lights) >= FEWEST else []
    pieces = [piece for piece in pieces if piece.valid.any()]
    return left_out_errors(pieces, fit) if pieces else None


def scene_gloss(
    frames: Observations, selection: Maps | None, lights: np.ndarray, settings: NormalsSettings
) -> SceneGloss | None:
    """Return gloss of the scene from a fixed sample of its pixels in a few bands; None where it is not asked for.

    The sample is the same for every machine and number of threads; it bounds the memory to that of one band.
    """
    if settings.refine == "none":
        return None
    from nishiki.model_selection.relighting import clearly_matt
    from nishiki.photometric.gloss_scene import fit_scene_gloss, thinned

    if settings.refine == "auto" and len(lights) > FEW_LIGHTS:
        return None
    tiles = [
        gloss_tile(piece.observations, piece.usable, piece.valid, piece.parcel, settings)
        for piece in sampled_pixels(frames, selection, lights, sample_bands(frames), SAMPLE_PIXELS)
    ]
    if not tiles:
        return None
    if settings.refine == "auto" and (fewer := thinned(tiles)):
        first = fit_scene_gloss(fewer, refractive_index=settings.refractive_index)
        if clearly_matt(first):
            return first
    return fit_scene_gloss(tiles, refractive_index=settings.refractive_index)


def sample_bands(frames: Observations, pixels: int | None = None) -> list[slice]:
    """Return bands of rows from which a sample is taken, evenly over the picture.

    pixels: size of the sample. Where it is given and the lamps are distant, the bands are thin and lie evenly over the
    rows of the object; together they hold about eight times as many pixels, so that little is read.
    """
    if pixels is None or frames.positions_mm is not None:
        bands = frames.bands()
        return [bands[i] for i in np.unique(np.linspace(0, len(bands) - 1, SAMPLE_BANDS).round().astype(int))]
    rows = np.flatnonzero(frames.mask.any(axis=1))
    if not rows.size:
        return []
    edges = np.unique(np.linspace(rows[0], rows[-1] + 1, SAMPLE_BANDS + 1).round().astype(int))
    height = -(-8 * pixels // (SAMPLE_BANDS * frames.shape[1]))
    starts = [max(a, (a + b - height) // 2) for a, b in pairwise(edges)]
    return [slice(int(a), int(min(a + height, b))) for a, b in zip(starts, edges[1:], strict=True)]


def sampled_pixels(
    frames: Observations, selection: Maps | None, lights: np.ndarray, bands: list[slice], pixels: int
) -> list[Sampled]:
    """About `pixels` pixels of the object from some bands: the same on every machine."""
    from nishiki.model_selection.relighting import Sampled

    step = max(1, sum(int(frames.mask[band].sum()) for band in bands) // pixels)
    pieces, seen, parcel_number = [], 0, 0
    for band in bands:
        observations, valid = frames.read(band, lights=lights)
        usable = valid if selection is None else unpack_lights(selection.read("usable", band), len(lights))
        inside = frames.mask[band]
        for parcel in parcels(frames, band, lights):
            area = np.s_[:, parcel.rows, parcel.columns]
            here = np.flatnonzero(inside[area[1:]])
            if inside[area[1:]].size < SMALL_PARCEL:  # lamps that stand near: whole parcels, or there are too many
                chosen = here if parcel_number % step == 0 else here[:0]
            else:
                chosen = here[(-seen) % step :: step]
            parcel_number, seen = parcel_number + 1, seen + here.size
            if chosen.size:
                pieces.append(Sampled(*(pick(array[area], chosen) for array in (observations, usable, valid)), parcel))
    return pieces


def pick(array: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Return pixels of an array (lights, rows, columns, ...) as (lights, 1, pixels, ...)."""
    return array.reshape(len(array), 1, -1, *array.shape[3:])[:, :, chosen]


def gloss_tile(observations, usable, valid, parcel: Parcel, settings: NormalsSettings) -> GlossTile:
    """Sampled pixels with their estimates from the selected lights."""
    from nishiki.photometric.gloss_scene import GlossTile

    maps = solve(observations, usable, valid, parcel, settings, None)
    return GlossTile(
        scaled(observations, parcel),
        valid,
        parcel.directions,
        maps["normals"],
        maps["flags"],
        maps["sigma"],
        maps["reflectance"],
    )
