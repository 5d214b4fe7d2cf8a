"""Solve for few coefficients whose picture, through the renderer's own look-up, is the captured one.

Minimises |y - A S c|^2 + price * (coefficients that are not zero), A the bilinear look-up at the pixels (or, in the
texel domain, the mask of visible samples), S the inverse transform. Where no pixel looks the data say nothing, so
whatever is cheapest stands there: invisible samples cost nothing. Accelerated proximal gradient (A. Beck and M.
Teboulle, A fast iterative shrinkage-thresholding algorithm, SIAM J. Imaging Sciences 2, 2009) with the hard threshold
of a price on non-zeros (T. Blumensath and M. Davies, Iterative thresholding for sparse approximations, J. Fourier Anal.
Appl. 14, 2008); the threshold falls to its final value, so that strong coefficients explain what they can first.

Minimises |y - A S c|^2 + price * bits(c), A the bilinear look-up at the pixels, S the inverse transform, with the
bits that `rate` expects of the coder. A coefficient that is changed alone lowers the error by h u^2, u = c + g / h its
best value, g = S^T A^T (y - A S c), h = |A S e|^2 the curvature in it; all with h u^2 above their price are chosen at
once, and those chosen are then solved together by conjugate gradients (so alternates D. Needell and J. Tropp, CoSaMP,
Appl. Comput. Harmon. Anal. 26, 2009). Curvatures differ by orders of magnitude between views that face a tile and views
that graze it; one step length for all, as iterative thresholding has it, must follow the largest and refuses what the
others need.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit

from nishiki.codec.transform import Block, PlaneTransform, squared_lengths


@dataclass(frozen=True)
class Footprints:
    """Places where pixels look into a block of texels.

    corner (n,) int32: index of the upper left texel in a flattened (observation, rows, columns) block; down, right (n,)
    float32 in [0, 1]: weights of the row below and the column to the right; order (n,) int64: places in the
    samples as they were given, the footprints being sorted by texel.
    """

    corner: np.ndarray
    down: np.ndarray
    right: np.ndarray
    order: np.ndarray
    shape: tuple[int, int, int]

    @classmethod
    def of(cls, observation: np.ndarray, s: np.ndarray, t: np.ndarray, shape: tuple[int, int, int]) -> "Footprints":
        """Build footprints from row s (n,) in [0, rows - 1] and column t (n,) in [0, columns - 1] of a block.

        shape: (observations, rows, columns) of the block.
        """
        _, rows, columns = shape
        row = np.clip(s.astype(np.int64), 0, rows - 2)
        column = np.clip(t.astype(np.int64), 0, columns - 2)
        corner = (observation.astype(np.int64) * rows + row) * columns + column
        order = np.argsort(corner, kind="stable")
        down = np.clip(s - row, 0, 1).astype(np.float32)[order]
        right = np.clip(t - column, 0, 1).astype(np.float32)[order]
        return cls(corner[order].astype(np.int32), down, right, order, shape)

    def look_up(self, texels: np.ndarray) -> np.ndarray:
        """Look up texels (channels, observations, rows, columns) at the pixels: values (channels, n)."""
        channels = texels.shape[0]
        out = np.empty((channels, len(self.corner)), texels.dtype)
        flat = np.ascontiguousarray(texels).reshape(channels, -1)
        bilinear(flat, self.corner, self.down, self.right, self.shape[2], out)
        return out

    def spread(self, values: np.ndarray) -> np.ndarray:
        """Apply the adjoint of `look_up` to values (channels, n): (channels, observations, rows, columns)."""
        channels = values.shape[0]
        out = np.zeros((channels, int(np.prod(self.shape))), values.dtype)
        bilinear_adjoint(np.ascontiguousarray(values), self.corner, self.down, self.right, self.shape[2], out)
        return out.reshape(channels, *self.shape)

    def density(self) -> np.ndarray:
        """Sum the pixels' weights of each texel, (observations, rows, columns) float32.

        Its maximum bounds the norm of A^T A.
        """
        return self.spread(np.ones((1, len(self.corner)), np.float32))[0]


@njit(cache=True, nogil=True, error_model="numpy")
def bilinear(texels, corner, down, right, columns, out):
    """Interpolate texels (channels, observations * rows * columns) at each pixel n into out[c, n]."""
    for c in range(texels.shape[0]):
        plane, values = texels[c], out[c]
        for n in range(corner.shape[0]):
            at, d, r = corner[n], down[n], right[n]
            if d == 0 and r == 0:
                values[n] = plane[at]
                continue
            top = plane[at] + r * (plane[at + 1] - plane[at])
            low = plane[at + columns] + r * (plane[at + columns + 1] - plane[at + columns])
            values[n] = top + d * (low - top)


@njit(cache=True, nogil=True, error_model="numpy")
def bilinear_adjoint(values, corner, down, right, columns, out):
    """Add weight * values[c, n] to out[c, texel]: the transpose of `bilinear`."""
    for c in range(values.shape[0]):
        plane, given = out[c], values[c]
        for n in range(corner.shape[0]):
            at, d, r, value = corner[n], down[n], right[n], given[n]
            if d == 0 and r == 0:
                plane[at] += value
                continue
            low = d * value
            top = value - low
            plane[at + 1] += r * top
            plane[at] += top - r * top
            plane[at + columns + 1] += r * low
            plane[at + columns] += low - r * low


@dataclass(frozen=True)
class Operator:
    """A and its adjoint on blocks (channels, lights * views, T, T), and the largest eigenvalue of A^T A."""

    look: Callable[[np.ndarray], np.ndarray]
    spread: Callable[[np.ndarray], np.ndarray]
    norm: float

    @classmethod
    def of_pixels(cls, feet: Footprints) -> "Operator":
        """Build the operator of the image domain: A is the look-up at the pixels."""
        return cls(feet.look_up, feet.spread, float(feet.density().max(initial=0)))


DESCENT = 4.0  # first threshold of `solve` over the last


def solve(
    data: np.ndarray, operator: Operator, block: Block, shape: tuple[int, ...], *, threshold: float, iterations: int
) -> np.ndarray:
    """Solve for the coefficients of `data` (channels, n) or (channels, lights * views, T, T).

    threshold: smallest coefficient worth its price. shape: of the block (channels, lights, views, T, T).
    """
    dtype = data.dtype
    held = np.zeros(shape, dtype)
    if not iterations or operator.norm < np.finfo(np.float32).tiny:  # lest a step be infinite
        return held
    ahead, momentum = held, 1.0
    pace = dtype.type(1 / (operator.norm * block.plane.bound))
    for step in range(iterations):
        left = data - operator.look(samples_of(block, ahead))
        gradient = block.adjoint(operator.spread(left).reshape(shape))
        following = (1 + np.sqrt(1 + 4 * momentum**2)) / 2
        level = threshold * DESCENT ** max(0.0, 1 - step / (0.6 * iterations))
        stepped = ahead + pace * gradient
        new = np.where(np.abs(stepped) <= dtype.type(level), dtype.type(0), stepped)
        ahead = new + dtype.type((momentum - 1) / following) * (new - held)
        held, momentum = new, following
    return held


def samples_of(block: Block, coefficients: np.ndarray) -> np.ndarray:
    """Compute samples (channels, lights * views, T, T) of coefficients (channels, lights, views, T, T)."""
    out = block.inverse(coefficients)
    return out.reshape(out.shape[0], -1, *out.shape[-2:])


FLOOR = 1e-3  # of the largest expected magnitude
FLAT_ROUNDS = 2


@dataclass(frozen=True)
class Pursuit:
    """The effort of the search."""

    rounds: int = 6  # choices of the support
    resumed: int = 3  # choices after an earlier solution
    inner: int = 5  # conjugate gradient steps after each
    descent: float = 16.0  # first price over the last
    ridge: float = 0.001  # curvature added to all, which keeps coefficients of barely visible texels small


def transfers(plane: PlaneTransform) -> np.ndarray:
    """Compute the mean share (rows, columns), 1/3..1, of a coefficient's energy that bilinear look-up passes, by band.

    A look-up at a fraction f passes |1 - f + f exp(i w)|^2 of a frequency w; its mean over f is 2/3 + cos(w) / 3, here
    averaged over the octave of each band. The coarsest band passes.
    """

    def line(length: int) -> np.ndarray:
        out = np.ones(length)
        for level in range(plane.levels):
            low, high = np.pi / 2 ** (level + 1), np.pi / 2**level
            mean = 2 / 3 + (np.sin(high) - np.sin(low)) / (high - low) / 3
            out[length >> (level + 1) : length >> level] = mean
        return out

    rows, columns = plane.shape
    return np.outer(line(rows), line(columns))


def curvatures(block: Block, density: np.ndarray) -> np.ndarray:
    """Estimate |A S e|^2 (lights, views, rows, columns) float32 of every coefficient e for pixels of some density.

    density (lights * views, rows, columns): the weight that pixels give each texel. At least 0.001 of the largest.
    """
    plane, lights, views = block.plane, block.lights, block.views
    lengths = squared_lengths(plane, density.astype(np.float64)) * (transfers(plane) / plane.gains**2)
    lengths = lengths.reshape(len(lights), len(views), *plane.shape)
    expected = np.tensordot(lights**2, np.moveaxis(np.tensordot(views**2, lengths, (1, 1)), 1, 0), 1)
    return np.ascontiguousarray(np.maximum(expected, FLOOR * expected.max(initial=0)), np.float32)


def pursue(
    data: np.ndarray,
    operator: Operator,
    block: Block,
    curvature: np.ndarray,
    *,
    price: float,
    bits: Callable[[np.ndarray], np.ndarray],
    effort: Pursuit,
    start: np.ndarray | None = None,
) -> np.ndarray:
    """Find coefficients (channels, lights, views, T, T) float32 of pixel values `data` (channels, n) float32.

    curvature: (lights, views, T, T), see `curvatures`; price: squared error that a bit is worth; bits: expected of
    every coefficient, of a solution in hand. While there is none, every coefficient costs one bit, at the higher prices
    of the first rounds. start: coefficients of an earlier solution at a similar price, to go on from.
    """
    if start is not None and not start.any():
        start = None
    shape = (len(data), *curvature.shape)
    held = np.zeros(shape, np.float32) if start is None else start.reshape(shape).astype(np.float32)
    if not effort.rounds or curvature.max(initial=0) <= 0:
        return np.zeros(shape, np.float32)
    left = data if start is None else data - operator.look(samples_of(block, held))
    chosen, cost = (held != 0).astype(np.uint8), np.ones(shape, np.float32)
    if start is None:
        prices = [price * effort.descent ** max(0.0, 1 - k / max(1, effort.rounds - 2)) for k in range(effort.rounds)]
    else:
        prices = [price] * (effort.resumed - 1)
    # the last choice only removes: what it would add could not be weighed again
    for turn, (level, adding) in enumerate([*((p, True) for p in (*prices, price)), (price, False)]):
        if start is not None or turn >= FLAT_ROUNDS:
            cost[:] = bits(held)
        gradient = None
        if adding:
            gradient = block.adjoint(operator.spread(left).reshape(held.shape))
            add_scaled(gradient, np.float32(-effort.ridge), held)
        choose(held, gradient, curvature, cost, chosen, np.float32(level))
        left = settle(held, chosen, data, operator, block, effort)
    return held


def settle(held, chosen, data, operator: Operator, block: Block, effort: Pursuit) -> np.ndarray:
    """Run conjugate gradients on the chosen coefficients, `held` in place; return the residual of data.

    The gradient is computed only where coefficients are chosen.
    """
    left = data - operator.look(samples_of(block, held))
    ridge, planes = np.float32(effort.ridge), chosen.view(bool).reshape(*chosen.shape[:3], -1).any(axis=3)
    ahead = block.adjoint(operator.spread(left).reshape(held.shape), planes)
    energy = first = restrict(ahead, held, chosen, ridge)
    for step in range(effort.inner):
        if energy <= 1e-6 * first:
            break
        seen = operator.look(samples_of(block, ahead))
        bend = dot(seen, seen) + effort.ridge * dot(ahead, ahead)
        if not bend:  # a gradient that is rounding alone can cancel against the last direction
            break
        stride = np.float32(energy / bend)
        add_scaled(held, stride, ahead)
        add_scaled(left, -stride, seen)
        if step + 1 < effort.inner:
            gradient = block.adjoint(operator.spread(left).reshape(held.shape), planes)
            before, energy = energy, restrict(gradient, held, chosen, ridge)
            add_scaled(gradient, np.float32(energy / before), ahead)
            ahead = gradient
    return left


@njit(cache=True, nogil=True, error_model="numpy")
def choose(held, gradient, curvature, cost, chosen, level):
    """Keep the coefficients that are worth `level` times their cost, zero the others, in place.

    held, gradient, cost, chosen: of the coefficients' shape; curvature: of all channels. Without a gradient (None)
    coefficients are only removed.
    """
    bend = curvature.reshape(-1)
    for c in range(len(held)):
        old, price, kept = held[c].reshape(-1), cost[c].reshape(-1), chosen[c].reshape(-1)
        slope = old if gradient is None else gradient[c].reshape(-1)
        for n in range(len(bend)):
            best = old[n] if gradient is None else old[n] + slope[n] / bend[n]
            worth = bend[n] * best * best > level * price[n]
            kept[n] = worth if gradient is not None else worth and kept[n] > 0
            if not kept[n]:
                old[n] = 0


@njit(cache=True, nogil=True, error_model="numpy")
def add_scaled(target, factor, values):
    """Add factor * values to an array in place."""
    target, values = target.reshape(-1), values.reshape(-1)
    for n in range(len(target)):
        target[n] += factor * values[n]


@njit(cache=True, nogil=True, error_model="numpy")
def restrict(gradient, held, chosen, ridge):
    """Make a gradient that of the chosen coefficients, with the ridge, in place; return the sum of its squares."""
    out, old, kept = gradient.reshape(-1), held.reshape(-1), chosen.reshape(-1)
    for n in range(len(out)):
        out[n] = out[n] - ridge * old[n] if kept[n] else 0
    return dot(out, out)


@njit(cache=True, nogil=True, error_model="numpy")
def dot(one, other):
    """Compute the inner product in double precision, in a fixed order: four sums that do not wait for one another."""
    one, other = one.reshape(-1), other.reshape(-1)
    a = b = c = d = 0.0
    whole = len(one) // 4 * 4
    for n in range(0, whole, 4):
        a += one[n] * other[n]
        b += one[n + 1] * other[n + 1]
        c += one[n + 2] * other[n + 2]
        d += one[n + 3] * other[n + 3]
    for n in range(whole, len(one)):
        a += one[n] * other[n]
    return a + b + (c + d)
