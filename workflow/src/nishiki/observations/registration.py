"""Movement of the camera between the photographs of a plane: measured although the light changes, and undone.

Photograph j shows at x + d_j(x) what the first one shows at x, with

    d_j(x) = t_j + A_j (x - c),    A_j = [[s_j, -r_j], [r_j, s_j]]

c the centre of the picture, t_j the shift, r_j the turn and s_j the change of scale. Edges of the paint stand still
when the lamp moves, and the shading of relief changes its sign as often as not, so the photographs are compared by the
Laplacian of their logarithms: the phase correlation (C. D. Kuglin and D. C. Hines, 1975) of a window under two lamps of
similar direction has its peak at the difference of their movements. All windows and pairs together determine the
movements by robust least squares. To compare each photograph with its photometric prediction from the others is no
substitute: shifts that follow the direction of the lamp look like slopes at the edges of the paint, and hardly change
the residual.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nishiki.formats.images import LEAST_SHIFT, Region

SIGMAS = 5.0  # times its standard error that a displacement must have
LIGHT_BIAS = 0.06  # pixels of shift that a change of the lamp imitated on objects that did not move
TURN_LIMIT = 1.0  # pixels, at the mean distance of the windows from the centre: relief in them shifts with the lamp
WINDOW, MARGIN = 160, 32  # pixels: side of a window at full resolution, and what is stored around it
GRID = 3  # windows a side
NEIGHBOURS = 6  # lamps of the most similar directions with which a photograph is compared
LEAST_PEAK = 7.0  # height of a peak of correlation, in robust standard deviations of the plane
LEAST_SUPPORT = 3  # pairs that must agree on a photograph
AGREE = 0.5  # pixels within which they agree
ROUNDS = 24  # of robust least squares
FINE, COARSER = 1.0, 1.6  # standard deviations of the Gaussians whose difference is the Laplacian, pixels
FLOOR = 0.03  # of the bright parts, added before the logarithm
CLIP = 4.0  # robust standard deviations at which features end
PEAK_WIDTH = 0.7  # pixels: standard deviation of the Gaussian that smooths the correlation
AT_A_TIME = 1 << 20  # pixels of correlation
WHITENING = 0.3  # part of the mean amplitude below which frequencies count less


@dataclass(frozen=True)
class Movement:
    """Movement of each photograph relative to the first."""

    shift: np.ndarray  # (lights, 2) float64: displacement of the picture's centre, columns and rows, pixels
    # turn, scale: (lights,) float64: turn in radians, from columns to rows, and change of scale; 0 where they are not
    # significant
    turn: np.ndarray
    scale: np.ndarray
    # (lights,) float64: standard error of the displacement along one axis, pixels, infinite where nothing was measured
    sigma: np.ndarray
    reach: float  # half of the picture's diagonal, pixels
    centre: np.ndarray  # (2,) float64: column and row of the picture's centre

    @property
    def largest(self) -> np.ndarray:
        """(lights,) float64: largest displacement in the picture, pixels."""
        return np.hypot(*self.shift.T) + self.reach * np.hypot(self.turn, self.scale)

    @property
    def significant(self) -> np.ndarray:
        """(lights,) bool: photographs that moved by more than LEAST_SHIFT and SIGMAS standard errors."""
        return self.largest > np.maximum(LEAST_SHIFT, SIGMAS * self.sigma)

    @property
    def moved(self) -> np.ndarray:
        """(lights,) bool: photographs to resample: where one moved, all that moved by more than their error."""
        return (self.largest > np.maximum(LEAST_SHIFT / 3, 2 * self.sigma)) & self.significant.any()

    def matrix(self, j: int) -> np.ndarray:
        """Compute (2, 3) float64: column and row in photograph j of a column and row of the first photograph."""
        turned = np.array([[1 + self.scale[j], -self.turn[j]], [self.turn[j], 1 + self.scale[j]]])
        return np.column_stack([turned, self.shift[j] + self.centre - turned @ self.centre])


@dataclass(frozen=True)
class Window:
    """One window of all photographs."""

    pictures: Sequence[np.ndarray]  # of all lights, (rows, columns) float32 or float16 linear light
    inside: np.ndarray  # (rows, columns) bool, the object
    corner: np.ndarray  # column and row of its first pixel in the whole picture
    step: np.ndarray  # pixels of the whole picture to one of the window
    margin: int = 0  # pixels around it that serve the alignment only

    @property
    def centre(self) -> np.ndarray:
        """(2,) float64: column and row of the middle of the object in it, in the whole picture."""
        rows, columns = np.nonzero(self.inside)
        middle = (np.array(self.inside.shape[::-1]) - 1) / 2 if not len(rows) else (columns.mean(), rows.mean())
        return self.corner + self.step * middle

    def part(self, rows: slice, columns: slice) -> "Window":
        """Return a part of it, with pictures that are views."""
        corner = self.corner + self.step * (columns.start, rows.start)
        pictures = [picture[rows, columns] for picture in self.pictures]
        return Window(pictures, self.inside[rows, columns], corner, self.step)


def choose_places(
    reduced: np.ndarray, inside: np.ndarray, step: int, part: tuple[slice, slice]
) -> list[tuple[slice, slice]]:
    """Choose windows at full resolution: in each cell of a grid where a photograph has most texture.

    reduced: (rows, columns) of the part of a photograph that is `step` times as large; inside: (rows, columns) bool,
    the object.
    """
    from scipy.ndimage import uniform_filter

    strength = uniform_filter(np.abs(_features(reduced[None], inside)[0]), max(WINDOW // step, 1), mode="constant")
    side = WINDOW + 2 * MARGIN
    cells = [np.linspace(0, n, GRID + 1).astype(int) for n in reduced.shape]
    places = []
    for top, bottom in zip(cells[0][:-1], cells[0][1:], strict=True):
        for left, right in zip(cells[1][:-1], cells[1][1:], strict=True):
            cell = strength[top:bottom, left:right]
            if cell.max(initial=0) > 0:
                middle = np.add(np.unravel_index(np.argmax(cell), cell.shape), (top, left))
                starts = middle * step - side // 2
                place = [
                    slice(
                        first := int(np.clip(p.start + start, p.start, max(p.stop - side, p.start))),
                        min(first + side, p.stop),
                    )
                    for start, p in zip(starts, part, strict=True)
                ]
                places.append((place[0], place[1]))
    return places


def measure_movement(whole: Window, windows: list[Window], directions: np.ndarray) -> Movement:
    """Measure the movement of the photographs under lamps of these directions (lights, 3).

    whole: the reduced pictures; windows: at full resolution, none where the pictures are not reduced.
    """
    halves = [(slice(0, n // 2), slice(n // 2, n)) for n in whole.inside.shape]
    parts = [whole, *(whole.part(rows, columns) for rows in halves[0] for columns in halves[1])]
    shape = whole.step[::-1] * whole.inside.shape
    count, centre = len(directions), whole.corner + whole.step * (np.array(whole.inside.shape[::-1]) - 1) / 2
    movement = Movement(
        np.zeros((count, 2)), np.zeros(count), np.zeros(count), np.zeros(count), float(np.hypot(*shape)) / 2, centre
    )
    # pairs of photographs: those of similar lamps, and each with the one before
    nearest = np.argsort(-(directions @ directions.T) - 9 * np.eye(count), axis=1)[:, 1 : NEIGHBOURS + 1]
    similar = {(min(j, k), max(j, k)) for j in range(count) for k in nearest[j]}
    pairs = np.array(sorted(similar | {(j, j + 1) for j in range(count - 1)}), np.int64)
    for chosen in (parts, windows or parts):
        movement = solve_movement(chosen, pairs, movement)
    return movement


def solve_movement(windows: list[Window], pairs: np.ndarray, before: Movement) -> Movement:
    """Determine the movements from windows of the photographs, which an earlier result aligns first.

    pairs (pairs, 2) int64: photographs that are compared with each other.
    """
    count, centre, reach = len(windows[0].pictures), before.centre, before.reach
    compared = [_compare(window, pairs, before) for window in windows]
    measured = np.concatenate([shifts for shifts, _ in compared])
    peaks = np.concatenate([heights for _, heights in compared])
    places = np.concatenate([np.tile((window.centre - centre) / reach, (len(pairs), 1)) for window in windows])
    pair = np.tile(pairs, (len(windows), 1))
    change, sigma = fit_movements(places, measured, peaks, pair, count)
    turn, scale = before.turn + change[:, 2] / reach, before.scale + change[:, 3] / reach
    lever = np.sqrt(np.average(np.square(places).sum(axis=1), weights=np.maximum(peaks - LEAST_PEAK, 1e-9)))
    outer, known = lever * reach * np.hypot(turn, scale), np.isfinite(sigma[:, 1])
    if not (outer[known] > np.maximum(TURN_LIMIT, SIGMAS * lever * sigma[known, 1])).any():
        turn = scale = np.zeros(count)
        change, sigma = fit_movements(places, measured, peaks, pair, count, turn=False)
    return Movement(before.shift + change[:, :2], turn, scale, np.hypot(sigma[:, 0], LIGHT_BIAS), reach, centre)


def fit_movements(
    places: np.ndarray, measured: np.ndarray, peaks: np.ndarray, pairs: np.ndarray, count: int, *, turn: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Fit the movements of `count` photographs to the differences of pairs, by robust least squares.

    places (n, 2): where, from the centre in units of the reach; measured (n, 2): displacement of the second of the pair
    against the first, pixels; peaks (n,): heights of the peaks of correlation; turn: False for shifts alone.
    Returns (count, 4) pixels: shift along columns and rows, turn and scale times the reach, against the first
    photograph that could be compared; and standard errors (count, 2) of shift and turn, infinite without support.
    """
    from scipy.sparse import csc_matrix
    from scipy.sparse.linalg import splu

    n, x, y, one, none = len(pairs), *places.T, np.ones(len(pairs)), np.zeros(len(pairs))
    terms = np.stack([np.stack([one, none, -y, x], 1), np.stack([none, one, x, y], 1)], 1)[:, :, : 4 if turn else 2]
    unknowns, size = terms.shape[2], terms.shape[2] * count
    columns = (unknowns * pairs[:, :, None] + np.arange(unknowns)).reshape(n, -1)  # (n, 2 unknowns)
    design = np.concatenate([-terms, terms], axis=2)  # (n, 2, 2 unknowns)
    squares, moments = design.transpose(0, 2, 1) @ design, np.einsum("nek,ne->nk", design, measured)
    cells = columns[:, :, None] * size + columns[:, None, :]
    strength = np.square(np.minimum(np.maximum(peaks - LEAST_PEAK, 0), 50))
    weights = strength
    for rounds in range(ROUNDS):
        normal = np.bincount(cells.ravel(), (squares * weights[:, None, None]).ravel(), size * size).reshape(size, size)
        normal[np.diag_indices(size)] += 1e-8 * max(float(normal.trace()) / size, 1e-9)
        factors = splu(csc_matrix(normal))  # dense solvers wait for their threads
        found = factors.solve(np.bincount(columns.ravel(), (moments * weights[:, None]).ravel(), size))
        residual = np.hypot(*(measured - np.einsum("nek,nk->ne", design, found[columns])).T)
        if rounds < ROUNDS // 2:  # least absolute deviations first: the minority of wrong peaks must not pull
            weights = strength / np.maximum(residual, 0.02)
        else:
            order = np.argsort(residual)
            total = np.cumsum(strength[order])
            median = float(residual[order][np.searchsorted(total, total[-1] / 2)]) if total[-1] > 0 else 0.0
            scale = max(1.4826 * median, 0.02)
            weights = strength / np.square(1 + np.square(residual / (2 * scale)))
    agrees = (residual < AGREE) & (strength > 0)
    support = np.bincount(pairs[agrees].ravel(), minlength=count)
    supported = support >= LEAST_SUPPORT
    first = int(np.argmax(supported))
    inverse = factors.solve(np.eye(size))
    degrees = max(2 * int((weights > 0).sum()) - size, 1)
    spread = float((weights * np.square(residual)).sum()) / degrees
    contrast = np.eye(count)
    contrast[:, first] -= 1
    change, sigma = np.zeros((count, 4)), np.full((count, 2), np.inf)
    change[:, :unknowns] = contrast @ found.reshape(count, unknowns)
    blocks = inverse.reshape(count, unknowns, count, unknowns)
    for column, unknown in enumerate((0, 2) if turn else (0,)):
        variance = np.einsum("ij,jk,ik->i", contrast, blocks[:, unknown, :, unknown], contrast)
        sigma[:, column] = np.sqrt(np.maximum(variance, 0) * spread)
    change[~supported], sigma[~supported] = 0, np.inf
    return change, sigma


def _features(pictures: Sequence[np.ndarray] | np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Compute clipped Laplacians of logarithms (lights, rows, columns), 0 at and beyond the rim of the object."""
    taper = taper_of(inside)
    features = np.zeros((len(pictures), *inside.shape), np.float32)
    if not (taper > 0).any():
        return features
    for picture, out in zip(pictures, features, strict=True):
        known = np.where(np.isfinite(picture), picture, np.float32(0))
        floor = FLOOR * np.percentile(known[taper > 0], 80)
        if floor <= 0:
            continue
        out[...] = laplacian(np.log(np.maximum(known, 0) + floor), taper) * taper
    return features


def taper_of(inside: np.ndarray, rim: int = 4, rise: int = 8) -> np.ndarray:
    """Return weights (rows, columns) float32 of an object's pixels: 0 in its rim, from there rising to 1; in pixels."""
    import cv2

    depth = cv2.distanceTransform(np.pad(inside.astype(np.uint8), 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
    return np.clip((depth - rim) / rise, 0, 1).astype(np.float32)


def laplacian(values: np.ndarray, taper: np.ndarray) -> np.ndarray:
    """Filter values (rows, columns) by a band; in robust standard deviations where the taper is not 0, and clipped."""
    import cv2

    curved = cv2.GaussianBlur(values, (0, 0), COARSER) - cv2.GaussianBlur(values, (0, 0), FINE)
    unit = 1.4826 * np.median(np.abs(curved[taper > 0])) + 1e-12
    return np.clip(curved / unit, -CLIP, CLIP)


def _compare(window: Window, pairs: np.ndarray, movement: Movement) -> tuple[np.ndarray, np.ndarray]:
    """Measure displacements (pairs, 2) in pixels of the whole picture, after alignment, and their peak heights."""
    from scipy.fft import rfft2

    features = _features(*align_window(window, movement))
    shape = features.shape[1:]
    spectra = rfft2(features)
    shifts, heights = np.zeros((len(pairs), 2)), np.zeros(len(pairs))
    step = max(1, AT_A_TIME // features[0].size)
    for first in range(0, len(pairs), step):
        part = slice(first, first + step)
        shifts[part], heights[part] = find_shifts(np.conj(spectra[pairs[part, 0]]) * spectra[pairs[part, 1]], shape)
    return shifts * window.step, heights


def find_shifts(cross: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Find the shifts of pictures of this shape by phase correlation, within a quarter of their shorter side.

    cross: (pairs, rows, columns // 2 + 1), conjugate spectrum of the first times that of the second. Returns (pairs, 2)
    displacements of the second, columns and rows, and the heights of their peaks in robust standard deviations.
    """
    from scipy.fft import fftfreq, irfft2, rfftfreq

    reach = max(min(*shape) // 4, 3)
    frequencies = np.square(fftfreq(shape[0]))[:, None] + np.square(rfftfreq(shape[1]))
    smooth = np.exp(-2 * np.square(np.pi * PEAK_WIDTH) * frequencies).astype(np.float32)
    rows, columns = (np.arange(-reach, reach + 1) % n for n in shape)
    amplitude = np.abs(cross)
    floor = WHITENING * amplitude.mean(axis=(1, 2), keepdims=True) + 1e-30
    return _peaks(irfft2(cross * (smooth / (amplitude + floor)), s=shape)[:, rows[:, None], columns])


def align_window(window: Window, movement: Movement, *, replicate: bool = True) -> tuple[list[np.ndarray], np.ndarray]:
    """Align the pictures with the first one, and return the object's pixels, without the margin.

    replicate: pixels beyond the border are those at it; otherwise NaN.
    """
    import cv2

    pictures, inside, edge = window.pictures, window.inside, window.margin
    rows, columns = (slice(edge, max(n - edge, edge + 1)) for n in inside.shape)
    aligned, size, flags = [], inside.shape[::-1], cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    for j, picture in enumerate(pictures):
        if movement.largest.any():
            matrix = movement.matrix(j)
            turned = matrix[:, :2]
            offset = (turned @ window.corner + matrix[:, 2] - window.corner) / window.step
            local = np.column_stack([turned, offset])
            picture = np.asarray(picture, np.float32)
            picture = cv2.warpAffine(picture, local, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
            if not replicate:
                shown = cv2.warpAffine(np.ones(inside.shape, np.uint8), local, size, flags=cv2.WARP_INVERSE_MAP)
                picture[shown == 0] = np.nan
        aligned.append(picture[rows, columns])
    return aligned, inside[rows, columns]


def _peaks(planes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find column and row of the maximum of each plane (n, 2 reach + 1, 2 reach + 1), and its robust deviation."""
    count, side, number = len(planes), planes.shape[1] - 2, np.arange(len(planes))
    row, column = np.divmod(planes[:, 1:-1, 1:-1].reshape(count, -1).argmax(axis=1), side)
    middle = planes[number, row + 1, column + 1]
    flat = planes.reshape(count, -1)
    spread = 1.4826 * np.median(np.abs(flat - np.median(flat, axis=1, keepdims=True)), axis=1) + 1e-12

    def vertex(before: np.ndarray, after: np.ndarray) -> np.ndarray:
        return 0.5 * (before - after) / np.minimum(before - 2 * middle + after, -1e-12)

    across = column + vertex(planes[number, row + 1, column], planes[number, row + 1, column + 2])
    down = row + vertex(planes[number, row, column + 1], planes[number, row + 2, column + 1])
    return np.stack([across, down], axis=1) - side // 2, middle / spread


REACH = 4  # pixels, of the kernel of Lanczos


def region_behind(matrix: np.ndarray, region: Region, rows: int, columns: int) -> Region:
    """Find the part of a photograph of these rows and columns that a region needs once moved by matrix (2, 3)."""
    row, column, height, width = region
    corners = matrix[:, :2] @ np.array([[0, width, 0, width], [0, 0, height, height]]) + matrix[:, 2:]
    reach = REACH + 1  # and of the mark around saturated pixels, which is interpolated
    low = np.floor(corners.min(axis=1)).astype(int) - reach + (column, row)
    high = np.ceil(corners.max(axis=1)).astype(int) + reach + (column, row)
    left, top = np.clip(low, 0, (columns - 1, rows - 1))
    right, bottom = np.clip(high, (left + 1, top + 1), (columns, rows))
    return int(top), int(left), int(bottom - top), int(right - left)


def move_codes(
    codes: np.ndarray, matrix: np.ndarray, shape: Sequence[int], saturated: np.number, clip: np.number
) -> np.ndarray:
    """Resample codes (rows, columns, channels) to the place that they have in the first photograph, by Lanczos' kernel.

    Parameters
    ----------
    codes : (rows, columns, channels) uint8, uint16 or float32
    matrix : (2, 3) float64
        Column and row in `codes` of a column and row of the result.
    shape : sequence of int
        Rows and columns of the result.
    saturated, clip : numpy.number
        Codes from which, and up to which, a sample is unusable.

    Returns
    -------
    (*shape, channels) of the same type
        A pixel is saturated in all channels where one within the reach of the kernel is so in any, and at `clip` in all
        where the nearest one is, or none: what must not be used before may not be used after.
    """
    import cv2

    size = (int(shape[1]), int(shape[0]))

    def warp(picture: np.ndarray, method: int, border: int = cv2.BORDER_REPLICATE) -> np.ndarray:
        flags = method | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(picture, matrix, size, flags=flags, borderMode=border, borderValue=1)

    hot = np.any(codes >= saturated, axis=2).astype(np.uint8)
    cold = np.all(codes <= clip, axis=2).astype(np.uint8)
    channels = (np.ascontiguousarray(channel) for channel in np.moveaxis(codes, 2, 0))
    moved = np.stack([warp(channel, cv2.INTER_LANCZOS4) for channel in channels], axis=2)
    if hot.any():
        reach = warp(cv2.dilate(hot, np.ones((2 * REACH - 1,) * 2, np.uint8)) * np.uint8(255), cv2.INTER_LINEAR)
        moved[reach > 0] = saturated
    moved[warp(cold, cv2.INTER_NEAREST, cv2.BORDER_CONSTANT) > 0] = clip
    return moved
