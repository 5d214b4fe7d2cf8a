"""Find photographs of a polarisation series that bear the polariser states of other photographs.

With H the projection on what angles can do to the light (`series_design`), P = I - H, the pictures of one view as the
rows of Y and S = Y Y', the misfit of the photographs in an order o is

    tr(P S[o, o])

so that thousands of orders are compared without the pictures: every exchange of two photographs, and cyclic shifts and
reversals of the list. Y is taken orthogonal to the mean picture, its slopes and a constant: lamps that vary, a camera
that moves a little and stray light then leave no misfit, whatever the order.
"""

from dataclasses import dataclass

import numpy as np

LEAVES = 0.7  # of the misfit, at most, that another order may leave where many photographs test the model
SPARE = 4.0  # surplus photographs with which half of that is allowed: few fit several orders by chance
EXPLAINED = 0.1  # of the variation that the right order may leave: else the model itself is wrong
AS_GOOD = 1.25  # times the least misfit: orders that explain the photographs as well
PAIRS, WORTH = 2, 0.7  # exchanges beside a shift or reversal, by which people err, and what each may leave
SHUFFLES, BY_CHANCE = 19, 2  # random orders, and how many of them may fit as well
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
        """Whether no other order is better beyond doubt."""
        return self.order == tuple(range(len(self.order)))


def series_design(angles_deg: np.ndarray) -> np.ndarray:
    """Return (states, terms): what turning polarisers, or retarders where the states are many, can do to the light.

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
        found = (tuple(int(n) for n in _exchanged(stated, *pair)) for pair in pairs)
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
        order = _exchanged(order, int(i), int(j))
    return order


def _exchanged(order: np.ndarray, i: int, j: int) -> np.ndarray:
    result = order.copy()
    result[[i, j]] = order[[j, i]]
    return result


def _changes(rest: np.ndarray, products: np.ndarray, order: np.ndarray) -> np.ndarray:
    """(states, states): how much the misfit changes when two photographs of an order are exchanged."""
    products = products[np.ix_(order, order)]
    left = rest @ products
    lengths, own, gaps = np.diag(products), np.diag(left), np.diag(rest)
    distances = lengths[:, None] + lengths - 2 * products
    return 2 * (left + left.T - own[:, None] - own) + (gaps[:, None] + gaps - 2 * rest) * distances
