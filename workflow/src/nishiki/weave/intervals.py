"""Determine the uncertainty of a weave fit, for each unknown and for their combinations."""

from dataclasses import dataclass

import numpy as np

from nishiki.weave.model import PARAMETERS, PLANES, SIZE
from nishiki.weave.search import SectionProblem, bounds, cell_of, clip, descend, in_cell

ROUNDS, WIDENINGS, HALVINGS = 25, 16, 7


def profile_intervals(problem: SectionProblem, p, cost: float, *, confidence: float, variance: float) -> dict:
    """Compute the interval (low, high) of every reported unknown by its name.

    Names: theta_a, contact (radians), a_weft, a_warp (the lobes' widths), index, flank_weft, flank_warp = l / (l + a),
    flat_warp and contacts_weft: shares of the flat top and the contacts in the section's length.
    """
    ranges = {}
    for at in problem.free:
        ends = profile_interval(problem, p, cost, int(at), confidence=confidence, variance=variance)
        name, form = _unknown_in_reports(int(at))
        ranges[name] = tuple(sorted(float(form(end)) for end in ends))
    return ranges


def _unknown_in_reports(at: int):
    """Return the name of an unknown in reports, and its value there as a function of the solver's."""
    if at == 2 * SIZE:
        return "index", lambda v: (1 + np.exp(v / 2)) / (1 - np.exp(v / 2))
    plane, name = PLANES[at // SIZE], PARAMETERS[at % SIZE]
    if name == "log_width":
        return f"a_{plane}", np.exp
    if name == "humps":
        return ("contacts_weft" if plane == "weft" else "flat_warp"), lambda v: 1 - v
    return f"{name}_{plane}", float


def profile_interval(problem: SectionProblem, p, cost: float, at: int, *, confidence: float, variance: float):
    """Find lowest and highest value of unknown `at` for which the others can still explain the data.

    The sum of squares, minimised over all other unknowns, may rise by variance F(confidence; 1, freedom). Walks
    outwards in growing steps, then halves; where theta_a is walked, the bounds follow it from cell to cell.
    """
    from scipy.stats import f

    allowed = cost + variance * float(f.ppf(confidence, 1, problem.freedom))
    low, high = bounds()
    rest = np.ascontiguousarray(problem.free[problem.free != at])
    edges = [problem.edges(plane) for plane in (0, 1)]
    ends = []
    for sign, limit in ((-1.0, low[at]), (1.0, high[at])):
        inside, best, step = p[at], p.copy(), 1e-4 * (high[at] - low[at])
        outside = None
        for _ in range(WIDENINGS):
            value = inside + sign * step
            value = max(value, limit) if sign < 0 else min(value, limit)
            optimum = _fit_held(problem, best, at, value, rest, edges, low, high)
            if optimum[1] > allowed:
                outside = value
                break
            inside, best, step = value, optimum[0], 3.0 * step
            if value == limit:
                break
        for _ in range(HALVINGS if outside is not None else 0):
            value = 0.5 * (inside + outside)
            optimum = _fit_held(problem, best, at, value, rest, edges, low, high)
            if optimum[1] > allowed:
                outside = value
            else:
                inside, best = value, optimum[0]
        ends.append(float(inside))
    return ends[0], ends[1]


def _fit_held(problem: SectionProblem, p, at, value, rest, edges, low, high):
    """Fit all others with one unknown held; a theta_a that ends at the border of its cell tries the next one."""
    start = p.copy()
    start[at] = value
    cell = [cell_of(edges[k], start[k * SIZE]) for k in (0, 1)]
    best = _in(problem, start, rest, edges, cell, low, high)
    for k in (0, 1):
        if at == k * SIZE:
            continue  # its cell is given
        theta_a, ends = best[0][k * SIZE], edges[k][cell[k] : cell[k] + 2]
        move = -1 if theta_a <= ends[0] + 1e-9 else 1 if theta_a >= ends[1] - 1e-9 else 0
        if move and 0 <= cell[k] + move < len(edges[k]) - 1:
            cell[k] += move
            optimum = _in(problem, best[0], rest, edges, cell, low, high)
            if optimum[1] < best[1]:
                best = optimum
            else:
                cell[k] -= move
    return best


def _in(problem: SectionProblem, p, rest, edges, cell, low, high):
    inside = in_cell(*in_cell(low, high, edges[0], 0, cell[0]), edges[1], 1, cell[1])
    p, low, high = (values[None] for values in (clip(p, rest, *inside), *inside))
    reached, sums = descend(p, low, high, rest, problem.data, ROUNDS, 1e-5)
    return reached[0], float(sums[0])


NULL = 1e-7  # singular value over the largest below which no measurement, however exact, would tell
STEP = 1e-5  # of the differences, in a logarithm
WEAK = 0.1  # standard deviation of a logarithm
LEAST = 0.05  # share of a direction's largest part from which a parameter is named


@dataclass(frozen=True)
class Identifiability:
    """The identifiability of the unknowns."""

    free: list[str]  # products of powers that change nothing
    weak: list[str]  # those determined to no better than WEAK, the worst first
    weak_error: list[float]  # the relative change of one standard deviation
    singular: list[float]  # values of the Jacobian over the largest, falling


def identify(predict, parameters: dict[str, float], weight: np.ndarray, *, variance: float) -> Identifiability:
    """Determine the identifiability from the Jacobian of the weighted prediction in the parameters' logarithms.

    predict(dict) -> (n,) reflectances; parameters: by name, those that are 0 cannot be changed by a factor and are left
    out; weight (n,) = 1 / sigma; variance: of the weighted residuals, used where above 1.
    """
    names = [name for name, value in parameters.items() if value > 0]

    def move(name: str, sign: int) -> np.ndarray:
        return predict({**parameters, name: parameters[name] * np.exp(sign * STEP)})

    slopes = np.stack([(move(name, 1) - move(name, -1)) / (2 * STEP) for name in names], axis=1) * weight[:, None]
    _, singular, rows = np.linalg.svd(slopes, full_matrices=True)
    singular = np.concatenate([singular, np.zeros(len(names) - len(singular))])
    largest = max(float(singular[0]), 1e-300)
    seen = singular > NULL * largest
    spread = np.sqrt(max(variance, 1.0))
    weak = [k for k in np.flatnonzero(seen)[::-1] if spread / singular[k] > WEAK]
    return Identifiability(
        free=[_product(row, names) for row in _reduce_rows(rows[~seen])],
        weak=[_product(rows[k], names) for k in weak],
        weak_error=[float(f"{spread / singular[k]:.3g}") for k in weak],
        singular=[float(f"{value / largest:.3g}") if value > NULL * largest else 0.0 for value in singular],
    )


def _reduce_rows(rows: np.ndarray) -> np.ndarray:
    """Reduce to row echelon form, pivots by size: the simplest vectors that span the same space."""
    rows, done = rows.copy(), 0
    for column in np.argsort(-np.abs(rows).sum(axis=0), kind="stable") if len(rows) else []:
        if done == len(rows):
            break
        pivot = done + int(np.argmax(np.abs(rows[done:, column])))
        if abs(rows[pivot, column]) < 1e-3:
            continue
        rows[[done, pivot]] = rows[[pivot, done]]
        rows[done] /= rows[done, column]
        for other in range(len(rows)):
            if other != done:
                rows[other] -= rows[other, column] * rows[done]
        done += 1
    return rows


def _product(row: np.ndarray, names: list[str]) -> str:
    """Format a direction in logarithms as a product of powers, its largest power 1."""
    row = row / row[np.argmax(np.abs(row))]
    return " · ".join(
        name if abs(power - 1) < 1e-3 else f"{name}^{power:.2g}"
        for name, power in zip(names, row, strict=True)
        if abs(power) > LEAST
    )
