"""Find the order of the lamps and the axes that explain the photographs of a plane scene best.

Orders and axes are tried (`nishiki.photometric.order_trials`), and their residual and curl are compared tile by tile,
so that each difference has a standard error over tiles of the picture. Candidates for the order are all cyclic shifts
and reversals, and permutations: the stack of photographs has rank 3, and its space and that of the lamps are laid over
each other by rotations and assignments (Kuhn, 1955) in turn, from many starts. Exchanges of two photographs are judged
by themselves, because two of many leave all other measures nearly as they are.
"""

import re
from dataclasses import dataclass, replace

import numpy as np

from nishiki.photometric.consistency import FEWEST_JUDGED, SURE, WORST_LAW
from nishiki.photometric.flags import NOISE
from nishiki.photometric.lambert_fit import median_of_lights, return_none_if_undetermined
from nishiki.photometric.order_trials import (
    FACTORS,
    TILE,
    TURNED,
    OrderTrial,
    Tiles,
    cut_tiles,
    loosen,
    measure_evenness,
    measure_shading,
    measure_slopes,
    tabulate_misfits,
    try_order,
)

STARTS = 60  # rotations from which permutations are sought; exchanged pairs and random orders of 12 need about 10
FINALISTS = 5  # orders by each of two measures that are fitted robustly
REFINED, TURNS = 3, 5  # fits from which photographs are assigned to lamps anew, and how often
FLAT = 0.05  # standard deviation of shading, relative: slopes of some three degrees, which a sheen imitates
TWINS_DEG = 15.0  # asymmetry of the lamps up to which any order has a twin that makes hills hollows: 5 and 7 on two
# domes, where wrong orders were found; 20 and more where none were
DOUBTFUL = 2.0  # standard errors by which an arrangement that is believed may at most be the worse one, and by which
# each of two exchanged photographs has to be the better one alone
HALVED = 0.5  # of the residual that is left of the photographs that an order moves: gloss gains less by chance
UNRIVALLED = 2.0  # times the standard errors of any exchange of two other photographs: gloss on a sound coin gains 7
LEAST_HEIGHT = 0.5  # logarithm of a factor of the lamps' heights, which turns normals by 9 degrees, see `loosen`:
# -.2 to .2 on sound sets of 12 to 96 lamps
GREATEST_HEIGHT = 7.1  # of metres among millimetres: under gloss there is no greatest one
UNLIKELY = 4.0  # standard errors by which the albedo is more even: the best factor of flat things gains 3
UNEVEN = 0.2  # of the logarithm of that factor, by which gloss, dirt and light between the parts of things shift it
EXCHANGED = "x,y,h"  # axes of lamps whose sines and cosines of the elevation were exchanged
CLEARLY = 0.3  # log of the misfit over that with sines and cosines exchanged: .5 to 2.8 on 7 sets listed so
UNITS = (2.54, 10.0, 25.4, 39.37, 100.0, 1000.0)  # ratios of units of length that people mix
COMMON = (1, -1, 2, -2)  # cyclic shifts that are always fitted, and the reversal: a photograph or two more or fewer


@dataclass(frozen=True)
class Arrangement:
    """Order of the lamps and direction of their axes, from the photographs."""

    order: tuple[int, ...]  # order[i]: the stated lamp that photograph i shows
    axes: str  # axes of the lamps in terms of those stated, see `turn_axes`
    # residual, curl: as stated, and then: median misfit relative to the albedo, and root mean square curl relative to
    # that of slopes in any direction
    residual: tuple[float, float]
    curl: tuple[float, float]
    # by how many standard errors residual and curl are better than as stated; 0 where nothing is to be changed
    sigmas: tuple[float, float]
    mirror_undecided: bool  # whether the slopes have as little curl with one axis mirrored, although they are no noise
    # whether the stated arrangement is wrong and none was found that explains the photographs, or two that do and of
    # which the simpler one is far worse; order and axes are then those stated
    unexplained: bool = False
    # factor of the heights of the lamps, with that order and those axes, under which the albedo is even
    height: float = 1.0

    @property
    def rearranged(self) -> bool:
        """Return whether another order or other axes explain the photographs."""
        return self.axes != "x,y" or self.order != tuple(range(len(self.order)))

    @property
    def as_stated(self) -> bool:
        """Return whether nothing is to be changed."""
        return not self.rearranged and not self.unexplained and self.height == 1


@return_none_if_undetermined
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
    found = _arrange_plane(values, lamps)
    if found is None:
        return None
    mended = lamps if found.unexplained else _turn_lamps(lamps[list(found.order)], found.axes)
    exchanged = _turn_lamps(lamps, EXCHANGED)
    fits = [_fit_lamps(values, each) for each in (exchanged, lamps, mended)[: 2 + found.rearranged]]
    left, *misfits = (np.full(1, np.nan) if fit is None else fit[1] for fit in fits)
    gains = [np.log(misfit / left) for misfit in misfits]
    clear = (
        measure_in_errors(gains[0]) > SURE
        and np.nanmean(gains[0]) > CLEARLY
        and measure_in_errors(gains[-1]) > -DOUBTFUL
    )
    if clear and np.nanmedian(left) < WORST_LAW:
        other = _arrange_plane(values, exchanged)
        if other is not None and other.as_stated and _find_height(values, exchanged) == 1:
            return replace(other, axes=EXCHANGED, residual=(found.residual[0], other.residual[0]))
    return found if found.unexplained else replace(found, height=_find_height(values, mended))


def _fit_lamps(values: np.ndarray, lamps: np.ndarray) -> tuple[OrderTrial, np.ndarray] | None:
    """Fit the photographs in their order; None where nothing is shaded.

    Also returns the misfit of each tile (tiles,) relative to its brightness, which the lamps' heights leave as it is.
    """
    tiles = cut_tiles(values, lamps)
    trial = None if tiles is None else try_order(tiles, np.arange(len(values)))
    if tiles is None or trial is None or measure_shading(tiles.values) < FLAT:
        return None
    sample, patches = tiles.sample
    sizes = median_of_lights(np.where(np.isfinite(sample), np.abs(trial.fit.alone), np.nan))
    misfit = sizes / np.nanmean(sample, axis=0)
    return trial, np.array([np.nanmean(misfit[patches == tile]) for tile in range(tiles.values.shape[1])])


def _find_height(values: np.ndarray, lamps: np.ndarray) -> float:
    """Find the factor of the lamps' heights under which the albedo is far more even than as listed, else 1."""
    factor, limit = 1.0, LEAST_HEIGHT * loosen(len(values))
    for _ in range(TURNS if len(values) >= FEWEST_JUDGED else 0):
        fitted = _fit_lamps(values, _turn_lamps(lamps, f"x,y,{factor:.6f}z"))
        if fitted is None or np.nanmedian(fitted[1]) > WORST_LAW:
            return 1.0
        evenness = measure_evenness(fitted[0].normals)
        best = int(np.argmin(np.nanmean(evenness, axis=0)))
        before, factor = factor, float(factor * FACTORS[best])
        if not limit < abs(np.log(factor)) < GREATEST_HEIGHT:
            return 1.0
        if abs(np.log(factor / before)) < UNEVEN:
            break
    else:
        return 1.0
    listed = np.argmin(np.abs(np.log(FACTORS * before)))
    if measure_in_errors(evenness[:, listed] - evenness[:, best]) < UNLIKELY:
        return 1.0
    unit = min((ratio**sign for ratio in UNITS for sign in (1, -1)), key=lambda ratio: abs(np.log(factor / ratio)))
    return unit if abs(np.log(factor / unit)) < UNEVEN / 2 else factor


def _arrange_plane(values: np.ndarray, lamps: np.ndarray) -> Arrangement | None:
    """Find the order and the axes as `arrange` does, without the heights of the lamps."""
    found = _arrange(values, lamps)
    if found is None or found.as_stated:
        return found
    again = None if found.unexplained else _arrange(values, _turn_lamps(lamps[list(found.order)], found.axes))
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
    """Find the order and the axes that explain the photographs best, without a test of the result."""
    from scipy.optimize import linear_sum_assignment

    tiles = cut_tiles(values, lamps)
    if tiles is None:
        return None
    stated = np.arange(len(values))
    first = try_order(tiles, stated)
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
            following: OrderTrial | None = trial
            for _ in range(TURNS):
                if following is None:
                    break
                # assign the photographs to the lamps that explain them best, given the normals of the trial, turned
                cost = np.nanmean(tabulate_misfits(tiles, following, turn), axis=2)
                order = linear_sum_assignment(np.nan_to_num(cost, nan=1.0))[1]
                following, turn = _add(trials, tiles, order), np.eye(3)
    # the simplest arrangement that is better than that stated, and than which no other is better
    poses = range(TURNED), range(TURNED + 2)  # nobody errs by an order and an angle at once
    rivals = [(trial, axes) for trial in trials.values() for axes in poses[trial is first]]
    rivals = [rival for rival in rivals if _beyond_doubt((first, 0), rival)]
    rivals.sort(key=lambda rival: _complexity(rival[0].order, rival[1]))
    rivals = [one for one in rivals if not any(_beyond_doubt(one, other) for other in rivals)]
    # Where a half turn leaves the lamps alike, hills may be hollows; of most things the middle is high.
    best, axes = next((one for one in rivals if one[1] or one[0].outwards[0] >= 0), (rivals or [(first, 0)])[0])
    if best is first and axes == 0 and (pair := _find_exchange(tiles, first)) is not None:
        best = _add(trials, tiles, pair) or trials.get(tuple(pair.tolist()), first)
    misfits = [float(np.nanmedian(trial.misfit)) for trial in (first, best)]
    if (best is not first or axes) and measure_shading(tiles.values) < min(FLAT, 3 * min(misfits)):
        return None  # a flat thing, whose slopes are those that its gloss makes
    sigmas = _compare((first, 0), (best, axes))[:2]
    contested = [_compare((best, axes), (trial, axes)) for trial in trials.values() if trial is not best]
    mirrored, exchanged, quarter = (_compare((best, 0), (best, other))[1] for other in (1, 2, 3))
    return Arrangement(
        tuple(best.order.tolist()),
        _name_axes(best, axes),
        (misfits[0], misfits[1]),
        (_curl(first, 0), _curl(best, axes)),
        sigmas,
        axes == 0 and mirrored > -DOUBTFUL and min(exchanged, quarter) < -SURE,
        # another order, by which people do not err, explains the photographs far better
        (best is not first or axes > 0)
        and any(residual > SURE and left < HALVED and curl > DOUBTFUL for residual, curl, left in contested),
    )


def _add(trials: dict[tuple[int, ...], OrderTrial], tiles: Tiles, order: np.ndarray) -> OrderTrial | None:
    """Try an order that was not tried before; None where it was, or where it cannot be fitted."""
    key = tuple(order.tolist())
    trial = None if key in trials else try_order(tiles, order)
    if trial is not None:
        trials[key] = trial
    return trial


def _complexity(order: np.ndarray, axes: int) -> tuple[int, ...]:
    """Return the sort key: as stated, then axes, small shifts, the reversal, exchanged pairs, and other orders."""
    count = len(order)
    number = np.arange(count)
    moved = int((order != number).sum())
    for kind, plain in enumerate((number, number[::-1])):
        step = int(order[0] - plain[0])
        if (order == np.roll(plain, -step if kind == 0 else step)).all():
            step = min(step % count, -step % count)
            return (int(moved > 0) + int(axes > 0), 2 * (step + (axes >= TURNED) * count) + kind, axes)
    return (1 + int(axes > 0), 2 * count + moved, axes)


def turn_axes(vectors: np.ndarray, axes: str) -> np.ndarray:
    """Turn vectors (..., 3) to axes in terms of their own; ValueError for a text that names none.

    axes : x and y, as `x,-y` where y is mirrored; then, where wanted, `2.5z`, heights multiplied by a factor, or `h`,
    heights exchanged with distances from the z axis; then `turn:30`, by 30 degrees from x towards y.
    """
    found = re.fullmatch(r"(-?x,-?y|-?y,-?x)(?:,(h|[0-9]+(?:[.][0-9]+)?z))?(?:,turn:(-?[0-9]+(?:[.][0-9]+)?))?", axes)
    if found is None or re.fullmatch(r"[0.]+z", found[2] or ""):
        raise ValueError(axes)
    plane = [(-1 if name[0] == "-" else 1) * vectors[..., "xy".index(name[-1])] for name in found[1].split(",")]
    across, height = np.stack(plane, axis=-1), vectors[..., 2:]
    if found[2] == "h":
        distance = np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12)
        across, height = across * height / distance, distance
    elif found[2]:
        height = float(found[2][:-1]) * height
    if found[3]:
        cosine, sine = np.cos(np.radians(float(found[3]))), np.sin(np.radians(float(found[3])))
        across = across @ np.array([[cosine, sine], [-sine, cosine]])
    return np.concatenate([across, height], axis=-1)


def name_heights(axes: str, factor: float) -> str:
    """Name axes, see `turn_axes`, with the heights multiplied by a factor."""
    plane, *turn = axes.split(",turn:")
    return ",turn:".join([f"{plane},{factor:.4g}z", *turn])


def turn_by_half(axes: str) -> str:
    """Name axes, see `turn_axes`, after a half turn."""
    plane, *turn = axes.split(",turn:")
    if turn:
        return f"{plane},turn:{(float(turn[0]) + 360) % 360 - 180:.0f}"
    return ",".join(axis[1:] if axis.startswith("-") else f"-{axis}" for axis in plane.split(","))


def _turn_lamps(lamps: np.ndarray, axes: str) -> np.ndarray:
    """Turn lamps, whose lengths are their light, to other axes; see `turn_axes`."""
    turned = turn_axes(lamps, axes)
    return turned * (np.linalg.norm(lamps, axis=-1) / np.linalg.norm(turned, axis=-1))[..., None]


def _find_exchange(tiles: Tiles, trial: OrderTrial) -> np.ndarray | None:
    """Find the order in which the lamps of two photographs are exchanged, where the tiles of both agree on it.

    The normals are those of all photographs, which two of many hardly turn. Gloss makes exchanges look better as well,
    but then many of them: one is believed that no exchange of two other photographs comes near.
    """
    if np.nanmedian(trial.misfit) < 2 * NOISE:  # there is nothing to gain but rounding
        return None
    table, order = tabulate_misfits(tiles, trial, np.eye(3)), trial.order.copy()
    own = np.einsum("jjt->jt", table)[:, None]
    alone, both = (
        measure_in_errors(np.log(a / b))
        for a, b in ((own, table), (own + own.swapaxes(0, 1), table + table.swapaxes(0, 1)))
    )
    pair = np.array(np.unravel_index(np.argmax(both), both.shape))
    rivals = np.delete(np.delete(both, pair, axis=0), pair, axis=1)
    first, second = pair
    sure = both[first, second] > max(SURE, UNRIVALLED * rivals.max())
    if not sure or min(alone[first, second], alone[second, first]) < DOUBTFUL:
        return None
    order[pair] = order[pair[::-1]]
    return order


def _curl(trial: OrderTrial, axes: int) -> float:
    return float(np.sqrt(np.nanmean(trial.energies[:, axes]) / np.nanmean(trial.energies[:, :TURNED])) / 2)


def _compare(first: tuple[OrderTrial, int], other: tuple[OrderTrial, int]) -> tuple[float, float, float]:
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
        sigma, left = float(measure_in_errors(gained)), float(np.exp(-np.mean(gained)))
    before, after = _shares(first), _shares(other)
    # normals that face away have no slopes: as bad as slopes in any direction
    nowhere = np.isnan(before) & np.isnan(after)
    before, after = (np.where(np.isfinite(e) | nowhere, e, 0.25) for e in (before, after))
    return sigma, float(measure_in_errors((before - after) / (before + after))), left


def _shares(one: tuple[OrderTrial, int]) -> np.ndarray:
    """Compute the curl of every tile as a share of the energy of all four derivatives: 0: a surface, 1/4: noise."""
    return one[0].energies[:, one[1]] / one[0].energies[:, :TURNED].sum(axis=1)


def measure_in_errors(differences: np.ndarray) -> np.ndarray:
    """Divide the mean by its standard error, as the normal deviate that is as rare (Wallace, 1959): tiles may be few.

    differences (..., tiles), NaN where unknown; 0 where nothing is known of the error.
    """
    freedom = np.isfinite(differences).sum(axis=-1) - 1
    known = np.where(np.isfinite(differences), differences, np.nan)
    mean, error = np.nanmean(known, axis=-1), np.nanstd(known, axis=-1, ddof=1) / np.sqrt(freedom + 1)
    rare = np.sqrt(freedom * np.log1p((mean / error) ** 2 / freedom)) * (8 * freedom + 1) / (8 * freedom + 3)
    return np.where(error > 0, np.copysign(rare, mean), 0.0)


def _beyond_doubt(first: tuple[OrderTrial, int], other: tuple[OrderTrial, int]) -> bool:
    """Check whether one test is sure, and the other does not contradict it.

    The residual alone is believed of orders by which people err, and not of one in thousands that fits by chance, and
    where the law holds: under few lamps gloss and cast shadows suit one of the plain orders to a half by chance.
    """
    residual, curl, left = _compare(first, other)
    if curl > SURE and residual > -DOUBTFUL and measure_in_errors(0.25 - _shares(other)) > SURE:
        return True
    moved, plain = _pattern(first[0].order, other[0].order)
    count = len(first[0].order)
    usual = (plain or moved <= _few(count)) and count >= FEWEST_JUDGED
    fitting = np.nanmedian(first[0].misfit) < 2 * NOISE  # there is nothing to gain but rounding
    explained = left < HALVED / loosen(count) and np.nanmedian(other[0].misfit) < WORST_LAW
    return residual > SURE and explained and curl > -DOUBTFUL and usual and not fitting


def _measure_asymmetry(lamps: np.ndarray) -> float:
    """Measure the mean angle in degrees between the lamps and those of them that a half turn brings nearest."""
    from scipy.optimize import linear_sum_assignment

    directions = lamps.reshape(len(lamps), -1, 3).mean(axis=1)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    angles = np.degrees(np.arccos(np.clip(directions * (-1, -1, 1) @ directions.T, -1, 1)))
    return float(angles[linear_sum_assignment(angles)].mean())


def _few(count: int) -> int:
    """Return the number of photographs out of place that people cause by exchanging some."""
    return min(4, count // 3)


def _pattern(first: np.ndarray, other: np.ndarray) -> tuple[int, bool]:
    """Count the photographs whose lamps differ, and check whether one order is the other shifted or reversed."""
    place = np.argsort(first)[other]
    plain = [np.roll(order, s) for order in (np.arange(len(first)), np.arange(len(first))[::-1]) for s in first]
    return int((first != other).sum()), any((place == order).all() for order in plain)


def _name_axes(trial: OrderTrial, axes: int) -> str:
    """Name the axes; of two a half turn apart, which are otherwise alike, those by which the middle stands out."""
    if axes == 0:
        return "x,y"
    outside = trial.outwards[axes] >= 0
    if axes < TURNED:
        return (("x,-y", "y,x", "y,-x") if outside else ("-x,y", "-y,-x", "-y,x"))[axes - 1]
    cosine, sine = trial.turns[axes - TURNED][:2, 0] * (1 if outside else -1)
    return f"x,{'-' if axes > TURNED else ''}y,turn:{np.degrees(np.arctan2(sine, cosine)):.0f}"


def _candidates(tiles: Tiles, seed: int, starts: int) -> list[np.ndarray]:
    """List orders beside the stated one that explain the photographs best by plain least squares, of rank or curl."""
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
    values, curls = np.nan_to_num(tiles.values.reshape(count, -1)), []
    for order in plain:  # slopes by least squares
        normals = (np.linalg.pinv(directions[order]) @ values).T.reshape(-1, TILE, TILE, 3)
        energies = measure_slopes(normals, tiles.middles)[0]
        curls.append(np.nanmedian(energies[:, 0] / energies[:, :TURNED].sum(axis=1)))
    by_curl = [plain[k] for k in np.argsort(curls, kind="stable")]
    return [*common, *_by_rank(level, directions, plain, seed, starts)[:FINALISTS], *by_curl[:FINALISTS]]


def _by_rank(
    level: np.ndarray, directions: np.ndarray, plain: list[np.ndarray], seed: int, starts: int
) -> list[np.ndarray]:
    """Rank orders by how much of the photographs' space of rank 3 the lamps' space holds, the most first."""
    from scipy.optimize import linear_sum_assignment

    axes, _, weights = np.linalg.svd(directions, full_matrices=False)
    whitened = axes @ weights
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
