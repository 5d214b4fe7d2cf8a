"""Find the order of the lamps and the axes that explain the photographs of a plane scene best.

Two tests, of which neither needs the other's assumption:

* The residual of Lambert's law with free gains (`nishiki.photometric.consistency`): a photograph under a lamp that is
  not its own misfits.
* The curl of the slopes p, q of the normals: slopes of a surface have none (Horn and Brooks, 1986). Lamps turned or
  mirrored about the line of sight leave the residual alone, and turn or mirror the normals; with

      a = p_y - q_x,   d = p_x + q_y,   a' = p_y + q_x,   d' = p_x - q_y

  a is the curl as stated, a' with one axis mirrored, d' with both exchanged, d after a quarter turn. A half turn leaves
  its size as it is: it makes hills hollows.

Both are compared tile by tile, so that each difference has a standard error over tiles of the picture. Candidates for
the order are all cyclic shifts and reversals, and permutations: the stack of photographs has rank 3, and its space and
that of the lamps are laid over each other by rotations and assignments (Kuhn, 1955) in turn, from many starts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from nishiki.photometric.consistency import (
    FEWEST_LAMPS,
    GRAZING,
    KINK,
    LEAST_SCALE,
    SURE,
    Fit,
    fit_lambert,
    lit_and_dark,
    none_where_undetermined,
    scale_of,
    solve_normals,
)

TILE = 8  # side of a tile, pixels of the reduced picture: one observation
FEWEST_TILES, MOST_TILES = 12, 140  # a mean of fewer has no useful error; more only take time
MOST_VALUES = 300_000  # of all tiles and photographs; with many lamps fewer tiles are enough
PER_TILE = 5  # pixels of a tile in the fit of gains
STEEPEST = 0.2  # cosine of the steepest slope that counts: beyond, small errors of the normal are any slope
STARTS = 60  # rotations from which permutations are sought; exchanged pairs and random orders of 12 need about 10
FINALISTS = 5  # orders by each of two measures that are fitted robustly
REFINED, TURNS = 3, 5  # fits from which photographs are assigned to lamps anew, and how often
FLAT = 0.05  # standard deviation of shading, relative: slopes of some three degrees, which a sheen imitates
TWINS_DEG = 15.0  # asymmetry of the lamps up to which any order has a twin that makes hills hollows: 5 and 7 on two
# domes, where wrong orders were found; 20 and more where none were
DOUBTFUL = 2.0  # standard errors by which an arrangement that is believed may at most be the worse one
HALVED = 0.5  # of the residual that is left of the photographs that an order moves: gloss gains less by chance
AXES = ((1, 0, 0, 1), (1, 0, 0, -1), (0, 1, 1, 0), (0, 1, -1, 0))  # as stated, mirrored, exchanged, turned
COMMON = (1, -1, 2, -2)  # cyclic shifts that are always fitted, and the reversal: a photograph or two more or fewer
LETTERS = "xy"


@dataclass(frozen=True)
class Arrangement:
    """How lamps belong to photographs, and which way their axes run, by what is seen.

    Attributes
    ----------
    order : tuple of int
        order[i]: the stated lamp that photograph i shows.
    axes : str
        Axes of the lamps in terms of those stated, as `x,-y`.
    residual, curl : (float, float)
        As stated, and then: median misfit relative to the albedo, and root mean square curl relative to that of slopes
        in any direction.
    sigmas : (float, float)
        By how many standard errors residual and curl are better than as stated; 0 where nothing is to be changed.
    mirror_undecided : bool
        Whether the slopes have as little curl with one axis mirrored, although they are no noise.
    unexplained : bool
        Whether the stated arrangement is wrong and none was found that explains the photographs; order and axes are
        then those stated.
    """

    order: tuple[int, ...]
    axes: str
    residual: tuple[float, float]
    curl: tuple[float, float]
    sigmas: tuple[float, float]
    mirror_undecided: bool
    unexplained: bool = False

    @property
    def rearranged(self) -> bool:
        """Whether another order or other axes explain the photographs."""
        return self.axes != "x,y" or self.order != tuple(range(len(self.order)))

    @property
    def as_stated(self) -> bool:
        """Whether nothing is to be changed."""
        return not self.rearranged and not self.unexplained


@dataclass(frozen=True)
class _Tiles:
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
class _Trial:
    """An order with its fit.

    misfit (lights, tiles) relative to the albedo, energies (tiles, 4) of the derivatives that AXES names, (4,) how far
    the normals then point outwards, and the turns about the line of sight, with and without mirroring y, after which
    the curl is least, as matrices (2, 3, 3).
    """

    order: np.ndarray
    fit: Fit
    misfit: np.ndarray
    energies: np.ndarray
    outwards: np.ndarray
    turns: np.ndarray


@none_where_undetermined
def arrange(values: np.ndarray, lamps: np.ndarray) -> Arrangement | None:
    """Find the order and the axes of the lamps that the photographs show.

    Parameters
    ----------
    values : (lights, rows, columns)
        Linear values of the reduced photographs, NaN where unusable.
    lamps : (lights, 3) or (lights, rows, columns, 3)
        Vectors to the lamps as stated, x right, y up; of lamps that stand near, at each pixel, as long as their light
        is strong.

    Returns
    -------
    Arrangement or None
        As stated unless another one is better beyond doubt. Another one is named only where the same test, with the
        lamps arranged so, finds nothing to change. None where nothing can be told.
    """
    found = _arrange(values, lamps)
    if found is None or found.as_stated:
        return found
    again = _arrange(values, turned(lamps[list(found.order)], found.axes))
    if again is not None and again.as_stated:
        moved, plain = _pattern(np.arange(len(values)), np.array(found.order))
        if plain or moved <= _few(len(values)):
            return found
        if _measure_asymmetry(lamps) > TWINS_DEG:
            other = _arrange(values, lamps, seed=1, starts=5 * STARTS)  # one that fits by chance is another one
            if other is not None and (other.order, other.axes) == (found.order, found.axes):
                return found
    return replace(found, order=tuple(range(len(values))), axes="x,y", mirror_undecided=False, unexplained=True)


def _arrange(values: np.ndarray, lamps: np.ndarray, seed: int = 0, starts: int = STARTS) -> Arrangement | None:
    """Find the order and the axes that explain the photographs best, without a test of what was found."""
    tiles = _cut(values, lamps)
    if tiles is None:
        return None
    stated = np.arange(len(values))
    first = _try(tiles, stated)
    if first is None:
        return None
    trials = {tuple(stated.tolist()): first}
    for order in _candidates(tiles, seed, starts):
        _add(trials, tiles, order)
    for trial in [*sorted(trials.values(), key=lambda t: np.nanmedian(t.misfit))[:REFINED], first]:
        turns = [np.eye(3)]
        if trial is not first:
            # a ring of lamps turned by its own step is explained as well: the normals turned so that the curl is least
            turns += [
                turn @ half
                for turn in trial.turns
                if np.isfinite(turn).all()
                for half in (np.eye(3), np.diag([-1.0, -1.0, 1.0]))
            ]
        for turn in turns:
            following: _Trial | None = trial
            for _ in range(TURNS):
                following = _add(trials, tiles, _reassigned(tiles, following, turn))
                if following is None:
                    break
                turn = np.eye(3)
    # the simplest arrangement that is better than that stated, and than which no other is better
    rivals = [(trial, axes) for trial in trials.values() for axes in range(len(AXES))]
    rivals = [rival for rival in rivals if _beyond_doubt((first, 0), rival)]
    rivals.sort(key=lambda rival: _complexity(rival[0].order, rival[1]))
    best, axes = next((one for one in rivals if not any(_beyond_doubt(one, other) for other in rivals)), (first, 0))
    misfits = [float(np.nanmedian(trial.misfit)) for trial in (first, best)]
    if (best is not first or axes) and _measure_shading(tiles.values) < min(FLAT, 3 * min(misfits)):
        return None  # a flat thing, whose slopes are those that its gloss makes
    sigmas = _compare((first, 0), (best, axes))[:2]
    mirrored, exchanged, quarter = (_compare((best, axes), (best, axes ^ other))[1] for other in (1, 2, 3))
    return Arrangement(
        tuple(best.order.tolist()),
        _name_axes(axes, best.outwards),
        (misfits[0], misfits[1]),
        (_curl(first, 0), _curl(best, axes)),
        sigmas,
        mirrored > -DOUBTFUL and min(exchanged, quarter) < -SURE,
    )


def _add(trials: dict[tuple[int, ...], _Trial], tiles: _Tiles, order: np.ndarray) -> _Trial | None:
    """Try an order that was not tried before; None where it was, or where it cannot be fitted."""
    key = tuple(order.tolist())
    trial = None if key in trials else _try(tiles, order)
    if trial is not None:
        trials[key] = trial
    return trial


def _complexity(order: np.ndarray, axes: int) -> tuple[int, ...]:
    """Sort key: as stated, then axes, small shifts, the reversal, exchanged pairs, and other orders."""
    count = len(order)
    number = np.arange(count)
    moved = int((order != number).sum())
    for kind, plain in enumerate((number, number[::-1])):
        step = int(order[0] - plain[0])
        if (order == np.roll(plain, -step if kind == 0 else step)).all():
            step = min(step % count, -step % count)
            return (int(moved > 0) + int(axes > 0), 2 * step + kind, axes)
    return (1 + int(axes > 0), 2 * count + moved, axes)


def turned(directions: np.ndarray, axes: str) -> np.ndarray:
    """Vectors (..., 3) by the axes that `Arrangement.axes` names: `x,-y` has y mirrored."""
    result = directions.copy()
    for place, name in enumerate(axes.split(",")):
        sign = -1 if name.startswith("-") else 1
        result[..., place] = sign * directions[..., LETTERS.index(name.lstrip("-"))]
    return result


def _cut(values: np.ndarray, lamps: np.ndarray) -> _Tiles | None:
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
    return _Tiles(part, vectors, np.stack([across - across.mean(), down.mean() - down], axis=1))


def _measure_shading(values: np.ndarray) -> float:
    """Measure by how much the light of one lamp differs between pixels of equal albedo, relative to it."""
    logarithms = np.log(np.where(values > 0, values, np.nan)).reshape(len(values), -1)
    for _ in range(2):  # without the lamps' strengths and the albedo
        logarithms = logarithms - np.nanmedian(logarithms, axis=1, keepdims=True)
        logarithms -= np.nanmedian(logarithms, axis=0)
    return 1.4826 * float(np.nanmedian(np.abs(logarithms)))


def _try(tiles: _Tiles, order: np.ndarray) -> _Trial | None:
    """Fit normals with the lamps in this order, and measure misfit and curl of every tile."""
    count, number = tiles.values.shape[:2]
    lamps = tiles.lamps[order]
    sample, patches = tiles.sample
    fit = fit_lambert(sample, lamps[:, patches] if lamps.shape[1] > 1 else lamps, patches)
    if not np.isfinite(fit.gains).all():
        return None
    sizes = np.where(np.isfinite(sample), np.abs(fit.alone), np.nan) / np.linalg.norm(fit.normals, axis=1)
    misfit = np.stack([np.nanmedian(sizes[:, patches == tile], axis=1) for tile in range(number)], axis=1)
    flat = tiles.values.reshape(count, -1)
    normals = _robust_normals(flat, lamps, fit)
    return _Trial(order, fit, misfit, *_slopes(normals.reshape(number, TILE, TILE, 3), tiles.middles))


def _reassigned(tiles: _Tiles, trial: _Trial, turn: np.ndarray) -> np.ndarray:
    """Assign the photographs to the lamps that explain them best, given the normals of a trial, turned."""
    from scipy.optimize import linear_sum_assignment

    count, (sample, patches) = len(tiles.values), tiles.sample
    albedo = np.linalg.norm(trial.fit.normals, axis=1)
    vectors = tiles.lamps if tiles.lamps.shape[1] == 1 else tiles.lamps[:, patches]
    shading = np.maximum(np.einsum("jsa,sa->js", vectors, trial.fit.normals @ turn.T / albedo[:, None]), 0.0)
    cost = np.ones((count, count))
    for photograph, values in enumerate(sample / albedo):
        known = np.isfinite(values)
        if known.sum() < FEWEST_TILES:
            continue
        here, there = values[known], shading[:, known]
        gains = np.median(here) / np.maximum(np.median(there, axis=1), GRAZING)
        for _ in range(2):
            weights = 1 / (GRAZING**2 + np.abs(here - gains[:, None] * there))
            gains = (weights * there * here).sum(axis=1) / np.maximum((weights * there**2).sum(axis=1), 1e-12)
        cost[photograph] = np.minimum(np.abs(here - gains[:, None] * there), 1.0).mean(axis=1)
    return linear_sum_assignment(np.nan_to_num(cost, nan=1.0))[1]


def _robust_normals(values: np.ndarray, lamps: np.ndarray, fit: Fit) -> np.ndarray:
    """Albedo times normal (pixels, 3) of all pixels with the gains of a fit, by four rounds of reweighting."""
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


def _slopes(normals: np.ndarray, middles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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


def _curl(trial: _Trial, axes: int) -> float:
    return float(np.sqrt(np.nanmean(trial.energies[:, axes]) / np.nanmean(trial.energies)) / 2)


def _compare(first: tuple[_Trial, int], other: tuple[_Trial, int]) -> tuple[float, float, float]:
    """Return the standard errors by which residual and curl of another trial with its axes are below the first's.

    The residual is that of the photographs whose lamps differ; third, the part of it that is left.
    """
    sigma, left = 0.0, 1.0
    moved = first[0].order != other[0].order
    if moved.any():
        before, after = (
            np.nanmean(np.where(np.isfinite(t.misfit), t.misfit, 1.0)[moved], axis=0) for t, _ in (first, other)
        )
        gained = np.log(before / after)
        sigma, left = _in_errors(gained), float(np.exp(-np.mean(gained)))
    before, after = _shares(first), _shares(other)
    # normals that face away have no slopes: as bad as slopes in any direction
    nowhere = np.isnan(before) & np.isnan(after)
    before, after = (np.where(np.isfinite(e) | nowhere, e, 0.25) for e in (before, after))
    return sigma, _in_errors((before - after) / (before + after)), left


def _shares(one: tuple[_Trial, int]) -> np.ndarray:
    """Curl of every tile as a share of the energy of all four derivatives: 0 for a surface, 1/4 for noise."""
    return one[0].energies[:, one[1]] / one[0].energies.sum(axis=1)


def _in_errors(differences: np.ndarray) -> float:
    """Mean over its standard error, as the normal deviate that is as rare (Wallace, 1959): tiles may be few."""
    known = differences[np.isfinite(differences)]
    freedom = len(known) - 1
    error = np.std(known, ddof=1) / np.sqrt(len(known)) if freedom > 0 else 0.0
    if not error > 0:
        return 0.0
    rare = np.sqrt(freedom * np.log1p((np.mean(known) / error) ** 2 / freedom)) * (8 * freedom + 1) / (8 * freedom + 3)
    return float(np.copysign(rare, np.mean(known)))


def _beyond_doubt(first: tuple[_Trial, int], other: tuple[_Trial, int]) -> bool:
    """Whether one test is sure, and the other does not speak against it.

    The residual alone is believed of orders by which people err, and not of one in thousands that fits by chance.
    """
    residual, curl, left = _compare(first, other)
    if curl > SURE and residual > -DOUBTFUL and _in_errors(0.25 - _shares(other)) > SURE:
        return True
    moved, plain = _pattern(first[0].order, other[0].order)
    usual = plain or moved <= _few(len(first[0].order))
    fitting = np.nanmedian(first[0].misfit) < 2 * LEAST_SCALE  # there is nothing to gain but rounding
    return residual > SURE and left < HALVED and curl > -DOUBTFUL and usual and not fitting


def _measure_asymmetry(lamps: np.ndarray) -> float:
    """Measure the mean angle in degrees between the lamps and those of them that a half turn brings nearest."""
    from scipy.optimize import linear_sum_assignment

    directions = lamps.reshape(len(lamps), -1, 3).mean(axis=1)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    angles = np.degrees(np.arccos(np.clip(directions * (-1, -1, 1) @ directions.T, -1, 1)))
    return float(angles[linear_sum_assignment(angles)].mean())


def _few(count: int) -> int:
    """Count of photographs out of place that people cause by exchanging some."""
    return min(4, count // 3)


def _pattern(first: np.ndarray, other: np.ndarray) -> tuple[int, bool]:
    """Count the photographs whose lamps differ, and say whether one order is the other shifted or reversed."""
    place = np.argsort(first)[other]
    plain = [np.roll(order, s) for order in (np.arange(len(first)), np.arange(len(first))[::-1]) for s in first]
    return int((first != other).sum()), any((place == order).all() for order in plain)


def _name_axes(axes: int, outwards: np.ndarray) -> str:
    """Name the axes; of the two a half turn apart, which nothing else tells, those by which the middle stands out."""
    if axes == 0:
        return "x,y"
    sign = 1 if outwards[axes] >= 0 else -1
    matrix = sign * np.array(AXES[axes]).reshape(2, 2)
    return ",".join(("-" if row.sum() < 0 else "") + LETTERS[int(np.flatnonzero(row)[0])] for row in matrix)


def _candidates(tiles: _Tiles, seed: int, starts: int) -> list[np.ndarray]:
    """Orders other than that stated which explain the photographs best by plain least squares, of rank or of curl."""
    count = len(tiles.values)
    directions = tiles.lamps.mean(axis=1)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    flat = tiles.values.reshape(count, -1)
    flat = flat[:, np.isfinite(flat).all(axis=0)] if np.isfinite(flat).all(axis=0).sum() > 50 else np.nan_to_num(flat)
    level = flat / np.maximum(flat.mean(axis=0), 1e-300)
    level = np.minimum(level, np.quantile(level, 0.95, axis=0))  # without highlights
    plain = [np.roll(order, s) for order in (np.arange(count), np.arange(count)[::-1]) for s in range(count)][1:]
    number = np.arange(count)
    common = [*(np.roll(number, s) for s in COMMON), number[::-1]]
    by_curl = sorted(plain, key=lambda order: _plain_curl(tiles, directions[order]))
    return [*common, *_by_rank(level, directions, plain, seed, starts)[:FINALISTS], *by_curl[:FINALISTS]]


def _plain_curl(tiles: _Tiles, directions: np.ndarray) -> float:
    """Curl of the slopes by least squares with these directions."""
    values = np.nan_to_num(tiles.values.reshape(len(directions), -1))
    normals = (np.linalg.pinv(directions) @ values).T.reshape(-1, TILE, TILE, 3)
    energies, _, _ = _slopes(normals, tiles.middles)
    return float(np.nanmedian(energies[:, :1].sum(axis=1) / energies.sum(axis=1)))


def _by_rank(
    level: np.ndarray, directions: np.ndarray, plain: list[np.ndarray], seed: int, starts: int
) -> list[np.ndarray]:
    """Orders by how much of the photographs' space of rank 3 the lamps' space holds, the most first."""
    from scipy.optimize import linear_sum_assignment

    whitened = _whitened(directions)
    scores: dict[tuple[int, ...], float] = {}
    rng = np.random.default_rng(seed)
    even = level / np.linalg.norm(level, axis=1, keepdims=True)  # as if all lamps were equally strong
    for stack in (level, even):
        space = np.linalg.svd(stack, full_matrices=False)[0][:, :3]
        orders = list(plain)
        for _ in range(starts):
            turn, order = np.linalg.qr(rng.normal(size=(3, 3)))[0], np.arange(len(directions))
            for _ in range(20):
                last, order = order, linear_sum_assignment(-(space @ turn) @ whitened.T)[1]
                if (order == last).all():
                    break
                left, _, right = np.linalg.svd(space.T @ whitened[order])
                turn = left @ right
            orders.append(order)
        for order in orders:
            held = float(((whitened[order].T @ space) ** 2).sum())
            scores[tuple(order.tolist())] = max(held, scores.get(tuple(order.tolist()), 0.0))
    return [np.array(order) for order in sorted(scores, key=lambda order: -scores[order])]


def _whitened(vectors: np.ndarray) -> np.ndarray:
    left, _, right = np.linalg.svd(vectors, full_matrices=False)
    return left @ right
