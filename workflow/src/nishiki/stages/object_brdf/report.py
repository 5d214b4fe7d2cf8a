"""The section of an object's page on reflection: the parameters of all texels as sheets of their charts."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.atlas.atlas import Atlas
from nishiki.atlas.store import ATLAS
from nishiki.brdf.texels.parameters import TexelFlag
from nishiki.brdf.texels.store import ParameterMaps
from nishiki.report.colour_map import sea
from nishiki.report.numbers import figure, percent
from nishiki.report.page import Facts, Figure, Figures, Section
from nishiki.report.pictures import brightened, brightening, colour_picture, scalar_picture

LIGHTING = {
    "camera": "a lamp beside the camera",
    "direction": "lamps of known direction",
    "position": "lamps at known places",
    "environment": "not stated; an irradiance over the normal was fitted",
}
Place = tuple[int, int]
"""Row and column of a cell."""


def model_section(object_brdf: Artifact | None, texels: Artifact | None, widest: int) -> Section | None:
    """Parameter maps as sheets of all charts, and what the fit says of itself; None without both stages."""
    if object_brdf is None or texels is None:
        return None
    maps, diagnostics = ParameterMaps(object_brdf.folder), object_brdf.diagnostics

    def read(tile: int) -> np.ndarray:
        part = maps.read(tile)
        joined = np.concatenate([part.kd, part.ks, part.sigma[..., None]], axis=-1)
        return np.where((part.flags & (TexelFlag.OUTSIDE | TexelFlag.UNSEEN))[..., None] == 0, joined, np.nan)

    width = diagnostics["median_sigma"]
    degrees = figure(None if width is None else float(np.degrees(width)))
    highlight, filled, unseen = (
        percent(100 * diagnostics[name]) for name in ("highlight_share", "filled_share", "unseen_share")
    )
    facts = [
        ("Texels", figure(diagnostics["texels"])),
        ("Lighting", LIGHTING.get(diagnostics["lighting"], diagnostics["lighting"])),
        ("Model alone", f"{figure(diagnostics['psnr_db'])} dB over {figure(diagnostics['samples'])} visible samples"),
        ("Highlight observed", f"{highlight} of the texels; median width {degrees}°"),
        (
            "Taken from neighbours",
            f"strength of the highlight at {filled} of the texels, everything at {unseen} that no view shows",
        ),
    ]
    intro = (
        "At every texel: diffuse reflection by Lambert's law, and a highlight by the simplified Torrance-Sparrow "
        "model. The sheets show all charts of the surface beside each other."
    )
    atlas = Atlas.load(texels.path(ATLAS))
    blocks = [intro, Figures(parameter_figures(sheet(read, atlas, widest)), 3), Facts(facts)]
    return Section("model", "Reflection", blocks)


def parameter_figures(parameters: np.ndarray) -> list[Figure]:
    """Pictures of K_d, K_s and sigma; parameters : sheet (rows, columns, 2 channels + 1) of all three."""
    channels = (parameters.shape[-1] - 1) // 2
    kd, ks = three(parameters[..., :channels]), three(parameters[..., channels : 2 * channels])
    figures = []
    for name, values, caption in (
        ("Diffuse reflection", kd, "K_d of every texel: the colour of the surface without its gloss."),
        ("Specular reflection", ks, "K_s of every texel, from its own highlights or its neighbours'."),
    ):
        gain = brightening(values)
        figures.append(Figure(name, caption + brightened(gain), colour_picture(values * gain)))
    width = scalar_picture(np.degrees(parameters[..., -1]), sea(), unit="degrees")
    figures.append(Figure("Width of the highlight", "sigma of every texel: the larger, the duller.", width))
    return figures


def shelves(charts: list[tuple[int, int]], wide: int) -> tuple[list[Place], int]:
    """Places of charts of (rows, columns) cells on a sheet `wide` cells wide, tallest first in rows; and its height."""
    places: list[Place] = [(0, 0)] * len(charts)
    top = left = height = 0
    for k in sorted(range(len(charts)), key=lambda k: (-charts[k][0], k)):
        rows, columns = charts[k]
        if left and left + columns > wide:
            top, left, height = top + height, 0, 0
        places[k] = (top, left)
        left, height = left + columns, max(height, rows)
    return places, top + height


def tile_places(atlas: Atlas) -> tuple[np.ndarray, Place]:
    """(tiles, 2) cell of every tile on the sheet, and the sheet's (rows, columns) in cells."""
    charts = [(int(rows), int(columns)) for _, rows, columns in atlas.chart_grid]
    cells = sum(rows * columns for rows, columns in charts)
    wide = max([int(np.ceil(np.sqrt(1.3 * cells))), *(columns for _, columns in charts)] or [1])
    places, height = shelves(charts, wide)
    starts = np.array(places, np.int64).reshape(-1, 2)
    return starts[atlas.tile_chart] + atlas.tile_place, (max(height, 1), wide)


def sheet(read: Callable[[int], np.ndarray], atlas: Atlas, widest: int) -> np.ndarray:
    """(rows, columns, n) float32 sheet of what read(tile) gives, (T, T, n) with NaN where there is nothing.

    Tiles are averaged down to whole pixels, NaN left out, so that the sheet is at most `widest` pixels wide if it can.
    """
    places, (rows, columns) = tile_places(atlas)
    side = max(1, min(atlas.size - 1, widest // columns))
    out = None
    for tile, (row, column) in enumerate(places):
        small = averaged(read(tile)[: atlas.size - 1, : atlas.size - 1], side)
        if out is None:
            out = np.full((rows * side, columns * side, small.shape[-1]), np.nan, np.float32)
        out[row * side : (row + 1) * side, column * side : (column + 1) * side] = small
    return np.full((side, side, 1), np.nan, np.float32) if out is None else out


def averaged(values: np.ndarray, side: int) -> np.ndarray:
    """(side, side, n) means over areas of values (t, t, n), t >= side; NaN where nothing is known."""
    edges = np.arange(side + 1) * values.shape[0] // side
    known = np.isfinite(values).all(axis=-1, keepdims=True)
    sums, count = np.where(known, values, 0).astype(np.float64), known.astype(np.float64)
    for axis in (0, 1):
        sums, count = (np.add.reduceat(a, edges[:-1], axis=axis) for a in (sums, count))
    return np.where(count > 0, sums / np.maximum(count, 1), np.nan).astype(np.float32)


def three(values: np.ndarray) -> np.ndarray:
    """Three channels to look at: themselves, one repeated, or the longest, middle and shortest of many."""
    channels = values.shape[-1]
    return values if channels == 3 else values[..., [channels - 1, channels // 2, 0]]
