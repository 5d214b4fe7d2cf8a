"""Find the corners of a ChArUco board in pictures, and calibrate intrinsics and distortion from several of them."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from nishiki.errors import UserError
from nishiki.formats.stored import PlainFields

LEAST_CORNERS = 4  # of a pose


@dataclass(frozen=True)
class BoardShape:
    """A ChArUco board."""

    squares_x: int  # squares_x, squares_y: counts
    squares_y: int
    square: float  # square, marker: lengths of a side in the world's unit
    marker: float
    dictionary: str = "DICT_4X4_50"  # OpenCV's name of the marker set


@dataclass(frozen=True)
class BoardCorners:
    """The inner corners of the board in one picture."""

    name: str
    ids: np.ndarray  # (n,) int
    pixels: np.ndarray  # (n, 2) float64 (column, row)
    points: np.ndarray  # (n, 3) float64 on the board, in the world's unit (x along the squares_x, z = 0)


@dataclass(frozen=True)
class Detection:
    """The boards found."""

    pictures: tuple[BoardCorners, ...]  # those with at least 4 corners
    unseen: tuple[str, ...]  # names of those without
    legacy: bool  # boards of OpenCV before 4.6 (first square white where the number of rows is even)


def board_of(shape: BoardShape, *, legacy: bool = False):
    """Make OpenCV's board. UserError where the dictionary is unknown or the lengths are impossible."""
    import cv2

    aruco = cv2.aruco
    if not hasattr(aruco, shape.dictionary):
        known = ", ".join(sorted(name for name in dir(aruco) if name.startswith("DICT_")))
        raise UserError(f"board dictionary {shape.dictionary!r} is unknown; expected one of {known}")
    if min(shape.squares_x, shape.squares_y) < 3 or not 0 < shape.marker < shape.square:
        raise UserError(
            f"board of {shape.squares_x} x {shape.squares_y} squares of {shape.square} with markers of {shape.marker}: "
            "expected at least 3 x 3 squares, and markers smaller than the squares. Remedy: correct turntable.board"
        )
    board = aruco.CharucoBoard(
        (shape.squares_x, shape.squares_y),
        shape.square,
        shape.marker,
        aruco.getPredefinedDictionary(getattr(aruco, shape.dictionary)),
    )
    board.setLegacyPattern(legacy)
    return board


def detect_boards(pictures: Iterable[tuple[str, np.ndarray]], shape: BoardShape) -> Detection:
    """Find the corners in pictures (name, (rows, columns) uint8), one picture in memory at a time.

    Both layouts of the markers are tried; the one that finds more corners over all pictures stands.
    """
    import cv2

    boards = [board_of(shape, legacy=legacy) for legacy in (False, True)]
    # Corners are refined by the grey values around them; markers alone place them a few tenths of a pixel off.
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detectors = [cv2.aruco.CharucoDetector(board, detectorParams=parameters) for board in boards]
    detected: list[list[BoardCorners]] = [[], []]
    names = []
    for name, image in pictures:
        names.append(name)
        image = np.ascontiguousarray(image, np.uint8)
        for place, (board, detector) in enumerate(zip(boards, detectors, strict=True)):
            pixels, ids, _, _ = detector.detectBoard(image)
            if ids is None or len(ids) < LEAST_CORNERS:
                continue
            order = np.argsort(ids := np.asarray(ids).ravel())
            points = np.asarray(board.getChessboardCorners(), np.float64)[ids[order]]
            pixels = np.asarray(pixels, np.float64).reshape(-1, 2)[order]
            detected[place].append(BoardCorners(name, ids[order], pixels, points))
    counts = [sum(len(corners.ids) for corners in each) for each in detected]
    legacy = counts[1] > counts[0]
    seen = detected[legacy]
    known = {corners.name for corners in seen}
    return Detection(tuple(seen), tuple(name for name in names if name not in known), bool(legacy))


LEAST_PICTURES = 3  # of a calibration
OUTLIER = 3.0  # error of a picture over the median from which it is left out
LEAST_CALIBRATION_CORNERS = 8  # of a picture that takes part
LEAST_TILT_DEG = 8.0
MOST_SIGMA = 0.04  # of focal length and centre, relative
STARTS = (0.8, 1.5, 3.0, 8.0)  # focal lengths, of the picture's longer side


@dataclass(frozen=True)
class LensCalibration(PlainFields):
    """A calibrated lens: intrinsics (3, 3) float64, distortion k1, k2, p1, p2, k3 (Brown's model)."""

    intrinsics: np.ndarray
    distortion: tuple[float, ...]
    rms_px: float  # root mean square distance of detected from projected corners over the pictures used
    picture_px: dict[str, float]  # by picture, those left out too
    focal_sigma: float  # standard deviation of the focal lengths, relative
    middle_sigma_px: float  # of the principal point
    tilt_deg: float  # largest angle between two boards
    outliers: tuple[str, ...] = ()  # names of pictures left out because they fit far worse than the others
    sparse: tuple[str, ...] = ()  # names of pictures with too few corners


def calibrate(
    pictures: tuple[BoardCorners, ...], *, rows: int, columns: int, distortion: str = "tangential"
) -> LensCalibration:
    """Fit the lens by least squares over all corners (Zhang, IEEE Trans. PAMI 22, 2000, as in OpenCV).

    distortion: terms fitted: none | radial (k1, k2) | tangential (k1, k2, p1, p2) | full (and k3). A picture whose
    error is above OUTLIER times the median of the pictures (at least 0.1 px) is left out, the worst first, and
    the rest fitted again.

    Raises UserError for fewer than 3 pictures with 8 corners, or where the pictures do not determine the lens, as
    when the board was held the same way in all of them: no two boards 8 degrees apart, or a standard deviation of the
    focal length or of the principal point above 4 % of it or of the longer side.
    """
    import cv2

    sparse = tuple(each.name for each in pictures if len(each.ids) < LEAST_CALIBRATION_CORNERS)
    used = [each for each in pictures if len(each.ids) >= LEAST_CALIBRATION_CORNERS]
    if len(used) < LEAST_PICTURES:
        raise UserError(
            f"calibration: expected at least {LEAST_PICTURES} pictures with {LEAST_CALIBRATION_CORNERS} corners of the "
            "board or more, "
            f"found {len(used)} (with fewer corners: {', '.join(sparse) or 'none'}). Remedy: photograph the board "
            "larger, "
            "sharper and from more directions; check squares, lengths and dictionary in turntable.board"
        )
    outliers: list[BoardCorners] = []
    while True:
        fit = _fit(used, rows, columns, distortion)
        fitted = list(fit.picture_px.values())
        worst = int(np.argmax(fitted))
        if fitted[worst] <= OUTLIER * max(float(np.median(fitted)), 0.1) or len(used) == LEAST_PICTURES:
            break
        outliers.append(used.pop(worst))
    middle_sigma = fit.middle_sigma_px / max(rows, columns)
    if fit.tilt_deg < LEAST_TILT_DEG or not fit.focal_sigma <= MOST_SIGMA or not middle_sigma <= MOST_SIGMA:
        raise UserError(
            f"calibration: these {len(used)} pictures do not determine the lens: boards at most {fit.tilt_deg:.1f} "
            "degrees "
            f"apart (expected {LEAST_TILT_DEG:g}), relative standard deviation of the focal length "
            f"{fit.focal_sigma:.2g} and of "
            f"the principal point {middle_sigma:.2g} (at most {MOST_SIGMA:g}). Remedy: tilt the board by 20 to 45 "
            "degrees, "
            "another way in every picture"
        )
    errors, coefficients = dict(fit.picture_px), np.array(fit.distortion)
    for each in outliers:  # at their own best poses
        _, turn, shift = cv2.solvePnP(each.points, each.pixels, fit.intrinsics, coefficients)
        projected = cv2.projectPoints(each.points, turn, shift, fit.intrinsics, coefficients)[0].reshape(-1, 2)
        errors[each.name] = float(np.sqrt(((projected - each.pixels) ** 2).sum(axis=1).mean()))
    return replace(fit, picture_px=errors, outliers=tuple(each.name for each in outliers), sparse=sparse)


def _fit(pictures: list[BoardCorners], rows: int, columns: int, distortion: str) -> LensCalibration:
    """Fit from several focal lengths, since OpenCV's own start diverges where boards are tilted little."""
    import cv2

    fits = []
    for focal in STARTS:
        start = np.diag([focal * max(rows, columns)] * 2 + [1.0])
        start[:2, 2] = (columns - 1) / 2, (rows - 1) / 2
        try:
            fits.append(_fit_from(start, pictures, rows, columns, distortion))
        except cv2.error:
            continue
    fits = [fit for fit in fits if np.isfinite(fit.rms_px)]
    if not fits:
        raise UserError(
            f"calibration: no camera explains these {len(pictures)} pictures. Remedy: tilt the board another way in "
            "every "
            "picture and keep it flat"
        )
    return min(fits, key=lambda fit: fit.rms_px)


def _fit_from(
    start: np.ndarray, pictures: list[BoardCorners], rows: int, columns: int, distortion: str
) -> LensCalibration:
    import cv2

    flags = {
        "none": cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST,
        "radial": cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST,
        "tangential": cv2.CALIB_FIX_K3,
        "full": 0,
    }[distortion]
    rms, matrix, coefficients, turns, _, sigma, _, errors = cv2.calibrateCameraExtended(
        [each.points.astype(np.float32) for each in pictures],
        [each.pixels.astype(np.float32) for each in pictures],
        (columns, rows),
        start,
        np.zeros(5),
        flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=(cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-12),
    )
    sigma, fitted = np.asarray(sigma).ravel(), np.asarray(coefficients).ravel()[:5]
    normals = np.array([cv2.Rodrigues(turn)[0][:, 2] for turn in turns])
    finite = np.isfinite(matrix).all() and np.isfinite(fitted).all() and np.isfinite(sigma[:4]).all()
    return LensCalibration(
        matrix,
        tuple(fitted.tolist()),
        float(rms) if finite else float("inf"),
        dict(zip([each.name for each in pictures], np.asarray(errors, np.float64).ravel().tolist(), strict=True)),
        float(max(sigma[0] / matrix[0, 0], sigma[1] / matrix[1, 1])),
        float(max(sigma[2:4])),
        float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1).min()))),  # largest angle between two boards
    )
