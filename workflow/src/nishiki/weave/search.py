"""Search the parameters of the weave model globally, with bounded least squares in each cell.

The unknowns are those of `reading.PARAMETERS` for both planes in a row, then log F0. At each point the two strengths
(gloss, body), both at least 0, are solved for exactly (variable projection, Golub and Pereyra, SIAM J. Numer. Anal.
10(2), 1973, here with the non-negative solution of two unknowns in closed form), and only the rest is searched.

G drops at theta_r = pi/2 - theta_a, so as a function of theta_a the sum of squares jumps wherever pi/2 - theta_a passes
a measured angle, and is smooth in between. Each interval between neighbouring measured angles is therefore a problem of
its own; a coarse table of all of them says which are worth a descent.
"""

from dataclasses import dataclass, replace
from math import exp, sqrt

import numpy as np
from numba import njit

from nishiki.weave.model import PARAMETERS, PLANES, SIZE, fill_columns, shape_of

UNKNOWNS = 2 * SIZE + 1


@njit(cache=True, nogil=True, error_model="numpy")
def strengths(a, b, y):
    """(gloss, body) >= 0 that minimise |gloss a + body b - y|^2."""
    aa = bb = ab = ay = by = 0.0
    for k in range(y.size):
        aa, bb, ab = aa + a[k] * a[k], bb + b[k] * b[k], ab + a[k] * b[k]
        ay, by = ay + a[k] * y[k], by + b[k] * y[k]
    det = aa * bb - ab * ab
    if det > 1e-13 * aa * bb:
        gloss, body = (ay * bb - by * ab) / det, (by * aa - ay * ab) / det
        if gloss >= 0.0 and body >= 0.0:
            return gloss, body
    alone_a = max(ay / aa, 0.0) if aa > 0.0 else 0.0
    alone_b = max(by / bb, 0.0) if bb > 0.0 else 0.0
    if alone_a * max(ay, 0.0) >= alone_b * max(by, 0.0):
        return alone_a, 0.0
    return 0.0, alone_b


@njit(cache=True, nogil=True, error_model="numpy")
def residuals(p, data, work, out):
    """Fill out (n,) = weight (model - y) and return the sum of squares; data: of a `Problem`. work: (n, 2)."""
    rows, split, y, weight, shared, reading = data
    f0, n = exp(p[2 * SIZE]), y.size
    weft, warp = shape_of(p[:SIZE], 0), shape_of(p[SIZE:], 1)
    fill_columns(weft, warp, exp(p[3]), exp(p[SIZE + 3]), rows, f0, reading, work)
    for k in range(n):
        work[k, 0] *= weight[k]
        work[k, 1] *= weight[k]
        out[k] = weight[k] * y[k]
    total = 0.0
    for part in range(1 if shared else 2):
        low, high = (0, n) if shared else ((0, split) if part == 0 else (split, n))
        if high == low:
            continue
        gloss, body = strengths(work[low:high, 0], work[low:high, 1], out[low:high])
        for k in range(low, high):
            out[k] = gloss * work[k, 0] + body * work[k, 1] - out[k]
            total += out[k] * out[k]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def costs(points, data):
    """Compute the sum of squares (points,) at every row of points (points, UNKNOWNS)."""
    n = data[2].size
    work, out, sums = np.empty((n, 2)), np.empty(n), np.empty(len(points))
    for k in range(len(points)):
        sums[k] = residuals(points[k], data, work, out)
    return sums


@njit(cache=True, nogil=True, error_model="numpy")
def jacobian(p, low, high, free, data):
    """Residuals (n,), Jacobian (n, free) of the projected residual, sum of squares; steps stay within the bounds."""
    n, m = data[2].size, free.size
    work, here, there, back = np.empty((n, 2)), np.empty(n), np.empty(n), np.empty(n)
    cost = residuals(p, data, work, here)
    out, q = np.empty((n, m)), p.copy()
    for j in range(m):
        at = free[j]
        step = 1e-6 * max(high[at] - low[at], 1e-9)
        up, down = min(p[at] + step, high[at]), max(p[at] - step, low[at])
        q[at] = up
        residuals(q, data, work, there)
        q[at] = down
        residuals(q, data, work, back)
        q[at] = p[at]
        for k in range(n):
            out[k, j] = (there[k] - back[k]) / (up - down) if up > down else 0.0
    return here, out, cost


@njit(cache=True, nogil=True, error_model="numpy")
def _step(p, low, high, free, normal, gradient, scale, damping):
    """Compute the damped step from p; unknowns that it would carry over a bound stop there."""
    m = free.size
    fixed, move = np.zeros(m, np.bool_), np.zeros(m)
    for _ in range(m):
        matrix, right = normal.copy(), -gradient
        for j in range(m):
            matrix[j, j] += damping + 1e-14 if matrix[j, j] > 0.0 else 1.0
        for j in range(m):
            if fixed[j]:
                right -= matrix[:, j] * (move[j] * scale[j])
        for j in range(m):
            if fixed[j]:
                matrix[j, :] = 0.0
                matrix[:, j] = 0.0
                matrix[j, j], right[j] = 1.0, move[j] * scale[j]
        move = np.linalg.solve(matrix, right) / scale
        clear = True
        for j in range(m):
            at = free[j]
            if not fixed[j] and not low[at] <= p[at] + move[j] <= high[at]:
                move[j] = (low[at] if p[at] + move[j] < low[at] else high[at]) - p[at]
                fixed[j], clear = True, False
        if clear:
            break
    q = p.copy()
    for j in range(m):
        q[free[j]] = min(max(p[free[j]] + move[j], low[free[j]]), high[free[j]])
    return q


@njit(cache=True, nogil=True, error_model="numpy")
def descend(p, low, high, free, data, rounds, tolerance):
    """Levenberg-Marquardt with bounds: unknowns at a bound that push outwards are held.

    Returns (p, sum of squares). Ends when a step gains less than `tolerance` of the sum or none is found.
    """
    p = p.copy()
    n = data[2].size
    work, trial = np.empty((n, 2)), np.empty(n)
    damping = 1e-3
    here, slopes, cost = jacobian(p, low, high, free, data)
    for _ in range(rounds):
        gradient, normal = slopes.T @ here, slopes.T @ slopes
        for j in range(free.size):
            at = free[j]
            if (p[at] <= low[at] and gradient[j] > 0.0) or (p[at] >= high[at] and gradient[j] < 0.0):
                normal[j, :] = 0.0
                normal[:, j] = 0.0
                gradient[j] = 0.0
        scale = np.sqrt(np.diag(normal))
        least = 1e-30 * scale.max()
        for j in range(free.size):
            if not scale[j] > least:  # no effect: held
                normal[j, :] = 0.0
                normal[:, j] = 0.0
                gradient[j], scale[j] = 0.0, 1.0
        gradient = gradient / scale
        for j in range(free.size):
            for k in range(free.size):
                normal[j, k] /= scale[j] * scale[k]
        gained = 0.0
        while damping < 1e10:
            q = _step(p, low, high, free, normal, gradient, scale, damping)
            tried = residuals(q, data, work, trial)
            if tried < cost:
                gained, p, damping = cost - tried, q, max(damping * 0.2, 1e-12)
                break
            damping *= 4.0
        if gained <= tolerance * cost or gained == 0.0:
            return p, min(cost, cost - gained)
        here, slopes, cost = jacobian(p, low, high, free, data)
        if sqrt(cost) < 1e-15 * sqrt(n):
            break
    return p, cost


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
class Problem:
    """Hold reflectances in both planes, weft first. shared: one pair of strengths. free: unknowns that are searched."""

    rows: np.ndarray
    split: int
    y: np.ndarray
    weight: np.ndarray
    shared: bool
    reading: int
    free: np.ndarray

    @property
    def data(self) -> tuple[np.ndarray, int, np.ndarray, np.ndarray, bool, int]:
        """What the compiled functions take."""
        return self.rows, self.split, self.y, self.weight, self.shared, self.reading

    def only(self, plane: int) -> "Problem":
        """One plane's data and unknowns."""
        part = slice(0, self.split) if plane == 0 else slice(self.split, None)
        free = self.free[(self.free // SIZE == plane) & (self.free < 2 * SIZE)]
        kept = {name: getattr(self, name)[part].copy() for name in ("rows", "y", "weight")}
        return replace(self, **kept, split=self.split if plane == 0 else 0, free=free)

    def edges(self, plane: int) -> np.ndarray:
        """Return the ends of the intervals of one plane's theta_a in which the model is smooth; see `cells`."""
        part = slice(0, self.split) if plane == 0 else slice(self.split, None)
        return cells(self.rows[part, 1])


def bounds() -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest value of every unknown."""
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


def search_plane(problem: Problem, plane: int, start: np.ndarray, *, alone: bool = True):
    """Best (sum of squares, cell, unknowns) of one plane's unknowns, at most KEPT of them, best first.

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
        ended = []
        for _, cell, p in running:
            p, cost = descend(p, *in_cell(low, high, edges, plane, cell), part.free, data, rounds, 1e-7)
            ended.append((float(cost), int(cell), p))
        running = ended
    best: dict[int, tuple[float, int, np.ndarray]] = {}
    for item in sorted(running, key=lambda item: item[:2]):
        best.setdefault(item[1], item)
    return list(best.values())[:KEPT]


def search(problem: Problem, start: np.ndarray) -> tuple[np.ndarray, float]:
    """Unknowns and sum of squares of the whole problem.

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


def _settle(problem: Problem, candidates: list[np.ndarray]) -> tuple[np.ndarray, float]:
    """Best descent of all unknowns from the candidates, in their own cells and then in the neighbouring ones."""
    (low, high), edges = bounds(), [problem.edges(plane) for plane in (0, 1)]
    tried: dict[tuple[int, int], tuple[float, np.ndarray]] = {}

    def attempt(weft: int, warp: int, p: np.ndarray) -> None:
        if not (0 <= weft < len(edges[0]) - 1 and 0 <= warp < len(edges[1]) - 1):
            return
        inside = in_cell(*in_cell(low, high, edges[0], 0, weft), edges[1], 1, warp)
        p = clipped(p, problem.free, *inside)
        p, cost = descend(p, *inside, problem.free, problem.data, ROUNDS, TOLERANCE)
        if (weft, warp) not in tried or cost < tried[weft, warp][0]:
            tried[weft, warp] = float(cost), p

    for p in candidates:
        attempt(cell_of(edges[0], p[0]), cell_of(edges[1], p[SIZE]), p)
    while True:
        (weft, warp), (cost, p) = min(tried.items(), key=lambda item: (item[1][0], item[0]))
        for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            if (weft + dx, warp + dy) not in tried:
                attempt(weft + dx, warp + dy, p)
        for plane, cell in ((0, weft), (1, warp)):
            for share in WITHIN:  # the valley may be narrow and bent: from elsewhere in the cell
                q = p.copy()
                q[plane * SIZE] = edges[plane][cell] + share * (edges[plane][cell + 1] - edges[plane][cell])
                attempt(weft, warp, q)
        if min(item[0] for item in tried.values()) >= cost * (1 - 1e-6):
            return p, cost


def cell_of(edges: np.ndarray, theta_a: float) -> int:
    """Find the number of the cell of theta_a."""
    return int(np.clip(np.searchsorted(edges, theta_a, "right") - 1, 0, len(edges) - 2))


def at_bounds(p: np.ndarray, free: np.ndarray) -> list[str]:
    """Names of the unknowns that ended at the end of their range."""
    low, high = bounds()
    near = 1e-6 * (high - low)
    return [NAMES[k] for k in free if p[k] <= low[k] + near[k] or p[k] >= high[k] - near[k]]


def clipped(p: np.ndarray, free: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Clip the searched unknowns to their bounds; fixed ones stay as they are."""
    p = p.copy()
    p[free] = np.clip(p[free], low[free], high[free])
    return p
