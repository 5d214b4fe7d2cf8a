"""How far measured oblique images lie from a model, carried over to the directions around them.

The logarithm of measured over modelled value is taken for a Gaussian process over pairs of directions (light, view):
mean 0, standard deviation SPREAD, correlation Wendland's function of the pairs' distance, summed over the mirror images
in the planes of weft and warp and over the exchange of light and view, so that the result has these symmetries exactly
(Wendland, Scattered Data Approximation, 2005; Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006).
Farther than REACH from all images the model stands alone.
"""

import math

import numpy as np
from numba import njit

SPREAD, NOISE = 0.15, 0.03  # of the logarithm: of the model's errors, and of a measurement
REACH = 0.8  # distance of pairs of unit vectors
LARGEST = 1.0  # logarithm of a ratio that is still taken for a model's error


@njit(cache=True, nogil=True, error_model="numpy")
def likeness(first, second, quarter):
    """Correlation of two pairs (6,): light and view."""
    total = 0.0
    for image in range(8 if quarter else 2):
        x = -1.0 if image & 2 else 1.0
        y = -1.0 if image & 4 else 1.0
        turn = 3 if image & 1 else 0
        product = 0.0
        for k in range(2):
            a, b = 3 * k, (3 * k + turn) % 6
            product += x * first[a] * second[b] + y * first[a + 1] * second[b + 1] + first[a + 2] * second[b + 2]
        square = 4.0 - 2.0 * product
        if square < REACH * REACH:
            d = math.sqrt(max(square, 0.0)) / REACH
            total += (1.0 - d) ** 4 * (4.0 * d + 1.0)
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def log_ratio(pairs, images, weights, quarter, out):
    """out (n,) = sum over images (m, 6) of their weight times their likeness to the pair (n, 6)."""
    for k in range(pairs.shape[0]):
        total = 0.0
        for j in range(images.shape[0]):
            total += weights[j] * likeness(pairs[k], images[j], quarter)
        out[k] = total


def pairs_of(incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
    """(n, 6) of directions (n, 3)."""
    return np.ascontiguousarray(np.concatenate([incident, outgoing], axis=-1))


def fit_ratio(pairs: np.ndarray, measured: np.ndarray, modelled: np.ndarray, quarter: bool) -> np.ndarray:
    """Weights (n,) of the images at pairs (n, 6), from measured and modelled values (n,)."""
    known = (measured > 0) & (modelled > 0)
    safe = np.where(known, measured, 1.0) / np.where(known, modelled, 1.0)
    target = np.clip(np.log(safe), -LARGEST, LARGEST)
    matrix = np.array([[likeness(a, b, quarter) for b in pairs] for a in pairs]).reshape(len(pairs), -1)
    return SPREAD**2 * np.linalg.solve(SPREAD**2 * matrix + NOISE**2 * np.eye(len(pairs)), target)


def ratio(incident: np.ndarray, outgoing: np.ndarray, images: np.ndarray, weights: np.ndarray, quarter: bool):
    """(n,) factor of a model at directions (n, 3)."""
    out = np.empty(len(incident))
    log_ratio(pairs_of(incident, outgoing), images, weights, quarter, out)
    return np.exp(np.clip(out, -LARGEST, LARGEST))
