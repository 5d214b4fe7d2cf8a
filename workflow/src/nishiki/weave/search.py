"""Global search of the weave fit: cells of theta_a between which the model jumps, and bounded descents inside of them.

G drops at theta_r = pi/2 - theta_a, so as a function of theta_a the sum of squares jumps wherever pi/2 - theta_a passes
a measured angle, and is smooth in between. Each interval between neighbouring measured angles is therefore a problem of
its own; a coarse table of all of them says which are worth a descent.
"""

from dataclasses import dataclass, replace

import numpy as np

from nishiki.weave.descent import UNKNOWNS, costs, descend
from nishiki.weave.reading import PARAMETERS, PLANES, SIZE

THETA_A = np.radians([2.0, 88.0])
BOUNDS = (THETA_A, (0.0, 0.999), (0.02, 1.0), (np.log(0.02), np.log(3.0)), (0.15, np.pi / 2))
INDEX = (1.2, 2.2)
TABLE = {"flank": (0.03, 0.3, 0.6, 0.9), "humps": (0.08, 0.3, 0.6, 0.97), "width": (0.06, 0.14, 0.3, 0.55, 1.0)}
NAMES = (*(f"{name}_{plane}" for plane in PLANES for name in PARAMETERS), "log_f0")
CONTACTS = (0.5, 0.9, 1.3)
CELLS, STARTS, KEPT = 60, 4, 4
HALVING = ((100, 6), (40, 12), (16, 40))  # descents that go on, and their rounds
ROUNDS, TOLERANCE = 60, 1e-10


@dataclass(frozen=True)
class Problem:
    """Reflectances in both planes, weft first: theta_i, theta_r (n,) radians, signed, y (n,), weight (n,) = 1 / sigma;
    the first `split` are in the weft plane. shared: one pair of strengths. free: unknowns that are searched."""

    theta_i: np.ndarray
    theta_r: np.ndarray
    split: int
    y: np.ndarray
    weight: np.ndarray
    shared: bool
    reading: int
    free: np.ndarray

    @property
    def data(self) -> tuple:
        """What the compiled functions take."""
        return self.theta_i, self.theta_r, self.split, self.y, self.weight, self.shared, self.reading

    def only(self, plane: int) -> "Problem":
        """One plane's data and unknowns."""
        rows = slice(0, self.split) if plane == 0 else slice(self.split, None)
        free = self.free[(self.free // SIZE == plane) & (self.free < 2 * SIZE)]
        kept = {name: getattr(self, name)[rows].copy() for name in ("theta_i", "theta_r", "y", "weight")}
        return replace(self, **kept, split=self.split if plane == 0 else 0, free=free)

    def edges(self, plane: int) -> np.ndarray:
        """Ends of the intervals of one plane's theta_a in which the model is smooth; see `cells`."""
        rows = slice(0, self.split) if plane == 0 else slice(self.split, None)
        return cells(np.concatenate([self.theta_i[rows], self.theta_r[rows]]))


def bounds() -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest value of every unknown."""
    f0 = [2.0 * np.log((n - 1) / (n + 1)) for n in INDEX]
    low, high = np.array([*BOUNDS, *BOUNDS, f0]).T
    return np.ascontiguousarray(low), np.ascontiguousarray(high)


def cells(theta: np.ndarray) -> np.ndarray:
    """Ends (cells + 1,) of the intervals of theta_a in which the model is smooth, for lamps and views at theta (n,)."""
    jumps = np.unique(np.round(np.pi / 2 - np.abs(theta), 12))
    jumps = jumps[(jumps > THETA_A[0] + 1e-6) & (jumps < THETA_A[1] - 1e-6)]
    if len(jumps) > CELLS:  # views scattered in angle: the jumps are then many and small
        jumps = np.quantile(jumps, np.linspace(0, 1, CELLS))
    return np.concatenate([THETA_A[:1], jumps, THETA_A[1:]])


def in_cell(low, high, edges, plane: int, cell: int):
    """The bounds with one plane's theta_a inside of a cell: its lower end belongs to it, its upper end does not."""
    low, high = low.copy(), high.copy()
    low[plane * SIZE], high[plane * SIZE] = edges[cell], edges[cell + 1] - 1e-12
    return low, high


def starts(edges: np.ndarray, plane: int, start: np.ndarray, free_contact: bool) -> np.ndarray:
    """The coarse table (cells, points, UNKNOWNS) of one plane; the other plane's unknowns as in `start`."""
    contacts = CONTACTS if free_contact else start[plane * SIZE + 4 : plane * SIZE + 5]
    grid = np.meshgrid(
        TABLE["flank"], TABLE["humps"], np.log(TABLE["width"]), contacts, (0.5,), indexing="ij"
    )  # the middle of a cell stands for it
    rows = np.stack([g.ravel() for g in grid], axis=-1)
    out = np.broadcast_to(start, (len(edges) - 1, len(rows), UNKNOWNS)).copy()
    middle = 0.5 * (edges[:-1] + edges[1:])
    out[..., plane * SIZE] = middle[:, None]
    out[..., plane * SIZE + 1 : plane * SIZE + 5] = rows[:, :4]
    return out


def search_plane(problem: Problem, plane: int, start: np.ndarray) -> list[tuple[float, int, np.ndarray]]:
    """Best (sum of squares, cell, unknowns) of one plane alone, at most KEPT of them, best first."""
    alone, (low, high) = problem.only(plane), bounds()
    edges = problem.edges(plane)
    table = starts(edges, plane, start, plane * SIZE + 4 in alone.free)
    found = costs(table.reshape(-1, UNKNOWNS), *alone.data).reshape(table.shape[:2])
    order = np.argsort(found, axis=1, kind="stable")[:, :STARTS]
    running = [(found[cell, k], cell, table[cell, k]) for cell in range(len(table)) for k in order[cell]]
    for left, rounds in HALVING:
        running = sorted(running, key=lambda item: item[:2])[:left]
        ended = []
        for _, cell, p in running:
            inside = in_cell(low, high, edges, plane, cell)
            p, cost = descend(p, *inside, alone.free, *alone.data, rounds, 1e-7)
            ended.append((float(cost), int(cell), p))
        running = ended
    best: dict[int, tuple[float, int, np.ndarray]] = {}
    for item in sorted(running, key=lambda item: item[:2]):
        best.setdefault(item[1], item)
    return list(best.values())[:KEPT]


def search(problem: Problem, start: np.ndarray) -> tuple[np.ndarray, float]:
    """Unknowns and sum of squares of the whole problem: both planes' best cells together, then their neighbours."""
    low, high = bounds()
    edges = [problem.edges(plane) for plane in (0, 1)]
    alone = [search_plane(problem, plane, start) for plane in (0, 1)]
    tried: dict[tuple[int, int], tuple[float, np.ndarray]] = {}

    def attempt(weft: int, warp: int, p: np.ndarray) -> None:
        if not (0 <= weft < len(edges[0]) - 1 and 0 <= warp < len(edges[1]) - 1) or (weft, warp) in tried:
            return
        inside = in_cell(*in_cell(low, high, edges[0], 0, weft), edges[1], 1, warp)
        p, cost = descend(np.clip(p, *inside), *inside, problem.free, *problem.data, ROUNDS, TOLERANCE)
        tried[weft, warp] = float(cost), p

    for _, weft, p in alone[0]:
        for _, warp, q in alone[1]:
            attempt(weft, warp, np.concatenate([p[:SIZE], q[SIZE:]]))
    while True:
        (weft, warp), (cost, p) = min(tried.items(), key=lambda item: (item[1][0], item[0]))
        for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            attempt(weft + dx, warp + dy, p)
        if min(item[0] for item in tried.values()) >= cost:
            return p, cost


def at_bounds(p: np.ndarray, free: np.ndarray) -> list[str]:
    """Names of the unknowns that ended at the end of their range."""
    low, high = bounds()
    near = 1e-6 * (high - low)
    return [NAMES[k] for k in free if p[k] <= low[k] + near[k] or p[k] >= high[k] - near[k]]
