"""Whether white boards belong to the photographs and to the lamps that the capture gives them to.

With lamp strength s_i, direction l_i and a board at angle theta_i, block by block over the object (Lambert, 1760):

    photograph P_i = s_i (m . l_i)        board B_i = s_i cos(theta_i)

so that log P_i - log B_j = log (m . l_i) - log cos(theta_i) for j = i, whatever the strengths, and for a board of
another lamp only where it happens to shine alike. m (three numbers a block) is fitted to the photographs divided by
their boards by least absolute deviations. The median misfit of every photograph with every board is a table; the
assignment of least total (Kuhn, 1955, the Hungarian method) tells which boards would fit better. Gloss, shadows and
lamps of unequal strength misfit with every board alike: exchanging boards then gains nothing, and nothing is reported.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from nishiki.capture.frames import Frame
from nishiki.formats.problems import Problem, warning
from nishiki.observations.frames import FrameReader
from nishiki.observations.reference import DarkField, board_cosine
from nishiki.photometric.consistency import quiet

BLOCKS = 8  # a side, over the bounding box of the object
SAMPLES = 12  # a side, of a block
LEAST_KNOWN = 0.3  # of a block's samples, and of the lamps a block is known under
FEWEST_LAMPS = 5
FEWEST_BLOCKS = 4
LARGEST_TABLE = 4e7  # numbers: lamps x lamps x blocks; with more lamps fewer blocks are looked at
GAIN = 0.04  # log units (4 %) that an exchange must gain: less does no harm
CLEARLY = 1.5  # times the usual misfit that an exchange must gain
SHARE = 0.3  # of the misfit that it must gain
BY_CHANCE = 0.65  # of the mean misfit of all pairs
FAR_BETTER = 0.65  # of the misfit; right pairings keep 0.75 or more of it, also of mirrors
FLOOR = 3.0  # the usual misfit is at most that many times what the best assignment leaves
ALONE = np.log(2.5)  # misfit of one photograph that no other board explains
GRAZING, FACING = 0.3, 0.9  # cosines beyond which shadows, or gloss, can do that
STEEP = 0.2  # spread of log cos(theta) from which the boards' levels must follow it
FOLLOWS = 0.3  # correlation of the two
LEVEL_GAIN = 0.15  # log units by which both of two exchanged lights must stand out
LEVEL_CLEARLY = 5.0  # times the usual misfit
MOST_NAMED = 12


@dataclass
class PairLevels:
    """Levels of photographs and boards on a coarse grid over the object, collected frame by frame.

    mask (rows, columns): the object; photographs, boards: by light, (blocks,) float64 linear per second, NaN where
    too few samples of a block are unsaturated and on the object.
    """

    reader: FrameReader
    darks: DarkField
    mask: np.ndarray
    photographs: dict[int, np.ndarray] = field(default_factory=dict)
    boards: dict[int, np.ndarray] = field(default_factory=dict)

    def __post_init__(self):
        high, wide = (np.flatnonzero(self.mask.any(axis=axis)) for axis in (1, 0))
        blocks_high, samples_high, self.rows = _places(high[0], high[-1] + 1)
        blocks_wide, samples_wide, self.columns = _places(wide[0], wide[-1] + 1)
        self.shape = (blocks_high, samples_high, blocks_wide, samples_wide)
        self.edges = (
            np.linspace(high[0], high[-1] + 1, blocks_high + 1),
            np.linspace(wide[0], wide[-1] + 1, blocks_wide + 1),
        )
        self.inside = self.mask[np.ix_(self.rows, self.columns)] != 0

    def add(self, frame: Frame, codes: np.ndarray) -> None:
        """Add the codes (rows, columns, channels) of a white frame or of a photograph of the object."""
        reader = self.reader
        part = codes[np.ix_(self.rows, self.columns)]
        linear = part if part.dtype.kind == "f" else reader.table[part]
        dark = self.darks.at(frame.exposure_s).mean(axis=(0, 1))
        values = (linear - dark).mean(axis=2, dtype=np.float64) / (frame.exposure or 1.0)
        values[(part >= reader.saturated).any(axis=2) | ~self.inside] = np.nan
        high, samples_high, wide, samples_wide = self.shape
        blocks = values.reshape(high, samples_high, wide, samples_wide).swapaxes(1, 2).reshape(high * wide, -1)
        levels, known = np.full(len(blocks), np.nan), np.isfinite(blocks).mean(axis=1) >= LEAST_KNOWN
        if known.any():
            levels[known] = np.nanmedian(blocks[known], axis=1)
        kept = self.boards if frame.role == "white" else self.photographs
        kept[reader.capture.lights.index(frame.light)] = np.where(levels > 0, levels, np.nan)

    def problems(self) -> list[Problem]:
        """What the levels say against the pairs of photographs, boards and lamps; nothing without boards."""
        lights = self.reader.capture.lights
        places = sorted(self.photographs.keys() & self.boards.keys())
        if len(places) < FEWEST_LAMPS:
            return []
        photographs, boards = (np.stack([kept[i] for i in places]) for kept in (self.photographs, self.boards))
        cosines = np.stack([self._cosines(i) for i in places])
        names, directions = [lights.names[i] for i in places], lights.directions[places]
        exchange = find_exchanges(photographs, boards, cosines, directions)
        problems = self._exchange_warnings(exchange, names) if exchange else []
        if any(p.kind == "white-exchanged" for p in problems):
            return problems
        with quiet():
            levels = np.nanmedian(np.log(boards), axis=1)
            expected = np.median(np.log(cosines), axis=1) - 2 * np.log(self._distances(places))
        if not np.isfinite(levels).all():
            return problems
        return problems + level_problems(levels, expected, directions, names)

    def _cosines(self, place: int) -> np.ndarray:
        cosine = np.asarray(board_cosine(self.reader, place, self.edges))
        return np.maximum(np.broadcast_to(cosine, (self.shape[0], self.shape[2], 1)).ravel(), 1e-3)

    def _distances(self, places: list[int]) -> np.ndarray:
        """Of lamps at known positions; 1 for directions."""
        lights = self.reader.capture.lights
        near = self.reader.capture.settings.lights.kind == "position_mm"
        return np.linalg.norm(lights.vectors[places], axis=1) if near else np.ones(len(places))

    def _exchange_warnings(self, exchange: Exchange, names: list[str]) -> list[Problem]:
        capture, problems = self.reader.capture, []
        moved = np.flatnonzero(exchange.better != np.arange(len(names)))
        board = {name: frame.file for name in names if (frame := capture.white_of(name))}
        if len(moved):
            pairs = [f"{board[names[exchange.better[i]]]} for light {names[i]}" for i in moved[:MOST_NAMED]]
            more = f" and {len(moved) - MOST_NAMED} more" if len(moved) > MOST_NAMED else ""
            was, would = (100 * np.expm1(x[moved].mean()) for x in (exchange.before, exchange.after))
            what = "white boards do not belong to their photographs: other boards fit better"
            remedy = "Compare the boards with the photographs and correct the column light of the white frames"
            said = f"{', '.join(pairs)}{more}; mean misfit {was:.0f} % as listed, {would:.0f} % then"
            problems.append(warning("white-exchanged", "frames.csv", what, found=said, remedy=remedy))
        for i in np.flatnonzero(exchange.alone):
            file = next(
                f.file for f in capture.observed if capture.lights.names[capture.lights.index(f.light)] == names[i]
            )
            factor, than = np.exp(abs(exchange.alone[i])), "brighter" if exchange.alone[i] > 0 else "darker"
            what = (
                f"photograph is {factor:.1f} times {than} than expected from its white board and the other photographs"
            )
            remedy = "Check exposure, lamp and board of this light"
            problems.append(warning("white-disagrees", file, what, found=f"board {board[names[i]]}", remedy=remedy))
        return problems


def level_problems(levels: np.ndarray, expected: np.ndarray, directions: np.ndarray, names: list[str]) -> list[Problem]:
    """Whether the boards' levels follow cos(theta) of their lamps (and the distance, where it is known).

    levels, expected (lamps,): logarithms. Lamps differ in strength, so what is told is a level that does not follow
    at all, or two lamps that both stand out of the smooth course over the directions and would not if exchanged.
    """
    if expected.std() >= STEEP and np.corrcoef(levels, expected)[0, 1] < FOLLOWS:
        what = "levels of the white boards do not follow cos(theta) of their lights"
        said = f"correlation {np.corrcoef(levels, expected)[0, 1]:.2f}"
        remedy = "Check that the lights belong to the photographs, unless lamp strengths or distances differ that much"
        return [warning("white-levels", "frames.csv", what, found=said, remedy=remedy)]
    strength, terms = levels - expected, np.column_stack([np.ones(len(levels)), directions[:, :2]])
    misfit = strength - _least_absolute(terms, strength)
    usual, size = np.median(np.abs(misfit)), np.abs(misfit)
    # exchanged lights: each board has the level that is expected of the other
    step = (levels - misfit)[None, :] - (levels - misfit)[:, None]
    then = np.maximum(np.abs(misfit[:, None] - step), np.abs(misfit[None, :] + step))
    now = np.minimum(size[:, None], size[None, :])
    exchanged = np.triu((now >= max(LEVEL_GAIN, LEVEL_CLEARLY * usual)) & (then <= now / 3), 1)
    odd = [f"{names[i]} and {names[j]}" for i, j in np.argwhere(exchanged)]
    if not odd:
        return []
    what = "levels of white boards would follow cos(theta) and their neighbours if lights were exchanged"
    remedy = "Check that these lights, boards and photographs belong together"
    return [warning("white-levels", "frames.csv", what, found="; ".join(odd[:MOST_NAMED]), remedy=remedy)]


def _least_absolute(terms: np.ndarray, values: np.ndarray, rounds: int = 20) -> np.ndarray:
    """Values (n,) fitted by terms (n, k) in the least absolute deviations."""
    weights = np.ones(len(values))
    for _ in range(rounds):
        root = np.sqrt(weights)[:, None]
        fitted = terms @ np.linalg.lstsq(terms * root, values * root[:, 0], rcond=None)[0]
        weights = 1.0 / np.maximum(np.abs(values - fitted), 1e-4)
    return fitted


def _places(start: int, stop: int) -> tuple[int, int, np.ndarray]:
    """Blocks and samples a block along one side, and the pixels (blocks * samples,) where they are taken."""
    length = stop - start
    blocks = min(BLOCKS, length)
    samples = max(1, min(SAMPLES, length // blocks))
    count = blocks * samples
    return blocks, samples, start + ((np.arange(count) + 0.5) * length / count).astype(np.int64)


@dataclass(frozen=True)
class Exchange:
    """better[i]: the board that fits photograph i best, i itself where nothing is gained; before, after (lamps,):
    misfit with its own board and with that one, log units; usual: the median misfit; alone (lamps,): signed misfit of
    photographs that no board explains, else 0."""

    better: np.ndarray
    before: np.ndarray
    after: np.ndarray
    usual: float
    alone: np.ndarray


def find_exchanges(
    photographs: np.ndarray, boards: np.ndarray, cosines: np.ndarray, directions: np.ndarray
) -> Exchange | None:
    """Boards that would fit other photographs better than their own.

    photographs, boards (lamps, blocks) linear levels, NaN where not known; cosines (lamps, blocks) between board and
    lamp; directions (lamps, 3) unit. None where there is too little to tell.
    """
    known = np.isfinite(photographs) & np.isfinite(boards)
    chosen = np.flatnonzero(known.mean(axis=0) >= 2 * LEAST_KNOWN)
    lamps = len(photographs)
    most = int(max(FEWEST_BLOCKS, LARGEST_TABLE / lamps**2))
    chosen = chosen[:: max(1, -(-len(chosen) // most))]
    if lamps < FEWEST_LAMPS or len(chosen) < FEWEST_BLOCKS:
        return None
    with quiet():
        return _exchanges(*(np.log(x[:, chosen]) for x in (photographs, boards, cosines)), directions)


def _exchanges(levels: np.ndarray, whites: np.ndarray, cosines: np.ndarray, directions: np.ndarray) -> Exchange:
    """`find_exchanges` with logarithms (lamps, blocks), of blocks that are known under most lamps."""
    from scipy.optimize import linear_sum_assignment

    lamps = len(levels)

    def reflected(order: np.ndarray) -> np.ndarray:
        """log (m . l) - log cos(theta) of every lamp and block, if the boards are in this order."""
        fitted = _fit_lambert(np.exp(levels - whites[order] + cosines), directions)
        return _log_shading(fitted, directions) - cosines

    identity = np.arange(lamps)
    first = reflected(identity)
    misfits = _misfits(levels - first, whites)
    before = misfits[identity, identity]

    def settle(stay: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Best order, its misfits, and those of the own boards beside it, where leaving the own board costs `stay`."""
        penalty = stay * (1 - np.eye(lamps))
        best, after, kept = identity, before, before
        # once from the photographs as they are paired, once from a flat grey object
        for shading in (first, _flat(levels, whites, cosines, directions)):
            order = identity
            for _ in range(6):
                last, order = order, linear_sum_assignment(_misfits(levels - shading, whites) + penalty)[1]
                shading = reflected(order)
                if (order == last).all():
                    break
            table = _misfits(levels - shading, whites)
            if (
                table[identity, order].sum() + stay * (order != identity).sum()
                < after.sum() + stay * (best != identity).sum()
            ):
                best, after, kept = order, table[identity, order], table[identity, identity]
        return best, after, kept

    free = settle(0.0)
    usual = min(float(np.median(before)), FLOOR * float(np.median(free[1])))
    best, after, _ = settle(max(GAIN / 2, usual))
    better = identity.copy()
    # a pairing hardly better than chance, which another order makes far better: most boards are wrong
    chance = misfits.mean()
    if chance >= 2 * GAIN and before.mean() >= BY_CHANCE * chance and free[1].mean() <= FAR_BETTER * before.mean():
        order, after, kept = free
        for cycle in _cycles(order):  # boards that shine alike may stand in any order
            if (kept[cycle] - after[cycle]).mean() >= GAIN:
                better[cycle] = order[cycle]
        return Exchange(better, before, after, usual, np.zeros(lamps))
    for cycle in _cycles(best):
        gain = (before[cycle] - after[cycle]).mean()
        if gain >= max(GAIN, CLEARLY * usual) and gain >= SHARE * before[cycle].mean():
            better[cycle] = best[cycle]
    with quiet():
        signed = np.nan_to_num(np.nanmedian(levels - first - whites, axis=1))
    steep = directions[:, 2]
    odd = np.abs(signed) > max(ALONE, 5 * usual)
    odd &= np.where(signed < 0, steep > GRAZING, steep < FACING) & (better == identity)
    return Exchange(better, before, after, usual, np.where(odd, signed, 0.0))


def _fit_lambert(values: np.ndarray, directions: np.ndarray, rounds: int = 8) -> np.ndarray:
    """m (blocks, 3) with values (lamps, blocks) = directions . m in the least absolute deviations, reweighted."""
    known = np.isfinite(values)
    filled = np.where(known, values, 0.0)
    scale = np.nanmedian(values, axis=0)
    weights = known.astype(np.float64)
    for _ in range(rounds):
        normal = np.einsum("ib,ik,il->bkl", weights, directions, directions)
        normal += 1e-6 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        fitted = np.linalg.solve(normal, np.einsum("ib,ik,ib->bk", weights, directions, filled)[..., None])[..., 0]
        weights = np.where(known, 1.0 / np.maximum(np.abs(filled - directions @ fitted.T), 0.01 * scale), 0.0)
    return fitted


def _log_shading(fitted: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """log (m . l), NaN where the block hardly faces the lamp."""
    shading = directions @ fitted.T
    return np.log(np.where(shading > 0.15 * np.linalg.norm(fitted, axis=1), shading, np.nan))


def _flat(levels: np.ndarray, whites: np.ndarray, cosines: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """What a flat object reflects, from the mean over all lamps: it does not depend on how the boards are paired."""
    frontal = np.log(np.maximum(directions[:, 2:3], 0.05)) - cosines
    return frontal + np.nanmean(levels, axis=0) - np.nanmean(whites + frontal, axis=0)


def _misfits(expected: np.ndarray, whites: np.ndarray) -> np.ndarray:
    """Median over the blocks of |expected board i - board j|, (lamps, lamps); 0 for lamps of which nothing is known."""
    table = np.zeros((len(whites), len(whites)))
    for i, row in enumerate(expected):
        known = np.isfinite(row) & np.isfinite(whites).all(axis=0)
        if known.sum() >= FEWEST_BLOCKS:
            table[i] = np.median(np.abs(row[known] - whites[:, known]), axis=1)
    return table


def _cycles(order: np.ndarray) -> list[np.ndarray]:
    """Groups of lamps among which an assignment exchanges boards."""
    left, cycles = set(np.flatnonzero(order != np.arange(len(order))).tolist()), []
    while left:
        cycle = [min(left)]
        while (following := int(order[cycle[-1]])) != cycle[0]:
            cycle.append(following)
        left -= set(cycle)
        cycles.append(np.array(cycle))
    return cycles
