"""Quality of pictures against everything that a renderer needs, beside what a user would otherwise store.

All methods are compared on the same pixels (inside the silhouette, not saturated), in the capture's own encoding, with
full scale as the peak. The bytes of the coded object are those of its streams, parameters, mesh, charts and cameras.
"""

import json
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np
from codecs_of_pictures import IMAGE_CODECS, VIDEO_CODECS, filled

from nishiki.artifacts.artifact import Artifact, open_artifact
from nishiki.atlas.store import Texels
from nishiki.codec.compact import cost_of
from nishiki.colour.colour import encode
from nishiki.evaluate.object_photographs import Photographs
from nishiki.observations.views import Views
from nishiki.render.object.renderer import DecodedObject

PROJECT = Path(__file__).resolve().parents[1]
VARIANTS = {
    "wavelet_texture": {},
    "wavelet_texture_db2": {"wavelet": "db2", "levels": 3, "view_transform": "db2"},
    "image_based": {"model": False},
    "wavelet_2d": {"model": False, "view_transform": "none"},
}


@dataclass(frozen=True)
class Asked:
    """methods: names of VARIANTS; amounts: bits a pixel."""

    methods: tuple[str, ...]
    amounts: tuple[float, ...]


@dataclass(frozen=True)
class Pictures:
    """values (observations, rows, columns, channels) float32 in the capture's encoding, cropped to the object; inside
    (observations, rows, columns) bool; crop: rows and columns; bits: of the camera's codes."""

    values: np.ndarray
    inside: np.ndarray
    crop: tuple[slice, slice]
    bits: int

    @property
    def pixels(self) -> int:
        """Object pixels of all pictures."""
        return int(np.count_nonzero(self.inside))

    def psnr(self, decoded: np.ndarray) -> float:
        """Decibels of decoded values in the same crop."""
        difference = (decoded - self.values)[self.inside].astype(np.float64)
        return float(-10 * np.log10(max(np.mean(difference**2), 1e-30)))


def photographs(inputs: Mapping[str, Artifact], covered: np.ndarray) -> Pictures:
    """All photographs of the object, cropped to what any of them shows; covered: where the surface is seen."""
    source = Photographs(inputs)
    views = Views(inputs["ingest"].folder)
    values, inside = [], []
    for light in range(len(views.lights)):
        for view in kept_views(inputs):
            linear, valid = source.read(view, light)
            outline = source.silhouette(view)
            shown = covered[len(values)] if outline is None else outline
            values.append(encode(linear, views.encoding).astype(np.float32))
            inside.append(valid & shown)
    inside = np.array(inside)
    crop = tuple(
        slice(int(np.flatnonzero(line)[0]), int(np.flatnonzero(line)[-1]) + 1)
        for line in (inside.any((0, 2)), inside.any((0, 1)))
    )
    bits = inputs["ingest"].diagnostics["capture"]["camera"]["bits"] or (8 if views.encoding == "srgb" else 16)
    return Pictures(np.array(values)[:, *crop], inside[:, *crop], crop, bits)


def kept_views(inputs: Mapping[str, Artifact]) -> list[int]:
    """Views that were not left out: those that every method stores."""
    texels = Texels(inputs["texels"].folder)
    return [place for place, view in enumerate(texels.views) if view not in texels.hold_out]


def coded_objects(inputs: dict[str, Artifact], work: Path, asked: Asked) -> Iterator[tuple[str, float, dict]]:
    """Run the residual stage for every variant and target: (method, amount asked for, inputs with its artifact)."""
    for method in asked.methods:
        for amount in asked.amounts:
            chosen = {"target": "bits_per_pixel", "amount": amount, **VARIANTS[method]}
            folders = [str(inputs[name].folder) for name in ("ingest", "mesh", "cameras", "texels", "object_brdf")]
            command = [sys.executable, str(PROJECT / "scripts/stage.py"), "residual", "--settings", json.dumps(chosen)]
            target = work / f"{method}-{amount}"
            subprocess.run([*command, "--inputs", *folders, "--output", str(target)], check=True)
            yield method, amount, {**inputs, "residual": open_artifact(next(target.iterdir()))}


def rendered(decoded: DecodedObject, kept: list[int], *, model_only: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Captured views in the capture's encoding, and where the surface is seen."""
    renderer = decoded.renderer(model_only=model_only)
    shots = [renderer.captured(view, light=light) for light in range(len(decoded.lights)) for view in kept]
    values, covered = [], []
    for picture in renderer.render(shots):
        values.append(encode(picture.linear, decoded.encoding).astype(np.float32))
        covered.append(picture.covered)
    return np.array(values), np.array(covered)


def row(
    method: str, bytes_: int, pictures: Pictures, decibels: float, encode_s: float, decode_s: float, **more
) -> dict:
    """One JSON line of the picture domain."""
    return {
        "domain": "pictures",
        "method": method,
        **more,
        "bytes": bytes_,
        "bits_per_pixel": round(8 * bytes_ / pictures.pixels, 4),
        "psnr_db": round(decibels, 2),
        "encode_s": round(encode_s, 3),
        "decode_s": round(decode_s, 3),
    }


def our_rows(inputs: dict[str, Artifact], work: Path, asked: Asked) -> Iterator[tuple[dict, Pictures]]:
    """Every variant at every target, and the model alone; each with the pictures that it was compared with."""
    pictures = None
    for method, amount, found in coded_objects(inputs, work, asked):
        decoded = DecodedObject.open(found)
        start = perf_counter()
        values, covered = rendered(decoded, kept_views(inputs))
        seconds = perf_counter() - start
        pictures = pictures or photographs(inputs, covered)
        cost = cost_of(
            decoded.mesh, decoded.atlas.chart, decoded.cameras, decoded.lighting.as_dict(), decoded.residual.bytes
        )
        kept = found["residual"].diagnostics
        texels = texels_of(kept)
        yield (
            row(
                method, cost.total, pictures, pictures.psnr(values[:, *pictures.crop]),
                found["residual"].run["seconds"], seconds, kept=round(kept["kept_of_all"], 5),
                kept_of_visible=round(kept["kept_of_visible"], 5), bits_per_texel=round(8 * cost.total / texels, 4),
                parts=cost.parts, default=method == "wavelet_texture",
            ),
            pictures,
        )  # fmt: skip
        if method == "wavelet_texture" and amount == asked.amounts[0]:
            start = perf_counter()
            alone, _ = rendered(decoded, kept_views(inputs), model_only=True)
            spent = perf_counter() - start
            without = {name: size for name, size in cost.parts.items() if not name.startswith("residual")}
            size = sum(without.values()) + decoded.residual.bytes.get("parameters", 0)
            quality = pictures.psnr(alone[:, *pictures.crop])
            yield row("model_only", size, pictures, quality, 0.0, spent, kept=0.0), pictures


def texels_of(diagnostics: dict) -> float:
    """(texel, view) samples that are visible in any view: what a bit is counted against."""
    return max(diagnostics["kept"] / max(diagnostics["kept_of_visible"], 1e-12), 1.0)


def codec_rows(pictures: Pictures) -> Iterator[dict]:
    """Image and video codecs on the same photographs, at several qualities each."""
    top = (1 << pictures.bits) - 1
    kind = np.uint8 if pictures.bits <= 8 else np.uint16
    codes = np.rint(pictures.values.clip(0, 1) * top).astype(kind)
    if codes.shape[-1] != 3:
        return
    codes = filled(codes, pictures.inside)
    for name, (codec, qualities) in {**IMAGE_CODECS, **VIDEO_CODECS}.items():
        for quality in qualities:
            coded = codec(codes, pictures.bits, quality)
            decibels = pictures.psnr((coded.decoded / np.float32(top)).astype(np.float32))
            yield row(name, coded.bytes, pictures, decibels, coded.encode_s, coded.decode_s, quality=quality)


def at_bits(rows: list[dict], method: str, bits: float) -> float | None:
    """PSNR of a method at a rate, linear in the logarithm of the rate; None more than 10 % outside of what was
    measured."""
    points = sorted((r["bits_per_pixel"], r["psnr_db"]) for r in rows if r["method"] == method)
    if len(points) < 2 or not 0.9 * points[0][0] <= bits <= 1.1 * points[-1][0]:
        return None
    last = min(max(1, int(np.searchsorted([p[0] for p in points], bits))), len(points) - 1)
    (low, at_low), (high, at_high) = points[last - 1 : last + 1]
    return float(at_low + (at_high - at_low) * np.log(bits / low) / np.log(high / low))


def gains(rows: list[dict]) -> Iterator[dict]:
    """How many decibels the default is above each other method at its own rates."""
    others = sorted({r["method"] for r in rows} - {"wavelet_texture", "model_only"})
    for own in (r for r in rows if r["method"] == "wavelet_texture"):
        above = {name: at_bits(rows, name, own["bits_per_pixel"]) for name in others}
        yield {
            "domain": "pictures",
            "method": "wavelet_texture",
            "bits_per_pixel": own["bits_per_pixel"],
            "psnr_db": own["psnr_db"],
            "gain_db": {name: round(own["psnr_db"] - value, 2) for name, value in above.items() if value is not None},
        }
