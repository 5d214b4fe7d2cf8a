"""Normals of an object that is flat overall, turned so that their smooth part faces the camera.

Lamps that stand near but count as distant, and lamps whose brightness falls off over the picture without a white board,
tilt the normals by an angle that changes slowly from edge to edge. Integrated, it is a bowl many times as deep as the
relief. Here the smooth part s of the normals is a polynomial of the pixel's place, fitted so that raised objects on a
flat ground do not pull it, and every normal is turned by the rotation that takes s to the camera's axis z,

    n' = n - (s + z) (s + z).n / (1 + s.z) + 2 (s.n) z,

before the integration. To subtract the smooth part of the heights instead leaves the relief exaggerated where the error
is large: slopes grow with the tangent of the tilt.
"""

import numpy as np
from numpy.polynomial import legendre

DEGREE = 3  # of the polynomials of the normals' components: heights of degree 4
MOST_BLOCKS = 128  # along the longer side: the fit sees the mean normals of this many squares
FLAT_WITHIN = 0.05  # length of a difference of unit normals (3 degrees) beyond which a square counts less
ROUNDS = 8  # of reweighting
BAND = 256  # rows turned at a time


def flatten_normals(normals, valid):
    """Turn the normals of a flat object so that their smooth part faces the camera.

    Parameters
    ----------
    normals : (rows, columns, 3)
        Unit vectors, x right, y up, z to the camera.
    valid : (rows, columns) bool
        Where they are used.

    Returns
    -------
    normals : (rows, columns, 3) float32
        Turned; 0 where not valid.
    angle : float
        Root mean square angle by which valid normals were turned, radians.
    """
    rows, columns = valid.shape
    out = np.zeros((rows, columns, 3), np.float32)
    if not valid.any():
        return out, 0.0
    smooth = smooth_normals(normals, valid)
    x = np.linspace(-1, 1, columns)
    y = np.linspace(-1, 1, rows) if rows > 1 else np.zeros(1)
    squares = 0.0
    for start in range(0, rows, BAND):
        band = slice(start, start + BAND)
        inside = valid[band]
        s = np.moveaxis(legendre.leggrid2d(y[band], x, smooth), 0, -1)[inside]
        s /= np.linalg.norm(s, axis=-1, keepdims=True)
        n = normals[band][inside].astype(np.float64)
        forward = np.einsum("pi,pi->p", s, n)
        squares += float(np.sum(np.square(np.arccos(np.clip(s[:, 2], -1, 1)))))
        s[:, 2] += 1
        n -= s * (np.einsum("pi,pi->p", s, n) / s[:, 2])[:, None]
        n[:, 2] += 2 * forward
        out[band][inside] = n
    return out, float(np.sqrt(squares / np.count_nonzero(valid)))


def smooth_normals(normals, valid):
    """Coefficients (4, 4, 3) of Legendre polynomials along y and x, each from -1 to 1, of the smooth part of normals.

    Least sum over the squares of Huber's function of the length of the difference (P. J. Huber, Robust estimation of a
    location parameter, Annals of Mathematical Statistics 35 (1), 1964), by iteratively reweighted least squares.
    """
    mean, y, x = block_means(normals, valid)
    powers = [(i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]
    terms = legendre.legvander2d(y, x, [DEGREE, DEGREE])[:, [i * (DEGREE + 1) + j for i, j in powers]]
    weight = np.ones(len(mean))
    for _ in range(ROUNDS):
        root = np.sqrt(weight)[:, None]
        solution = np.linalg.lstsq(terms * root, mean * root, rcond=None)[0]
        weight = 1 / np.maximum(np.linalg.norm(mean - terms @ solution, axis=1), FLAT_WITHIN)
    coefficients = np.zeros((DEGREE + 1, DEGREE + 1, 3))
    for (i, j), values in zip(powers, solution, strict=True):
        coefficients[i, j] = values
    return coefficients


def block_means(normals, valid):
    """Unit mean normals (n, 3) of squares of pixels, those with valid ones, and their places y and x from -1 to 1."""
    side = -(-max(valid.shape) // MOST_BLOCKS)
    starts = [np.arange(0, length, side) for length in valid.shape]
    total = np.add.reduceat(np.where(valid[..., None], normals, 0), starts[0], axis=0, dtype=np.float64)
    total = np.add.reduceat(total, starts[1], axis=1)
    length = np.linalg.norm(total, axis=-1)
    places = [
        2 * np.minimum(start + 0.5 * (side - 1), extent - 1) / max(extent - 1, 1) - 1
        for start, extent in zip(starts, valid.shape, strict=True)
    ]
    filled = length > 0
    row, column = np.nonzero(filled)
    return total[filled] / length[filled][:, None], places[0][row], places[1][column]
