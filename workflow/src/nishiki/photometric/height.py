"""Integrate normals to a height, after a turn that takes away a tilt common to the picture.

The unknown heights h minimise sum over neighbouring pixels a, b of w (h_b - h_a - g)^2, g the mean slope of the two
times the pitch (R. T. Frankot and R. Chellappa, A method for enforcing integrability in shape from shading algorithms,
IEEE Trans. PAMI 10 (4), 1988; with natural boundaries T. Simchony, R. Chellappa and M. Shao, IEEE Trans. PAMI 12 (5),
1990), which `nishiki.photometric.multigrid` solves. Everything reads the normals by bands of rows.

Normals of an object that is flat overall are turned so that their smooth part faces the camera. Lamps that stand near
but count as distant, and lamps whose brightness falls off over the picture without a white board, tilt the normals by
an angle that changes slowly from edge to edge. Integrated, it is a bowl many times as deep as the relief. Here the
smooth part s of the normals is a polynomial of the pixel's place, fitted so that raised objects on a flat ground do not
pull it, and every normal is turned by the rotation that takes s to the camera's axis z,

    n' = n - (s + z) (s + z).n / (1 + s.z) + 2 (s.n) z,

before the integration. To subtract the smooth part of the heights instead leaves the relief exaggerated where the error
is large: slopes grow with the tangent of the tilt.
"""

import itertools
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.polynomial import legendre

from nishiki.errors import UserError
from nishiki.photometric.multigrid import BAND_PIXELS, WHOLE_PIXELS, Laplace, RowsOnDisk, divergence, edges, windows
from nishiki.progress import Summarised
from nishiki.threads import strips

METHODS = ("auto", "dct", "weighted")
LEAST_NZ = 0.05  # normals that are steeper (87 degrees) count as this steep: slopes stay finite
LEAST_WEIGHT = 1e-3  # a steep pixel keeps this much say, so that it stays tied to its neighbours
NOT_UNIT = 0.02  # of the squared length, as where normals are shaded
PITCHES = (1e-12, 1e12)  # beyond, heights and their squares leave float32
BOW_PIXELS = 100_000  # at most, to which the quadratic surface of `bow` is fitted


@dataclass(frozen=True, repr=False)
class HeightField(Summarised):
    """A relief and the residual of its integration.

    height (rows, columns) float32 in the unit of the pixel pitch, towards the camera, mean 0 over each connected part;
    NaN where `valid` (rows, columns) bool is False: a number there would be a wall around the object.
    integrability_rms: root mean square of p_y - q_x, in slope per unit length, over the 2 x 2 squares of valid pixels;
    0 for the normals of a continuous surface. gradient_rms: root mean square of (height difference / pitch - slope)
    over valid neighbours. bow: see `bow`. parts: number of connected parts, whose relative heights the normals do not
    tell. residual: relative residual of the linear system at the end. range: of the heights.
    """

    height: np.ndarray
    valid: np.ndarray
    method: str
    integrability_rms: float
    gradient_rms: float
    bow: float
    parts: int
    iterations: int
    residual: float
    valid_pixels: int
    range: float


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
        `dct`: equal weights, where pixels that are not valid count as flat; for full rectangles. `weighted`: only valid
        pixels, weighted by nz^4, the inverse variance of a slope for equal angular errors. `auto`: `dct` where every
        pixel is valid and none is steeper than 80 degrees, else `weighted`.
    tolerance : float, optional
        Relative residual at which the iterations end.
    max_iterations : int, optional
        Largest number of iterations.

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
    normals = np.asarray(normals)
    if normals.ndim != 3 or normals.shape[2] != 3:
        raise UserError(f"height: expected normals of shape (rows, columns, 3), found {normals.shape}")
    shape = normals.shape[:2]
    valid = np.ones(shape, bool) if valid is None else np.asarray(valid, dtype=bool)
    if valid.shape != shape:
        raise UserError(f"height: expected a mask of shape {shape} as the normals, found {valid.shape}")
    height, where = np.empty(shape, np.float32), np.empty(shape, bool)

    def write(rows, values, inside):
        height[rows], where[rows] = values, inside

    found = integrate_bands(
        shape,
        lambda rows: (normals[rows], valid[rows]),
        write,
        pixel_pitch=pixel_pitch,
        method=method,
        iterations=(tolerance, max_iterations),
    )
    return HeightField(height, where, **found)


def integrate_bands(shape, read, write, *, pixel_pitch, method, iterations=(1e-5, 1000), folder=None):
    """Integrate unit normals by bands of rows; see `integrate_normals`.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    read : callable
        Function of a slice of rows that returns normals (r, columns, 3) and valid (r, columns) bool.
    write : callable
        Called once for each band, from the top: rows, heights (r, columns) float32, valid (r, columns).
    pixel_pitch, method
        As of `integrate_normals`.
    iterations : (float, int)
        Relative residual at which they end, and their largest number.
    folder : Path, optional
        Where pictures of many pixels are kept on the disk meanwhile, 24 bytes a pixel. Default: that of the system.

    Returns
    -------
    dict
        The numbers of `HeightField`.
    """
    if not PITCHES[0] <= pixel_pitch <= PITCHES[1]:
        raise UserError(
            f"height: expected a pixel pitch above 0 ({PITCHES[0]:g} to {PITCHES[1]:g}), found {pixel_pitch}; "
            "give the distance of two pixels in a unit that suits it"
        )
    if method not in METHODS:
        raise UserError(f"height: expected a method of {', '.join(METHODS)}, found {method!r}")
    rows, columns = shape
    dtype = np.float32 if rows * columns > WHOLE_PIXELS else np.float64
    bands = list(windows(rows, band_rows(columns), 1))
    count, steepest = 0, 1.0
    for band in bands:
        normals, valid = unit_normals(read, band.core)
        count += int(np.count_nonzero(valid))
        steepest = min(steepest, float(np.min(normals[..., 2], where=valid, initial=1)))
    if not count:
        raise UserError(f"height: expected valid normals, found none among {rows * columns} pixels; see their flags")
    if method == "auto":
        method = "dct" if count == rows * columns and steepest > np.cos(np.radians(80.0)) else "weighted"
    with tempfile.TemporaryDirectory(dir=folder) as place:
        numbers = itertools.count()

        def new(kind):
            small = rows * columns <= BAND_PIXELS
            return np.zeros(shape, kind) if small else RowsOnDisk(Path(place, str(next(numbers))), shape, kind)

        weight, right = (new(np.dtype(dtype)) for _ in range(2))
        for band in bands:
            gradients, _, weights = slopes(read, band.read, dtype, pixel_pitch)
            weights = np.ones_like(weights) if method == "dct" else weights
            right[band.core] = divergence(gradients, edges(weights))[band.inner]
            weight[band.core] = weights[band.inner]
        height, steps, residual = Laplace(shape, weight).solve(right, new, *iterations)
        parts, means = level_parts(bands, lambda rows: (height[rows], unit_normals(read, rows)[1]))
        sums, sample, low, high = np.zeros(4), HeightSample(count, BOW_PIXELS), np.inf, -np.inf
        for band, mean in zip(bands, means, strict=True):
            rows = slice(band.core.start, band.read.stop)  # and the row below
            gradients, valid, _ = slopes(read, rows, dtype, pixel_pitch)
            values, stop = height[rows], band.core.stop - band.core.start
            sums += leftovers(values, gradients, valid, stop)
            valid = valid[:stop]
            values = (values[:stop] - mean[parts_of(valid)[0]]).astype(np.float32)
            low, high = np.nanmin(values, initial=low), np.nanmax(values, initial=high)
            sample.add(values, valid, band.core.start)
            write(band.core, values, valid)
    curl, squares, mismatch, pairs = sums
    return {
        "method": method,
        "integrability_rms": float(np.sqrt(curl / max(1, squares)) / pixel_pitch**2),
        "gradient_rms": float(np.sqrt(mismatch / max(1, pairs)) / pixel_pitch),
        "bow": bow(sample, pixel_pitch),
        "parts": parts,
        "iterations": steps,
        "residual": residual,
        "valid_pixels": count,
        "range": float(high - low),
    }


def band_rows(columns):
    """Return the number of rows held at once of a picture of so many columns."""
    return max(16, min(256, BAND_PIXELS // columns))


def unit_normals(read, rows):
    """Read a band; normals that are not of unit length are not valid."""
    normals, valid = read(rows)
    with np.errstate(over="ignore", invalid="ignore"):
        return normals, valid & (np.abs(np.einsum("rci,rci->rc", normals, normals) - 1) < NOT_UNIT)  # false for NaN


def slopes(read, rows, dtype, pitch):
    """Compute height differences (along, down) from a band's normals, valid pixels, and the weight nz^4 of each.

    The weight is 0 where a pixel is not valid.
    """
    normals, valid = unit_normals(read, rows)
    nz = np.maximum(np.where(valid, normals[..., 2], 1), LEAST_NZ).astype(dtype)
    p = np.where(valid, -normals[..., 0], 0).astype(dtype) / nz
    q = np.where(valid, -normals[..., 1], 0).astype(dtype) / nz  # dz / dy, y up
    half = dtype(0.5 * float(pitch))
    gradients = (p[:, :-1] + p[:, 1:]) * half, (q[:-1] + q[1:]) * -half  # rows count downwards: a step down is -q
    return gradients, valid, np.where(valid, np.maximum(nz**4, LEAST_WEIGHT), 0).astype(dtype)


def parts_of(valid):
    """Return the numbers (rows, columns) of the connected parts of a band, from 1, 0 elsewhere, and how many."""
    from scipy import ndimage

    return ndimage.label(valid)


def level_parts(bands, read):
    """Find connected parts across bands.

    Returns their number, and for each band the mean height of the part that each of its own parts belongs to, NaN
    first.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    sums, counts, pairs, above, offset = [], [], [np.zeros((2, 0), int)], 0, 0
    for band in bands:
        values, valid = read(band.core)
        labels, found = parts_of(valid)
        counts.append(np.bincount(labels.ravel(), minlength=found + 1)[1:])
        sums.append(np.bincount(labels.ravel(), weights=values.ravel(), minlength=found + 1)[1:])
        joined = (above > 0) & valid[0]
        pairs.append(np.unique(np.stack([np.broadcast_to(above, joined.shape), labels[0] + offset])[:, joined], axis=1))
        above, offset = np.where(valid[-1], labels[-1] + offset, 0), offset + found
    a, b = np.concatenate(pairs, axis=1) - 1
    parts, part = connected_components(coo_array((np.ones(len(a), bool), (a, b)), (offset, offset)), directed=False)
    mean = np.bincount(part, np.concatenate(sums)) / np.bincount(part, np.concatenate(counts))
    ends = np.cumsum([len(each) for each in counts])[:-1]
    return parts, [np.append(np.nan, each) for each in np.split(mean[part], ends)]


def leftovers(height, gradients, valid, stop):
    """Return sums over a band and the row below, of pairs and squares that begin above row `stop`.

    They are the sum of the squared circulation around 2 x 2 squares of valid pixels, their number, the sum of the
    squared difference of height difference and gradient over valid neighbours, and their number.
    """
    along, down = gradients
    complete = valid[:-1, :-1] & valid[:-1, 1:] & valid[1:, :-1] & valid[1:, 1:]
    around = along[:-1] + down[:, 1:] - along[1:] - down[:, :-1]
    curl = np.sum(np.square(around[complete], dtype=np.float64))
    beside, below = (valid[:, :-1] & valid[:, 1:])[:stop], valid[:-1] & valid[1:]
    total = np.sum(np.square((np.diff(height, axis=1) - along)[:stop][beside], dtype=np.float64))
    total += np.sum(np.square((np.diff(height, axis=0) - down)[below], dtype=np.float64))
    return curl, np.count_nonzero(complete), total, np.count_nonzero(beside) + np.count_nonzero(below)


class HeightSample:
    """Valid pixels of a picture, evenly chosen as its bands come: at most `most` of `count`."""

    def __init__(self, count, most):
        self.step, self.passed, self.bands = max(1, -(-count // most)), 0, []

    def add(self, values, valid, first):
        """Choose from a band that begins with row `first`."""
        rows, columns = np.divmod(np.flatnonzero(valid)[-self.passed % self.step :: self.step], valid.shape[1])
        self.passed += np.count_nonzero(valid)
        self.bands.append((rows + first, columns, values[rows, columns]))

    def chosen(self):
        """Return rows, columns and values of the pixels."""
        return [np.concatenate(each) for each in zip(*self.bands, strict=True)]


def bow(sample, pitch):
    """Compute the range of the second-order part of heights over the longer side of their places; 0 of one pixel.

    The second-order part is that of the least-squares quadratic surface: a plane has none, a bowl is hardly more.
    """
    rows, columns, height = sample.chosen()
    extent = max(np.ptp(rows), np.ptp(columns))
    if extent == 0:
        return 0.0
    x, y = 2 * (columns - columns.mean()) / extent, 2 * (rows - rows.mean()) / extent
    z = height.astype(np.float64) / (pitch * extent)
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    solution = np.linalg.lstsq(terms, z, rcond=None)[0]
    return float(np.ptp(terms[:, 3:] @ solution[3:]))


DEGREE = 3  # of the polynomials of the normals' components: heights of degree 4
MOST_BLOCKS = 128  # along the longer side: the fit sees the mean normals of this many squares
FLAT_WITHIN = 0.05  # length of a difference of unit normals (3 degrees) beyond which a square counts less
ROUNDS = 8  # of reweighting


def flatten_normals(shape, read, write):
    """Turn the normals of a flat object so that their smooth part faces the camera.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    read : callable
        Function of a slice of rows: unit normals (r, columns, 3), x right, y up, z to the camera; valid (r, columns)
        bool.
    write : callable
        Called once for each band, from the top: rows, turned normals (r, columns, 3) float32, 0 where they do not
        count.

    Returns
    -------
    float
        Root mean square angle by which normals were turned, radians.
    """
    smooth = smooth_normals(shape, read)
    y, x = (np.linspace(-1, 1, side) for side in shape)
    squares, count = 0.0, 0
    for band in strips(shape[0], band_rows(shape[1])):
        normals, inside = read(band)
        out = np.zeros((*inside.shape, 3), np.float32)
        s = np.moveaxis(legendre.leggrid2d(y[band], x, smooth), 0, -1)[inside]
        s /= np.linalg.norm(s, axis=-1, keepdims=True)
        n = normals[inside].astype(np.float64)
        forward = np.einsum("pi,pi->p", s, n)
        squares += float(np.sum(np.square(np.arccos(np.clip(s[:, 2], -1, 1)))))
        count += len(s)
        s[:, 2] += 1
        n -= s * (np.einsum("pi,pi->p", s, n) / s[:, 2])[:, None]
        n[:, 2] += 2 * forward
        out[inside] = n
        write(band, out)
    return float(np.sqrt(squares / max(1, count)))


def smooth_normals(shape, read):
    """Fit Legendre coefficients (4, 4, 3) along y and x, each from -1 to 1, to the smooth part of normals.

    Least sum over the squares of Huber's function of the length of the difference (P. J. Huber, Robust estimation of a
    location parameter, Annals of Mathematical Statistics 35 (1), 1964), by iteratively reweighted least squares.
    """
    mean, y, x = block_means(shape, read)
    coefficients = np.zeros((DEGREE + 1, DEGREE + 1, 3))
    if not len(mean):
        return coefficients
    powers = [(i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]
    terms = legendre.legvander2d(y, x, [DEGREE, DEGREE])[:, [i * (DEGREE + 1) + j for i, j in powers]]
    weight = np.ones(len(mean))
    for _ in range(ROUNDS):
        root = np.sqrt(weight)[:, None]
        solution = np.linalg.lstsq(terms * root, mean * root, rcond=None)[0]
        weight = 1 / np.maximum(np.linalg.norm(mean - terms @ solution, axis=1), FLAT_WITHIN)
    for (i, j), values in zip(powers, solution, strict=True):
        coefficients[i, j] = values
    return coefficients


def block_means(shape, read):
    """Average normals over squares of pixels: unit means (n, 3) where some are valid, and places y and x, -1 to 1."""
    side = -(-max(shape) // MOST_BLOCKS)
    columns, bands = np.arange(0, shape[1], side), []
    for band in strips(shape[0], max(1, band_rows(shape[1]) // side) * side):
        normals, valid = read(band)
        rows = np.arange(0, len(valid), side)
        across = np.add.reduceat(np.where(valid[..., None], normals, 0), rows, axis=0, dtype=np.float64)
        bands.append(np.add.reduceat(across, columns, axis=1))
    total = np.concatenate(bands)
    length = np.linalg.norm(total, axis=-1)
    places = [
        2 * np.minimum(np.arange(0, extent, side) + 0.5 * (side - 1), extent - 1) / max(extent - 1, 1) - 1
        for extent in shape
    ]
    filled = length > 0
    row, column = np.nonzero(filled)
    return total[filled] / length[filled][:, None], places[0][row], places[1][column]
