"""Lens, axis and centre from photographs of a board, drawn by rays of a known lens or posed exactly."""

import re

import cv2
import numpy as np
import pytest
from boards import COLUMNS, DISTORTION, LENS, POSES, ROWS, SHAPE, board_camera, photograph, rotation_of
from refusals import refused

from nishiki.calibrate.camera import calibrate_geometry, print_board, resting_point, resting_point_with_sigma
from nishiki.calibrate.result import write_calibration
from nishiki.errors import UserError
from nishiki.geometry.board import detect_boards


def stage_poses(axes, *, noise=0.0, count=9, seed=0):
    """Poses of a board on a stage whose axes (unit vectors) meet in one point of the camera's frame."""
    random = np.random.default_rng(seed)
    centre, rest = np.array([12.0, -8.0, 400.0]), rotation_of((0.3, 2.8, 0.2))
    offset = np.array([-30.0, 15.0, 40.0])
    rotations, translations = [], []
    for k in range(count):
        turn = np.eye(3)
        for place, axis in enumerate(axes):
            turn = turn @ rotation_of(np.array(axis) * (0.25 * (k - 4) if place == 0 else 0.3 * np.sin(2.0 * k)))
        rotations.append(turn @ rest)
        translations.append(centre + turn @ offset + random.normal(0, noise, 3))
    return np.array(rotations), np.array(translations), centre


def test_one_axis_is_found_with_its_direction():
    axis = np.array([0.1, -0.98, 0.17]) / np.linalg.norm([0.1, -0.98, 0.17])
    rotations, translations, centre = stage_poses([axis])
    found = resting_point(rotations, translations)
    assert abs(found["axis"] @ axis) == pytest.approx(1, abs=1e-12)
    assert np.linalg.norm(np.cross(found["point"] - centre, axis)) < 1e-8
    assert found["rms"] < 1e-9


def test_axes_that_meet_have_a_centre_whose_uncertainty_is_that_of_repeats():
    axes = ([0.0, 1.0, 0.0], [1.0, 0.0, 0.0])
    exact = resting_point(*stage_poses(axes)[:2])
    assert exact["axis"] is None
    np.testing.assert_allclose(exact["point"], stage_poses(axes)[2], atol=1e-8)
    fits = [resting_point_with_sigma(*stage_poses(axes, noise=0.05, seed=seed)[:2]) for seed in range(60)]
    errors = [np.linalg.norm(fit["point"] - stage_poses(axes)[2]) for fit in fits]
    stated = np.sqrt(np.mean([fit["point_sigma"] ** 2 for fit in fits]))
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(stated, rel=0.4)


def test_a_stage_that_hardly_turned_is_refused():
    rotations, translations, _ = stage_poses([[0.0, 1.0, 0.0]])
    with refused(UserError, "5", by="resting_point"):
        resting_point(np.repeat(rotations[:1], 5, axis=0), np.repeat(translations[:1], 5, axis=0))


@pytest.mark.slow
def test_lens_is_that_of_the_rays(tmp_path):
    paths = []
    for name, (angles, shift) in POSES.items():
        paths.append(tmp_path / f"{name}.png")
        cv2.imwrite(str(paths[-1]), photograph(board_camera(name, angles, shift)))
    result = calibrate_geometry(paths, SHAPE)
    numbers, intrinsics = result.numbers, result.numbers["intrinsics"]
    assert intrinsics["fx"] == pytest.approx(LENS[0, 0], abs=4 * numbers["focal_sigma_px"] + 0.5)
    assert intrinsics["cx"] == pytest.approx(LENS[0, 2], abs=4 * numbers["principal_point_sigma_px"] + 0.5)
    assert intrinsics["distortion"][0] == pytest.approx(DISTORTION[0], abs=0.02)
    write_calibration(tmp_path / "out", result)
    assert (tmp_path / "out" / "intrinsics.yaml").is_file()
    cv2.imwrite(str(tmp_path / "blank.png"), np.full((ROWS, COLUMNS), 90, np.uint8))
    with pytest.raises(UserError, match="larger"):
        calibrate_geometry([tmp_path / "blank.png"] * 3, SHAPE)


def test_printed_board_is_detected_and_has_its_size():
    svg, data = print_board(SHAPE)
    assert f'width="{SHAPE.squares_x * SHAPE.square:g}mm"' in svg
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    drawn = np.full_like(picture, 255)
    scale = picture.shape[1] / (SHAPE.squares_x * SHAPE.square)
    for numbers in re.findall(r"M([\d.]+) ([\d.]+)H([\d.]+)V([\d.]+)H", svg):
        left, top, right, bottom = (round(float(v) * scale) for v in numbers)
        drawn[top:bottom, left:right] = 0
    assert (drawn == np.where(picture < 128, 0, 255)).all()
    framed = cv2.resize(cv2.copyMakeBorder(drawn, 90, 90, 90, 90, cv2.BORDER_CONSTANT, value=255), None, fx=0.4, fy=0.4)
    corners = detect_boards([("printed", framed)], SHAPE).pictures[0]
    assert len(corners.ids) == (SHAPE.squares_x - 1) * (SHAPE.squares_y - 1)
