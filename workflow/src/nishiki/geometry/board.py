"""Corners of a ChArUco board in a picture."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from nishiki.errors import UserError

LEAST_CORNERS = 4


@dataclass(frozen=True)
class BoardShape:
    """squares_x, squares_y: counts; square, marker: lengths of a side in the world's unit; dictionary: OpenCV's name
    of the marker set."""

    squares_x: int
    squares_y: int
    square: float
    marker: float
    dictionary: str = "DICT_4X4_50"


@dataclass(frozen=True)
class BoardCorners:
    """Inner corners of the board that one picture shows: ids (n,) int, pixels (n, 2) float64 (column, row), points
    (n, 3) float64 on the board, in the world's unit (x along the squares_x, z = 0)."""

    name: str
    ids: np.ndarray
    pixels: np.ndarray
    points: np.ndarray


@dataclass(frozen=True)
class Detection:
    """pictures: those with at least 4 corners; unseen: names of those without; legacy: boards of OpenCV before 4.6
    (first square white where the number of rows is even)."""

    pictures: tuple[BoardCorners, ...]
    unseen: tuple[str, ...]
    legacy: bool


def board_of(shape: BoardShape, *, legacy: bool = False):
    """OpenCV's board. UserError where the dictionary is unknown or the lengths cannot be."""
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
    """Corners in pictures (name, (rows, columns) uint8), one picture in memory at a time.

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
            corners = _corners(name, image, board, detector)
            if corners is not None:
                detected[place].append(corners)
    counts = [sum(len(corners.ids) for corners in each) for each in detected]
    legacy = counts[1] > counts[0]
    seen = detected[legacy]
    known = {corners.name for corners in seen}
    return Detection(tuple(seen), tuple(name for name in names if name not in known), bool(legacy))


def _corners(name: str, image: np.ndarray, board, detector) -> BoardCorners | None:
    pixels, ids, _, _ = detector.detectBoard(image)
    if ids is None or len(ids) < LEAST_CORNERS:
        return None
    ids = np.asarray(ids).ravel()
    order = np.argsort(ids)
    points = np.asarray(board.getChessboardCorners(), np.float64)[ids[order]]
    return BoardCorners(name, ids[order], np.asarray(pixels, np.float64).reshape(-1, 2)[order], points)
