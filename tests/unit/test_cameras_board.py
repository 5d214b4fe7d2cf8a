"""Boards drawn by casting a ray through every pixel of a known lens: corners, intrinsics, distortion, poses."""

from functools import cache

import cv2
import numpy as np
import pytest
from boards import COLUMNS, DISTORTION, LENS, POSES, ROWS, SHAPE, board_camera, photograph
from refusals import refused

from nishiki.errors import UserError
from nishiki.geometry.board import BoardCorners, BoardShape, board_of, calibrate, detect_boards
from nishiki.geometry.camera import distort
from nishiki.geometry.pose import Sight, estimate_pose


@cache
def pictures() -> tuple:
    cameras = {name: board_camera(name, *pose) for name, pose in POSES.items()}
    return tuple((name, photograph(camera, seed=k)) for k, (name, camera) in enumerate(cameras.items()))


@cache
def detection():
    return detect_boards(pictures(), SHAPE)


@pytest.mark.slow
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
    assert np.sqrt((errors**2).sum(axis=1).mean()) < 0.08
    assert np.abs(errors.mean(axis=0)).max() < 0.01, "half a pixel of offset would show here"


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


@pytest.mark.slow
def test_pictures_without_a_board_are_named():
    found = detect_boards([("empty", np.full((ROWS, COLUMNS), 90, np.uint8)), pictures()[0]], SHAPE)
    assert found.unseen == ("empty",)


def test_intrinsics_and_distortion_are_recovered():
    found = calibrate(detection().pictures, rows=ROWS, columns=COLUMNS)
    assert found.rms_px < 0.08
    assert not found.outliers
    assert not found.sparse
    error = np.abs(found.intrinsics - LENS)
    assert max(error[0, 0] / 610, error[1, 1] / 604) < 0.002
    assert max(error[0, 2], error[1, 2]) < 1.0
    assert found.focal_sigma < 0.005
    # Over the picture the two lenses put a ray at the same pixel.
    y, x = np.mgrid[-0.3:0.31:0.05, -0.42:0.43:0.05]
    plane = np.column_stack([x.ravel(), y.ravel()])
    ours = distort(plane, found.distortion) * np.diag(found.intrinsics)[:2] + found.intrinsics[:2, 2]
    true = distort(plane, DISTORTION) * np.diag(LENS)[:2] + LENS[:2, 2]
    offset = ours - true
    assert np.abs(offset - offset.mean(axis=0)).max() < 0.3


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
    with refused(UserError, "3", by="calibrate"):
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
    with refused(UserError, by="calibrate"):
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
        assert found.rms_px < 0.08
        turn = cv2.Rodrigues(found.camera.rotation @ true.rotation.T)[0]
        assert np.degrees(np.linalg.norm(turn)) < 0.05
        assert np.linalg.norm(found.camera.centre - true.centre) < 0.001 * np.linalg.norm(true.translation)
