"""Reflection parameters to integers and back: 2-D transform, steps from what an error does to the pictures."""

from __future__ import annotations

import numpy as np

from nishiki.codec.design import Design
from nishiki.codec.extent import Extent
from nishiki.codec.parameters import WIDTH_FLOOR, Maps, Weights
from nishiki.codec.quantise import quantise
from nishiki.codec.solve import Operator, solve
from nishiki.codec.transform import Block

ITERATIONS = 60


def encode_parameters(
    maps: Maps, weights: Weights, typical: tuple[float, ...], design: Design, extent: Extent, threshold: float
):
    """(C, 3, rows, columns) int32: kd, ks and log sigma (channel 0) as multiples of their steps; of cropped maps.

    typical: weight of a typical texel for each group; texels weigh in with their own up to that, so that what the
    pictures do not show is filled with whatever is cheapest. threshold: in steps.
    """
    out = np.zeros(design.parameter_shape(extent), np.int32)
    block = Block(design.parameter_plane(extent), np.eye(1), np.eye(1))
    groups = zip(_planes(maps), (weights.kd, weights.ks, weights.sigma[..., None]), typical, strict=True)
    for group, (values, weight, usual) in enumerate(groups):
        mix, mean = design.parameter_mix(group), design.parameter_mean(group)
        planes = np.tensordot(mix, values - mean[:, None, None], 1).astype(np.float32)
        share = np.clip(weight.mean(axis=-1) / usual, 0, 1) if usual > 0 else np.zeros(weight.shape[:2])
        step = design.parameter_steps[group]
        out[: len(planes), group] = _solve_planes(planes, share.astype(np.float32), block, step, threshold)
    return out


def _solve_planes(planes: np.ndarray, share: np.ndarray, block: Block, step: float, threshold: float) -> np.ndarray:
    root = np.sqrt(share)[None, None]
    operator = Operator(lambda v: v * root, lambda v: v * root, float(share.max(initial=0)))
    shape = (len(planes), 1, 1, *planes.shape[1:])
    data = planes[:, None] * root
    solution = solve(data, operator, block, shape, threshold=threshold * step, iterations=ITERATIONS)
    return quantise(solution.coefficients, step)[:, 0, 0]


def decode_parameters(values: np.ndarray, design: Design, extent: Extent) -> Maps:
    """Cropped maps of integers (C, 3, rows, columns); K_d and K_s are held at 0 and above, sigma above 0.001 rad and
    below 1e3."""
    block = Block(design.parameter_plane(extent), np.eye(1), np.eye(1))
    planes = []
    for group in range(3):
        count = 1 if group == 2 else design.channels
        coefficients = (values[:count, group] * np.float32(design.parameter_steps[group])).astype(np.float32)
        samples = block.inverse(coefficients[:, None, None])[:, 0, 0]
        mixed = np.tensordot(design.parameter_mix(group).T, samples, 1) + design.parameter_mean(group)[:, None, None]
        planes.append(np.moveaxis(mixed, 0, -1).astype(np.float32))
    width = np.exp(np.clip(planes[2][..., 0], np.log(WIDTH_FLOOR), np.log(1e3)))
    return Maps(np.maximum(planes[0], 0), np.maximum(planes[1], 0), width)


def _planes(maps: Maps) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    width = np.log(np.clip(maps.sigma, WIDTH_FLOOR, 1e3))
    return np.moveaxis(maps.kd, -1, 0), np.moveaxis(maps.ks, -1, 0), width[None]
