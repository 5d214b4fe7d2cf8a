"""Lights, normals and sample values that the cases of stability draw from."""

import numpy as np

EXTREME = np.array(
    [
        *(0, -0.0, 1e-45, 1e-40, 1.2e-38, 1e-30, 1e-20, 1e-3, 0.5, 1, 1e10, 1e20, 1e30, 3e38, 3.4028235e38),
        *(-1e-10, -1, -1e20, -3e38, np.nan, np.inf, -np.inf),
    ],
    np.float32,
)
"""Zeros, subnormal and huge numbers of both signs, NaN, infinities."""


def dome(count: int, lowest: float = 0.3) -> np.ndarray:
    """(count, 3) lights spread evenly over a dome by the golden angle, z from `lowest` to 0.98."""
    k = np.arange(count) + 0.5
    z = lowest + (0.98 - lowest) * k / count
    angle, radius = k * np.pi * (3 - np.sqrt(5)), np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def tilted(count: int, seed: int, most: float = 0.6) -> np.ndarray:
    """(count, 3) unit normals of random tilt up to `most` radians."""
    rng = np.random.default_rng(seed)
    tilt, turn = rng.uniform(0, most, count), rng.uniform(0, 2 * np.pi, count)
    return np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], axis=1)


def turned_cone(count: int, radius: float, turn: float) -> np.ndarray:
    """(count, 3) unit vectors on a cone about an oblique axis; radius: tangent of its half angle."""
    axis = np.array([0.3, -0.4, 0.8]) / np.linalg.norm([0.3, -0.4, 0.8])
    across = np.cross(axis, [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    angle = turn + 2 * np.pi * np.arange(count) / count
    rim = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * np.cross(axis, across)
    cone = axis + radius * rim
    return cone / np.linalg.norm(cone, axis=1, keepdims=True)


def matt_pixels(count: int, pixels: int, seed: int, *, most: float = 0.6, lowest: float = 0.3):
    """Noise-free Lambertian observations (count, 1, pixels) float32, the lights, normals and albedos."""
    lights, normals = dome(count, lowest), tilted(pixels, seed, most)
    albedo = np.random.default_rng(seed).uniform(0.1, 0.9, pixels)
    stack = np.maximum(lights @ normals.T, 0) * albedo
    return stack.astype(np.float32).reshape(count, 1, pixels), lights, normals, albedo


def same(found, expected) -> bool:
    """Whether all values are equal."""
    return bool(np.array_equal(np.asarray(found, float), np.asarray(expected, float)))
