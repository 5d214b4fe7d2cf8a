"""Boards drawn by casting a ray through every pixel of a known lens: corners, intrinsics, distortion, poses."""

from functools import cache

import cv2
import numpy as np
import pytest

from nishiki.errors import UserError
from nishiki.geometry.board import BoardCorners, BoardShape, board_of, detect_boards
from nishiki.geometry.calibration import calibrate
from nishiki.geometry.camera import Camera, distort
from nishiki.geometry.pose import Sight, estimate_pose

ROWS, COLUMNS = 420, 560
SHAPE = BoardShape(7, 5, 20.0, 14.0, "DICT_4X4_50")
LENS = np.array([[610.0, 0, 285.3], [0, 604.0, 204.6], [0, 0, 1]])
DISTORTION = (-0.21, 0.09, 0.0012, -0.0008, 0.0)
PER_UNIT = 8  # pixels of the board's drawing a unit of length


def turned(degrees_x: float, degrees_y: float, degrees_z: float) -> np.ndarray:
    return cv2.Rodrigues(np.radians([degrees_x, 0, 0.0]))[0] @ (
        cv2.Rodrigues(np.radians([0, degrees_y, 0.0]))[0] @ cv2.Rodrigues(np.radians([0, 0, degrees_z]))[0]
    )


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


@cache
def pictures() -> tuple:
    cameras = {name: board_camera(name, *pose) for name, pose in POSES.items()}
    return tuple((name, photograph(camera, seed=k)) for k, (name, camera) in enumerate(cameras.items()))


@cache
def detection():
    return detect_boards(pictures(), SHAPE)


def test_corners_are_where_the_camera_puts_them():
    found = detection()
    assert [each.name for each in found.pictures] == list(POSES)
    assert not found.unseen
    assert not found.legacy
    errors = []
    for each in found.pictures:
        expected, _ = board_camera(each.name, *POSES[each.name]).project(each.points)
        errors.append(each.pixels - expected)
        assert len(each.ids) >= 20
    errors = np.concatenate(errors)
    assert np.sqrt((errors**2).sum(axis=1).mean()) < 0.12
    assert np.abs(errors.mean(axis=0)).max() < 0.04, "half a pixel of offset would show here"


def test_boards_of_the_older_layout_are_recognised():
    shape = BoardShape(5, 4, 20.0, 14.0, "DICT_4X4_50")
    image = cv2.copyMakeBorder(
        board_of(shape, legacy=True).generateImage((500, 400)), 30, 30, 30, 30, cv2.BORDER_CONSTANT, value=255
    )
    found = detect_boards([("old", image)], shape)
    assert found.legacy
    assert len(found.pictures[0].ids) == 12
    assert not detect_boards(
        [("new", cv2.copyMakeBorder(board_of(shape).generateImage((500, 400)), 30, 30, 30, 30, 0, value=255))], shape
    ).legacy


def test_pictures_without_a_board_are_named():
    found = detect_boards([("empty", np.full((ROWS, COLUMNS), 90, np.uint8)), pictures()[0]], SHAPE)
    assert found.unseen == ("empty",)


def test_intrinsics_and_distortion_are_recovered():
    found = calibrate(detection().pictures, rows=ROWS, columns=COLUMNS)
    assert found.rms_px < 0.15
    assert not found.outliers
    assert not found.sparse
    error = np.abs(found.intrinsics - LENS)
    assert max(error[0, 0] / 610, error[1, 1] / 604) < 0.005
    assert max(error[0, 2], error[1, 2]) < 2.0
    assert found.focal_sigma < 0.005
    # Over the picture the two lenses put a ray at the same pixel.
    y, x = np.mgrid[-0.3:0.31:0.05, -0.42:0.43:0.05]
    plane = np.column_stack([x.ravel(), y.ravel()])
    ours = distort(plane, found.distortion) * np.diag(found.intrinsics)[:2] + found.intrinsics[:2, 2]
    true = distort(plane, DISTORTION) * np.diag(LENS)[:2] + LENS[:2, 2]
    offset = ours - true
    assert np.abs(offset - offset.mean(axis=0)).max() < 0.8


def test_a_spoilt_picture_is_left_out_and_named():
    shifted = []
    for each in detection().pictures:
        pixels = each.pixels.copy()
        if each.name == "d":
            pixels[:, 0] += 3 * np.sin(np.arange(len(pixels)))
        shifted.append(BoardCorners(each.name, each.ids, pixels, each.points))
    found = calibrate(tuple(shifted), rows=ROWS, columns=COLUMNS)
    assert found.outliers == ("d",)
    assert found.picture_px["d"] > 1 > max(v for name, v in found.picture_px.items() if name != "d")
    assert abs(found.intrinsics[0, 0] - 610) < 4


def test_too_few_pictures():
    with pytest.raises(UserError, match="at least 3 pictures"):
        calibrate(detection().pictures[:2], rows=ROWS, columns=COLUMNS)


@pytest.mark.parametrize("tilt", [0, 4, 15, 30])
@pytest.mark.parametrize("noise", [0.0, 0.1, 0.5])
def test_boards_all_held_the_same_way_do_not_pass(tilt, noise):
    """Parallel boards give two equations for four unknowns: focal length and distance trade against each other."""
    rng = np.random.default_rng(5)
    points = np.asarray(board_of(SHAPE).getChessboardCorners(), np.float64)
    same = []
    for k in range(5):
        camera = board_camera(str(k), (tilt, 0, 10 * k), (4 * k - 8, 3 * k - 6, 200), distortion=(0,) * 5)
        pixels = camera.project(points)[0] + rng.normal(0, noise, (len(points), 2))
        same.append(BoardCorners(str(k), np.arange(len(points)), pixels, points))
    with pytest.raises(UserError, match="tilt the board"):
        calibrate(tuple(same), rows=ROWS, columns=COLUMNS, distortion="none")


@pytest.mark.parametrize("change", [{"dictionary": "DICT_NONE"}, {"marker": 20.0}, {"marker": -1.0}, {"squares_x": 2}])
def test_impossible_boards(change):
    with pytest.raises(UserError):
        board_of(BoardShape(**{**SHAPE.__dict__, **change}))


def test_pose_of_a_view_from_its_board():
    for each in detection().pictures:
        true = board_camera(each.name, *POSES[each.name])
        found = estimate_pose(
            Sight(each.name, each.points, each.pixels), LENS, DISTORTION, rows=ROWS, columns=COLUMNS, outlier_px=2.0
        )
        assert found.rms_px < 0.15
        turn = cv2.Rodrigues(found.camera.rotation @ true.rotation.T)[0]
        assert np.degrees(np.linalg.norm(turn)) < 0.2
        assert np.linalg.norm(found.camera.centre - true.centre) < 0.005 * np.linalg.norm(true.translation)
