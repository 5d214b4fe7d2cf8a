"""Estimate the error of the normals from the spread over lamps left out, and from integrability.

`sigma` is a jackknife over the lamps: it holds errors that change with the lamp. Errors that all
lamps share leave another trace: the slopes of a surface have no curl (B. K. P. Horn and M. J. Brooks, The variational
approach to shape from shading, Computer Vision, Graphics, and Image Processing 33, 1986), and errors that change from
place to place do. With

    k     = p_y - q_x of every square of four valid pixels, p and q the slopes, pixels as unit
    delta = WINDOW / 4 * mean of k over WINDOW x WINDOW squares

delta is the error of the slopes along the border of the window that explains the circulation around it. The expected
error is

    E^2 = mean of sigma^2 over a window + c^3 d^2

d the root mean square of delta over a window, c = n_z, c^1.5 the mean factor from slopes to angles along and across the
tilt.

Errors of what ingest put right are shared by all pixels and leave no curl. To first order, with lights l_j and
M = sum l_j l_j^T, a relative error e_j of the strength of lamp j turns the normal n by the part of M^-1 l_j (l_j . n)
e_j across n. An error of the shift of its photograph acts on the slopes of albedo times normal, relative to the albedo,
in place of n, and an error a of the light of the room turns n by a M^-1 sum l_j.
"""

from typing import Any

import numpy as np

WINDOW = 7  # pixels
REACH = WINDOW  # rows on either side that the error of a pixel depends on: half of two windows, and a square of pixels
GROUPS = 8  # of neighbouring lamps that are left out in turn
LEAST_NZ, LARGEST_SIGMA = 0.15, 0.5  # slopes beyond, and radians beyond, count as these
UNKNOWN = 0.5 * np.pi  # as sigma of pixels without an estimate


def direction_groups(directions: np.ndarray) -> np.ndarray:
    """Divide lamps (n, 3) into GROUPS of neighbours; fewer lamps are a group each.

    Returns
    -------
    (n,) int, numbers of the groups: the nearest of GROUPS lamps, each the farthest from those chosen before.
    """
    chosen = [int(np.argmax(directions[:, 2]))]
    while len(chosen) < min(GROUPS, len(directions)):
        chosen.append(int(np.argmin((directions @ directions[chosen].T).max(axis=1))))
    return np.unique(np.argmax(directions @ directions[chosen].T, axis=1), return_inverse=True)[1]


def expected_error(normals: np.ndarray, sigma: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Estimate the root mean square angle by which the normals are likely to be off.

    Parameters
    ----------
    normals : (rows, columns, 3)
        Unit vectors, x right, y up, z to the camera.
    sigma : (rows, columns)
        Radians, of the stage `normals`.
    valid : (rows, columns) bool
        Pixels with an estimate.

    Returns
    -------
    (rows, columns) float32
        Radians, at most pi / 2, which it is where a pixel is not valid.
    """
    known = valid.astype(np.float32)
    square = np.minimum(sigma, LARGEST_SIGMA).astype(np.float32) ** 2
    circulation = slope_error(normals, valid) * np.clip(normals[..., 2], LEAST_NZ, 1) ** 1.5
    error = np.sqrt(np.maximum(window_mean(square * known, known), 0) + circulation**2)
    return np.where(valid, np.minimum(error, UNKNOWN), UNKNOWN).astype(np.float32)


def correction_error(
    normals: np.ndarray, albedo: np.ndarray, directions: np.ndarray, uncertainty: dict[str, Any]
) -> np.ndarray:
    """Compute the root mean square angle by which errors of corrections turn normals.

    Parameters
    ----------
    normals : (rows, columns, 3)
        Unit vectors.
    albedo : (rows, columns)
        Relative to white.
    directions : (lights, 3)
        Unit vectors to the lamps.
    uncertainty : dict
        `gains`: covariance (lights, lights) of the relative strengths; `shift_px`: standard errors (lights,) of the
        shifts along either axis, pixels; `ambient`: standard error of the light of the room, relative to the albedo
        under a frontal lamp. Each may be absent.

    Returns
    -------
    (rows, columns) float32
        Radians, at most pi / 2.
    """
    inverse = np.linalg.inv(directions.T @ directions)
    turns = np.einsum("ja,jb->jab", directions @ inverse, directions).reshape(len(directions), 9)
    terms = []
    if "gains" in uncertainty:
        terms.append((np.array(uncertainty["gains"]), normals))
    if "shift_px" in uncertainty:
        covariance = np.diag(np.square(uncertainty["shift_px"]))
        body, level = normals * albedo[..., None], np.maximum(albedo, 1e-6)[..., None]
        terms += [(covariance, np.gradient(body, axis=axis) / level) for axis in (0, 1)]
    constant = uncertainty.get("ambient", 0.0) * (directions @ inverse).sum(axis=0)
    variance = constant @ constant - (normals @ constant) ** 2
    for covariance, field in terms:
        tensor = turns.T @ covariance @ turns
        whole = np.einsum("abac->bc", tensor.reshape(3, 3, 3, 3))
        pairs = (normals[..., :, None] * field[..., None, :]).reshape(*albedo.shape, 9)
        variance = variance + ((field @ whole) * field).sum(axis=-1) - ((pairs @ tensor) * pairs).sum(axis=-1)
    return np.minimum(np.sqrt(np.maximum(variance, 0)), UNKNOWN).astype(np.float32)


def slope_error(normals: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Compute the slopes' error (rows, columns) float32 that explains their curl, d in the module's equations."""
    nz = np.maximum(normals[..., 2], LEAST_NZ)
    p = np.where(valid, -normals[..., 0] / nz, 0).astype(np.float32)
    q = np.where(valid, -normals[..., 1] / nz, 0).astype(np.float32)
    down = p[1:, :-1] + p[1:, 1:] - p[:-1, :-1] - p[:-1, 1:]  # 2 dp / d(row); y points up
    right = q[:-1, 1:] + q[1:, 1:] - q[:-1, :-1] - q[1:, :-1]
    known = np.zeros(valid.shape, np.float32)
    known[:-1, :-1] = valid[:-1, :-1] & valid[1:, :-1] & valid[:-1, 1:] & valid[1:, 1:]
    curl = np.zeros(valid.shape, np.float32)
    curl[:-1, :-1] = -0.5 * (down + right) * known[:-1, :-1]
    delta = window_mean(curl, known) * np.float32(WINDOW / 4)
    # the rest that running sums leave behind large values may be negative
    return np.sqrt(np.maximum(window_mean(delta * delta * known, known), 0))


def window_mean(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Average the known values (0 elsewhere) over a window around each pixel; 0 where none is known."""
    from scipy.ndimage import uniform_filter

    share = uniform_filter(known, WINDOW, mode="constant")
    total = uniform_filter(values, WINDOW, mode="constant")
    # running sums leave roundings: below half a pixel there is none
    return np.where(share > 0.5 / WINDOW**2, total / np.maximum(share, 0.5 / WINDOW**2), np.float32(0))
