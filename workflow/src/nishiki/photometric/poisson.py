"""Poisson's equation on the pixel grid: directly by the cosine transform, with weights by conjugate gradients."""

import numpy as np


def edge_gradients(p, q, pitch):
    """Height differences that the slopes ask for: to the right (rows, columns - 1) and down (rows - 1, columns).

    Rows count downwards and y upwards, so that a step down is -q.
    """
    half = p.dtype.type(0.5 * pitch)
    return (p[:, :-1] + p[:, 1:]) * half, (q[:-1] + q[1:]) * -half


def divergence(differences, weights):
    """Right-hand side of the normal equations: the weighted differences that end in a pixel less those that start."""
    along, down = differences
    rows, columns = along.shape[0], down.shape[1]
    out = np.zeros((rows, columns), dtype=along.dtype)
    flow = along * weights[0]
    out[:, 1:] += flow
    out[:, :-1] -= flow
    flow = down * weights[1]
    out[1:] += flow
    out[:-1] -= flow
    return out


def laplacian(height, weights):
    """The matrix of the normal equations times a height field: the weighted graph Laplacian of the grid."""
    return divergence((np.diff(height, axis=1), np.diff(height, axis=0)), weights)


def poisson_symbol(shape, dtype):
    """Eigenvalues of the unweighted Laplacian with natural boundaries, by cosine frequency: a column and a row."""
    rows = 2.0 - 2.0 * np.cos(np.pi * np.arange(shape[0]) / shape[0])
    columns = 2.0 - 2.0 * np.cos(np.pi * np.arange(shape[1]) / shape[1])
    return rows[:, None].astype(dtype), columns[None, :].astype(dtype)


def solve_rectangle(right, symbol):
    """Solve the unweighted Laplacian on the full rectangle; right is used up. The mean is 0."""
    from scipy import fft

    spectrum = fft.dctn(right, type=2, norm="ortho", overwrite_x=True)
    rows, columns = symbol
    for k in range(0, spectrum.shape[0], 256):  # in bands: the sum of the symbols is never held whole
        band = rows[k : k + 256] + columns
        if k == 0:
            band[0, 0] = 1
        spectrum[k : k + 256] /= band
    spectrum[0, 0] = 0
    return fft.idctn(spectrum, type=2, norm="ortho", overwrite_x=True)


def conjugate_gradients(weights, right, symbol, tolerance, max_iterations):
    """Solve the weighted Laplacian, preconditioned by the unweighted one on the full rectangle.

    Pixels without neighbours of positive weight, and the mean of each part, are left as they come: the right-hand side
    does not ask for them. Returns heights, iterations and the relative residual.
    """
    height = np.zeros_like(right)
    scale = norm(right)
    if scale == 0.0:
        return height, 0, 0.0
    residual = right
    direction = solve_rectangle(residual.copy(), symbol)
    gain = inner(residual, direction)
    left = 1.0
    for iteration in range(1, max_iterations + 1):
        image = laplacian(direction, weights)
        step = right.dtype.type(gain / inner(direction, image))
        height += step * direction
        residual -= step * image
        left = norm(residual) / scale
        if left <= tolerance:
            return height, iteration, left
        conditioned = solve_rectangle(residual.copy(), symbol)
        previous, gain = gain, inner(residual, conditioned)
        direction *= right.dtype.type(gain / previous)
        direction += conditioned
    return height, max_iterations, left


def inner(a, b):
    """Scalar product, summed in float64 row by row, so that float32 fields of many megapixels lose nothing."""
    return float(np.sum(np.einsum("rc,rc->r", a, b, dtype=np.float64)))


def norm(a):
    """Euclidean norm, summed as `inner`."""
    return float(np.sqrt(inner(a, a)))
