"""Write a page that displays a painting under moving lamps, its data beside it or inside it.

A record of a pixel holds, in this order: known (1 or 0), normal (3), coefficients (K), terms of the body shading (0, 3
or 5), region.
"""

import zlib
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.artifacts.maps import Maps, shrink
from nishiki.artifacts.stage import Context
from nishiki.colour.colour import cie_1931_cmfs, srgb_matrix
from nishiki.colour.colour import illuminant as cie_illuminant
from nishiki.colour.sampling import WAVELENGTHS_NM
from nishiki.formats.stored import load_arrays
from nishiki.observations.plane import Observations
from nishiki.progress import Progress
from nishiki.render.plane.shade import PlaneMaps, entering
from nishiki.report.viewer import encoding
from nishiki.report.viewer.page import Blocks, webp, webp_stack, write_page
from nishiki.report.viewer.pyramid import BORDER, TILE, Pyramid, fill_unknown, height_block
from nishiki.stages.painting_maps import PaintingMaps, captured_lamp, each_map, predict_light
from nishiki.threads import strips

PAGE = Path(__file__).with_suffix(".js")
ILLUMINANTS = ("D65", "D50", "A", "E", "F2", "F7", "F11", "LED-B1", "LED-B3", "LED-B5")
BAND_PIXELS = 1 << 20  # in memory
FINE, COARSE, FINE_PIXELS = encoding.Steps(0.35, 0.00116, 0.0046), encoding.Steps(0.95, 0.011, 0.019), 2_000_000
"""Steps of the codes, and largest map for the finer ones. With the coarse ones each kind of code
costs about the same difference of the picture for a bit; the steps of tilts are below the noise of the normals of
photographs of that size."""
RELIEFS = ((1_200_000, 0.002), (16_000_000, 0.03))
"""Sizes above which the heights that cast the shadows are averaged, and steps of their codes, in pixels. A sweep over
the first takes about a tenth of a second, so that its shadows follow a lamp that is dragged; those of the second come
when the lamp rests. Neighbours that differ by a step of 0.03 make a horizon of 1.7 degrees."""


def run(context: Context) -> dict:
    """Write tiles, heights and layers, then the page around them."""
    maps = PaintingMaps(context.inputs)
    rows, columns = maps.shape
    blocks = Blocks(context.output, inline_bytes=int(context.settings.inline_mb * 1e6))
    steps, step = FINE if rows * columns <= FINE_PIXELS else COARSE, context.settings.step
    band_rows = max(4, min(256, BAND_PIXELS // columns // 4 * 4))
    code = PaintingCode.of(maps, band_rows, steps if step == "auto" else steps.scale(step))

    regions: set[bool] = set()

    def write(level: int, row: int, column: int, values: np.ndarray) -> None:
        planes = code.encode(values)
        regions.add(bool(planes[-1].any()))
        blocks.add(f"tile-{level}-{row}-{column}", webp_stack(planes))

    pyramid = Pyramid(rows, columns, read_records(maps, slice(0, 1)).shape[-1], write)
    for band in context.progress.over(list(strips(rows, band_rows)), "band"):
        pyramid.push(read_records(maps, band))
    shadows = []
    if maps.heights and maps.casts_shadows:
        smaller = [most for most, _ in RELIEFS if most < rows * columns]
        for number, (most, step) in enumerate(RELIEFS[: len(smaller) + 1]):
            block, described = height_block(maps.height, (rows, columns), maps.pitch, most, step)
            blocks.add(f"height-{number}", block)
            shadows.append({"block": f"height-{number}", **described})
    manifest = {
        "format": 1,
        "chain": "painting",
        **context.stamp,
        "title": context.inputs["ingest"].diagnostics["capture"]["title"],
        "rows": rows,
        "columns": columns,
        "pitch_mm": maps.pitch_mm,
        "wavelengths_nm": WAVELENGTHS_NM.tolist(),
        "basis": None if maps.basis is None else maps.basis.tolist(),
        "cmf": cie_1931_cmfs().T.tolist(),
        "illuminants": illuminants(context.inputs["ingest"]),
        "gloss": gloss_of(maps),
        "code": code.describe(),
        "tiles": {
            "size": TILE,
            "border": BORDER,
            "levels": [{"rows": shape[0], "columns": shape[1], "factor": factor} for factor, shape in pyramid.levels()],
            "regions": True in regions,
            "unknown": UNKNOWN,
        },
        "shadows": shadows,
        "layers": layers_of(context.inputs, blocks),
        "photographs": photographs_of(maps, Observations(context.inputs["ingest"].folder), blocks, context.progress),
    }
    return write_page(blocks, manifest, PAGE)


def illuminants(ingest: Artifact) -> dict[str, dict[str, list[float]]]:
    """Return the selectable spectra, {name: {nm, power}}; `capture`: that of the lamp, where the capture states it."""
    powers = {name: cie_illuminant(name) for name in ILLUMINANTS}
    path = ingest.path("curves.npz")
    curves = load_arrays(path) if path.is_file() else {}
    if "illuminant" in curves:
        powers["capture"] = curves["illuminant"]
    return {name: {"nm": WAVELENGTHS_NM.tolist(), "power": power.tolist()} for name, power in powers.items()}


MOST_PIXELS = 1_000_000  # of a map of errors
LARGEST, UNKNOWN = 254, 255
"""Largest code of values, and that of an unknown one, of a photograph that cannot be used, and of no region."""
FARTHEST = 99.5  # percentile of a measured map that its colours reach to


def layers_of(inputs: dict[str, Artifact], blocks: Blocks) -> list[dict[str, Any]]:
    """Write the available maps; return the page's data on each. Normals come with the appearance."""
    layers = [
        {"name": "appearance", "label_key": "layer.appearance", "unit": "", "range": [0, 1], "map": "grey"},
        {"name": "normals", "label_key": "layer.normals", "unit": "", "range": [-1, 1], "map": "normal"},
    ]
    maps = {name: Maps(each.folder) for name, each in inputs.items() if each.path("maps.zarr").is_dir()}
    normals = maps["normals"]
    sources = [
        ("height", maps["height"].attributes("height")["unit"] if "height" in maps else "", "height", "height", 1.0),
        ("sigma", "°", "normals", "sigma", np.degrees(1.0)),
        ("residual", "", "normals", "residual", 1.0),
        ("sigma_spectrum", "", "spectra", "sigma", 1.0),
    ]
    for name, unit, stage, key, factor in sources:
        if stage in maps:
            layers.append(_quantise_map(name, unit, factor * _reduce_map(maps[stage], key), blocks))
    if "evaluate" in maps:
        difference = _mean_difference(maps["evaluate"], len(inputs["ingest"].diagnostics.get("lights", ())))
        if difference is not None:
            layers.append(_quantise_map("delta_e", "CIEDE2000", difference, blocks))
    layers.append(_sample_counts("lights_used", "lights", "grey", normals, blocks))
    if any(count for name, count in inputs["normals"].diagnostics.items() if name.startswith("flagged_")):
        layers.append(_sample_counts("flags", "", "flags", normals, blocks))
    return layers


def _reduce_map(maps: Maps, key: str, how: Literal["mean", "middle"] = "mean") -> np.ndarray:
    """Reduce a map over blocks to at most `MOST_PIXELS`; a mean is NaN where nothing is known."""
    shape = maps.group[key].shape[:2]
    block = int(np.ceil(np.sqrt(shape[0] * shape[1] / MOST_PIXELS)))
    return shrink(lambda rows: maps.read(key, rows), shape, block, how)


def _mean_difference(maps: Maps, lights: int) -> np.ndarray | None:
    """Compute the mean colour difference over the held-out lights, NaN where none was compared."""
    parts = [_reduce_map(maps, name) for name in (f"de00_{light:03d}" for light in range(lights)) if name in maps]
    if not parts:
        return None
    count = np.isfinite(parts).sum(axis=0)
    return np.where(count > 0, np.nansum(parts, axis=0) / np.maximum(count, 1), np.nan)


def _quantise_map(name: str, unit: str, values: np.ndarray, blocks: Blocks) -> dict[str, Any]:
    """Quantise values within their range; those beyond its ends take its ends."""
    known = np.isfinite(values)
    low, high = np.percentile(values[known], (100 - FARTHEST, FARTHEST)) if known.any() else (0.0, 1.0)
    low, high = float(low), float(max(high, low + 1e-9))
    codes = np.clip(np.rint((np.nan_to_num(values) - low) * (LARGEST / (high - low))), 0, LARGEST)
    return _written(name, unit, "grey", np.where(known, codes, UNKNOWN).astype(np.uint8), (low, high), blocks)


def _sample_counts(name: str, unit: str, colours: str, maps: Maps, blocks: Blocks) -> dict[str, Any]:
    """Return whole numbers, the pixel in the middle of every block."""
    values = _reduce_map(maps, name, "middle")
    high = LARGEST if colours == "flags" else max(int(values.max()), 1)
    top = max(high, LARGEST)  # more than 254 lights share codes
    codes = np.rint(np.minimum(values, top) * (LARGEST / top)).astype(np.uint8)
    return {**_written(name, unit, colours, codes, (0, top), blocks), "range": [0, high]}


def _written(
    name: str, unit: str, colours: str, codes: np.ndarray, ends: tuple[float, float], blocks: Blocks
) -> dict[str, Any]:
    blocks.add(f"layer-{name}", webp([codes] * 3))
    return {
        "name": name,
        "label_key": f"layer.{name}",
        "unit": unit,
        "range": list(ends),
        "map": colours,
        "block": f"layer-{name}",
        "code": {"low": ends[0], "high": ends[1], "top": LARGEST, "nothing": UNKNOWN},
        "rows": codes.shape[0],
        "columns": codes.shape[1],
    }


SAMPLES = 60_000
"""Approximate number of pixels for fitting the codes."""


def read_records(maps: PaintingMaps, rows: slice) -> np.ndarray:
    """Return records (rows, columns, 1 + 3 + K + terms + 1) float32 of some rows; 0 where nothing is known."""
    normals, colours = maps.shading_normals(rows), maps.display_colours(rows)
    known = np.isfinite(colours).all(axis=-1) & (np.abs((normals**2).sum(axis=-1) - 1) < 0.02)
    shading, regions = maps.shading(rows), maps.regions(rows)
    parts = [known[..., None], normals, colours, *([] if shading is None else [shading])]
    values = np.where(known[..., None], np.concatenate(parts, axis=-1, dtype=np.float32), 0)
    regions = np.zeros(known.shape) if regions is None else regions
    return np.concatenate([values, regions[..., None].astype(np.float32)], axis=-1)


@dataclass(frozen=True)
class PaintingCode:
    """Codes of the planes of a painting, in the order in which a tile holds them: normal, colour, body shading."""

    normal: encoding.NormalCode
    colour: encoding.ColourCode
    shading: encoding.PrincipalCode | None
    channels: int

    @classmethod
    def of(cls, maps: PaintingMaps, band_rows: int, steps: encoding.Steps) -> "PaintingCode":
        """Fit the codes to a sample of the maps."""
        rows, columns = maps.shape
        step = max(1, round(np.sqrt(rows * columns / SAMPLES)))
        taken = []
        for band in strips(rows, band_rows):
            # a copy, as a view would keep the band
            taken.append(read_records(maps, band)[-band.start % step :: step, ::step].copy())
        values = np.concatenate(taken).reshape(-1, taken[0].shape[-1])
        values = values[values[:, 0] > 0]
        channels = values.shape[1] - 5 - maps.terms
        matrices = encoding.colour_matrices(maps.basis, np.linalg.inv(srgb_matrix()))
        shading = None
        if maps.terms:
            terms = values[:, 4 + channels : -1]
            # backwards, because a picture of the last planes of colour and the smallest of shading takes fewer bytes
            shading = encoding.PrincipalCode.of(terms, encoding.shading_features(maps.terms), steps.shading).backwards()
        return cls(
            encoding.NormalCode.of(values[:, 1:4], steps.tilt),
            encoding.ColourCode.of(values[:, 4 : 4 + channels], matrices, maps.basis, steps.colour),
            shading,
            channels,
        )

    def encode(self, values: np.ndarray) -> list[np.ndarray]:
        """Return planes of codes (rows, columns) uint8; the last is the region of a pixel, or `UNKNOWN`.

        values : (rows, columns, fields) float32, records or means of them.
        """
        known = values[..., 0] >= 0.5
        content = fill_unknown(values[..., 1:-1], values[..., 0] > 0)
        normals = content[..., :3]
        length = np.sqrt((normals**2).sum(axis=-1, keepdims=True))
        normals = np.where(length > 1e-3, normals / np.maximum(length, 1e-3), np.array([0, 0, 1], np.float32))
        planes = self.normal.encode(normals) + self.colour.encode(content[..., 3 : 3 + self.channels])
        planes += self.shading.encode(content[..., 3 + self.channels :]) if self.shading else []
        return [*planes, np.where(known, values[..., -1], UNKNOWN).astype(np.uint8)]

    def describe(self) -> dict[str, Any]:
        """Return the parameters for the manifest."""
        return {
            "normal": self.normal.describe(),
            "colour": self.colour.describe(),
            "shading": self.shading.describe() if self.shading else None,
        }


def gloss_of(maps: PaintingMaps) -> dict[str, Any]:
    """Describe every region's gloss for the manifest. entering: share of ambient light that enters the surface."""
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
"""Bytes before compression, which determine the distance of the samples."""


def photographs_of(
    maps: PaintingMaps, frames: Observations, blocks: Blocks, progress: Progress
) -> dict[str, Any] | None:
    """Write photographs and predictions at every `step`-th pixel; return the page's data on them, None without any.

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
    codes = np.rint(np.sqrt(np.clip(np.nan_to_num(pair), 0, None) / white) * LARGEST)
    codes = np.where(np.isfinite(pair), codes, UNKNOWN).astype(np.uint8)
    blocks.add("photographs", zlib.compress(codes.tobytes(), 9))
    return {
        "block": "photographs",
        "rows": codes.shape[2],
        "columns": codes.shape[3],
        "first": first,
        "step": step,
        "lights": list(frames.lights),
        "white": white,
        "top": LARGEST,
        "nothing": UNKNOWN,
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
