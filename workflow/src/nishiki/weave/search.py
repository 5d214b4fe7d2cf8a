"""Find the parameters of the weave model globally, with bounded least squares in each cell.

The unknowns are those of `reading.PARAMETERS` for both planes in a row, then log F0. At each point the two strengths
(gloss, body), both at least 0, are solved for exactly (variable projection, Golub and Pereyra, SIAM J. Numer. Anal.
10(2), 1973, here with the non-negative solution of two unknowns in closed form), and only the rest is searched.

G drops at theta_r = pi/2 - theta_a, so as a function of theta_a the sum of squares jumps wherever pi/2 - theta_a passes
a measured angle, and is smooth in between. Each interval between neighbouring measured angles is therefore a problem of
its own; a coarse table of all of them says which are worth a descent.
"""

from dataclasses import dataclass, replace

import numpy as np

from nishiki.threads import strips
from nishiki.weave.model import PARAMETERS, PLANES, SIZE, columns, shape_of

UNKNOWNS = 2 * SIZE + 1
LADDER = 4.0 ** np.arange(4)  # dampings that are tried at once where the first gains nothing


def strengths(a: np.ndarray, b: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find (gloss, body) (...,) >= 0 that minimise |gloss a + body b - y|^2; a, b (..., n), y (n,)."""
    aa, bb, ab = ((one * other).sum(axis=-1) for one, other in ((a, a), (b, b), (a, b)))
    ay, by = (a * y).sum(axis=-1), (b * y).sum(axis=-1)
    det = aa * bb - ab * ab
    with np.errstate(all="ignore"):
        gloss, body = (ay * bb - by * ab) / det, (by * aa - ay * ab) / det
    both = (det > 1e-13 * aa * bb) & (gloss >= 0.0) & (body >= 0.0)
    alone_a, alone_b = (np.maximum(xy, 0.0) / np.where(xx > 0.0, xx, 1.0) for xy, xx in ((ay, aa), (by, bb)))
    by_a = alone_a * np.maximum(ay, 0.0) >= alone_b * np.maximum(by, 0.0)
    return np.where(both, gloss, np.where(by_a, alone_a, 0.0)), np.where(both, body, np.where(by_a, 0.0, alone_b))


def residuals(points: np.ndarray, data) -> np.ndarray:
    """Compute weight (model - y) (points, n) at every row of points (points, UNKNOWNS); data: of a `SectionProblem`."""
    rows, y, weight, reading = data
    out = np.empty((len(points), len(y)))
    for some in strips(len(points)):
        p, here = points[some], out[some]
        weft, warp = ([v[:, None] for v in shape_of(p[:, plane * SIZE :], plane)] for plane in (0, 1))
        widths = np.exp(p[:, [3, SIZE + 3]]).T[:, :, None]
        work = columns(weft, warp, widths, rows, f0=np.exp(p[:, 2 * SIZE :]), reading=reading)
        a, b = np.moveaxis(work * weight[:, None], -1, 0)
        gloss, body = strengths(a, b, weight * y)
        here[:] = gloss[:, None] * a + body[:, None] * b - weight * y
    return out


def costs(points: np.ndarray, data) -> np.ndarray:
    """Compute the sum of squares (points,) at every row of points (points, UNKNOWNS)."""
    return (residuals(points, data) ** 2).sum(axis=1)


def jacobian(points, low, high, free, data) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute residuals (k, n), Jacobians (k, n, free) of the projected residuals, sums of squares (k,) at k points.

    Steps stay within the bounds low, high (k, UNKNOWNS).
    """
    step, (count, n) = 1e-6 * np.maximum(high - low, 1e-9), (len(free), len(data[1]))
    up, down = np.minimum(points + step, high)[:, free], np.maximum(points - step, low)[:, free]
    around = np.tile(points[:, None], (1, 2 * count + 1, 1))
    around[:, np.arange(count), free], around[:, np.arange(count, 2 * count), free] = up, down
    out = residuals(around.reshape(-1, UNKNOWNS), data).reshape(len(points), -1, n)
    slopes = (out[:, :count] - out[:, count:-1]) / np.where(up > down, up - down, np.inf)[:, :, None]
    return out[:, -1], np.swapaxes(slopes, 1, 2), (out[:, -1] ** 2).sum(axis=1)


def _step(points, low, high, free, equations, damping) -> np.ndarray:
    """Compute the damped steps from k points; unknowns that they would carry over a bound stop there."""
    (normal, gradient, scale), unit = equations, np.eye(len(free))
    matrix = normal + unit * np.where(normal > 0.0, damping[:, None, None] + 1e-14, 1.0)
    at, low, high = points[:, free], low[:, free], high[:, free]
    fixed, move = np.zeros(at.shape, bool), np.zeros(at.shape)
    for _ in free:
        stopped = np.where(fixed, move * scale, 0.0)
        right = np.where(fixed, stopped, -gradient - np.einsum("kij,kj->ki", matrix, stopped))
        held = np.where(fixed[:, :, None] | fixed[:, None, :], unit, matrix)
        move = np.linalg.solve(held, right[:, :, None])[:, :, 0] / scale
        beyond = ~fixed & ((at + move < low) | (at + move > high))
        if not beyond.any():
            break
        move = np.where(beyond, np.clip(at + move, low, high) - at, move)
        fixed |= beyond
    out = points.copy()
    out[:, free] = np.clip(at + move, low, high)
    return out


def descend(points, low, high, free, data, rounds: int, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Run Levenberg-Marquardt from k points within bounds, all (k, UNKNOWNS): points reached, and their sums (k,).

    Unknowns at a bound that push outwards are held. Ends when a step gains less than `tolerance` of the sum or none is
    found.
    """
    points, damping = points.copy(), np.full(len(points), 1e-3)
    here, slopes, sums = jacobian(points, low, high, free, data)
    going = np.arange(len(points))
    for last in reversed(range(rounds)):
        at, cost = points[going][:, free], sums[going]
        gradient, normal = np.einsum("kni,kn->ki", slopes, here), np.swapaxes(slopes, 1, 2) @ slopes
        held = ((at <= low[going][:, free]) & (gradient > 0.0)) | ((at >= high[going][:, free]) & (gradient < 0.0))
        scale = np.sqrt(np.where(held, 0.0, np.diagonal(normal, axis1=1, axis2=2)))
        held = ~(scale > 1e-30 * scale.max(axis=1, keepdims=True))  # without effect, too
        scale = np.where(held, 1.0, scale)
        normal = np.where(held[:, :, None] | held[:, None, :], 0.0, normal / (scale[:, :, None] * scale[:, None]))
        gradient = np.where(held, 0.0, gradient / scale)
        gained, trying, factors = np.zeros(len(going)), np.arange(len(going)), np.ones(1)
        while len(trying):
            each = np.repeat(trying, len(factors))
            mine, at, equations = going[trying], going[each], (normal[each], gradient[each], scale[each])
            ladder = damping[mine, None] * factors
            tried = _step(points[at], low[at], high[at], free, equations, ladder.ravel())
            gain = np.where(ladder < 1e10, cost[trying, None] - costs(tried, data).reshape(ladder.shape), 0)
            first = np.arange(len(mine)), (gain > 0).argmax(axis=1)  # the least damping that gains
            better = gain[first] > 0
            chosen = tried.reshape(*ladder.shape, -1)[first]
            points[mine[better]], gained[trying[better]] = chosen[better], gain[first][better]
            damping[mine] = np.where(better, np.maximum(ladder[first] * 0.2, 1e-12), ladder[:, -1] * 4.0)
            trying, factors = trying[~better & (damping[mine] < 1e10)], LADDER
        sums[going] = cost - gained
        going = going[(gained > tolerance * cost) & (sums[going] >= 1e-30 * len(data[1]))]
        if not last or not len(going):
            break
        here, slopes, sums[going] = jacobian(points[going], low[going], high[going], free, data)
    return points, sums


THETA_A = np.radians([2.0, 88.0])
BOUNDS = (THETA_A, (0.0, 0.999), (0.02, 1.0), (np.log(0.02), np.log(3.0)), (0.15, np.pi / 2))
INDEX = (1.2, 2.2)
TABLE = {"flank": (0.03, 0.3, 0.6, 0.9), "humps": (0.08, 0.3, 0.6, 0.97), "width": (0.06, 0.14, 0.3, 0.55, 1.0)}
NAMES = (*(f"{name}_{plane}" for plane in PLANES for name in PARAMETERS), "log_f0")
CONTACTS = (0.5, 0.9, 1.3)
CELLS, STARTS, KEPT = 60, 4, 4
HALVING = ((90, 6), (30, 12), (12, 30))  # descents that go on, and their rounds
WITHIN = (0.2, 0.5, 0.8)
AGAIN = ((24, 6), (8, 15))  # the same, when a plane is searched beside what was found for the other one
ROUNDS, TOLERANCE, RETURNS = 60, 1e-10, 3


@dataclass(frozen=True)
class SectionProblem:
    """Reflectances in both planes, weft first. free: unknowns that are searched."""

    rows: np.ndarray
    split: int
    y: np.ndarray
    weight: np.ndarray
    reading: int
    free: np.ndarray

    @property
    def data(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
        """Arguments of the functions of the search."""
        return self.rows, self.y, self.weight, self.reading

    @property
    def freedom(self) -> int:
        """Degrees of freedom: values less unknowns, gloss and body among them, at least 1."""
        return max(self.y.size - self.free.size - 2, 1)

    def only(self, plane: int) -> "SectionProblem":
        """Select one plane's data and unknowns."""
        part = slice(0, self.split) if plane == 0 else slice(self.split, None)
        free = self.free[(self.free // SIZE == plane) & (self.free < 2 * SIZE)]
        kept = {name: getattr(self, name)[part].copy() for name in ("rows", "y", "weight")}
        return replace(self, **kept, split=self.split if plane == 0 else 0, free=free)

    def edges(self, plane: int) -> np.ndarray:
        """Return the ends of the intervals of one plane's theta_a in which the model is smooth; see `cells`."""
        part = slice(0, self.split) if plane == 0 else slice(self.split, None)
        return cells(self.rows[part, 1])


def bounds() -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest value of every unknown."""
    f0 = [2.0 * np.log((n - 1) / (n + 1)) for n in INDEX]
    low, high = np.array([*BOUNDS, *BOUNDS, f0]).T
    return np.ascontiguousarray(low), np.ascontiguousarray(high)


def cells(theta: np.ndarray) -> np.ndarray:
    """Compute the ends (cells + 1,) of the intervals of theta_a in which the model is smooth at theta (n,)."""
    jumps = np.unique(np.round(np.pi / 2 - np.abs(theta), 12))
    jumps = jumps[(jumps > THETA_A[0] + 1e-6) & (jumps < THETA_A[1] - 1e-6)]
    if len(jumps) > CELLS:  # views scattered in angle: the jumps are then many and small
        jumps = np.quantile(jumps, np.linspace(0, 1, CELLS))
    return np.concatenate([THETA_A[:1], jumps, THETA_A[1:]])


def in_cell(low, high, edges, plane: int, cell: int) -> tuple[np.ndarray, np.ndarray]:
    """Restrict the bounds to one cell of a plane's theta_a; the lower end belongs to it, the upper does not."""
    low, high = low.copy(), high.copy()
    low[plane * SIZE], high[plane * SIZE] = edges[cell], edges[cell + 1] - 1e-12
    return low, high


def starts(edges: np.ndarray, plane: int, start: np.ndarray, free_contact: bool) -> np.ndarray:
    """Build the coarse table (cells, points, UNKNOWNS) of one plane; the other plane's unknowns as in `start`."""
    unknowns = start[plane * SIZE : (plane + 1) * SIZE]
    humps, contacts = (
        (TABLE["humps"] if unknowns[2] > 0 else unknowns[2:3]),
        (CONTACTS if free_contact else unknowns[4:5]),
    )
    grid = np.meshgrid(TABLE["flank"], humps, np.log(TABLE["width"]), contacts, indexing="ij")
    rows = np.stack([g.ravel() for g in grid], axis=-1)
    out = np.broadcast_to(start, (len(edges) - 1, len(rows), UNKNOWNS)).copy()
    middle = 0.5 * (edges[:-1] + edges[1:])
    out[..., plane * SIZE] = middle[:, None]
    out[..., plane * SIZE + 1 : plane * SIZE + 5] = rows
    return out


def search_plane(problem: SectionProblem, plane: int, start: np.ndarray, *, alone: bool = True):
    """Find the best (sum of squares, cell, unknowns) of one plane's unknowns, at most KEPT of them, best first.

    alone : against this plane's data only, with strengths of its own; False: against all data, the other plane's
    unknowns as in `start`.
    """
    part = problem.only(plane)
    data, (low, high) = (part if alone else problem).data, bounds()
    edges = problem.edges(plane)
    table = starts(edges, plane, start, plane * SIZE + 4 in part.free)
    sums = costs(table.reshape(-1, UNKNOWNS), data).reshape(table.shape[:2])
    order = np.argsort(sums, axis=1, kind="stable")[:, :STARTS]
    running = [(sums[cell, k], cell, table[cell, k]) for cell in range(len(table)) for k in order[cell]]
    for left, rounds in HALVING if alone else AGAIN:
        running = sorted(running, key=lambda item: item[:2])[:left]
        inside = np.array([in_cell(low, high, edges, plane, cell) for _, cell, _ in running])
        lows, highs = inside.swapaxes(0, 1)
        p, sums = descend(np.array([p for *_, p in running]), lows, highs, part.free, data, rounds, 1e-7)
        running = [(float(cost), int(cell), q) for cost, (_, cell, _), q in zip(sums, running, p, strict=True)]
    best: dict[int, tuple[float, int, np.ndarray]] = {}
    for item in sorted(running, key=lambda item: item[:2]):
        best.setdefault(item[1], item)
    return list(best.values())[:KEPT]


def search(problem: SectionProblem, start: np.ndarray) -> tuple[np.ndarray, float]:
    """Find unknowns and sum of squares of the whole problem.

    Each plane alone; their best cells together, and the neighbours of these; then each plane's cells once more beside
    what was found for the other one, until nothing is gained.
    """
    alone = [search_plane(problem, plane, start) for plane in (0, 1)]
    pairs = [np.concatenate([p[:SIZE], q[SIZE:]]) for _, _, p in alone[0] for _, _, q in alone[1]]
    p, cost = _settle(problem, pairs)
    for _ in range(RETURNS):
        again = [item[2] for plane in (0, 1) for item in search_plane(problem, plane, p, alone=False)]
        settled = _settle(problem, again)
        if settled[1] >= cost * (1 - 1e-6):
            return p, cost
        p, cost = settled
    return p, cost


def _settle(problem: SectionProblem, candidates: list[np.ndarray]) -> tuple[np.ndarray, float]:
    """Find the best descent of all unknowns from the candidates, in their own cells, then in the neighbouring ones."""
    (low, high), edges = bounds(), [problem.edges(plane) for plane in (0, 1)]
    tried: dict[tuple[int, int], tuple[float, np.ndarray]] = {}

    def attempt(starts: list[tuple[int, int, np.ndarray]]) -> None:
        starts = [each for each in starts if 0 <= each[0] < len(edges[0]) - 1 and 0 <= each[1] < len(edges[1]) - 1]
        inside = np.array([in_cell(*in_cell(low, high, edges[0], 0, a), edges[1], 1, b) for a, b, _ in starts])
        first = [clip(p, problem.free, *each) for (*_, p), each in zip(starts, inside, strict=True)]
        lows, highs = inside.swapaxes(0, 1)
        reached = descend(np.array(first), lows, highs, problem.free, problem.data, ROUNDS, TOLERANCE)
        for (weft, warp, _), p, cost in zip(starts, *reached, strict=True):
            if (weft, warp) not in tried or cost < tried[weft, warp][0]:
                tried[weft, warp] = float(cost), p

    attempt([(cell_of(edges[0], p[0]), cell_of(edges[1], p[SIZE]), p) for p in candidates])
    while True:
        (weft, warp), (cost, p) = min(tried.items(), key=lambda item: (item[1][0], item[0]))
        around = [(weft + dx, warp + dy) for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1))]
        starts = [(*place, p) for place in around if place not in tried]
        for plane, cell in ((0, weft), (1, warp)):
            for share in WITHIN:  # the valley may be narrow and bent: from elsewhere in the cell
                q = p.copy()
                q[plane * SIZE] = edges[plane][cell] + share * (edges[plane][cell + 1] - edges[plane][cell])
                starts.append((weft, warp, q))
        attempt(starts)
        if min(item[0] for item in tried.values()) >= cost * (1 - 1e-6):
            return p, cost


def cell_of(edges: np.ndarray, theta_a: float) -> int:
    """Find the number of the cell of theta_a."""
    return int(np.clip(np.searchsorted(edges, theta_a, "right") - 1, 0, len(edges) - 2))


def at_bounds(p: np.ndarray, free: np.ndarray) -> list[str]:
    """List the unknowns that ended at the end of their range."""
    low, high = bounds()
    near = 1e-6 * (high - low)
    return [NAMES[k] for k in free if p[k] <= low[k] + near[k] or p[k] >= high[k] - near[k]]


def clip(p: np.ndarray, free: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Clip the searched unknowns to their bounds; fixed ones stay as they are."""
    p = p.copy()
    p[free] = np.clip(p[free], low[free], high[free])
    return p
