"""Register the fields of a mosaic pair by pair, on reflectance and normals.

Lit photographs are not compared: light and highlights stand still in the camera's frame while the painting moves. All
pairs are tried on thumbnails, by the correlation of features that takes the overlap alone into account (D. Padfield,
2012). Every likely shift is then followed in windows of reduced maps and, in the end, of the maps themselves: phase
correlation finds the displacement of a window, least squares (B. Lucas and T. Kanade, 1981) refine it, and give its
covariance, which is large along an edge. Where two shifts explain the windows of an overlap nearly as well, as with a
repeated ornament, the overlap is not used; flat areas give no windows.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from nishiki.observations.registration import LEAST_PEAK, find_shifts, laplacian, taper_of

FLOOR = 0.02  # reflectance that is added before the logarithm
REDUCED_PIXELS, THUMBNAIL_PIXELS = 1 << 19, 1 << 15  # of a field
WINDOW = 48, 128  # least and largest side in pixels
TRIED, MEASURED = 24, 64  # windows at most in an overlap, of reduced maps and of the maps themselves
LEAST_WINDOWS = 5  # that agree in an overlap that is used
AGREE = 2.0  # pixels within which windows agree with one similarity, beside their standard errors
LEAST_OVERLAP = 0.03  # of a thumbnail
LEAST_SCORE = 7.0  # peak of a thumbnail's correlation, in robust standard deviations; right shifts had 11 to 45
CANDIDATES, CANDIDATE_SCORE = 4, 0.4  # shifts that are followed: most, and score relative to that of the best
RIVAL = 0.6  # share of the agreeing windows from which another shift makes an overlap ambiguous
APART = 5  # pixels of thumbnails between different shifts
TOLERANCE = 0.1  # of a field's diagonal, within which a stated position must be right
BLOCK = 12  # pixels: side of the blocks whose gradients are taken as independent
LEAST_ERROR = 0.02  # pixels: standard error of a displacement at least
MOST_ERROR = 1.0  # pixels: standard error up to which a window counts


@dataclass(frozen=True)
class Field:
    """One field of a mosaic; places in it are (column, row) of its maps, in pixels.

    name : str
    shape : rows, columns
    read : callable
        From slices of rows and columns to signals (rows, columns, 3) float32 and known (rows, columns) bool.
    centre : (2,) float64
        Place of the optical axis, the middle of the whole photograph.
    stated : (2,) float64 or None
        Stated place of the centre in the mosaic, to the right and down, from any origin.
    """

    name: str
    shape: tuple[int, int]
    read: Callable[[slice, slice], tuple[np.ndarray, np.ndarray]]
    centre: np.ndarray
    stated: np.ndarray | None = None


@dataclass(frozen=True)
class Overlap:
    """Two fields that show the same part of the object, by their numbers.

    points : (2, n, 2) float64
        Places in the first and in the second field that show the same.
    covariance : (n, 2, 2) float64
        Covariance of the places in the second field.
    problem : str
        Why the overlap is not used: 'ambiguous' or 'contradicts'; empty where it is used.
    """

    first: int
    second: int
    points: np.ndarray
    covariance: np.ndarray
    problem: str = ""


def signals(reflectance: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Combine reflectance (rows, columns, channels) and normals into signals to compare: log, x, y; float32."""
    logarithm = np.log(np.maximum(reflectance.mean(axis=-1), 0) + FLOOR)
    return np.concatenate([logarithm[..., None], normals[..., :2]], axis=-1).astype(np.float32)


def reduce_fields(fields: Sequence[Field], pixels: int) -> tuple[list[Field], int]:
    """Average fields over squares of one side, so that none has more pixels; return them and the side."""
    step = int(np.ceil(np.sqrt(max(field.shape[0] * field.shape[1] for field in fields) / pixels)))
    return [reduce_field(field, step) for field in fields], step


def reduce_field(field: Field, step: int) -> Field:
    """Average a field over squares of this side. One band is in memory."""
    if step == 1:
        return field
    rows, columns = (n // step for n in field.shape)
    values, known = np.empty((rows, columns, 3), np.float32), np.empty((rows, columns), bool)
    for top in range(0, rows, 64):
        band = slice(top, min(top + 64, rows))
        part, inside = field.read(slice(band.start * step, band.stop * step), slice(0, columns * step))
        squares = (band.stop - band.start, step, columns, step)
        count = inside.reshape(squares).sum(axis=(1, 3))
        total = (part * inside[..., None]).reshape(*squares, 3).sum(axis=(1, 3))
        values[band], known[band] = total / np.maximum(count, 1)[..., None], 2 * count > step**2
    return replace(
        field,
        shape=(rows, columns),
        read=lambda y, x: (values[y, x], known[y, x]),
        centre=(field.centre + 0.5) / step - 0.5,
        stated=None if field.stated is None else field.stated / step,
    )


def register_fields(fields: Sequence[Field]) -> list[Overlap]:
    """Find the overlaps of all fields and measure them; one that cannot be relied on is returned with its problem."""
    reduced, fine = reduce_fields(fields, REDUCED_PIXELS)
    thumbnails, coarse = reduce_fields(reduced, THUMBNAIL_PIXELS)
    steps = coarse * fine
    size = 2 * max(field.shape[0] for field in thumbnails), 2 * max(field.shape[1] for field in thumbnails)
    spectra = [thumbnail_spectra(field, size) for field in thumbnails]
    overlaps = []
    for i, j in combinations(range(len(fields)), 2):
        stated, beside = stated_shift(fields[i], fields[j])
        if not beside:
            continue
        found = []
        place = None if stated is None else (stated / steps, TOLERANCE * np.hypot(*fields[i].shape) / steps)
        for shift in find_candidates(spectra[i], spectra[j], size, place):
            guess = enlarge(np.column_stack([np.eye(2), shift]), coarse)
            measured = measure_overlap(reduced[i], reduced[j], guess, TRIED)
            if measured is not None:
                matrix = enlarge(measured[0], fine)
                middle = matrix[:, :2] @ fields[i].centre + matrix[:, 2] - fields[i].centre
                near = stated is None or np.hypot(*(middle - stated)) < TOLERANCE * np.hypot(*fields[i].shape)
                if all(np.hypot(*(middle - other[2])) > APART * steps for other in found):
                    found.append((measured[1].shape[1], near, middle, matrix, measured))
        found.sort(key=lambda each: -each[0])
        rivals = [each for each in found if each[0] >= RIVAL * found[0][0]]
        within = [each for each in rivals if each[1]]
        if not found:
            continue
        *_, matrix, measured = (within or rivals)[0]
        problem = "contradicts" if not within else "ambiguous" if len(within) > 1 else ""
        if not problem:
            measured = measure_overlap(fields[i], fields[j], matrix, MEASURED)
        if measured is not None:
            overlaps.append(Overlap(i, j, measured[1], measured[2], problem))
    return overlaps


def stated_shift(first: Field, second: Field) -> tuple[np.ndarray | None, bool]:
    """Return the shift (2,) from places in `first` to those in `second` that is stated, and whether they may overlap.

    None and True where the place of one is not stated.
    """
    if first.stated is None or second.stated is None:
        return None, True
    shift = second.centre - first.centre + first.stated - second.stated
    reach = TOLERANCE * np.hypot(*first.shape)
    return shift, bool((shift < np.add(second.shape[::-1], reach)).all() and (shift + first.shape[::-1] > -reach).all())


def enlarge(matrix: np.ndarray, side: int) -> np.ndarray:
    """Rewrite a matrix (2, 3) between averages over squares of this side for the fields that were averaged."""
    half = np.full(2, (side - 1) / 2)
    return np.column_stack([matrix[:, :2], side * matrix[:, 2] + half - matrix[:, :2] @ half])


def thumbnail_spectra(field: Field, size: tuple[int, int]) -> np.ndarray:
    """Return spectra (5, rows, columns // 2 + 1) of the three features, the sum of their squares, and the mask."""
    from scipy.fft import rfft2

    values, known = field.read(*(slice(0, n) for n in field.shape))
    taper = taper_of(known, 1, 4)  # overlaps are narrow here
    features = [laplacian(values[..., k], taper) * taper for k in range(3)]
    return rfft2(np.stack([*features, np.square(features).sum(axis=0), taper]), s=size)


def find_candidates(
    first: np.ndarray, second: np.ndarray, size: tuple[int, int], place: tuple[np.ndarray, float] | None = None
) -> list[np.ndarray]:
    """Find likely shifts (2,) (columns, rows) from places of one thumbnail to those of another, from their spectra.

    place : stated shift and its tolerance, in which as many are looked for as elsewhere.
    """
    from scipy.fft import irfft2

    pairs = ((first[:3], second[:3]), (first[3:4], second[4:]), (first[4:], second[3:4]), (first[4:], second[4:]))
    likeness, *energy, area = (irfft2((np.conj(one) * two).sum(axis=0), s=size) for one, two in pairs)
    score = likeness * np.sqrt(np.maximum(area, 0) / (np.maximum(energy[0], 0) * np.maximum(energy[1], 0) + 1e-6))
    allowed = area > LEAST_OVERLAP * area.max()
    score = np.where(allowed, score / (1.4826 * np.median(np.abs(score[allowed])) + 1e-12), 0)
    down, across = ((np.arange(n) + n // 2) % n - n // 2 for n in size)
    shifts: list[np.ndarray] = []
    for near in (None,) if place is None else (place, None):
        within = True if near is None else np.hypot(across - near[0][0], down[:, None] - near[0][1]) < near[1]
        least = max(CANDIDATE_SCORE * float((score * within).max()), LEAST_SCORE)
        for _ in range(CANDIDATES):
            row, column = np.unravel_index(int((score * within).argmax()), size)
            if score[row, column] * np.broadcast_to(within, size)[row, column] < least:
                break
            shifts.append(np.array([across[column], down[row]], float))
            score[
                np.ix_(*((np.arange(-APART, APART + 1) + n) % m for n, m in zip((row, column), size, strict=True)))
            ] = 0
    return shifts


def measure_overlap(first: Field, second: Field, guess: np.ndarray, windows: int) -> tuple[np.ndarray, ...] | None:
    """Measure where so many windows of a field lie in another one; guess (2, 3): the matrix to it, to a few pixels.

    Returns the similarity (2, 3) that most of them agree with, and of these the places (2, n, 2) and their covariances
    (n, 2, 2); None where fewer than LEAST_WINDOWS agree.
    """
    import cv2

    found: list[tuple[list[np.ndarray], np.ndarray]] = []
    side, places = window_places(first.shape, second.shape, guess, windows)
    for tops in places:
        strip = slice(int(tops[0, 1]), int(tops[0, 1]) + side)
        left, right = int(tops[:, 0].min()), int(tops[:, 0].max()) + side
        corners = np.array([(x, y) for x in (left, right) for y in (strip.start, strip.stop)]) @ guess[:, :2].T
        corners += guess[:, 2]
        low = np.clip(corners.min(axis=0).astype(int) - 4, 0, None)
        high = np.minimum(corners.max(axis=0).astype(int) + 5, second.shape[::-1])
        here = first.read(strip, slice(left, right))
        there = second.read(slice(low[1], high[1]), slice(low[0], high[0]))
        for corner in tops:
            offset = guess[:, :2] @ corner + guess[:, 2] - low
            local = np.column_stack([guess[:, :2], offset])
            columns = slice(int(corner[0]) - left, int(corner[0]) - left + side)
            warp = (local, (side, side))
            moved = cv2.warpAffine(there[0], *warp, flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)
            shown = cv2.warpAffine(there[1].astype(np.uint8), *warp, flags=cv2.WARP_INVERSE_MAP)
            match = match_window(here[0][:, columns], moved, here[1][:, columns] & (shown > 0))
            if match is not None:
                middle = corner + (side - 1) / 2
                found.append(([middle, guess[:, :2] @ (middle + match[0]) + guess[:, 2]], match[1]))
    if len(found) < LEAST_WINDOWS:
        return None
    points, covariance = np.array([each[0] for each in found]).swapaxes(0, 1), np.array([each[1] for each in found])
    matrix, agrees = fit_similarity(points, covariance)
    return (matrix, points[:, agrees], covariance[agrees]) if agrees.sum() >= LEAST_WINDOWS else None


def window_places(
    first: tuple[int, int], second: tuple[int, int], guess: np.ndarray, windows: int
) -> tuple[int, list[np.ndarray]]:
    """Place windows, about so many at most, evenly where two fields of these shapes overlap.

    Returns their side, and the places (n, 2) of their corners in the first field, by rows of windows.
    """
    shape, other = np.array(first[::-1]), np.array(second[::-1])
    corners = np.array([(x, y) for x in (0, other[0]) for y in (0, other[1])]) - guess[:, 2]
    corners = corners @ np.linalg.inv(guess[:, :2]).T
    low, high = np.maximum(corners.min(axis=0), 0), np.minimum(corners.max(axis=0), shape)
    side = int(np.clip((high - low).min() / 1.5, *WINDOW))
    high -= side
    if (high < low).any():
        return side, []
    count = (high - low) / side + 1
    count *= min(2, np.sqrt(windows / count.prod()))  # windows overlap where they are few
    axes = [np.unique(np.linspace(a, b, max(int(n), 1)).astype(int)) for a, b, n in zip(low, high, count, strict=True)]
    places = []
    for y in axes[1]:
        row = np.array([(x, y) for x in axes[0]], float)
        there = row @ guess[:, :2].T + guess[:, 2]
        inside = ((there >= -side / 4) & (there <= other - 0.75 * side)).all(axis=1)
        places += [row[inside]] if inside.any() else []
    return side, places


def match_window(first: np.ndarray, second: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Measure the displacement of a window's signals (rows, columns, 3) float32 in the second, where both are known.

    Returns it (columns, rows) and its covariance (2, 2), or None where it cannot be measured.
    """
    import cv2
    from scipy.fft import rfft2

    taper = taper_of(known)
    if taper.mean() < 0.3:
        return None
    one, two = (np.stack([laplacian(part[..., k], taper) for k in range(3)], axis=-1) for part in (first, second))
    spectra = [rfft2(part * taper[..., None], axes=(0, 1)) for part in (one, two)]
    shifts, heights = find_shifts((np.conj(spectra[0]) * spectra[1]).sum(axis=2)[None], taper.shape)
    if heights[0] < LEAST_PEAK:
        return None
    shift, step = shifts[0], np.zeros(2)
    for _ in range(6):
        shift = shift + step
        matrix = np.column_stack([np.eye(2), shift])
        warp = {"flags": cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP, "borderMode": cv2.BORDER_REPLICATE}
        moved = cv2.warpAffine(two, matrix, taper.shape[::-1], **warp)
        weight = taper * cv2.warpAffine(taper, matrix, taper.shape[::-1], flags=cv2.WARP_INVERSE_MAP)
        power = [(weight[..., None] * part).sum(axis=(0, 1)) for part in (one * moved, one * one, moved * moved)]
        likeness = np.maximum(power[0], 0) / np.sqrt(power[1] * power[2] + 1e-12)
        share = weight[..., None] * (likeness / (1.02 - np.square(likeness))).astype(np.float32)
        slopes = [np.stack(np.gradient(part, axis=(1, 0)), axis=-1) for part in (one, moved)]
        scores = (share * (one - moved))[..., None] * (0.5 * (slopes[0] + slopes[1]))  # (rows, columns, 3, 2)
        cross = np.einsum("rck,rcki,rckj->ij", share, *slopes)
        matrix = 0.5 * (cross + cross.T)
        if np.linalg.eigvalsh(matrix)[0] <= 1e-3 * weight.sum():
            return None
        step = np.linalg.solve(matrix, scores.sum(axis=(0, 1, 2)))
        if np.hypot(*step) < 0.01:
            break
        if np.hypot(*step) > 3:
            return None
    if np.hypot(*step) > 0.1:
        return None
    rows, columns = (n // BLOCK for n in taper.shape)
    blocks = scores.sum(axis=2)[: rows * BLOCK, : columns * BLOCK].reshape(rows, BLOCK, columns, BLOCK, 2)
    sums = blocks.sum(axis=(1, 3))
    inverse = np.linalg.inv(matrix)
    covariance = inverse @ np.einsum("abi,abj->ij", sums, sums) @ inverse + LEAST_ERROR**2 * np.eye(2)
    return (shift, covariance) if np.sqrt(covariance.trace() / 2) < MOST_ERROR else None


def fit_similarity(points: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit the similarity (2, 3) from points[0] to points[1] (2, n, 2) robustly; return which agree, (n,) bool, too."""
    middle = points[0].mean(axis=0)
    (x, y), one, none = (points[0] - middle).T, np.ones(points.shape[1]), np.zeros(points.shape[1])
    design = np.stack([np.stack([one, none, x, -y], 1), np.stack([none, one, y, x], 1)], 1)  # (n, 2, 4)
    error = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2) + 0.1
    weight = 1 / error
    for _ in range(30):
        rows, sizes = design * np.sqrt(weight)[:, None, None], points[1] * np.sqrt(weight)[:, None]
        found = np.linalg.lstsq(rows.reshape(-1, 4), sizes.ravel(), rcond=1e-9)[0]
        residual = np.hypot(*(points[1] - design @ found).T)
        weight = 1 / np.maximum(residual, 0.1 * error) / error  # least absolute deviations
    matrix = np.array([[found[2], -found[3]], [found[3], found[2]]])
    agrees = residual < AGREE + 3 * error
    return np.column_stack([matrix, found[:2] - matrix @ middle]), agrees
