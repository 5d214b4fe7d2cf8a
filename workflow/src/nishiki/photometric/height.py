"""Integrate normals to a height, after a turn that takes away a tilt common to the picture.

The unknown heights h minimise sum over neighbouring pixels a, b of w (h_b - h_a - g)^2, g the mean slope of the two
times the pitch. On a full rectangle with equal weights this is Poisson's equation with natural boundaries, which the
discrete cosine transform solves directly (T. Simchony, R. Chellappa and M. Shao, Direct analytical methods for solving
Poisson equations in computer vision problems, IEEE Trans. PAMI 12 (5), 1990; for the periodic case R. T. Frankot and
R. Chellappa, IEEE Trans. PAMI 10 (4), 1988). With a mask or weights the same solver preconditions conjugate gradients.

Normals of an object that is flat overall are turned so that their smooth part faces the camera. Lamps that stand near
but count as distant, and lamps whose brightness falls off over the picture without a white board, tilt the normals by
an angle that changes slowly from edge to edge. Integrated, it is a bowl many times as deep as the relief. Here the
smooth part s of the normals is a polynomial of the pixel's place, fitted so that raised objects on a flat ground do not
pull it, and every normal is turned by the rotation that takes s to the camera's axis z,

    n' = n - (s + z) (s + z).n / (1 + s.z) + 2 (s.n) z,

before the integration. To subtract the smooth part of the heights instead leaves the relief exaggerated where the error
is large: slopes grow with the tangent of the tilt.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from nishiki.errors import UserError
from nishiki.summary import Summarised
from nishiki.threads import strips


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
    """Multiply a height field by the normal equations: the weighted graph Laplacian of the grid."""
    return divergence((np.diff(height, axis=1), np.diff(height, axis=0)), weights)


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


METHODS = ("auto", "dct", "weighted")
LEAST_NZ = 0.05  # normals that are steeper (87 degrees) count as this steep: slopes stay finite
LEAST_WEIGHT = 1e-3  # a steep pixel keeps this much say, so that it stays tied to its neighbours
NOT_UNIT = 0.02  # of the squared length, as where normals are shaded
PITCHES = (1e-12, 1e12)  # beyond, heights and their squares leave float32
BOW_PIXELS = 100_000  # at most, to which the quadratic surface of `bow` is fitted
SINGLE_ABOVE = 4_000_000  # pixels above which the work arrays are float32: half the memory, heights to about 1e-5


@dataclass(frozen=True, repr=False)
class HeightField(Summarised):
    """A relief with what the integration left over.

    height (rows, columns) float32 in the unit of the pixel pitch, towards the camera, mean 0 over each connected part;
    NaN where `valid` (rows, columns) bool is False: a number there would be a wall around the object.
    integrability_rms: root mean square of p_y - q_x, in slope per unit length, over the 2 x 2 squares of valid pixels;
    0 for the normals of a continuous surface. gradient_rms: root mean square of (height difference / pitch - slope)
    over valid neighbours. bow: see `bow`. parts: number of connected parts, whose relative heights the normals do not
    tell. residual: relative residual of the linear system at the end.
    """

    height: np.ndarray
    valid: np.ndarray
    integrability_rms: float
    gradient_rms: float
    bow: float
    parts: int
    iterations: int
    residual: float
    method: str

    @property
    def diagnostics(self):
        """The scalars, as plain numbers."""
        names = ("method", "integrability_rms", "gradient_rms", "bow", "parts", "iterations", "residual")
        inside = self.height[self.valid]
        span = float(inside.max() - inside.min()) if inside.size else 0.0
        return {**{name: getattr(self, name) for name in names}, "valid_pixels": int(inside.size), "range": span}


def integrate_normals(normals, *, valid=None, pixel_pitch=1.0, method="auto", tolerance=1e-5, max_iterations=1000):
    """Integrate unit normals into a relief.

    Parameters
    ----------
    normals : (rows, columns, 3) array_like of float
        Unit vectors; x right, y up, z towards the camera.
    valid : (rows, columns) array_like of bool, optional
        Pixels with a normal. Default: all.
    pixel_pitch : float, optional
        Distance of neighbouring pixels, whose unit the height takes.
    method : {'auto', 'dct', 'weighted'}, optional
        `dct`: one direct solution with equal weights, where pixels that are not valid count as flat; for full
        rectangles. `weighted`: only valid pixels, weighted by nz^4, the inverse variance of a slope for equal angular
        errors. `auto`: `dct` where every pixel is valid and none is steeper than 80 degrees, else `weighted`.
    tolerance : float, optional
        Relative residual at which the iterations of `weighted` end.
    max_iterations : int, optional
        Largest number of these iterations.

    Returns
    -------
    HeightField
        `height` (rows, columns) float32, mean 0 over each connected part, NaN where it is not `valid`.

    Raises
    ------
    nishiki.errors.UserError
        For shapes that do not fit, a pitch out of 1e-12 .. 1e12, no valid pixel, and unknown methods.

    Examples
    --------
    A plane that rises to the right by a tenth of a pixel for each pixel:

    >>> import numpy as np
    >>> import nishiki
    >>> normals = np.broadcast_to(np.array([-0.1, 0, 1]) / np.sqrt(1.01), (16, 16, 3))
    >>> relief = nishiki.integrate_height(normals)
    >>> bool(np.allclose(np.diff(relief.height, axis=1), 0.1, atol=1e-3))
    True
    """
    normals, valid = checked_normals(normals, valid, pixel_pitch)
    if method not in METHODS:
        raise UserError(f"height: expected a method of {', '.join(METHODS)}, found {method!r}")
    if method == "auto":
        method = "dct" if valid.all() and normals[..., 2].min() > np.cos(np.radians(80.0)) else "weighted"
    dtype = np.float32 if valid.size > SINGLE_ABOVE else np.float64
    p, q, weight = slopes(normals, valid, dtype)
    half = dtype(0.5 * float(pixel_pitch))
    gradients = (p[:, :-1] + p[:, 1:]) * half, (q[:-1] + q[1:]) * -half  # rows count downwards: a step down is -q
    del p, q
    down, across = (2.0 - 2.0 * np.cos(np.pi * np.arange(side) / side) for side in valid.shape)
    symbol = down[:, None].astype(dtype), across[None].astype(dtype)  # eigenvalues of the Laplacian, free boundaries
    if method == "dct":
        height = solve_rectangle(divergence(gradients, (dtype(1), dtype(1))), symbol)
        iterations, residual = 0, 0.0
    else:
        weights = np.minimum(weight[:, :-1], weight[:, 1:]), np.minimum(weight[:-1], weight[1:])
        right = divergence(gradients, weights)
        height, iterations, residual = conjugate_gradients(weights, right, symbol, tolerance, max_iterations)
    parts = level_parts(height, valid)
    curl, mismatch = leftovers(height, gradients, valid, float(pixel_pitch))
    height = height.astype(np.float32)
    bowed = bow(height, valid, float(pixel_pitch))
    return HeightField(height, valid, curl, mismatch, bowed, parts, iterations, residual, method)


def checked_normals(normals, valid, pixel_pitch):
    """Check normals and mask: UserError where shapes differ; normals that are not of unit length are not valid."""
    normals = np.asarray(normals)
    if normals.ndim != 3 or normals.shape[2] != 3:
        raise UserError(f"height: expected normals of shape (rows, columns, 3), found {normals.shape}")
    with np.errstate(over="ignore", invalid="ignore"):
        unit = np.abs(np.einsum("rci,rci->rc", normals, normals) - 1) < NOT_UNIT  # false for NaN
    valid = unit if valid is None else np.asarray(valid, dtype=bool)
    if valid.shape != normals.shape[:2]:
        raise UserError(f"height: expected a mask of shape {normals.shape[:2]} as the normals, found {valid.shape}")
    if not PITCHES[0] <= pixel_pitch <= PITCHES[1]:
        raise UserError(
            f"height: expected a pixel pitch above 0 ({PITCHES[0]:g} to {PITCHES[1]:g}), found {pixel_pitch}; "
            "give the distance of two pixels in a unit that suits it"
        )
    valid = valid & unit
    if not valid.any():
        raise UserError(f"height: expected valid normals, found none among {valid.size} pixels; see the normals' flags")
    return normals, valid


def slopes(normals, valid, dtype):
    """Slopes p = dz/dx and q = dz/dy (y up), and the weight nz^4 of each pixel, 0 where not valid."""
    nz = np.maximum(np.where(valid, normals[..., 2], 1), LEAST_NZ).astype(dtype)
    p = np.where(valid, -normals[..., 0], 0).astype(dtype) / nz
    q = np.where(valid, -normals[..., 1], 0).astype(dtype) / nz
    weight = np.where(valid, np.maximum(nz**4, LEAST_WEIGHT), 0).astype(dtype)
    return p, q, weight


def level_parts(height, valid):
    """Subtract its mean from each connected part, in place; NaN elsewhere. Returns the number of parts."""
    from scipy import ndimage

    height[~valid] = 0
    labels, parts = ndimage.label(valid)
    if parts == 1:
        height[valid] -= height[valid].mean(dtype=np.float64)
        height[~valid] = np.nan
        return 1
    counts = np.bincount(labels.ravel())
    means = np.bincount(labels.ravel(), weights=height.ravel()) / np.maximum(counts, 1)
    height -= means.astype(height.dtype)[labels]
    height[~valid] = np.nan
    return parts


def leftovers(height, gradients, valid, pitch):
    """RMS of p_y - q_x over the 2 x 2 squares of valid pixels, and RMS of the slope mismatch over valid neighbours."""
    along, down = gradients
    complete = valid[:-1, :-1] & valid[:-1, 1:] & valid[1:, :-1] & valid[1:, 1:]
    around = along[:-1] + down[:, 1:] - along[1:] - down[:, :-1]
    squares = np.sum(np.square(around[complete], dtype=np.float64))
    curl = np.sqrt(squares / max(1, np.count_nonzero(complete))) / pitch**2
    beside, below = valid[:, :-1] & valid[:, 1:], valid[:-1] & valid[1:]
    total = np.sum(np.square((np.diff(height, axis=1) - along)[beside], dtype=np.float64))
    total += np.sum(np.square((np.diff(height, axis=0) - down)[below], dtype=np.float64))
    edges = np.count_nonzero(beside) + np.count_nonzero(below)
    return float(curl), float(np.sqrt(total / max(1, edges)) / pitch)


def bow(height, valid, pitch):
    """Range of the second-order part of the heights over the longer side of the valid pixels; 0 of a single pixel.

    The second-order part is that of the least-squares quadratic surface: a plane has none, a bowl is hardly more.
    """
    extent = max(np.ptp(np.flatnonzero(valid.any(axis=1))), np.ptp(np.flatnonzero(valid.any(axis=0))))
    if extent == 0:
        return 0.0
    inside = np.flatnonzero(valid)
    rows, columns = np.divmod(inside[:: -(-inside.size // BOW_PIXELS)], valid.shape[1])
    x, y = 2 * (columns - columns.mean()) / extent, 2 * (rows - rows.mean()) / extent
    z = height[rows, columns].astype(np.float64) / (pitch * extent)
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    solution = np.linalg.lstsq(terms, z, rcond=None)[0]
    return float(np.ptp(terms[:, 3:] @ solution[3:]))


DEGREE = 3  # of the polynomials of the normals' components: heights of degree 4
MOST_BLOCKS = 128  # along the longer side: the fit sees the mean normals of this many squares
FLAT_WITHIN = 0.05  # length of a difference of unit normals (3 degrees) beyond which a square counts less
ROUNDS = 8  # of reweighting


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
    for band in strips(rows):
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
    """Average normals over squares of pixels: unit means (n, 3) where some are valid, and places y and x, -1 to 1."""
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
