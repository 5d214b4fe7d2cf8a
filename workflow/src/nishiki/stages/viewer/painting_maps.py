"""What the viewer of a painting is made from: maps by bands of rows, their codes, photographs.

A record of a pixel holds, in this order: known (1 or 0), normal (3), coefficients (K), terms of the body shading (0, 3
or 5), region.
"""

import json
import zlib
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.artifacts.maps import Maps, directional_shading, maps_with, shading_normals
from nishiki.brdf.scene import gloss_table
from nishiki.brdf.slopes import slope_covariance
from nishiki.brdf.torrance_sparrow import transmittance
from nishiki.colour.colour import srgb_matrix
from nishiki.evaluate.camera_colour import display_map, displayed_colours
from nishiki.evaluate.prediction import light_of, predict_light
from nishiki.observations.parcels import point_mm
from nishiki.observations.plane import Observations
from nishiki.photometric.flags import NO_ESTIMATE
from nishiki.progress import Progress
from nishiki.render.plane.scene import Gloss
from nishiki.render.plane.shade import PlaneMaps
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

SAMPLES = 60_000
"""Pixels, about, that the codes are fitted to."""
UNKNOWN_REGION = 255  # code
FULL_TURN = 48  # nodes of the mean over the half space


@dataclass(frozen=True)
class PaintingMaps:
    """The maps of a painting, read by bands of rows."""

    normals: Maps
    spectra: Maps | None
    brdf: Maps | None
    parameters: dict[str, Any] | None

    @classmethod
    def of(cls, inputs: dict[str, Artifact]) -> "PaintingMaps":
        """Return the maps of the upstream artifacts."""
        brdf = inputs.get("brdf")
        return cls(
            Maps(inputs["normals"].folder),
            Maps(inputs["spectra"].folder) if "spectra" in inputs else None,
            maps_with(brdf, "labels"),
            json.loads(brdf.path("parameters.json").read_text()) if brdf else None,
        )

    @cached_property
    def to_srgb(self) -> list[list[float]] | None:
        """The matrix of `display_map`, which is found over the whole painting."""
        return display_map(self.normals)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        rows, columns = self.normals.group["normals"].shape[:2]
        return rows, columns

    @property
    def basis(self) -> np.ndarray | None:
        """(K, 61) of the coefficients; None where they are channels of a camera."""
        return None if self.spectra is None else np.array(self.spectra.attributes("coefficients")["basis"])

    @property
    def terms(self) -> int:
        """Terms of the body shading: 0, 3 or 5."""
        return self.normals.group["shading"].shape[-1] if "shading" in self.normals else 0

    @property
    def casts_shadows(self) -> bool:
        """Whether the height casts shadows: not where the body shading holds them."""
        return not directional_shading(self.normals)

    def read(self, rows: slice) -> np.ndarray:
        """Return records (rows, columns, 1 + 3 + K + terms + 1) float32 of some rows; 0 where nothing is known."""
        normals = shading_normals(self.normals, rows)
        if self.spectra is None:
            colours = displayed_colours(self.normals.read("reflectance", rows), self.to_srgb)
        else:
            colours = self.spectra.read("coefficients", rows)
        known = (self.normals.read("flags", rows) & NO_ESTIMATE) == 0
        known &= np.isfinite(colours).all(axis=-1) & (np.abs((normals**2).sum(axis=-1) - 1) < 0.02)
        parts = [known[..., None], normals, colours]
        parts += [self.normals.read("shading", rows)] if self.terms else []
        values = np.concatenate(parts, axis=-1, dtype=np.float32)
        regions = self.brdf.read("labels", rows) if self.brdf else np.zeros(known.shape)
        values = np.where(known[..., None], values, 0)
        return np.concatenate([values, regions[..., None].astype(np.float32)], axis=-1)

    def sample(self, band_rows: int) -> np.ndarray:
        """Return (n, fields) records of known pixels, evenly spread."""
        rows, columns = self.shape
        step = max(1, round(np.sqrt(rows * columns / SAMPLES)))
        taken = []
        for first in range(0, rows, band_rows):
            start = -first % step
            band = self.read(slice(first, min(first + band_rows, rows)))
            taken.append(band[start::step, ::step].copy())  # a view would keep the band
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
        values = maps.sample(band_rows)
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

    def decode(self, planes: list[np.ndarray]) -> np.ndarray:
        """(rows, columns, 3 + K + terms) normals, coefficients and terms of planes of codes, without the region."""
        colours = 1 + len(self.colour.chroma.planes)
        parts = [self.normal.decode(planes[:2]), self.colour.decode(planes[2 : 2 + colours])]
        if self.shading:
            terms = self.shading.decode(planes[2 + colours :])
            parts.append(np.broadcast_to(terms, (*parts[0].shape[:-1], terms.shape[-1])))
        return np.concatenate(parts, axis=-1)

    def described(self) -> dict[str, Any]:
        """For the manifest."""
        return {
            "normal": self.normal.described(),
            "colour": self.colour.described(),
            "shading": self.shading.described() if self.shading else None,
        }


def gloss_of(maps: PaintingMaps) -> dict[str, Any]:
    """Describe every region's gloss for the manifest. entering: what the surface lets in of light from all sides."""
    if maps.parameters is None:
        return {"beta": [[]], "gamma": [[]], "refractive_index": [1.0], "transmission": [0.0], "entering": [1.0],
                "blurred": False}  # fmt: skip
    beta, gamma, index, transmission = gloss_table(maps.parameters)
    used = beta.max(axis=0) > 0
    nodes, weights = np.polynomial.legendre.leggauss(FULL_TURN)
    cosine = (nodes + 1) / 2
    mean = np.array([weights @ (cosine * transmittance(cosine, each)) for each in index])
    return {
        "beta": beta[:, used].tolist(),
        "gamma": gamma[:, used].tolist(),
        "refractive_index": index.tolist(),
        "transmission": transmission.tolist(),
        "entering": (1 - transmission * (1 - mean)).tolist(),
        "blurred": True,
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
    positions = frames.positions_mm
    centre = None if positions is None else point_mm(frames, (rows - 1) / 2, (columns - 1) / 2)
    predicted = np.stack([
        predict_light(
            model,
            light_of(frames.directions[j], None if positions is None else positions[j], centre=centre,
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


def sampled_model(maps: PaintingMaps, frames: Observations, first: list[int], step: int) -> PlaneMaps:
    """Return the maps of the fit at the samples; slopes inside a pixel from its neighbours at full resolution."""
    gloss = Gloss.none() if maps.parameters is None else Gloss(*gloss_table(maps.parameters))
    parts: dict[str, list[np.ndarray]] = {"normals": [], "coefficients": [], "labels": [], "shading": [], "slopes": []}
    for band in frames.bands():
        chosen = slice((first[0] - band.start) % step, None, step)
        if band.start + chosen.start >= band.stop:
            continue

        def sampled(values: np.ndarray, chosen: slice = chosen) -> np.ndarray:
            return np.ascontiguousarray(values[chosen, first[1] :: step])

        parts["normals"].append(sampled(shading_normals(maps.normals, band)))
        parts["coefficients"].append(sampled(maps.normals.read("reflectance", band)))
        if maps.brdf:
            parts["labels"].append(sampled(maps.brdf.read("labels", band)))
        if maps.terms:
            parts["shading"].append(sampled(maps.normals.read("shading", band)))
        if maps.parameters is not None:
            wider = slice(max(band.start - 1, 0), min(band.stop + 1, frames.shape[0]))
            slopes = slope_covariance(shading_normals(maps.normals, wider))
            parts["slopes"].append(sampled(slopes[band.start - wider.start :][: band.stop - band.start]))
    joined: dict[str, Any] = {name: np.concatenate(values) if values else None for name, values in parts.items()}
    return PlaneMaps(gloss=gloss, **joined)
