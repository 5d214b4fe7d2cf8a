"""Relightable images as relight writes them and OpenLIME shows them, fitted to the photographs."""

import json
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.colour.colour import srgb_encode
from nishiki.formats.picture_tiles import (
    picture_on_disk,
    read_full_resolution,
    read_jpeg,
    write_deep_zoom,
    write_jpeg,
)
from nishiki.formats.ptm import read_ptm, write_ptm
from nishiki.observations.plane import Observations
from nishiki.render.display import normals_as_colours
from nishiki.stages.export.grid_pictures import GridPictures
from nishiki.stages.export.light_models import (
    GRID_SIDE,
    GridModel,
    HarmonicModel,
    LightModel,
    OpenLimeModel,
    PrincipalModel,
    TabulatedModel,
)
from nishiki.stages.export.photographs import CodedErrors, Photographs
from nishiki.stages.export.scene import ExportedScene

PTM = "painting.ptm"
SAMPLES = 10_000
"""Pixels from which components, ridge, width and the range of every plane are taken, evenly spread."""
ENDS = 0.05  # percent of the samples beyond each end of a plane's range
MARGIN = 0.05  # of that range, added at each end
OWN_RANGE = 0.5  # share of a plane's own range in its scale
LARGEST_SINGLE = 2048  # pixels of the longer side up to which a plane is one file
DecodedRows = tuple[slice, Callable[[slice], np.ndarray]]
"""Rows, and a function from some of them to their coefficients (rows, columns, planes), which are large."""


def write(context: Context, scene: ExportedScene) -> dict:
    """A folder `relight_KIND` for every kind; their errors against photographs."""
    frames = Observations(context.inputs["ingest"].folder)
    fitted = frames.fit_lights(context.settings.hold_out)
    checked = frames.check_lights(context.settings.hold_out)
    photographs = Photographs(frames, scene)
    samples = photographs.samples(fitted, SAMPLES)
    kinds, files = {}, []
    for kind in context.settings.relight.kinds:
        folder = context.output.path(f"exports/relight_{kind}/info.json").parent
        seen = GridPictures(frames, scene, fitted) if kind == "bilinear" else photographs
        chosen = samples if seen is photographs else seen.samples(fitted, SAMPLES)
        model = model_of(kind, frames.directions[fitted], *chosen, planes=context.settings.relight.planes)
        stored = StoredModel.of(model, frames.directions[fitted], *chosen)
        with tempfile.TemporaryDirectory(dir=context.output.folder) as scratch:
            stored.write(folder, Path(scratch), seen, fitted, context)
        groups = {name: lights for name, lights in (("fitted", fitted), ("check", checked)) if len(lights)}
        kinds[kind] = {
            "planes": model.planes,
            "width": getattr(model, "width", None),
            "ridge": getattr(model, "ridge", None),
            "psnr_db": {name: stored.errors(folder, photographs, lights) for name, lights in groups.items()},
        }
        if kind == "ptm":
            errors = {name: stored.file_errors(folder, photographs, lights) for name, lights in groups.items()}
            kinds["ptm file"] = {"planes": model.planes, "psnr_db": errors}
        if isinstance(model, PrincipalModel):
            there = stored.shown_by(OpenLimeModel.like(model))
            errors = {name: there.errors(folder, photographs, lights) for name, lights in groups.items()}
            kinds["rbf in OpenLIME 1.2"] = {"planes": model.planes, "psnr_db": errors}
        write_layers(folder, scene, context)
        files += sorted(
            path.relative_to(context.output.folder).as_posix() for path in folder.rglob("*") if path.is_file()
        )
    return {"files": files, "kinds": kinds}


def model_of(kind: str, lights: np.ndarray, values: np.ndarray, valid: np.ndarray, *, planes: int) -> LightModel:
    """The model of one kind for these lights, with what it takes from sample pixels (of bilinear: `GridPictures`)."""
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
        """With the range of every plane from sample pixels, and its steps from what it counts under lights (n, 3).

        A step of every plane would err alike in the pictures where its scale is the largest range in pictures,
        divided by the plane's root mean square weight under the lights; that costs fewest bytes for an error, but
        leaves slight planes few of 256 codes. The scale is half of that and half of the plane's own range.
        """
        low, high = np.percentile(model.fit(values, valid), [ENDS, 100 - ENDS], axis=0)
        span = np.maximum(high - low, 1e-6)
        weight = np.sqrt(np.mean([(model.transfer(light)[1] ** 2).sum(axis=1) for light in lights], axis=0))
        weight = np.maximum(weight, 1e-6)
        scale = (1 + 2 * MARGIN) * (OWN_RANGE * span + (1 - OWN_RANGE) * (span * weight).max() / weight)
        return cls(model, scale, -(low - MARGIN * span) / scale)

    def codes(self, coefficients: np.ndarray) -> np.ndarray:
        """(n, planes) uint8 of coefficients."""
        return np.rint(255 * np.clip(coefficients / self.scale + self.bias, 0, 1)).astype(np.uint8)

    def coefficients(self, codes: np.ndarray) -> np.ndarray:
        """Of codes, as viewers compute them."""
        return (codes / 255 - self.bias) * self.scale

    def write(
        self, folder: Path, scratch: Path, photographs: Photographs, lights: np.ndarray, context: Context
    ) -> None:
        """info.json and the planes, three to a picture."""
        frames, settings = photographs.frames, context.settings.relight
        rows, columns = frames.shape
        pictures = [picture_on_disk(scratch / f"plane_{n}", rows, columns) for n in range(self.model.planes // 3)]
        for part, values, valid in (strip for band in frames.bands() for strip in photographs.strips(band, lights)):
            coefficients = self.model.fit(values, valid)
            codes = self.codes(coefficients)
            for number, picture in enumerate(pictures):
                picture[part] = codes[:, 3 * number : 3 * number + 3].reshape(-1, columns, 3)
        self.layout = "deepzoom" if max(rows, columns) > LARGEST_SINGLE else "image"
        for number, picture in enumerate(pictures):
            if self.layout == "image":
                write_jpeg(folder / f"plane_{number}.jpg", picture, settings.jpeg_quality)
            else:
                write_deep_zoom(folder, f"plane_{number}", picture, scratch, settings.jpeg_quality)
        if self.model.kind == "ptm":
            write_ptm(folder / PTM, pictures, self.scale.reshape(-1, 3), self.bias.reshape(-1, 3))
        text = json.dumps(self.info(photographs.frames, lights, context), indent=1) + "\n"
        (folder / "info.json").write_text(text, encoding="utf-8")

    def info(self, frames: Observations, lights: np.ndarray, context: Context) -> dict:
        """What the viewer reads."""
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

    def decoded(self, folder: Path, frames: Observations) -> Iterator[DecodedRows]:
        """Some rows at a time, at most a band, and what gives the coefficients of some of them from the files."""
        names = [f"plane_{number}" for number in range(self.model.planes // 3)]
        if self.layout == "image":
            bands = iter([[(slice(0, frames.shape[0]), read_jpeg(folder / f"{name}.jpg")) for name in names]])
        else:
            bands = zip(*(read_full_resolution(folder, name, *frames.shape) for name in names), strict=True)
        for parts in bands:
            start, stop = parts[0][0].start, parts[0][0].stop
            for top in range(start, stop, frames.band_rows):
                rows = slice(top, min(top + frames.band_rows, stop))
                inner = slice(top - start, rows.stop - start)
                yield rows, partial(self._of_codes, np.concatenate([each[inner] for _, each in parts], axis=-1), rows)

    def _of_codes(self, codes: np.ndarray, rows: slice, part: slice) -> np.ndarray:
        return self.coefficients(codes[part.start - rows.start : part.stop - rows.start])

    def shown_by(self, model: LightModel) -> "StoredModel":
        """The same planes under another interpolation between the lights."""
        other = StoredModel(model, self.scale, self.bias)
        other.layout = self.layout
        return other

    def errors(self, folder: Path, photographs: Photographs, lights: np.ndarray) -> dict[str, float]:
        """PSNR of what a viewer shows of the folder against the coded photographs."""
        return self._errors(self.decoded(folder, photographs.frames), photographs, lights)

    def file_errors(self, folder: Path, photographs: Photographs, lights: np.ndarray) -> dict[str, float]:
        """PSNR of what a viewer shows of the .ptm file against the coded photographs."""
        coefficients = read_ptm(folder / PTM)
        return self._errors(((band, coefficients) for band in photographs.frames.bands()), photographs, lights)

    def _errors(self, bands: Iterator[DecodedRows], photographs: Photographs, lights: np.ndarray) -> dict[str, float]:
        errors = CodedErrors(len(lights))
        transfers = [self.model.transfer(photographs.frames.directions[light]) for light in lights]
        for rows, decoded in bands:
            for part, values, valid in photographs.strips(rows, lights):
                coefficients = decoded(part).reshape(-1, self.model.planes)
                for number, (offset, weights) in enumerate(transfers):
                    errors.add(number, offset + coefficients @ weights, values[:, number], valid[:, number])
        return errors.decibels()


def write_layers(folder: Path, scene: ExportedScene, context: Context) -> None:
    """normals.jpg and albedo.jpg, for viewers that show layers beside the relightable one, where one file does."""
    if max(scene.shape) > LARGEST_SINGLE:
        return
    everything = slice(0, scene.shape[0])
    quality = context.settings.relight.jpeg_quality
    coded = normals_as_colours(scene.normals(everything))
    write_jpeg(folder / "normals.jpg", (coded // 257).astype(np.uint8), quality)
    albedo = np.rint(255 * srgb_encode(scene.srgb(everything))).astype(np.uint8)
    write_jpeg(folder / "albedo.jpg", albedo, quality)
