"""Pictures of a calibration board, drawn by casting a ray through every pixel of a known lens."""

from functools import cache

import cv2
import numpy as np

from nishiki.geometry.board import BoardShape, board_of
from nishiki.geometry.camera import Camera, distort

ROWS, COLUMNS = 420, 560
SHAPE = BoardShape(7, 5, 20.0, 14.0, "DICT_4X4_50")
LENS = np.array([[610.0, 0, 285.3], [0, 604.0, 204.6], [0, 0, 1]])
DISTORTION = (-0.21, 0.09, 0.0012, -0.0008, 0.0)
PER_UNIT = 8  # pixels of the board's drawing a unit of length


def rotation_of(vector) -> np.ndarray:
    return cv2.Rodrigues(np.asarray(vector, np.float64))[0]


def turned(degrees_x: float, degrees_y: float, degrees_z: float) -> np.ndarray:
    x, y, z = np.radians([degrees_x, degrees_y, degrees_z])
    return rotation_of((x, 0, 0)) @ rotation_of((0, y, 0)) @ rotation_of((0, 0, z))


def board_camera(name, angles, shift, *, lens=LENS, distortion=DISTORTION) -> Camera:
    """A camera before the board: the board's middle at `shift` in the camera's frame, turned by `angles`."""
    rotation = turned(*angles)
    middle = np.array([SHAPE.squares_x * SHAPE.square / 2, SHAPE.squares_y * SHAPE.square / 2, 0])
    return Camera(name, lens, rotation, np.array(shift, float) - rotation @ middle, ROWS, COLUMNS, distortion)


POSES = {
    "a": ((0, 25, 3), (-10, 5, 190)),
    "b": ((28, 0, -8), (20, -12, 200)),
    "c": ((-25, 12, 30), (-25, 10, 210)),
    "d": ((15, -30, 80), (15, 0, 220)),
    "e": ((-20, -22, -50), (-5, -15, 185)),
    "f": ((5, 38, 170), (10, 18, 230)),
    "g": ((-35, -5, 10), (25, 10, 195)),
    "h": ((30, 20, -120), (-30, -10, 225)),
}


@cache
def drawing() -> np.ndarray:
    size = (SHAPE.squares_x * SHAPE.square * PER_UNIT, SHAPE.squares_y * SHAPE.square * PER_UNIT)
    return cv2.GaussianBlur(board_of(SHAPE).generateImage(tuple(int(s) for s in size), marginSize=0), (0, 0), 2)


@cache
def rays(samples: int) -> tuple[np.ndarray, ...]:
    """Directions (rows * columns, 3) of the lens's rays through samples x samples places of every pixel: the lens is
    inverted by fixed-point iteration, another path than the projection under test."""
    offsets = (np.arange(samples) - (samples - 1) / 2) / samples
    row, column = np.mgrid[:ROWS, :COLUMNS].astype(float)
    found = []
    for dy in offsets:
        for dx in offsets:
            plane = np.column_stack([(column + dx - LENS[0, 2]).ravel(), (row + dy - LENS[1, 2]).ravel()])
            plane /= np.diag(LENS)[:2]
            straight = plane.copy()
            for _ in range(25):
                straight += plane - distort(straight, DISTORTION)
            assert np.abs(distort(straight, DISTORTION) - plane).max() < 1e-7
            found.append(np.column_stack([straight, np.ones(len(plane))]))
    return tuple(found)


def photograph(camera: Camera, *, noise=1.5, seed=0) -> np.ndarray:
    """(rows, columns) uint8: mean of four rays a pixel, each cut with the board's plane z = 0."""
    total = np.zeros((ROWS, COLUMNS))
    picture = drawing().astype(np.float32)
    for directions in rays(2):
        turned_rays = directions @ camera.rotation
        hit = camera.centre[:2] - turned_rays[:, :2] * (camera.centre[2] / turned_rays[:, 2])[:, None]
        place = (hit * PER_UNIT - 0.5).astype(np.float32).reshape(ROWS, COLUMNS, 2)
        total += cv2.remap(
            picture, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=150
        )
    values = 20 + 0.2 * total + np.random.default_rng(seed).normal(0, noise, (ROWS, COLUMNS))
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
