"""Viewer: a page on which a painting is seen under moving lamps, its data beside it or inside it."""

from pathlib import Path

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.artifacts.maps import Maps
from nishiki.artifacts.stage import Context
from nishiki.colour.colour import cie_1931_cmfs
from nishiki.colour.colour import illuminant as cie_illuminant
from nishiki.colour.sampling import WAVELENGTHS_NM
from nishiki.formats.stored import load_arrays
from nishiki.observations.plane import Observations
from nishiki.report.viewer.encoding import Steps
from nishiki.report.viewer.heights import height_block
from nishiki.report.viewer.page import Blocks, write_page
from nishiki.report.viewer.pictures import webp_stack
from nishiki.report.viewer.pyramid import BORDER, TILE, Pyramid
from nishiki.stages.viewer.layers import layers_of
from nishiki.stages.viewer.painting import UNKNOWN_REGION, PaintingCode, PaintingMaps, gloss_of
from nishiki.stages.viewer.photographs import photographs_of

PAGE = Path(__file__).with_name("page.js")
ILLUMINANTS = ("D65", "D50", "A", "E", "F2", "F7", "F11", "LED-B1", "LED-B3", "LED-B5")
BAND_ROWS = 256
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
    maps = PaintingMaps.of(context.inputs)
    rows, columns = maps.shape
    blocks = Blocks(context.output, inline_bytes=int(context.settings.inline_mb * 1e6))
    steps, step = FINE if rows * columns <= FINE_PIXELS else COARSE, context.settings.step
    code = PaintingCode.of(maps, BAND_ROWS, steps if step == "auto" else steps.scaled(step))

    regions: set[bool] = set()

    def write(level: int, row: int, column: int, values: np.ndarray) -> None:
        planes = code.encode(values)
        regions.add(bool(planes[-1].any()))
        blocks.add(f"tile-{level}-{row}-{column}", webp_stack(planes))

    pyramid = Pyramid(rows, columns, maps.read(slice(0, 1)).shape[-1], write)
    for first in context.progress.over(range(0, rows, BAND_ROWS), "band"):
        pyramid.push(maps.read(slice(first, min(first + BAND_ROWS, rows))))
    height = Maps(context.inputs["height"].folder) if "height" in context.inputs else None
    pitch = maps.normals.group.attrs.get("pixel_pitch_mm")
    shadows = []
    if height is not None and maps.casts_shadows:
        smaller = [most for most, _ in RELIEFS if most < rows * columns]
        for number, (most, step) in enumerate(RELIEFS[: len(smaller) + 1]):
            block, described = height_block(
                lambda band: height.read("height", band), (rows, columns), pitch or 1.0, most, step
            )
            blocks.add(f"height-{number}", block)
            shadows.append({"block": f"height-{number}", **described})
    manifest = {
        "format": 1,
        "chain": "painting",
        **context.stamp,
        "title": context.inputs["ingest"].diagnostics["capture"]["title"],
        "rows": rows,
        "columns": columns,
        "pitch_mm": pitch,
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
    """Spectra on offer, {name: {nm, power}}; `capture`: that of the lamp, where the capture states it."""
    powers = {name: cie_illuminant(name) for name in ILLUMINANTS}
    path = ingest.path("curves.npz")
    curves = load_arrays(path) if path.is_file() else {}
    if "illuminant" in curves:
        powers["capture"] = curves["illuminant"]
    return {name: {"nm": WAVELENGTHS_NM.tolist(), "power": power.tolist()} for name, power in powers.items()}
