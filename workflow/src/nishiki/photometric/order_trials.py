"""Fit the photographs of a plane scene with their lamps in some order, and measure misfit and curl tile by tile.

Two measures, of which neither needs the other's assumption:

* The residual of Lambert's law with free gains (`nishiki.photometric.lambert_fit`): a photograph under a lamp that is
  not its own misfits.
* The curl of the slopes p, q of the normals: slopes of a surface have none (Horn and Brooks, 1986). Lamps turned or
  mirrored about the line of sight leave the residual alone, and turn or mirror the normals; with

      a = p_y - q_x,   d = p_x + q_y,   a' = p_y + q_x,   d' = p_x - q_y

  a is the curl as stated, a' with one axis mirrored, d' with both exchanged, d after a quarter turn. A half turn leaves
  its size as it is: it makes hills hollows.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nishiki.photometric.lambert_fit import (
    FEWEST_LAMPS,
    GRAZING,
    KINK,
    Fit,
    fit_lambert,
    lit_and_dark,
    median_of_lights,
    scale_of,
    solve_normals,
)

TILE = 8  # side of a tile, pixels of the reduced picture: one observation
FEWEST_TILES, MOST_TILES = 12, 140  # a mean of fewer has no useful error; more only take time
MOST_VALUES = 300_000  # of all tiles and photographs; with many lamps fewer tiles are enough
PER_TILE = 5  # pixels of a tile in the fit of gains
STEEPEST = 0.2  # cosine of the steepest slope that counts: beyond, small errors of the normal are any slope
AXES = ((1, 0, 0, 1), (1, 0, 0, -1), (0, 1, 1, 0), (0, 1, -1, 0))  # as stated, mirrored, exchanged, turned


@dataclass(frozen=True)
class Tiles:
    """Values (lights, tiles, side, side), lamps (lights, 1 or tiles, 3), middles (tiles, 2) of the tiles, x and y."""

    values: np.ndarray
    lamps: np.ndarray
    middles: np.ndarray

    @cached_property
    def sample(self) -> tuple[np.ndarray, np.ndarray]:
        """Values (lights, pixels) of some pixels of every tile, and the tile (pixels,) of each."""
        count, number = self.values.shape[:2]
        values = self.values.reshape(count, number, -1)[:, :, :: TILE * TILE // PER_TILE]
        tile = np.arange(number).repeat(values.shape[2])
        values = values.reshape(count, -1)
        usable = np.isfinite(values).sum(axis=0) >= FEWEST_LAMPS
        return values[:, usable], tile[usable]


@dataclass(frozen=True)
class OrderTrial:
    """An order with its fit."""

    order: np.ndarray
    fit: Fit
    misfit: np.ndarray  # (lights, tiles) relative to the albedo
    energies: np.ndarray  # (tiles, 4) of the derivatives that AXES names
    outwards: np.ndarray  # (4,) how far the normals then point outwards
    # (2, 3, 3): turns about the line of sight, with and without mirroring y, after which the curl is least
    turns: np.ndarray


def cut_tiles(values: np.ndarray, lamps: np.ndarray) -> Tiles | None:
    """Cut tiles spread over the object out of the pictures; None where they are too few."""
    count, rows, columns = values.shape
    high, wide = rows // TILE, columns // TILE
    if count < FEWEST_LAMPS or high * wide < FEWEST_TILES:
        return None
    up, left = (rows - high * TILE) // 2, (columns - wide * TILE) // 2

    def cut(array: np.ndarray) -> np.ndarray:
        part = array[:, up : up + high * TILE, left : left + wide * TILE]
        shape = (len(part), high, TILE, wide, TILE, *part.shape[3:])
        return np.moveaxis(part.reshape(shape), 3, 2).reshape(len(part), high * wide, TILE, TILE, *part.shape[3:])

    tiles = cut(values)
    known = np.isfinite(tiles).sum(axis=0) >= max(FEWEST_LAMPS, count // 2)
    level = np.nanmax(np.where(np.isfinite(tiles), tiles, 0.0), axis=0)
    known &= level > 0.05 * np.quantile(level[known], 0.9) if known.any() else known
    chosen = np.flatnonzero(known.mean(axis=(1, 2)) > 0.6)
    if len(chosen) < FEWEST_TILES:
        return None
    most = int(np.clip(MOST_VALUES // (count * TILE * TILE), 4 * FEWEST_TILES, MOST_TILES))
    chosen = chosen[:: -(-len(chosen) // most)]
    down, across = np.divmod(chosen, wide)
    vectors = lamps[:, None, :] if lamps.ndim == 2 else cut(lamps)[:, chosen, TILE // 2, TILE // 2]
    part = np.where(known[chosen], tiles[:, chosen], np.nan).astype(np.float64)
    return Tiles(part, vectors, np.stack([across - across.mean(), down.mean() - down], axis=1))


def measure_shading(values: np.ndarray) -> float:
    """Measure by how much the light of one lamp differs between pixels of equal albedo, relative to it."""
    logarithms = np.log(np.where(values > 0, values, np.nan)).reshape(len(values), -1)
    for _ in range(2):  # without the lamps' strengths and the albedo
        logarithms = logarithms - np.nanmedian(logarithms, axis=1, keepdims=True)
        logarithms -= np.nanmedian(logarithms, axis=0)
    return 1.4826 * float(np.nanmedian(np.abs(logarithms)))


def try_order(tiles: Tiles, order: np.ndarray) -> OrderTrial | None:
    """Fit normals with the lamps in this order, and measure misfit and curl of every tile."""
    count, number = tiles.values.shape[:2]
    lamps = tiles.lamps[order]
    sample, patches = tiles.sample
    fit = fit_lambert(sample, lamps[:, patches] if lamps.shape[1] > 1 else lamps, patches)
    if not np.isfinite(fit.gains).all():
        return None
    sizes = np.where(np.isfinite(sample), np.abs(fit.alone), np.nan) / np.linalg.norm(fit.normals, axis=1)
    misfit = np.stack([median_of_lights(sizes[:, patches == tile].T) for tile in range(number)], axis=1)
    flat = tiles.values.reshape(count, -1)
    normals = _robust_normals(flat, lamps, fit)
    return OrderTrial(order, fit, misfit, *measure_slopes(normals.reshape(number, TILE, TILE, 3), tiles.middles))


def tabulate_misfits(tiles: Tiles, trial: OrderTrial, turn: np.ndarray) -> np.ndarray:
    """Measure the misfit (photographs, lamps, tiles) of every photograph under every lamp, relative to the albedo.

    The normals are those of a trial, turned; each photograph has the strength that fits its lamp. At most 1; 1 too
    where a photograph shows too little, and NaN in tiles of which it shows nothing.
    """
    (sample, patches), (count, number) = tiles.sample, tiles.values.shape[:2]
    albedo = np.linalg.norm(trial.fit.normals, axis=1)
    vectors = tiles.lamps if tiles.lamps.shape[1] == 1 else tiles.lamps[:, patches]
    shading = np.maximum(np.einsum("jsa,sa->js", vectors, trial.fit.normals @ turn.T / albedo[:, None]), 0.0)
    table = np.ones((count, count, number))
    for photograph, values in enumerate(sample / albedo):
        known = np.isfinite(values)
        if known.sum() < FEWEST_TILES:
            continue
        here, there = values[known], shading[:, known]
        gains = np.median(here) / np.maximum(np.median(there, axis=1), GRAZING)
        for _ in range(2):
            weights = 1 / (GRAZING**2 + np.abs(here - gains[:, None] * there))
            gains = (weights * there * here).sum(axis=1) / np.maximum((weights * there**2).sum(axis=1), 1e-12)
        sizes = np.minimum(np.abs(here - gains[:, None] * there), 1.0)
        shown, first, pixels = np.unique(patches[known], return_index=True, return_counts=True)
        table[photograph] = np.nan
        table[photograph][:, shown] = np.add.reduceat(sizes, first, axis=1) / pixels
    return table


def _robust_normals(values: np.ndarray, lamps: np.ndarray, fit: Fit) -> np.ndarray:
    """Solve for albedo times normal (pixels, 3) of all pixels with the gains of a fit, by four reweighted rounds."""
    vectors = fit.gains[:, None, None] * (lamps if lamps.shape[1] == 1 else lamps.repeat(TILE * TILE, axis=1))
    known = np.isfinite(values)
    filled, weights = np.where(known, values, 0.0), known.astype(np.float64)
    for _ in range(4):
        normals, _ = solve_normals(weights, filled, vectors)
        albedo = np.linalg.norm(normals, axis=1) + 1e-300
        cosine = np.einsum("jsa,sa->js", vectors, normals)
        lit, _ = lit_and_dark(known, filled, cosine, albedo)
        scale = scale_of(filled - cosine, lit, albedo)
        weights = lit / (1 + ((filled - cosine) / (KINK * scale)) ** 2)
    normals[(known.sum(axis=0) < FEWEST_LAMPS) | (normals[:, 2] < GRAZING * albedo)] = np.nan
    return normals


def measure_slopes(normals: np.ndarray, middles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return energies (tiles, 4) of the derivatives in AXES, outward tilt (4,), and turns of least curl (2, 3, 3)."""
    size = np.linalg.norm(normals, axis=-1)
    steep = np.maximum(normals[..., 2], STEEPEST * size)
    p, q = -normals[..., 0] / steep, -normals[..., 1] / steep

    def across(f: np.ndarray) -> np.ndarray:
        return 0.5 * (f[:, 1:, 1:] - f[:, 1:, :-1] + f[:, :-1, 1:] - f[:, :-1, :-1])

    def upwards(f: np.ndarray) -> np.ndarray:
        return 0.5 * (f[:, :-1, 1:] - f[:, 1:, 1:] + f[:, :-1, :-1] - f[:, 1:, :-1])

    parts = (upwards(p) - across(q), upwards(p) + across(q), across(p) - upwards(q), across(p) + upwards(q))
    parts = tuple(np.clip(part, -1, 1) for part in parts)  # an edge of the object counts as a step of unit slope
    energies = np.stack([np.nanmean(part**2, axis=(1, 2)) for part in parts], axis=1)
    mean = np.stack([-np.nanmean(p, axis=(1, 2)), -np.nanmean(q, axis=(1, 2))], axis=1)
    tilts = [mean @ np.array(axes).reshape(2, 2).T for axes in AXES]
    outwards = np.stack([np.nansum((tilt - np.nanmean(tilt, axis=0)) * middles) for tilt in tilts])
    turns = []
    for still, turned_part, mirror in ((0, 3, 1.0), (1, 2, -1.0)):
        # curl after a turn by f: cos f a - sin f d, of least square where (cos 2f, sin 2f) ~ (dd - aa, 2 ad)
        first, second = parts[still], parts[turned_part]
        angle = 0.5 * np.arctan2(2 * np.nanmean(first * second), np.nanmean(second**2) - np.nanmean(first**2))
        cosine, sine = np.cos(angle), np.sin(angle)
        turns.append(np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]]) @ np.diag([1.0, mirror, 1.0]))
    return energies, outwards, np.stack(turns)
