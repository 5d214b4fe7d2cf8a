"""Solve the weighted Laplace equation of a picture by bands of rows, in memory that does not grow with the picture.

The unknowns h minimise the sum over neighbouring pixels a, b of w_ab (h_b - h_a - g_ab)^2, w_ab the smaller weight of
the two. Conjugate gradients solve the normal equations, preconditioned by one V cycle of multigrid. A level halves the
picture: four pixels become one, and an edge carries half of the weights between them, which is Galerkin's operator of
constant interpolation with Braess's over-correction (D. Braess, Towards algebraic multigrid for elliptic problems of
second order, Computing 55, 1995). Two Jacobi steps before and after each correction smooth the upper half of the
spectrum best that two can (Chebyshev nodes).

An operation on a band is wrong only near the rows at which the band is cut. So each band is read with a margin that the
cuts do not cross, and the numbers are those of the whole picture: there is no border to be seen. Vectors of the picture
lie on the disk; only levels of few pixels are held whole.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

SMOOTHING = (0.562, 1.389)  # steps of Jacobi: inverse nodes of Chebyshev's polynomial of degree 2 over 0.5 .. 2
BAND_PIXELS = 1_000_000  # of a window in memory
WHOLE_PIXELS = 4_000_000  # at most, of the finest level that is held whole; beyond, work arrays are float32: heights
# to about 1e-5
MARGIN = 4  # rows of the coarsest level of a window that a cut may spoil, at either end
LAST_SWEEPS = 8  # pairs of smoothing steps on the level of at most 2 x 2 pixels


class RowsOnDisk:
    """An array (rows, columns) in a file, read and written by slices of rows like an array in memory."""

    def __init__(self, path: Path, shape: tuple[int, int], dtype: np.dtype):
        self.path, self.columns, self.dtype = path, shape[1], np.dtype(dtype)
        with open(path, "wb") as file:
            file.truncate(shape[0] * shape[1] * self.dtype.itemsize)

    def __getitem__(self, rows: slice) -> np.ndarray:
        """Read rows start .. stop - 1."""
        width = self.columns * self.dtype.itemsize
        values = np.fromfile(self.path, self.dtype, (rows.stop - rows.start) * self.columns, offset=rows.start * width)
        return values.reshape(-1, self.columns)

    def __setitem__(self, rows: slice, values: np.ndarray) -> None:
        """Write rows from start on."""
        with open(self.path, "r+b") as file:
            file.seek(rows.start * self.columns * self.dtype.itemsize)
            np.ascontiguousarray(values, self.dtype).tofile(file)


Rows = np.ndarray | RowsOnDisk
"""An array of the picture, in memory or on the disk."""


@dataclass(frozen=True)
class RowWindow:
    """Rows of a picture: `core` are to be computed, `read` with those they depend on, `inner` is the core in these."""

    core: slice
    read: slice

    @property
    def inner(self) -> slice:
        """Rows of the core, counted from the first that is read."""
        return slice(self.core.start - self.read.start, self.core.stop - self.read.start)

    def coarser(self, levels: int) -> "RowWindow":
        """Return the rows that these become after so many halvings."""
        halved = [slice(rows.start >> levels, -(-rows.stop >> levels)) for rows in (self.core, self.read)]
        return RowWindow(*halved)


def windows(rows: int, step: int, margin: int) -> Iterator[RowWindow]:
    """Cut 0 .. rows - 1 into cores of `step` rows, and read `margin` more on either side."""
    for start in range(0, rows, step):
        stop = min(start + step, rows)
        yield RowWindow(slice(start, stop), slice(max(start - margin, 0), min(stop + margin, rows)))


def edges(weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the weights of the pairs of neighbours, along and down: the smaller of the two pixels'."""
    return np.minimum(weight[:, :-1], weight[:, 1:]), np.minimum(weight[:-1], weight[1:])


def divergence(flows: tuple[np.ndarray, np.ndarray], weights: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Compute the normal equations' right-hand side: weighted differences that end in a pixel less those that start."""
    along, down = flows
    out = np.zeros((along.shape[0], down.shape[1]), along.dtype)
    flow = along * weights[0]
    out[:, 1:] += flow
    out[:, :-1] -= flow
    flow = down * weights[1]
    out[1:] += flow
    out[:-1] -= flow
    return out


def laplacian(height: np.ndarray, weights: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Multiply by the normal equations: the weighted graph Laplacian of the grid."""
    return divergence((np.diff(height, axis=1), np.diff(height, axis=0)), weights)


@dataclass(frozen=True)
class GridLevel:
    """A grid: `weights` of its pairs of neighbours, and the inverse of the diagonal of its Laplacian, 0 where that is.

    A pixel without neighbours of positive weight stays as it comes: the right-hand side does not ask for it.
    """

    weights: tuple[np.ndarray, np.ndarray]
    inverse: np.ndarray

    @classmethod
    def of(cls, weights: tuple[np.ndarray, np.ndarray]) -> "GridLevel":
        """Return the level of these weights."""
        along, down = weights
        total = np.zeros((along.shape[0], down.shape[1]), along.dtype)
        total[:, 1:] += along
        total[:, :-1] += along
        total[1:] += down
        total[:-1] += down
        return cls(weights, np.divide(1, total, out=np.zeros_like(total), where=total > 0))

    def coarser(self) -> "GridLevel":
        """Return the level of half as many rows and columns."""
        along, down = self.weights
        rows, columns = self.inverse.shape
        half = along.dtype.type(0.5)
        across = np.add.reduceat(along[:, 1::2], np.arange(0, rows, 2), axis=0) * half
        return GridLevel.of((across, np.add.reduceat(down[1::2], np.arange(0, columns, 2), axis=1) * half))

    def smooth(self, height: np.ndarray, right: np.ndarray, steps: tuple[float, ...]) -> np.ndarray:
        """Take steps of Jacobi's iteration, in place."""
        for step in steps:
            change = right - laplacian(height, self.weights)
            change *= self.inverse
            change *= right.dtype.type(step)
            height += change
        return height

    def start(self, right: np.ndarray) -> np.ndarray:
        """Smooth from 0."""
        height = self.inverse * right
        height *= right.dtype.type(SMOOTHING[0])
        return self.smooth(height, right, SMOOTHING[1:])


def levels_of(finest: GridLevel, count: int | None = None) -> list[GridLevel]:
    """Return a level and the coarser ones, `count` in all or until 2 x 2 pixels are left."""
    levels = [finest]
    while len(levels) < count if count else max(levels[-1].inverse.shape) > 2:
        levels.append(levels[-1].coarser())
    return levels


def descend(levels: list[GridLevel], right: np.ndarray) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray]:
    """Run the first half of a V cycle: heights and right-hand sides of the levels, and that below the last."""
    passed = []
    for level in levels:
        height = level.start(right)
        passed.append((height, right))
        left = right - laplacian(height, level.weights)
        rows, columns = (np.arange(0, side, 2) for side in left.shape)
        right = np.add.reduceat(np.add.reduceat(left, rows, axis=0), columns, axis=1)
    return passed, right


def ascend(levels: list[GridLevel], passed: list[tuple[np.ndarray, np.ndarray]], below: np.ndarray) -> np.ndarray:
    """Run the second half of a V cycle, from the heights below the last level."""
    for level, (height, right) in zip(reversed(levels), reversed(passed), strict=True):
        rows, columns = height.shape
        height += np.repeat(np.repeat(below, 2, axis=0)[:rows], 2, axis=1)[:, :columns]
        below = level.smooth(height, right, SMOOTHING[::-1])
    return below


def inner(a: np.ndarray, b: np.ndarray) -> float:
    """Compute the scalar product in float64 row by row, so that float32 fields of many megapixels lose nothing."""
    return float(np.sum(np.einsum("rc,rc->r", a, b, dtype=np.float64)))


class Laplace:
    """The equations of one picture, by windows of rows.

    shape: rows and columns; weight: of the pixels, 0 where there is no unknown.
    """

    def __init__(self, shape: tuple[int, int], weight: Rows):
        rows, columns = shape
        self.weight, self.dtype, self.count = weight, weight.dtype, 1
        while rows * columns > WHOLE_PIXELS << 2 * self.count:
            self.count += 1
        margin = MARGIN << self.count
        step = max(2 * margin, BAND_PIXELS // columns - 2 * margin) >> self.count << self.count
        step = rows if rows * columns <= BAND_PIXELS else step
        self.windows = list(windows(rows, step, margin))
        self.narrow = list(windows(rows, step, 1))
        small = -(-rows >> self.count), -(-columns >> self.count)
        along, down = (np.zeros((small[0] - k, small[1] - 1 + k), self.dtype) for k in range(2))
        for window in self.windows:
            coarse, at = self.levels(window, self.count + 1)[-1].weights, window.coarser(self.count)
            along[at.core] = coarse[0][at.inner]
            down[at.core] = coarse[1][at.inner]
        self.below = levels_of(GridLevel.of((along, down)))

    def levels(self, window: RowWindow, count: int) -> list[GridLevel]:
        """Return the finest levels of a window."""
        return levels_of(GridLevel.of(edges(self.weight[window.read])), count)

    def precondition(self, right: Rows, out: Rows) -> float:
        """Write one V cycle of a vector to `out`; return the scalar product of the two."""
        below = np.zeros_like(self.below[0].inverse)
        for window in self.windows:
            at = window.coarser(self.count)
            below[at.core] = descend(self.levels(window, self.count), right[window.read])[1][at.inner]
        passed, last = descend(self.below[:-1], below)
        last -= last.mean()  # the last level is smoothed only, less the mean, which no height can explain
        smooth = self.below[-1].smooth(self.below[-1].start(last), last, SMOOTHING * LAST_SWEEPS)
        below, gain = ascend(self.below[:-1], passed, smooth), 0.0
        for window in self.windows:
            levels, values = self.levels(window, self.count), right[window.read]
            found = ascend(levels, descend(levels, values)[0], below[window.coarser(self.count).read])[window.inner]
            out[window.core] = found
            gain += inner(values[window.inner], found)
        return gain

    def image(self, window: RowWindow, values: np.ndarray) -> np.ndarray:
        """Multiply a narrow window of a vector by the equations."""
        return laplacian(values, edges(self.weight[window.read]))[window.inner]

    def solve(
        self, right: Rows, new: Callable[[np.dtype], Rows], tolerance: float, most: int
    ) -> tuple[Rows, int, float]:
        """Solve for a right-hand side, which is used up; return heights, iterations and the relative residual.

        new: makes an array of zeros of the picture's shape.
        """
        height, direction, following, conditioned = (new(self.dtype) for _ in range(4))
        scale = sum(inner(right[w.core], right[w.core]) for w in self.narrow)
        if scale == 0.0:
            return height, 0, 0.0
        gain, previous, left = self.precondition(right, conditioned), np.inf, 1.0
        for iteration in range(1, most + 1):
            turn, bend = self.dtype.type(gain / previous), 0.0
            for window in self.narrow:
                values = direction[window.read] * turn
                values += conditioned[window.read]
                following[window.core] = values[window.inner]
                bend += inner(values[window.inner], self.image(window, values))
            direction, following = following, direction
            step, squares = self.dtype.type(gain / bend), 0.0
            for window in self.narrow:
                values = direction[window.read]
                height[window.core] = height[window.core] + step * values[window.inner]
                rest = right[window.core] - step * self.image(window, values)
                right[window.core] = rest
                squares += inner(rest, rest)
            left = float(np.sqrt(squares / scale))
            if left <= tolerance:
                return height, iteration, left
            previous, gain = gain, self.precondition(right, conditioned)
        return height, most, left
