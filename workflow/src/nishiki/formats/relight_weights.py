"""What the numbers of a relightable image are multiplied by for one light, as relight fits and evaluates them.

Terms: polynomials (ptm; Malzbender and others, 2001), hemispherical harmonics (hsh; Gautron and others, 2004), real
spherical harmonics (sh). Weights of tabulated directions: Gaussians between the captured lights (rbf), and bilinear
interpolation on a grid over the hemisphere (Ponchio, Corsini and Scopigno, 2018).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from nishiki.formats.hsh import LARGEST_ORDER, hemispherical_harmonics

LEAST_WEIGHT = 0.001  # of a captured light, below which viewers leave it out
FROM_YCOCG = np.array([[1.0, 0.5, -0.5], [1.0, 0.0, 0.5], [1.0, -0.5, -0.5]])
"""Red, green and blue of brightness, R - B, and G - (R + B) / 2."""


def ptm_weights(lights: np.ndarray) -> np.ndarray:
    """(n, 6) of unit vectors (n, 3): 1, x, y, x^2, x y, y^2."""
    x, y = lights[:, 0], lights[:, 1]
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


def spherical_harmonics(lights: np.ndarray) -> np.ndarray:
    """(n, 9) of unit vectors (n, 3), by degree and within it from order -l to l, without Condon's and Shortley's sign.

    That is the order in which relight fits them. OpenLIME 1.2 shows them with x and y exchanged.
    """
    x, y, z = lights.T
    first, second = 0.5 * math.sqrt(3 / math.pi), 0.5 * math.sqrt(15 / math.pi)
    linear = [np.full_like(x, 0.5 / math.sqrt(math.pi)), first * y, first * z, first * x]
    square = 0.25 * math.sqrt(5 / math.pi) * (3 * z * z - 1)
    mixed = [second * x * y, second * y * z, square, second * x * z, 0.5 * second * (x * x - y * y)]
    return np.stack([*linear, *mixed], axis=1)


def terms_of(kind: str, count: int) -> Callable[[np.ndarray], np.ndarray] | None:
    """The function of ptm, hsh or sh with this many terms, of unit vectors (n, 3); None where there is none."""
    if kind == "hsh" and count in [order**2 for order in range(1, LARGEST_ORDER + 1)]:
        return lambda lights: hemispherical_harmonics(lights, math.isqrt(count))
    if kind == "ptm" and count in (3, 6):
        return lambda lights: ptm_weights(lights)[:, :count]
    return spherical_harmonics if (kind, count) == ("sh", 9) else None


def gaussian_weights(lights: np.ndarray, light: np.ndarray, width: float) -> np.ndarray:
    """(lights,) of captured unit vectors (lights, 3) for one light, sum 1."""
    squares = np.sum((lights - light) ** 2, axis=1)
    weights = np.exp(-(squares - squares.min()) / width**2)
    weights /= weights.sum()
    weights[weights <= LEAST_WEIGHT] = 0
    return weights / weights.sum()


def bilinear_weights(side: int, light: np.ndarray) -> np.ndarray:
    """(side^2,) of a grid over the hemisphere for one unit vector with z >= 0, sum 1; at most four are not 0.

    The octahedral map, turned by 45 degrees: s = |x| + |y| + |z|; columns from (x + y) / s = -1 to 1, rows from
    (y - x) / s = -1 to 1, nodes at both ends.
    """
    x, y, _ = light
    total = np.abs(light).sum()
    across, down = ((np.array([x + y, y - x]) / total + 1) / 2 * (side - 1)).clip(0, side - 1)
    column, row = min(int(across), side - 2), min(int(down), side - 2)
    weights = np.zeros((side, side))
    right, below = across - column, down - row
    weights[row : row + 2, column : column + 2] = np.outer([1 - below, below], [1 - right, right])
    return weights.ravel()


def grid_directions(side: int) -> np.ndarray:
    """(side^2, 3) unit vectors of the nodes, in the order of `bilinear_weights`; those of the outermost have z = 0."""
    down, across = np.mgrid[:side, :side] * 2 / (side - 1) - 1
    x, y = ((across - down) / 2).ravel(), ((across + down) / 2).ravel()
    vectors = np.stack([x, y, np.maximum(1 - np.abs(x) - np.abs(y), 0)], axis=1)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
