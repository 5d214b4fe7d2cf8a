"""What a fixed sample of the scene decides: its gloss, whether the joint fit is made, which model predicts lamps."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from nishiki.artifacts.maps import Maps
from nishiki.model_selection.decision import Decision
from nishiki.observations.parcels import Parcel, parcels
from nishiki.observations.plane import Observations
from nishiki.photometric.light_selection import unpack_lights
from nishiki.photometric.relighting import MODELS
from nishiki.stages.normals import NormalsSettings
from nishiki.stages.normals.parcel import relit, scaled, solve

if TYPE_CHECKING:
    from nishiki.brdf.gloss_profile import GlossProfile
    from nishiki.model_selection.relighting import Fitted, Sampled
    from nishiki.photometric.gloss_scene import GlossTile, SceneGloss

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
    """Gloss of the joint fit, or None; the model of relighting, or None where there is none; what was decided.

    Captured lamps that are left out in turn decide, on a sample of the pixels, where the settings leave it open.
    """
    models = () if settings.solver == "least_squares" else MODELS
    profile = gloss.profile if gloss is not None and gloss.significant else None
    errors, refinement = None, None
    if settings.refine != "gloss" and (profile is not None or (models and settings.relighting == "auto")):
        errors = prediction_errors(frames, selection, lights, profile, models, settings)
    if gloss is not None:
        from nishiki.model_selection.refinement import decided

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
    """Gloss of the scene from a fixed sample of its pixels in a few bands; None where it is not asked for.

    The sample is the same for every machine and number of threads; it bounds the memory to that of one band.
    """
    if settings.refine == "none":
        return None
    from nishiki.model_selection.refinement import clearly_matt
    from nishiki.photometric.gloss_scene import FEW_LIGHTS, fit_scene_gloss, thinned

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
    """Bands of rows from which a sample is taken, evenly over the picture.

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
        usable = read_usable(selection, band, len(lights), valid)
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
    """Pixels of an array (lights, rows, columns, ...) as (lights, 1, pixels, ...)."""
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


def read_usable(selection: Maps | None, band: slice, lights: int, valid: np.ndarray) -> np.ndarray:
    """Samples (lights, rows, columns) that separate chose; all valid ones where it was left out."""
    if selection is None:
        return valid
    return unpack_lights(selection.read("usable", band), lights)
