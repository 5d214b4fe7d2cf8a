"""Height from normals: the surface whose slopes are, in the sense of weighted least squares, those of the normals.

The unknown heights h minimise sum over neighbouring pixels a, b of w (h_b - h_a - g)^2, g the mean slope of the two
times the pitch. On a full rectangle with equal weights this is Poisson's equation with natural boundaries, which the
discrete cosine transform solves directly (T. Simchony, R. Chellappa and M. Shao, Direct analytical methods for solving
Poisson equations in computer vision problems, IEEE Trans. PAMI 12 (5), 1990; for the periodic case R. T. Frankot and
R. Chellappa, IEEE Trans. PAMI 10 (4), 1988). With a mask or weights the same solver preconditions conjugate gradients.
"""

from dataclasses import dataclass

import numpy as np

from nishiki.errors import UserError
from nishiki.photometric.poisson import conjugate_gradients, divergence, edge_gradients, poisson_symbol, solve_rectangle
from nishiki.summary import Summarised

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


def integrate_normals(normals, *, valid=None, pixel_pitch=1.0, method="auto", tolerance=1e-5, max_iterations=400):
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
    gradients = edge_gradients(p, q, float(pixel_pitch))
    del p, q
    symbol = poisson_symbol(valid.shape, dtype)
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
    """Normals and mask of matching shape, or a UserError; normals that are not of unit length are not valid."""
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
