"""What the photographs show at samples of a painting, beside what its fitted model predicts there."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np

from nishiki.artifacts.maps import shading_normals
from nishiki.brdf.parameters import gloss_table, is_facets
from nishiki.brdf.slopes import slope_covariance
from nishiki.evaluate.prediction import FittedModel, light_of, predict_light
from nishiki.observations.parcels import point_mm
from nishiki.observations.plane import Observations
from nishiki.progress import Progress
from nishiki.render.plane.scene import Gloss
from nishiki.report.viewer.page import Blocks
from nishiki.stages.viewer.painting import PaintingMaps

MOST_CODES = 2_000_000
"""Bytes before compression; they decide how far the samples are apart."""
TOP, NOTHING = 254, 255
"""Largest code, and that of a photograph that cannot be used there."""


def photographs_of(maps: PaintingMaps, frames: Observations, blocks: Blocks, progress: Progress) -> dict[str, Any]:
    """Write photographs and predictions at every `step`-th pixel; what the page has to know of them.

    Values are means over the channels, relative to a white that faces the lamp. The block holds uint8 (2, lights,
    rows, columns), photographs first: values relative to `white` are (code / 254)^2. Predictions are those of the stage
    evaluate without cast shadows: Tominaga and Tanaka (2004), eq. 10, with the terms of the body shading.
    """
    count, (rows, columns) = len(frames.lights), frames.shape
    step = int(np.ceil(np.sqrt(2 * count * rows * columns / MOST_CODES)))
    first = [(size - 1) % step // 2 for size in frames.shape]  # the samples lie around the middle, as the lamps' origin
    observed = []
    for band in progress.over(frames.bands(), "photographs"):
        for strip, values, valid in frames.strips(band, lights=np.arange(count), channel="mean"):
            chosen = (slice(None), slice((first[0] - strip.start) % step, None, step), slice(first[1], None, step))
            observed.append(np.where(valid[chosen], values[chosen], np.nan))
    photographs = np.concatenate(observed, axis=1)
    model = sampled_model(maps, frames, first, step)
    pitch = (frames.pixel_pitch_mm or 1.0) * step
    centre = point_mm(frames, (rows - 1) / 2, (columns - 1) / 2) if frames.positions_mm is not None else None
    predicted = np.stack([
        predict_light(
            model,
            light_of(frames.directions[j], None if centre is None else frames.positions_mm[j], centre=centre,
                     white_board=frames.white_board),
            pitch=pitch,
        ).channels.mean(axis=-1)
        for j in range(count)
    ])  # fmt: skip
    pair = np.stack([photographs, predicted])
    white = float(max(np.nan_to_num(pair).max(), 1e-6))
    codes = np.rint(np.sqrt(np.clip(np.nan_to_num(pair), 0, None) / white) * TOP)
    codes = np.where(np.isfinite(pair), codes, NOTHING).astype(np.uint8)
    blocks.add("photographs", zlib.compress(codes.tobytes(), 9))
    return {
        "block": "photographs",
        "rows": codes.shape[2],
        "columns": codes.shape[3],
        "first": first,
        "step": step,
        "lights": list(frames.lights),
        "white": white,
        "top": TOP,
        "nothing": NOTHING,
    }


def sampled_model(maps: PaintingMaps, frames: Observations, first: list[int], step: int) -> FittedModel:
    """The maps of the fit at the samples; slopes inside a pixel from its neighbours at full resolution."""
    gloss = Gloss.none() if maps.parameters is None else Gloss(*gloss_table(maps.parameters))
    facets = maps.parameters is not None and is_facets(maps.parameters)
    parts: dict[str, list[np.ndarray]] = {"normals": [], "reflectance": [], "labels": [], "shading": [], "slopes": []}
    for band in frames.bands():
        chosen = slice((first[0] - band.start) % step, None, step)
        if band.start + chosen.start >= band.stop:
            continue

        def sampled(values: np.ndarray, chosen: slice = chosen) -> np.ndarray:
            return np.ascontiguousarray(values[chosen, first[1] :: step])

        parts["normals"].append(sampled(shading_normals(maps.normals, band)))
        parts["reflectance"].append(sampled(maps.normals.read("reflectance", band)))
        if maps.brdf:
            parts["labels"].append(sampled(maps.brdf.read("labels", band)))
        if maps.terms:
            parts["shading"].append(sampled(maps.normals.read("shading", band)))
        if facets:
            wider = slice(max(band.start - 1, 0), min(band.stop + 1, frames.shape[0]))
            slopes = slope_covariance(shading_normals(maps.normals, wider))
            parts["slopes"].append(sampled(slopes[band.start - wider.start :][: band.stop - band.start]))
    joined = {name: np.concatenate(values) if values else None for name, values in parts.items()}
    return FittedModel(gloss=gloss, **joined)
