"""Fit the photographs of a plane scene with their lamps in some order, and measure misfit and curl tile by tile.

Two measures, of which neither needs the other's assumption:

* The residual of Lambert's law with free gains (`nishiki.photometric.lambert_fit`): a photograph under a lamp that is
  not its own misfits.
* The curl of the slopes p, q of the normals: slopes of a surface have none (Horn and Brooks, 1986). Lamps turned or
  mirrored about the line of sight leave the residual alone, and turn or mirror the normals; with

      a = p_y - q_x,   d = p_x + q_y,   a' = p_y + q_x,   d' = p_x - q_y

  a is the curl as stated, a' with one axis mirrored, d' with both exchanged, d after a quarter turn, and
  a cos f - d sin f after a turn by f. A half turn leaves its size as it is: it makes hills hollows.

Lamps whose heights are listed too great or too small by a common factor change neither: the relief becomes steeper or
flatter, its albedo changes with its slope, and the gains with the lamps' heights (Belhumeur, Kriegman and Yuille,
1999). Paint and slope have little to do with each other, so that the albedo is most even under the right factor
(Alldrin, Mallick and Kriegman, 2007): the mean change of its logarithm from pixel to pixel is the third measure.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nishiki.photometric import lambert_fit
from nishiki.photometric.flags import NOISE

TILE = 8  # side of a tile, pixels of the reduced picture: one observation
FEWEST_TILES, MOST_TILES = 12, 140  # a mean of fewer has no useful error; more only take time
MOST_VALUES = 300_000  # of all tiles and photographs; with many lamps fewer tiles are enough
PER_TILE = 5  # pixels of a tile in the fit of gains
STEEPEST = 0.2  # cosine of the steepest slope that counts: beyond, small errors of the normal are any slope
AXES = ((1, 0, 0, 1), (1, 0, 0, -1), (0, 1, 1, 0), (0, 1, -1, 0))  # as stated, mirrored, exchanged, turned
TURNED = len(AXES)  # pose of the least curl after a turn by any angle; the next one has y mirrored before
LEAST_TURN_DEG = 10.0  # of such a turn from those of AXES: 12 to 96 sound lamps show turns of up to 4, see `loosen`
FACTORS = np.exp(np.linspace(-4, 4, 81))  # of the lamps' heights: from a fiftieth to fifty times, in steps of 10 %


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
        usable = np.isfinite(values).sum(axis=0) >= lambert_fit.FEWEST_LAMPS
        return values[:, usable], tile[usable]


@dataclass(frozen=True)
class OrderTrial:
    """An order with its fit."""

    order: np.ndarray
    fit: lambert_fit.Fit
    misfit: np.ndarray  # (lights, tiles) relative to the albedo
    normals: np.ndarray  # (tiles, side, side, 3) albedo times normal
    energies: np.ndarray  # (tiles, 6) of the derivatives that AXES names and of those turned; NaN: no turn
    outwards: np.ndarray  # (6,) how far the normals then point outwards
    # (2, 3, 3): turns about the line of sight, with and without mirroring y, after which the curl is least
    turns: np.ndarray


def cut_tiles(values: np.ndarray, lamps: np.ndarray) -> Tiles | None:
    """Cut tiles spread over the object out of the pictures; None where they are too few."""
    count, rows, columns = values.shape
    high, wide = rows // TILE, columns // TILE
    if count < lambert_fit.FEWEST_LAMPS or high * wide < FEWEST_TILES:
        return None
    up, left = (rows - high * TILE) // 2, (columns - wide * TILE) // 2

    def cut(array: np.ndarray) -> np.ndarray:
        part = array[:, up : up + high * TILE, left : left + wide * TILE]
        shape = (len(part), high, TILE, wide, TILE, *part.shape[3:])
        return np.moveaxis(part.reshape(shape), 3, 2).reshape(len(part), high * wide, TILE, TILE, *part.shape[3:])

    tiles = cut(values)
    known = np.isfinite(tiles).sum(axis=0) >= max(lambert_fit.FEWEST_LAMPS, count // 2)
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
    fit = lambert_fit.fit_lambert(sample, lamps[:, patches] if lamps.shape[1] > 1 else lamps, patches)
    if not np.isfinite(fit.gains).all():
        return None
    sizes = np.where(np.isfinite(sample), np.abs(fit.alone), np.nan) / np.linalg.norm(fit.normals, axis=1)
    misfit = np.stack([lambert_fit.median_of_lights(sizes[:, patches == tile].T) for tile in range(number)], axis=1)
    flat = tiles.values.reshape(count, -1)
    normals = _robust_normals(flat, lamps, fit).reshape(number, TILE, TILE, 3)
    grazing = normals[..., 2:] < lambert_fit.GRAZING * np.linalg.norm(normals, axis=-1, keepdims=True)
    least = LEAST_TURN_DEG * loosen(count)
    slopes = measure_slopes(np.where(grazing, np.nan, normals), tiles.middles, least)
    return OrderTrial(order, fit, misfit, normals, *slopes)


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
        gains = np.median(here) / np.maximum(np.median(there, axis=1), lambert_fit.GRAZING)
        for _ in range(2):
            weights = 1 / (lambert_fit.GRAZING**2 + np.abs(here - gains[:, None] * there))
            gains = (weights * there * here).sum(axis=1) / np.maximum((weights * there**2).sum(axis=1), 1e-12)
        sizes = np.minimum(np.abs(here - gains[:, None] * there), 1.0)
        shown, first, pixels = np.unique(patches[known], return_index=True, return_counts=True)
        table[photograph] = np.nan
        table[photograph][:, shown] = np.add.reduceat(sizes, first, axis=1) / pixels
    return table


def _robust_normals(values: np.ndarray, lamps: np.ndarray, fit: lambert_fit.Fit) -> np.ndarray:
    """Solve for albedo times normal (pixels, 3) of all pixels with the gains of a fit, by four reweighted rounds."""
    vectors = fit.gains[:, None, None] * (lamps if lamps.shape[1] == 1 else lamps.repeat(TILE * TILE, axis=1))
    known = np.isfinite(values)
    filled, weights = np.where(known, values, 0.0), known.astype(np.float64)
    for _ in range(4):
        normals, _ = lambert_fit.solve_normals(weights, filled, vectors)
        albedo = np.linalg.norm(normals, axis=1) + 1e-300
        cosine = np.einsum("jsa,sa->js", vectors, normals)
        lit, _ = lambert_fit.lit_and_dark(known, filled, cosine, albedo)
        scale = lambert_fit.scale_of(filled - cosine, lit, albedo)
        weights = lit / (1 + ((filled - cosine) / (lambert_fit.KINK * scale)) ** 2)
    normals[known.sum(axis=0) < lambert_fit.FEWEST_LAMPS] = np.nan
    return normals


def measure_evenness(normals: np.ndarray) -> np.ndarray:
    """Measure the logarithmic change (tiles, factors) of the albedo, were the lamps higher by each of FACTORS.

    normals (tiles, side, side, 3): albedo times normal.
    """
    flat, high = (normals[..., :2] ** 2).sum(axis=-1), normals[..., 2] ** 2
    changes = []
    for factor in FACTORS:
        albedo = 0.5 * np.log(flat + high / factor**2)
        steps = [np.nanmean(np.abs(np.diff(albedo, axis=axis)), axis=(1, 2)) for axis in (1, 2)]
        changes.append(np.log(np.maximum(sum(steps), NOISE)))
    return np.stack(changes, axis=1)


def loosen(count: int) -> float:
    """Compute the factor of a limit of what sound photographs show, which grows where few lamps determine the gains.

    Sound selections of 6 and 8 lamps of the grey sphere show turns of 21 and 11 degrees, and half and twice the height.
    """
    return count / (count - lambert_fit.FEWEST_LAMPS) if count > lambert_fit.FEWEST_LAMPS else np.inf


def measure_slopes(
    normals: np.ndarray, middles: np.ndarray, least_deg: float = LEAST_TURN_DEG
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return energies (tiles, 6) of the derivatives, outward tilt (6,), and turns of least curl, see `OrderTrial`."""
    size = np.linalg.norm(normals, axis=-1)
    steep = np.maximum(normals[..., 2], STEEPEST * size)
    p, q = -normals[..., 0] / steep, -normals[..., 1] / steep

    def across(f: np.ndarray) -> np.ndarray:
        return 0.5 * (f[:, 1:, 1:] - f[:, 1:, :-1] + f[:, :-1, 1:] - f[:, :-1, :-1])

    def upwards(f: np.ndarray) -> np.ndarray:
        return 0.5 * (f[:, :-1, 1:] - f[:, 1:, 1:] + f[:, :-1, :-1] - f[:, 1:, :-1])

    parts = (upwards(p) - across(q), upwards(p) + across(q), across(p) - upwards(q), across(p) + upwards(q))
    parts = tuple(np.clip(part, -1, 1) for part in parts)  # an edge of the object counts as a step of unit slope
    energies = [np.nanmean(part**2, axis=(1, 2)) for part in parts]
    whole, turns = sum(energies), []
    for still, turned, mirror in ((0, 3, 1.0), (1, 2, -1.0)):
        # curl after a turn by f: cos f a - sin f d, of least square where (cos 2f, sin 2f) ~ (dd - aa, 2 ad)
        both = np.nanmean(parts[still] * parts[turned], axis=(1, 2))
        most = np.nanmean((energies[turned] - energies[still]) / whole)
        angle = 0.5 * np.arctan2(2 * np.nanmean(both / whole), most)
        cosine, sine = np.cos(angle), np.sin(angle)
        left = cosine**2 * energies[still] - 2 * cosine * sine * both + sine**2 * energies[turned]
        new = abs(np.sin(2 * angle)) > np.sin(np.radians(2 * min(least_deg, 45.0)))
        energies.append(left if new else np.full_like(left, np.nan))
        turns.append(np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]]) @ np.diag([1.0, mirror, 1.0]))
    mean = np.stack([-np.nanmean(p, axis=(1, 2)), -np.nanmean(q, axis=(1, 2))], axis=1)
    tilts = [mean @ pose.T for pose in (*np.array(AXES).reshape(-1, 2, 2), *(turn[:2, :2] for turn in turns))]
    outwards = np.stack([np.nansum((tilt - np.nanmean(tilt, axis=0)) * middles) for tilt in tilts])
    return np.stack(energies, axis=1), outwards, np.stack(turns)
