"""Texel-domain coding as the paper counts it: the k largest coefficients; invisible samples fill themselves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nishiki.codec.solve import Operator, Pursuit, curvatures, pursue, transfers
from nishiki.codec.transform import Block

PASSES = 8  # that may search for a price
COUNT_TOLERANCE = 0.005
EFFORT = Pursuit()


@dataclass(frozen=True)
class Kept:
    """coefficients as given, zero where dropped; threshold: smallest magnitude kept; error: sum of squares over the
    visible samples; discarded: energy of the dropped coefficients."""

    coefficients: list[np.ndarray]
    threshold: float
    error: float
    discarded: float


def masked_operator(visible: np.ndarray) -> Operator:
    """The texel domain: A keeps the visible samples, visible (lights * views, T, T) bool."""
    kept = visible[None].astype(np.float32)

    def mask(values: np.ndarray) -> np.ndarray:
        return values * kept.astype(values.dtype)

    return Operator(mask, mask, 1.0)


def largest(coefficients: list[np.ndarray], count: int) -> float:
    """Magnitude of the `count`-th largest of all coefficients of all tiles: one threshold for the object."""
    sizes = np.concatenate([np.abs(c).ravel() for c in coefficients])
    if count <= 0:
        return np.inf
    if count >= sizes.size:
        return 0.0
    return float(np.partition(sizes, sizes.size - count)[sizes.size - count])


def keep_largest(
    residuals: list[np.ndarray], visible: list[np.ndarray], blocks: list[Block], *, count: int, rounds: int = 16
) -> Kept:
    """Keep the `count` largest coefficients of the whole object, without quantisation (Miyazaki et al. 2007,
    section 4.1).

    residuals: per tile (channels, lights, views, T, T); visible: per tile (lights, views, T, T) bool. In each round
    the invisible samples take the values that the kept coefficients give there, and the coefficients are chosen anew;
    rounds = 0: invisible samples are zero and are coded as such.
    """
    samples = [np.where(seen[None], values, 0) for values, seen in zip(residuals, visible, strict=True)]
    before, momentum = None, 1.0
    for turn in range(rounds + 1):
        coefficients = [block.forward(values) for block, values in zip(blocks, samples, strict=True)]
        threshold = largest(coefficients, count)
        kept = [np.where(np.abs(c) >= threshold, c, c.dtype.type(0)) for c in coefficients]
        decoded = [block.inverse(c) for block, c in zip(blocks, kept, strict=True)]
        if turn < rounds:
            following = (1 + np.sqrt(1 + 4 * momentum**2)) / 2
            ahead = _ahead(decoded, before, (momentum - 1) / following)
            samples = [
                np.where(seen[None], values, guess)
                for seen, values, guess in zip(visible, residuals, ahead, strict=True)
            ]
            before, momentum = decoded, following
    error = sum(
        float(np.sum(((values - guess)[:, seen]).astype(np.float64) ** 2))
        for seen, values, guess in zip(visible, residuals, decoded, strict=True)
    )
    discarded = sum(float(np.sum((c - k).astype(np.float64) ** 2)) for c, k in zip(coefficients, kept, strict=True))
    return Kept(kept, threshold, error, discarded)


def _ahead(decoded: list[np.ndarray], before: list[np.ndarray] | None, factor: float) -> list[np.ndarray]:
    """Where the rounds are heading: `factor` of the last change is added, so that they arrive sooner."""
    if before is None:
        return decoded
    return [now + now.dtype.type(factor) * (now - old) for now, old in zip(decoded, before, strict=True)]


def keep_by_pursuit(
    residuals: list[np.ndarray], visible: list[np.ndarray], blocks: list[Block], *, count: int, effort: Pursuit = EFFORT
) -> Kept:
    """Choose and solve for at most `count` coefficients of the whole object, as the coder does for its pictures.

    All coefficients have one price, which is sought; the visible samples are the data, and the coefficients that are
    chosen are solved together, so that the invisible samples cost nothing. residuals, visible: as of `keep_largest`.
    Where the price that is found leaves a few too many, the smallest are dropped; `discarded` is their energy.
    """
    data = [
        np.where(seen, values, 0).reshape(len(values), -1, *values.shape[-2:]).astype(np.float32)
        for values, seen in zip(residuals, visible, strict=True)
    ]
    masks = [seen.reshape(-1, *seen.shape[-2:]) for seen in visible]
    operators = [masked_operator(mask) for mask in masks]
    curvature = [
        curvatures(block, mask) / transfers(block.plane).astype(np.float32)
        for block, mask in zip(blocks, masks, strict=True)
    ]
    scale = sum(float(np.sum(values.astype(np.float64) ** 2)) for values in data) / sum(v.size for v in data)
    logs, price, solutions = [], np.log(0.1 * scale), [None] * len(data)
    best, most = None, sum(values.size for values in residuals)
    for _ in range(PASSES):
        solutions = [
            pursue(*arguments, price=float(np.exp(price)), bits=_one_bit, effort=effort, start=start)
            for *arguments, start in zip(data, operators, blocks, curvature, solutions, strict=True)
        ]
        number = sum(np.count_nonzero(solution) for solution in solutions)
        off = np.log(max(number, 1) / min(count, most))
        logs.append((price, off))
        if best is None or abs(off) <= abs(best[0]):
            best = (off, solutions)
        if abs(off) <= COUNT_TOLERANCE:
            break
        price += np.clip(off / _slope(logs), -4, 4)
    kept = best[1]
    threshold = largest(kept, min(count, most))
    smaller = sum(float(np.sum(c[np.abs(c) < threshold].astype(np.float64) ** 2)) for c in kept)
    kept = [np.where(np.abs(c) >= threshold, c, np.float32(0)) for c in kept]
    error = sum(
        float(np.sum((values - block.inverse(c))[:, seen].astype(np.float64) ** 2))
        for values, block, c, seen in zip(residuals, blocks, kept, visible, strict=True)
    )
    return Kept(kept, threshold, error, smaller)


def _one_bit(coefficients: np.ndarray) -> np.ndarray:
    return np.ones(coefficients.shape, np.float32)


def _slope(logs: list[tuple[float, float]]) -> float:
    """By how much the logarithm of the count falls with that of the price."""
    apart = [k for k in range(len(logs) - 1) if abs(logs[k][0] - logs[-1][0]) > 0.1]
    if not apart:
        return 0.7
    other = min(apart, key=lambda k: abs(logs[k][1]))
    slope = -(logs[-1][1] - logs[other][1]) / (logs[-1][0] - logs[other][0])
    return float(np.clip(slope, 0.1, 2.0))
