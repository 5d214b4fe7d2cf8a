"""What the viewer of a painting is made from: maps by bands of rows, their codes, photographs.

A record of a pixel holds, in this order: known (1 or 0), normal (3), coefficients (K), terms of the body shading (0, 3
or 5), region.
"""

import zlib
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

import numpy as np

from nishiki.colour.colour import srgb_matrix
from nishiki.evaluate.prediction import predict_light
from nishiki.observations.plane import Observations
from nishiki.progress import Progress
from nishiki.render.plane.shade import PlaneMaps, entering
from nishiki.report.viewer.encoding import (
    ColourCode,
    NormalCode,
    PrincipalCode,
    Steps,
    colour_matrices,
    shading_features,
)
from nishiki.report.viewer.page import Blocks
from nishiki.report.viewer.pyramid import filled
from nishiki.stages.painting_maps import PaintingMaps, captured_lamp, each_map
from nishiki.threads import strips

SAMPLES = 60_000
"""Pixels, about, that the codes are fitted to."""
UNKNOWN_REGION = 255  # code


def read_records(maps: PaintingMaps, rows: slice) -> np.ndarray:
    """Return records (rows, columns, 1 + 3 + K + terms + 1) float32 of some rows; 0 where nothing is known."""
    normals, colours = maps.shading_normals(rows), maps.display_colours(rows)
    known = np.isfinite(colours).all(axis=-1) & (np.abs((normals**2).sum(axis=-1) - 1) < 0.02)
    shading, regions = maps.shading(rows), maps.regions(rows)
    parts = [known[..., None], normals, colours, *([] if shading is None else [shading])]
    values = np.where(known[..., None], np.concatenate(parts, axis=-1, dtype=np.float32), 0)
    regions = np.zeros(known.shape) if regions is None else regions
    return np.concatenate([values, regions[..., None].astype(np.float32)], axis=-1)


def sample_records(maps: PaintingMaps, band_rows: int) -> np.ndarray:
    """Return (n, fields) records of known pixels, evenly spread."""
    rows, columns = maps.shape
    step = max(1, round(np.sqrt(rows * columns / SAMPLES)))
    taken = []
    for band in strips(rows, band_rows):
        taken.append(read_records(maps, band)[-band.start % step :: step, ::step].copy())  # a view would keep the band
    values = np.concatenate(taken).reshape(-1, taken[0].shape[-1])
    return values[values[:, 0] > 0]


@dataclass(frozen=True)
class PaintingCode:
    """Codes of the planes of a painting, in the order in which a tile holds them: normal, colour, body shading."""

    normal: NormalCode
    colour: ColourCode
    shading: PrincipalCode | None
    channels: int

    @classmethod
    def of(cls, maps: PaintingMaps, band_rows: int, steps: Steps) -> "PaintingCode":
        """Fit to a sample of the maps."""
        values = sample_records(maps, band_rows)
        channels = values.shape[1] - 5 - maps.terms
        matrices = colour_matrices(maps.basis, np.linalg.inv(srgb_matrix()))
        shading = None
        if maps.terms:
            terms = values[:, 4 + channels : -1]
            # backwards, because a picture of the last planes of colour and the smallest of shading takes fewer bytes
            shading = PrincipalCode.of(terms, shading_features(maps.terms), steps.shading).backwards()
        return cls(
            NormalCode.of(values[:, 1:4], steps.tilt),
            ColourCode.of(values[:, 4 : 4 + channels], matrices, maps.basis, steps.colour),
            shading,
            channels,
        )

    def encode(self, values: np.ndarray) -> list[np.ndarray]:
        """Return planes of codes (rows, columns) uint8; the last is the region of a pixel, or `UNKNOWN_REGION`.

        values : (rows, columns, fields) float32, records or means of them.
        """
        known = values[..., 0] >= 0.5
        content = filled(values[..., 1:-1], values[..., 0] > 0)
        normals = content[..., :3]
        length = np.sqrt((normals**2).sum(axis=-1, keepdims=True))
        normals = np.where(length > 1e-3, normals / np.maximum(length, 1e-3), np.array([0, 0, 1], np.float32))
        planes = self.normal.encode(normals) + self.colour.encode(content[..., 3 : 3 + self.channels])
        planes += self.shading.encode(content[..., 3 + self.channels :]) if self.shading else []
        return [*planes, np.where(known, values[..., -1], UNKNOWN_REGION).astype(np.uint8)]

    def described(self) -> dict[str, Any]:
        """For the manifest."""
        return {
            "normal": self.normal.described(),
            "colour": self.colour.described(),
            "shading": self.shading.described() if self.shading else None,
        }


def gloss_of(maps: PaintingMaps) -> dict[str, Any]:
    """Describe every region's gloss for the manifest. entering: what the surface lets in of light from all sides."""
    gloss = maps.gloss
    used = gloss.beta.max(axis=0) > 0
    return {
        "beta": gloss.beta[:, used].tolist(),
        "gamma": gloss.gamma[:, used].tolist(),
        "refractive_index": gloss.refractive_index.tolist(),
        "transmission": np.asarray(gloss.transmission).tolist(),
        "entering": entering(gloss).tolist(),
        "blurred": maps.glossy,
    }


MOST_CODES = 2_000_000
"""Bytes before compression; they decide how far the samples are apart."""
TOP, NOTHING = 254, 255
"""Largest code, and that of a photograph that cannot be used there."""


def photographs_of(
    maps: PaintingMaps, frames: Observations, blocks: Blocks, progress: Progress
) -> dict[str, Any] | None:
    """Write photographs and predictions at every `step`-th pixel; what the page has to know of them, None without any.

    Values are means over the channels, relative to a white that faces the lamp. The block holds uint8 (2, lights,
    rows, columns), photographs first: values relative to `white` are (code / 254)^2. Predictions are those of the stage
    evaluate without cast shadows: Tominaga and Tanaka (2004), eq. 10, with the terms of the body shading.
    """
    count, (rows, columns) = len(frames.lights), frames.shape
    if not count:  # the maps of a mosaic
        return None
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
    lamps = (captured_lamp(frames, j) for j in range(count))
    predicted = np.stack([predict_light(model, lamp, pitch=pitch).channels.mean(axis=-1) for lamp in lamps])
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


def sampled_model(maps: PaintingMaps, frames: Observations, first: list[int], step: int) -> PlaneMaps:
    """Return the maps of the fit at the samples; slopes inside a pixel from its neighbours at full resolution."""
    parts = []
    for band in frames.bands():
        start = (first[0] - band.start) % step
        if band.start + start < band.stop:
            chosen = slice(start, None, step), slice(first[1], None, step)
            parts.append(each_map(maps.model(band), itemgetter(chosen)))
    joined: dict[str, Any] = {
        name: None if values[0] is None else np.concatenate(values)
        for name, *values in zip(PlaneMaps._fields, *parts, strict=True)
        if name != "gloss"
    }
    return PlaneMaps(gloss=maps.gloss, **joined)
