"""Texel-domain coding as the paper counts it: the k largest coefficients; invisible samples fill themselves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nishiki.codec.transform import Block


@dataclass(frozen=True)
class Kept:
    """coefficients as given, zero where dropped; threshold: smallest magnitude kept; error: sum of squares over the
    visible samples; discarded: energy of the dropped coefficients."""

    coefficients: list[np.ndarray]
    threshold: float
    error: float
    discarded: float


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
