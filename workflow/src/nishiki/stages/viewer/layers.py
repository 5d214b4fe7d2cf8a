"""Maps that the viewer shows as colours and reads under the cursor: codes of 8 bits, at most a megapixel each."""

from __future__ import annotations

from typing import Any

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.artifacts.maps import Maps
from nishiki.report.viewer.page import Blocks
from nishiki.report.viewer.pictures import webp

MOST_PIXELS = 1_000_000
TOP, NOTHING = 254, 255
"""Largest code, and that of an unknown value."""
FARTHEST = 99.5  # percentile of a measured map that its colours reach to


def layers_of(inputs: dict[str, Artifact], blocks: Blocks) -> list[dict[str, Any]]:
    """Write the maps that there are; what the page has to know of each. Normals come with the appearance."""
    layers = [
        {"name": "appearance", "label_key": "layer.appearance", "unit": "", "range": [0, 1], "map": "grey"},
        {"name": "normals", "label_key": "layer.normals", "unit": "", "range": [-1, 1], "map": "normal"},
    ]
    normals = Maps(inputs["normals"].folder)
    sources = [
        ("sigma", "°", "grey", normals, "sigma", np.degrees(1.0)),
        ("residual", "", "grey", normals, "residual", 1.0),
    ]
    if "height" in inputs:
        height = Maps(inputs["height"].folder)
        sources.insert(0, ("height", height.attributes("height")["unit"], "grey", height, "height", 1.0))
    if "spectra" in inputs:
        sources.append(("sigma_spectrum", "", "grey", Maps(inputs["spectra"].folder), "sigma", 1.0))
    for name, unit, colours, maps, key, factor in sources:
        layers.append(_measured(name, unit, colours, _reduced(maps, key, factor), blocks))
    if "evaluate" in inputs and inputs["evaluate"].path("maps.zarr").is_dir():
        difference = _mean_difference(Maps(inputs["evaluate"].folder), len(inputs["ingest"].diagnostics["lights"]))
        if difference is not None:
            layers.append(_measured("delta_e", "CIEDE2000", "grey", difference, blocks))
    layers.append(_counted("lights_used", "lights", "grey", normals, blocks))
    layers.append(_counted("flags", "", "flags", normals, blocks))
    return layers


def _factor(shape: tuple[int, ...]) -> int:
    return int(np.ceil(np.sqrt(shape[0] * shape[1] / MOST_PIXELS)))


def _reduced(maps: Maps, key: str, factor: float = 1.0) -> np.ndarray:
    """A map averaged over blocks to at most `MOST_PIXELS`, NaN where nothing is known; read by bands."""
    shape = maps.group[key].shape
    step = _factor(shape)
    bands = []
    for first in range(0, shape[0], step * 64):
        values = maps.read(key, slice(first, min(first + step * 64, shape[0]))).astype(np.float32) * factor
        pad = ((0, -values.shape[0] % step), (0, -values.shape[1] % step))
        blocks = np.pad(values, pad, constant_values=np.nan)
        blocks = blocks.reshape(blocks.shape[0] // step, step, blocks.shape[1] // step, step)
        known = np.isfinite(blocks)
        count = known.sum(axis=(1, 3))
        total = np.where(known, blocks, 0).sum(axis=(1, 3))
        bands.append(np.divide(total, count, out=np.full(total.shape, np.nan, np.float32), where=count > 0))
    return np.concatenate(bands)


def _mean_difference(maps: Maps, lights: int) -> np.ndarray | None:
    """Mean colour difference over the lights left out, NaN where none was compared."""
    names = [name for name in (f"de00_{light:03d}" for light in range(lights)) if name in maps]
    if not names:
        return None
    total, count = 0, 0
    for name in names:
        values = _reduced(maps, name)
        total, count = total + np.nan_to_num(values), count + np.isfinite(values)
    return np.divide(total, count, out=np.full(total.shape, np.nan, np.float32), where=count > 0)


def _measured(name: str, unit: str, colours: str, values: np.ndarray, blocks: Blocks) -> dict[str, Any]:
    """Codes of the range of the values; those beyond its ends take its ends."""
    known = np.isfinite(values)
    low, high = np.percentile(values[known], (100 - FARTHEST, FARTHEST)) if known.any() else (0.0, 1.0)
    low, high = float(low), float(max(high, low + 1e-9))
    codes = np.where(known, np.clip(np.rint((np.nan_to_num(values) - low) * (TOP / (high - low))), 0, TOP), NOTHING)
    return _written(name, unit, colours, codes.astype(np.uint8), low, high, blocks)


def _counted(name: str, unit: str, colours: str, maps: Maps, blocks: Blocks) -> dict[str, Any]:
    """Whole numbers, the pixel in the middle of every block."""
    step = _factor(maps.group[name].shape)
    rows = maps.group[name].shape[0]
    band = step * 64
    parts = [
        maps.read(name, slice(first, min(first + band, rows)))[step // 2 :: step, step // 2 :: step]
        for first in range(0, rows, band)
    ]
    values = np.minimum(np.concatenate(parts), TOP).astype(np.uint8)
    high = TOP if colours == "flags" else max(int(values.max()), 1)
    return {**_written(name, unit, colours, values, 0, TOP, blocks), "range": [0, high]}


def _written(
    name: str, unit: str, colours: str, codes: np.ndarray, low: float, high: float, blocks: Blocks
) -> dict[str, Any]:
    block = f"layer-{name}"
    blocks.add(block, webp([codes] * 3))
    return {
        "name": name,
        "label_key": f"layer.{name}",
        "unit": unit,
        "range": [low, high],
        "map": colours,
        "block": block,
        "code": {"low": low, "high": high, "top": TOP, "nothing": NOTHING},
        "rows": codes.shape[0],
        "columns": codes.shape[1],
    }
