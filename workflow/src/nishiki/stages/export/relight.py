"""Write relightable images in the format of relight and OpenLIME, fitted to the photographs."""

import itertools
import json
import math
import tempfile
from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.colour.colour import srgb_encode
from nishiki.formats.banded_pictures import (
    picture_on_disk,
    read_full_resolution,
    read_jpeg,
    write_deep_zoom,
    write_jpeg,
)
from nishiki.formats.legacy_rti import read_ptm, write_ptm
from nishiki.observations.plane import Observations
from nishiki.render.display import normals_as_colours
from nishiki.stages.export.light_models import (
    GRID_SIDE,
    GridModel,
    HarmonicModel,
    LightModel,
    PrincipalModel,
    TabulatedModel,
)
from nishiki.stages.export.registry import CodedErrors
from nishiki.stages.export.scene import CodedPhotographs, ExportedScene, GridPictures
from nishiki.threads import in_threads, over_items

PTM = "painting.ptm"
SAMPLES = 10_000
"""Number of evenly spread pixels for fitting components, ridge, width and the range of every plane."""
CHECKED = 1 << 20
"""Number of pixels for measuring the errors."""
ENDS = 0.05  # percent of the samples beyond each end of a plane's range
MARGIN = 0.05  # of that range, added at each end
OWN_RANGE = 0.5  # share of a plane's own range in its scale
LARGEST_SINGLE = 2048  # pixels of the longer side up to which a plane is one file
DecodedRows = tuple[slice, np.ndarray]
"""Rows, and codes (planes, rows, columns) of their coefficients."""


def write(context: Context, scene: ExportedScene) -> dict:
    """Write a folder `relight_KIND` for every kind; return their errors against photographs."""
    frames = Observations(context.inputs["ingest"].folder)
    settings = context.settings.relight
    hold_out = context.settings.hold_out
    fitted = frames.fit_lights(hold_out)
    photographs = CodedPhotographs(frames, scene)
    samples: dict[type, tuple[np.ndarray, np.ndarray]] = {}
    kinds = {}
    for kind in settings.kinds:
        folder = context.output.path(f"exports/relight_{kind}/info.json").parent
        seen = GridPictures(frames, scene, fitted) if kind == "bilinear" else photographs
        if type(seen) not in samples:
            samples[type(seen)] = seen.samples(fitted, SAMPLES)
        chosen = samples[type(seen)]
        model = model_of(kind, frames.directions[fitted], *chosen, planes=settings.planes)
        stored = StoredModel.of(model, frames.directions[fitted], *chosen)
        with tempfile.TemporaryDirectory(dir=context.output.folder) as scratch:
            stored.write(folder, Path(scratch), seen, fitted, context)
        errors = {kind: stored.errors(stored.decode_rows(folder, frames), photographs, hold_out)}
        if kind == "ptm" and settings.single_file:
            exact = StoredModel(model, np.full(model.planes, 255.0), np.zeros(model.planes))
            coefficients = read_ptm(folder / PTM)
            written = ((band, coefficients(band)) for band in frames.bands())
            rows = ((band, values.reshape(*values.shape[:2], -1).transpose(2, 0, 1)) for band, values in written)
            errors["ptm file"] = exact.errors(rows, photographs, hold_out)
        for name, psnr_db in errors.items():
            kinds[name] = {"planes": model.planes, "psnr_db": psnr_db}
        kinds[kind] |= {"width": getattr(model, "width", None), "ridge": getattr(model, "ridge", None)}
        write_layers(folder, scene, context)
    return {"kinds": kinds}


def model_of(kind: str, lights: np.ndarray, values: np.ndarray, valid: np.ndarray, *, planes: int) -> LightModel:
    """Fit the model of one kind for these lights to sample pixels (of bilinear: `GridPictures`)."""
    if kind == "bilinear":
        return GridModel.of(lights, values, valid, planes)
    if kind == "rbf":
        return PrincipalModel.of(lights, values, valid, planes)
    return HarmonicModel.of(kind, lights, values, valid)


class StoredModel:
    """A model whose coefficients are 8-bit planes: code / 255 = coefficient / scale + bias."""

    def __init__(self, model: LightModel, scale: np.ndarray, bias: np.ndarray):
        self.model, self.scale, self.bias = model, scale, bias
        self.layout = "image"

    @classmethod
    def of(cls, model: LightModel, lights: np.ndarray, values: np.ndarray, valid: np.ndarray) -> "StoredModel":
        """Compute the range of every plane from sample pixels, and its steps from its weight under lights (n, 3).

        A step of every plane would err alike in the pictures where its scale is the largest range in pictures,
        divided by the plane's root mean square weight under the lights; that costs fewest bytes for an error, but
        leaves slight planes few of 256 codes. The scale is half of that and half of the plane's own range.
        """
        low, high = np.percentile(model.fit(values, valid), [ENDS, 100 - ENDS], axis=1)
        span = np.maximum(high - low, 1e-6)
        weight = np.sqrt(np.mean([(model.transfer(light)[1] ** 2).sum(axis=1) for light in lights], axis=0))
        weight = np.maximum(weight, 1e-6)
        scale = (1 + 2 * MARGIN) * (OWN_RANGE * span + (1 - OWN_RANGE) * (span * weight).max() / weight)
        return cls(model, scale, -(low - MARGIN * span) / scale)

    def codes(self, coefficients: np.ndarray) -> np.ndarray:
        """Quantise coefficients to (planes, n) uint8."""
        values = coefficients / self.scale[:, None] + self.bias[:, None]
        return np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)

    def transfer(self, lights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute o (3 n, 1) and T (3 n, planes), float32: a viewer computes o + T codes under unit vectors (n, 3)."""
        transfers = [self.model.transfer(light) for light in lights]
        offsets = np.concatenate([offset for offset, _ in transfers])
        weights = np.concatenate([each.T for _, each in transfers])
        offsets = offsets - weights @ (self.bias * self.scale)
        return np.float32(offsets)[:, None], np.float32(weights * self.scale / 255)

    def write(
        self, folder: Path, scratch: Path, photographs: CodedPhotographs, lights: np.ndarray, context: Context
    ) -> None:
        """Write info.json and the planes, three to a picture."""
        frames, settings = photographs.frames, context.settings.relight
        rows, columns = frames.shape
        pictures = [picture_on_disk(scratch / f"plane_{n}", rows, columns) for n in range(self.model.planes // 3)]

        def fit(band: slice) -> None:
            for part, values, valid in photographs.strips(band, lights):
                codes = self.codes(self.model.fit(values, valid)).reshape(len(pictures), 3, -1, columns)
                for picture, each in zip(pictures, codes, strict=True):
                    picture[part] = each.transpose(1, 2, 0)

        def store(number: int) -> None:
            if self.layout == "image":
                write_jpeg(folder / f"plane_{number}.jpg", pictures[number], settings.jpeg_quality)
            else:
                write_deep_zoom(folder, f"plane_{number}", pictures[number], scratch, settings.jpeg_quality)

        over_items(fit, frames.bands())
        self.layout = "deepzoom" if max(rows, columns) > LARGEST_SINGLE else "image"
        over_items(store, range(len(pictures)))
        if self.model.kind == "ptm" and settings.single_file:
            write_ptm(folder / PTM, pictures, self.scale.reshape(-1, 3), self.bias.reshape(-1, 3))
        text = json.dumps(self.info(photographs.frames, lights, context), indent=1) + "\n"
        (folder / "info.json").write_text(text, encoding="utf-8")

    def info(self, frames: Observations, lights: np.ndarray, context: Context) -> dict:
        """Return the content of info.json."""
        rows, columns = frames.shape
        material = {"scale": self.scale.tolist(), "bias": self.bias.tolist()}
        content = {
            "width": columns,
            "height": rows,
            "format": "jpg",
            "type": self.model.kind,
            "colorspace": self.model.colour_space,
            "nplanes": self.model.planes,
            "quality": context.settings.relight.jpeg_quality,
            "lights": [round(float(value), 6) for value in frames.directions[lights].ravel()],
            "materials": [material],
            "nishiki": dict(context.stamp),
        }
        if frames.pixel_pitch_mm:
            content["pixelSizeInMM"] = frames.pixel_pitch_mm
        if isinstance(self.model, PrincipalModel):
            content["sigma"] = self.model.width
        if isinstance(self.model, GridModel):
            content["resolution"] = GRID_SIDE
        if isinstance(self.model, TabulatedModel):
            material["range"] = self.model.span.tolist()
            basis = np.concatenate([self.model.mean_code[None], self.model.codes])
            content["basis"] = basis.ravel().tolist()
        return content

    def decode_rows(self, folder: Path, frames: Observations) -> Iterator[DecodedRows]:
        """Yield some rows at a time, at most a band, of the files."""
        names = [f"plane_{number}" for number in range(self.model.planes // 3)]
        if self.layout == "image":
            bands = iter([[(slice(0, frames.shape[0]), read_jpeg(folder / f"{name}.jpg")) for name in names]])
        else:
            bands = zip(*(read_full_resolution(folder, name, *frames.shape) for name in names), strict=True)
        for parts in bands:
            start, stop = parts[0][0].start, parts[0][0].stop
            for top in range(start, stop, frames.band_rows):
                inner = slice(top - start, min(top + frames.band_rows, stop) - start)
                codes = np.concatenate([each[inner].transpose(2, 0, 1) for _, each in parts])
                yield slice(top, top + codes.shape[1]), codes

    def errors(
        self, decoded: Iterator[DecodedRows], photographs: CodedPhotographs, hold_out: Collection[str]
    ) -> dict[str, dict[str, float]]:
        """Compute the PSNR of viewers' pictures from decoded codes against the coded photographs, by group of lights.

        Of large pictures some rows of each part are compared, about CHECKED pixels in all.
        """
        frames = photographs.frames
        fitted, checked = frames.fit_lights(hold_out), frames.check_lights(hold_out)
        lights = np.concatenate([fitted, checked])
        offset, weights = self.transfer(frames.directions[lights])

        def compare(part: DecodedRows) -> list[CodedErrors]:
            count = max(round(part[1].shape[1] * min(CHECKED / math.prod(frames.shape), 1)), 1)
            rows, codes = slice(part[0].start, part[0].start + count), part[1][:, :count]
            found = []
            for strip, values, valid in photographs.strips(rows, lights):
                here = codes[:, strip.start - rows.start : strip.stop - rows.start]
                shown = weights @ here.reshape(len(codes), -1).astype(np.float32) + offset
                found.append(CodedErrors.compare_strip(shown.reshape(values.shape), values, valid))
            return found

        errors = CodedErrors(len(lights))
        for each in itertools.chain.from_iterable(in_threads(compare, decoded)):
            errors.include(each)
        groups = {"fitted": slice(0, len(fitted))} | ({"check": slice(len(fitted), None)} if len(checked) else {})
        return {group: errors.decibels(part) for group, part in groups.items()}


def write_layers(folder: Path, scene: ExportedScene, context: Context) -> None:
    """Write normals.jpg and albedo.jpg for viewers with layers, where one file suffices."""
    if max(scene.shape) > LARGEST_SINGLE:
        return
    everything = slice(0, scene.shape[0])
    quality = context.settings.relight.jpeg_quality
    coded = normals_as_colours(scene.normals(everything))
    write_jpeg(folder / "normals.jpg", (coded // 257).astype(np.uint8), quality)
    albedo = np.rint(255 * srgb_encode(scene.srgb(everything))).astype(np.uint8)
    write_jpeg(folder / "albedo.jpg", albedo, quality)
