"""Find photographs of a polarisation series that bear the states of others, and describe its separation.

With H the projection on what angles can do to the light (`series_design`), P = I - H, the pictures of one view as the
rows of Y and S = Y Y', the misfit of the photographs in an order o is

    tr(P S[o, o])

so that thousands of orders are compared without the pictures: every exchange of two photographs, and cyclic shifts and
reversals of the list. Y is taken orthogonal to the mean picture, its slopes and a constant: lamps that vary, a camera
that moves a little and stray light then leave no misfit, whatever the order.

Statistics of a separation, and of how well a series agrees with its own model, stand below.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nishiki.polarisation.noise import complete_around, squared_differences
from nishiki.polarisation.polarisation import LIT, SeparatedView
from nishiki.polarisation.polariser_states import StateSums
from nishiki.threads import strips

LEAVES = 0.7  # of the misfit, at most, that another order may leave where many photographs test the model
SPARE = 4.0  # surplus photographs with which half of that is allowed: few fit several orders by chance
EXPLAINED = 0.1  # of the variation that the right order may leave: else the model itself is wrong
AS_GOOD = 1.25  # times the least misfit: orders that explain the photographs as well
PAIRS, WORTH = 2, 0.7  # exchanges beside a shift or reversal, by which people err, and what each may leave
SHUFFLES, BY_CHANCE = 19, 2  # random orders, and how many of them may fit as well
MOST_VALUES = 1 << 19
GROUP = 64  # neighbouring values of a photograph that are averaged
DRIFT = 0.02  # of the light: a lamp varies by as much between photographs
FEWEST_FITTED = 3  # surplus photographs that tell whether random orders fit as well


@dataclass(frozen=True)
class SeriesOrder:
    """Order of the states that explains the photographs of a series best."""

    # order[i]: the photograph that shows state i; the stated order unless another one is better beyond doubt
    order: tuple[int, ...]
    others: tuple[tuple[int, ...], ...]  # exchanges of two photographs that explain them as well as `order`
    # unexplained, corrected: share of the variation between the photographs that the angles leave, as stated and in
    # `order`
    unexplained: float
    corrected: float

    @property
    def all(self) -> tuple[tuple[int, ...], ...]:
        """Every order that explains the photographs as well."""
        return (self.order, *self.others)

    @property
    def as_stated(self) -> bool:
        """Return whether no other order is better beyond doubt."""
        return self.order == tuple(range(len(self.order)))


def series_design(angles_deg: np.ndarray) -> np.ndarray:
    """Return the changes of light (states, terms) by turning polarisers, or retarders where the states are many.

    angles_deg : (states, 1 or 2), of the analyser, or of generator and analyser. Each arm contributes 1 and cosine and
    sine of twice its angle, retarders of four times as well, whatever their calibration is; arms multiply.
    """
    designs = []
    for multiples in ((2, 4), (2,)) if angles_deg.shape[1] > 1 else ((2,),):
        turns = np.radians(angles_deg)[:, :, None] * multiples
        arms = np.concatenate([np.ones((*angles_deg.shape, 1)), np.cos(turns), np.sin(turns)], axis=2)
        design = arms[:, 0]
        for arm in range(1, arms.shape[1]):
            design = (design[:, :, None] * arms[:, arm, None]).reshape(len(arms), -1)
        designs.append(design)
        if len(design) > design.shape[1] + FEWEST_FITTED and np.linalg.matrix_rank(design) == design.shape[1]:
            break
    return designs[-1]


def remove_nuisance(pictures: np.ndarray) -> np.ndarray:
    """Return (states, pixels) of pictures (states, rows, columns), orthogonal to mean picture, slopes and constant."""
    mean = pictures.mean(axis=0)
    slopes = np.gradient(mean) if min(mean.shape) > 1 else []
    nuisance = np.linalg.qr(np.stack([mean, np.ones_like(mean), *slopes]).reshape(len(slopes) + 2, -1).T)[0]
    flat = pictures.reshape(len(pictures), -1)
    return flat - (flat @ nuisance) @ nuisance.T


def find_order(series: np.ndarray, design: np.ndarray) -> SeriesOrder | None:
    """Find the order of the photographs (states, values) that a design (states, terms) explains best.

    None where as many terms as photographs, or photographs without variation, leave nothing to compare.
    """
    count = len(series)
    rest = np.eye(count) - design @ np.linalg.pinv(design)
    surplus = round(float(np.trace(rest)))
    products = series @ series.T
    variation = float(np.trace(products) - products.sum() / count)
    if surplus < 1 or not variation > 0:
        return None

    def misfit(order: np.ndarray) -> float:
        return float((rest * products[np.ix_(order, order)]).sum())

    stated = np.arange(count)
    first = misfit(stated)
    steps = sorted(range(count), key=lambda step: min(step, count - step))
    plain = [np.roll(order, step) for order in (stated, stated[::-1]) for step in steps]
    ends = [_exchange(rest, products, order) for order in (stated, min(plain, key=misfit))]
    least = min(map(misfit, ends))
    simple = [order for order in (ends[0], *plain, ends[1]) if misfit(order) <= AS_GOOD * least]
    best = simple[0]  # of those that explain the photographs as well, the likeliest
    allowed = LEAVES * surplus / (surplus + SPARE) * first
    if misfit(best) > allowed or misfit(best) > EXPLAINED * variation or first <= 1e-9 * variation:
        best = stated
    others: list[tuple[int, ...]] = []
    if (best != stated).sum() == 2:
        changes = first + _changes(rest, products, stated)
        pairs = np.argwhere(np.triu(changes <= AS_GOOD * misfit(best), 1))
        found = (tuple(int(n) for n in _swap(stated, *pair)) for pair in pairs)
        others = [order for order in found if order != tuple(best.tolist())]
    return SeriesOrder(tuple(best.tolist()), tuple(others), first / variation, misfit(best) / variation)


def fits_by_chance(series: np.ndarray, design: np.ndarray) -> bool:
    """Return whether a design fits the photographs in random orders as well as in the stated one.

    series : (states, values); design : (states, terms). False where hardly more photographs than terms tell nothing.
    """
    if len(series) < design.shape[1] + FEWEST_FITTED:
        return False
    rest = np.eye(len(series)) - design @ np.linalg.pinv(design)
    products = (around := series - series.mean(axis=0)) @ around.T
    orders = [np.arange(len(series)), *(np.random.default_rng(i).permutation(len(series)) for i in range(SHUFFLES))]
    first, *others = (float((rest * products[np.ix_(order, order)]).sum()) for order in orders)
    return sum(other <= first for other in others) > BY_CHANCE


def _exchange(rest: np.ndarray, products: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Exchange two photographs as long as it takes a good part of the misfit away."""
    for _ in range(PAIRS):
        changes = _changes(rest, products, order)
        i, j = np.unravel_index(np.argmin(changes), changes.shape)
        if changes[i, j] > (WORTH - 1) * float((rest * products[np.ix_(order, order)]).sum()):
            break
        order = _swap(order, int(i), int(j))
    return order


def _swap(order: np.ndarray, i: int, j: int) -> np.ndarray:
    result = order.copy()
    result[[i, j]] = order[[j, i]]
    return result


def _changes(rest: np.ndarray, products: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Compute the misfit's change (states, states) when two photographs of an order are exchanged."""
    products = products[np.ix_(order, order)]
    left = rest @ products
    lengths, own, gaps = np.diag(products), np.diag(left), np.diag(rest)
    distances = lengths[:, None] + lengths - 2 * products
    return 2 * (left + left.T - own[:, None] - own) + (gaps[:, None] + gaps - 2 * rest) * distances


@dataclass(frozen=True)
class SeparationStatistics:
    """Statistics of one view, over the valid pixels of the object and all channels."""

    valid: float  # share of the object's pixels
    diffuse: float | None  # diffuse, specular: means
    specular: float | None
    negative: float | None  # share of specular values below 0
    negative_mean: float | None  # their mean
    noise: float | None  # standard deviation of the specular values' noise
    # share of values below -3 noise, which noise alone leaves at about 0.1 %. None where nothing is valid.
    doubtful: float | None


def statistics_of(view: SeparatedView, shown: np.ndarray | None = None) -> SeparationStatistics:
    """Compute statistics of a separated view over the pixels that show the object, (rows, columns) bool; None: all."""
    shown = np.ones(view.valid.shape, bool) if shown is None else shown
    share = float(view.valid[shown].mean()) if shown.any() else 0.0
    inside = view.valid & shown
    values = view.specular[inside]
    if not values.size:
        return SeparationStatistics(share, None, None, None, None, None, None)
    noise = noise_of(view.specular, inside)
    below = values[values < 0]
    return SeparationStatistics(
        share,
        float(view.diffuse[inside].mean(dtype=np.float64)),
        float(values.mean(dtype=np.float64)),
        float((values < 0).mean()),
        float(below.mean(dtype=np.float64)) if below.size else 0.0,
        noise,
        float((values < -3 * noise).mean()) if noise is not None else None,
    )


def select_lit(total: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Select, (rows, columns) bool, the pixels of total (rows, columns, channels) that are a tenth of the brightest."""
    light = total.mean(axis=-1)
    bright = float(np.percentile(light[valid], 99)) if valid.any() else 0.0
    return light >= LIT * bright if bright > 0 else np.ones(light.shape, bool)


def noise_of(values: np.ndarray, valid: np.ndarray) -> float | None:
    """Estimate the standard deviation of the noise of (rows, columns, channels); None without a 3 x 3 valid place.

    The median of squared second differences is used, so that texture counts little.
    """
    if min(valid.shape) < 3:
        return None
    complete = complete_around(valid, 1)
    return float(np.sqrt(np.median(squared_differences(values, complete, 1)))) if complete.any() else None


class Thinned:
    """Every n-th pixel of every photograph of one view, so few that all states fit into memory."""

    def __init__(self, sums: StateSums, shape: tuple[int, int], channels: int):
        self.step = 1
        while -(-shape[0] // self.step) * -(-shape[1] // self.step) * channels > MOST_VALUES:
            self.step += 1
        self.has_fit = sums.design.shape[1] > 0
        self.values: list[np.ndarray] = []
        self.valid = np.ones([-(-side // self.step) for side in shape], bool)

    def add(self, values: np.ndarray, valid: np.ndarray) -> None:
        """Add the next photograph."""
        if not self.has_fit:
            return
        self.valid &= valid[:: self.step, :: self.step]
        self.values.append(values[:: self.step, :: self.step].copy())

    def blocks(self) -> Iterator[np.ndarray]:
        """Yield (states, values) float64 of the pixels that are valid in all photographs, a few rows at a time."""
        for part in strips(len(self.valid)):
            inside = self.valid[part]
            if inside.any():
                yield np.stack([values[part][inside].ravel() for values in self.values]).astype(np.float64)


def diagnose(sums: StateSums, thinned: Thinned) -> dict:
    """Diagnose a series; empty for sums without a fit.

    residual: root mean square of what the least squares leaves, relative to the mean of the photographs. unexplained:
    share of the variation between the states that it leaves, of means over 64 values so that noise counts little; 0
    where it leaves less than 2 % of the light: what varies so little is the lamp. exchanged: number of states whose
    photographs another order explains better beyond doubt. mueller: the mean matrix relative to its first element.
    polarisance_median: median over the pixels of the root mean square of the 3 x 3 other elements (2 x 2 where only
    linear polarisation is known), 1 for a mirror, 0 where all polarisation is lost. pixels_used: of the choice.
    """
    if not thinned.has_fit:
        return {}
    count, total, left, sums_of_solved, ratios = 0, 0.0, 0.0, 0.0, []
    means = []
    inner = [place for place, k in enumerate(sums.elements) if k % 4 and k // 4]
    for series in thinned.blocks():
        solved = sums.inverse @ series
        left += float(((series - sums.design @ solved) ** 2).sum())
        groups = max(1, series.shape[1] // GROUP)
        means.append(series[:, : groups * GROUP].reshape(len(series), groups, -1).mean(axis=2))
        count, total = count + series.size, total + float(series.sum())
        sums_of_solved = sums_of_solved + solved.sum(axis=1)
        if inner:
            lit = solved[0] > 0
            ratios.append(np.sqrt((solved[inner][:, lit] ** 2).sum(axis=0) / np.sqrt(len(inner))) / solved[0, lit])
    if not count:
        return {"residual": None, "unexplained": None, "pixels_used": 0}
    series = np.concatenate(means, axis=1)
    order = find_order(remove_nuisance(series[:, None]), sums.design)
    rest = (series - sums.design @ (sums.inverse @ series)) ** 2
    varied = float(((series - series.mean(axis=0)) ** 2).sum())
    differ = varied > 0 and not np.sqrt(rest.mean()) < DRIFT * abs(series.mean())
    diagnostics: dict = {
        "residual": float(np.sqrt(left / count) / (total / count)) if total > 0 else None,
        "unexplained": float(rest.sum()) / varied if differ else 0.0,
        "exchanged": sum(i != k for i, k in enumerate(order.order)) if order else 0,
        "pixels_used": int(thinned.valid.sum()),
    }
    if sums.elements:
        mean = np.zeros(16)
        mean[list(sums.elements)] = sums_of_solved
        known = np.concatenate(ratios)
        diagnostics["mueller"] = (mean / mean[0]).reshape(4, 4).tolist() if mean[0] > 0 else None
        diagnostics["polarisance_median"] = float(np.median(known)) if known.size else None
    return diagnostics
