"""Sparse coefficients whose picture is the captured one: iterative thresholding through the renderer's look-up.

Minimises |y - A S c|^2 + price * (coefficients that are not zero), A the bilinear look-up at the pixels (or, in the
texel domain, the mask of visible samples), S the inverse transform. Where no pixel looks the data say nothing, so
whatever is cheapest stands there: invisible samples cost nothing. Accelerated proximal gradient (A. Beck and M.
Teboulle, A fast iterative shrinkage-thresholding algorithm, SIAM J. Imaging Sciences 2, 2009) with the hard threshold
of a price on non-zeros (T. Blumensath and M. Davies, Iterative thresholding for sparse approximations, J. Fourier Anal.
Appl. 14, 2008); the threshold falls to its final value, so that strong coefficients explain what they can first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nishiki.codec.interpolate import Footprints
from nishiki.codec.quantise import threshold_and_go_on
from nishiki.codec.transform import Block


@dataclass(frozen=True)
class Solution:
    """coefficients (channels, lights, views, T, T) float32; error: sum of squares left in the data; iterations."""

    coefficients: np.ndarray
    error: float
    iterations: int


@dataclass(frozen=True)
class Operator:
    """A and its adjoint on blocks (channels, lights * views, T, T), and the largest eigenvalue of A^T A."""

    look: Callable[[np.ndarray], np.ndarray]
    spread: Callable[[np.ndarray], np.ndarray]
    norm: float

    @classmethod
    def of_pixels(cls, feet: Footprints) -> Operator:
        """The image domain: A is the look-up at the pixels."""
        return cls(feet.look_up, feet.spread, float(feet.density().max(initial=0)))


def solve(
    data: np.ndarray,
    operator: Operator,
    block: Block,
    shape: tuple[int, ...],
    *,
    threshold: float,
    iterations: int,
    start: np.ndarray | None = None,
    descent: float = 4.0,
) -> Solution:
    """Coefficients of `data` (channels, n) or (channels, lights * views, T, T).

    threshold: smallest coefficient worth its price. shape: of the block (channels, lights, views, T, T). start:
    coefficients of an earlier solution. descent: the first threshold over the last.
    """
    dtype = data.dtype
    held = np.zeros(shape, dtype) if start is None else start.astype(dtype, copy=True)
    if not iterations or operator.norm == 0:
        left = data - operator.look(samples_of(block, held))
        return Solution(held, float(np.sum(left.astype(np.float64) ** 2)), 0)
    ahead, momentum = held.copy(), 1.0
    pace = dtype.type(1 / (operator.norm * block.bound()))
    for step in range(iterations):
        left = data - operator.look(samples_of(block, ahead))
        gradient = block.adjoint(operator.spread(left).reshape(shape))
        following = (1 + np.sqrt(1 + 4 * momentum**2)) / 2
        level = threshold * descent ** max(0.0, 1 - step / (0.6 * iterations))
        arguments = (pace, dtype.type(level), dtype.type((momentum - 1) / following))
        threshold_and_go_on(ahead.ravel(), gradient.ravel(), *arguments, held.ravel(), ahead.ravel())
        momentum = following
    left = data - operator.look(samples_of(block, held))
    return Solution(held, float(np.sum(left.astype(np.float64) ** 2)), iterations)


def samples_of(block: Block, coefficients: np.ndarray) -> np.ndarray:
    """(channels, lights * views, T, T) samples of coefficients (channels, lights, views, T, T)."""
    out = block.inverse(coefficients)
    return out.reshape(out.shape[0], -1, *out.shape[-2:])
