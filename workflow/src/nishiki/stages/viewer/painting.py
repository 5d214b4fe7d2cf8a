"""Viewer: a page on which a painting is seen under moving lamps, its data beside it or inside it."""

from pathlib import Path
from typing import Any, Literal

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.artifacts.maps import Maps, shrink
from nishiki.artifacts.stage import Context
from nishiki.colour.colour import cie_1931_cmfs
from nishiki.colour.colour import illuminant as cie_illuminant
from nishiki.colour.sampling import WAVELENGTHS_NM
from nishiki.formats.stored import load_arrays
from nishiki.observations.plane import Observations
from nishiki.report.viewer.encoding import Steps
from nishiki.report.viewer.page import Blocks, webp, webp_stack, write_page
from nishiki.report.viewer.pyramid import BORDER, TILE, Pyramid, height_block
from nishiki.stages.painting_maps import PaintingMaps
from nishiki.stages.viewer.painting_maps import UNKNOWN_REGION, PaintingCode, gloss_of, photographs_of, read_records
from nishiki.threads import strips

PAGE = Path(__file__).with_suffix(".js")
ILLUMINANTS = ("D65", "D50", "A", "E", "F2", "F7", "F11", "LED-B1", "LED-B3", "LED-B5")
BAND_PIXELS = 1 << 20  # in memory
FINE, COARSE, FINE_PIXELS = Steps(0.35, 0.00116, 0.0046), Steps(0.95, 0.011, 0.019), 2_000_000
"""Steps of the codes, and the size of a map up to which the finer are taken. With the coarse ones each kind of code
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
    code = PaintingCode.of(maps, band_rows, steps if step == "auto" else steps.scaled(step))

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
        "code": code.described(),
        "tiles": {
            "size": TILE,
            "border": BORDER,
            "levels": [{"rows": shape[0], "columns": shape[1], "factor": factor} for factor, shape in pyramid.levels()],
            "regions": True in regions,
            "unknown": UNKNOWN_REGION,
        },
        "shadows": shadows,
        "layers": layers_of(context.inputs, blocks),
        "photographs": photographs_of(maps, Observations(context.inputs["ingest"].folder), blocks, context.progress),
    }
    return write_page(blocks, manifest, PAGE)


def illuminants(ingest: Artifact) -> dict[str, dict[str, list[float]]]:
    """Return spectra on offer, {name: {nm, power}}; `capture`: that of the lamp, where the capture states it."""
    powers = {name: cie_illuminant(name) for name in ILLUMINANTS}
    path = ingest.path("curves.npz")
    curves = load_arrays(path) if path.is_file() else {}
    if "illuminant" in curves:
        powers["capture"] = curves["illuminant"]
    return {name: {"nm": WAVELENGTHS_NM.tolist(), "power": power.tolist()} for name, power in powers.items()}


MOST_PIXELS = 1_000_000  # of a map of errors
LARGEST, UNKNOWN = 254, 255
"""Largest code, and that of an unknown value."""
FARTHEST = 99.5  # percentile of a measured map that its colours reach to


def layers_of(inputs: dict[str, Artifact], blocks: Blocks) -> list[dict[str, Any]]:
    """Write the maps that there are; what the page has to know of each. Normals come with the appearance."""
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
            layers.append(_measured(name, unit, factor * _reduced(maps[stage], key), blocks))
    if "evaluate" in maps:
        difference = _mean_difference(maps["evaluate"], len(inputs["ingest"].diagnostics.get("lights", ())))
        if difference is not None:
            layers.append(_measured("delta_e", "CIEDE2000", difference, blocks))
    layers.append(_counted("lights_used", "lights", "grey", normals, blocks))
    if any(count for name, count in inputs["normals"].diagnostics.items() if name.startswith("flagged_")):
        layers.append(_counted("flags", "", "flags", normals, blocks))
    return layers


def _reduced(maps: Maps, key: str, how: Literal["mean", "middle"] = "mean") -> np.ndarray:
    """Reduce a map over blocks to at most `MOST_PIXELS`; a mean is NaN where nothing is known."""
    shape = maps.group[key].shape[:2]
    block = int(np.ceil(np.sqrt(shape[0] * shape[1] / MOST_PIXELS)))
    return shrink(lambda rows: maps.read(key, rows), shape, block, how)


def _mean_difference(maps: Maps, lights: int) -> np.ndarray | None:
    """Return mean colour difference over the lights left out, NaN where none was compared."""
    parts = [_reduced(maps, name) for name in (f"de00_{light:03d}" for light in range(lights)) if name in maps]
    if not parts:
        return None
    count = np.isfinite(parts).sum(axis=0)
    return np.where(count > 0, np.nansum(parts, axis=0) / np.maximum(count, 1), np.nan)


def _measured(name: str, unit: str, values: np.ndarray, blocks: Blocks) -> dict[str, Any]:
    """Return codes of the range of the values; those beyond its ends take its ends."""
    known = np.isfinite(values)
    low, high = np.percentile(values[known], (100 - FARTHEST, FARTHEST)) if known.any() else (0.0, 1.0)
    low, high = float(low), float(max(high, low + 1e-9))
    codes = np.clip(np.rint((np.nan_to_num(values) - low) * (LARGEST / (high - low))), 0, LARGEST)
    return _written(name, unit, "grey", np.where(known, codes, UNKNOWN).astype(np.uint8), (low, high), blocks)


def _counted(name: str, unit: str, colours: str, maps: Maps, blocks: Blocks) -> dict[str, Any]:
    """Return whole numbers, the pixel in the middle of every block."""
    values = _reduced(maps, name, "middle")
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
