"""Cameras between the views of a turn, and the weights of the views around them."""

import numpy as np
import pytest
from refusals import refused

from nishiki.geometry.camera import Camera
from nishiki.geometry.turn import (
    camera_between,
    fit_turn,
    rotation_matrix,
    rotation_vector,
    scale_camera,
    turn_camera,
    twist,
)
from nishiki.render.object.shots import Neighbours

AXIS = np.array([0.1, 0.97, -0.2]) / np.linalg.norm([0.1, 0.97, -0.2])
POINT = np.array([0.3, -0.2, 0.5])


def pose(angle):
    """A camera turned by `angle` about the axis through POINT, seen from the object."""
    first = Camera(
        "0", np.array([[800.0, 0, 320], [0, 820, 240], [0, 0, 1]]), np.eye(3), np.array([0, 0, 5.0]), 480, 640
    )
    spin = rotation_matrix(angle * AXIS)
    rotation = first.rotation @ spin.T
    centre = spin @ (first.centre - POINT) + POINT
    return Camera(f"{angle:.3f}", first.intrinsics, rotation, -rotation @ centre, 480, 640)


def circle(count, span=2 * np.pi):
    return [pose(span * k / count) for k in range(count)]


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, np.pi - 1e-7, np.pi])
def test_rotation_vectors_and_matrices(angle):
    matrix = rotation_matrix(angle * AXIS)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-14)
    vector = rotation_vector(matrix)
    assert np.isclose(np.linalg.norm(vector), angle, atol=1e-7)
    np.testing.assert_allclose(rotation_matrix(vector), matrix, atol=1e-7)


def test_twist_is_the_angle_about_the_axis():
    swing = rotation_matrix(0.3 * np.cross(AXIS, [1.0, 0, 0]))
    assert np.isclose(twist(rotation_matrix(0.7 * AXIS), AXIS), 0.7)
    assert np.isclose(twist(swing @ rotation_matrix(-0.7 * AXIS), AXIS), -0.7)
    assert twist(np.eye(3), AXIS) == 0


def test_axis_and_positions_of_an_ideal_turn():
    turn = fit_turn(circle(12), full_turn=True)
    np.testing.assert_allclose(np.abs(turn.axis @ AXIS), 1, atol=1e-12)
    off = turn.point - POINT
    np.testing.assert_allclose(off - (off @ AXIS) * AXIS, 0, atol=1e-9)
    np.testing.assert_allclose(turn.position, 2 * np.pi * np.arange(12) / 12, atol=1e-9)
    assert np.isclose(turn.length, 2 * np.pi)
    assert turn.deviation_deg < 1e-5


def test_cameras_between_lie_on_the_circle_not_on_its_chord():
    cameras = circle(8)
    turn = fit_turn(cameras, full_turn=True)
    for index, fraction in ((0, 0.5), (3, 0.25), (7, 0.8)):
        made = camera_between(cameras, turn, index, fraction)
        want = pose(2 * np.pi * (index + fraction) / 8)
        np.testing.assert_allclose(made.matrix, want.matrix, atol=1e-8)


def test_cameras_between_pass_through_disturbed_neighbours():
    rng = np.random.default_rng(0)
    cameras = []
    for camera in circle(10):
        rotation = rotation_matrix(rng.normal(size=3) * 0.01) @ camera.rotation
        cameras.append(
            Camera(camera.name, camera.intrinsics, rotation, camera.translation + rng.normal(size=3) * 0.01, 480, 640)
        )
    turn = fit_turn(cameras, full_turn=True)
    for index in (0, 4, 9):
        for fraction in (0.0, 1.0):
            made = camera_between(cameras, turn, index, fraction)
            np.testing.assert_allclose(made.matrix, cameras[(index + int(fraction)) % 10].matrix, atol=1e-9)
        half = camera_between(cameras, turn, index, 0.5)
        np.testing.assert_allclose(half.rotation @ half.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.norm(half.centre - pose(2 * np.pi * (index + 0.5) / 10).centre) < 0.1


def test_a_turn_of_few_or_equal_views_has_no_nan():
    for cameras in ([pose(0.0)], [pose(0.0), pose(0.0)], [pose(0.0), pose(0.4)]):
        for closed in (False, True):
            turn = fit_turn(cameras, full_turn=closed)
            assert np.isfinite(turn.axis).all()
            assert np.isfinite(turn.position).all()
            made = camera_between(cameras, turn, 0, 0.5)
            assert np.isfinite(made.matrix).all()


def test_scaling_keeps_what_a_pixel_sees():
    camera = pose(0.3)
    half = scale_camera(camera, 0.5)
    assert (half.rows, half.columns) == (240, 320)
    points = np.random.default_rng(1).normal(size=(20, 3)) * 0.5
    full, _ = camera.project(points)
    small, _ = half.project(points)
    np.testing.assert_allclose((full + 0.5) / 2 - 0.5, small, atol=1e-9)


def test_turned_about_the_axis_and_back():
    turn = fit_turn(circle(6), full_turn=True)
    camera = pose(0.2)
    np.testing.assert_allclose(
        turn_camera(turn_camera(camera, turn, 0.9), turn, -0.9).matrix, camera.matrix, atol=1e-10
    )


def test_weights_reproduce_straight_lines():
    turn = fit_turn(circle(16), full_turn=True)
    for view in (5, 15):
        place = turn.locate(view, 0.3)
        found = Neighbours.around(turn, place)
        assert dict(zip(found.views.tolist(), found.weights, strict=True)) == pytest.approx(
            {view: 0.7, (view + 1) % 16: 0.3}
        )


def test_neighbours_go_round_the_closed_turn_and_skip_left_out_views():
    closed = fit_turn(circle(8), full_turn=True)
    assert set(Neighbours.around(closed, closed.locate(7, 0.5)).views) == {7, 0}
    found = Neighbours.around(closed, float(closed.position[0]), without=frozenset({0}))
    assert dict(zip(found.views.tolist(), found.weights.tolist(), strict=True)) == pytest.approx({7: 0.5, 1: 0.5})
    exact = Neighbours.around(closed, float(closed.position[3]))
    assert exact.views.tolist() == [3]
    assert exact.weights.tolist() == [1.0]


def test_open_paths_do_not_run_over_their_ends():
    half = fit_turn(circle(8, span=np.pi), full_turn=False)
    found = Neighbours.around(half, float(half.position[0]), without=frozenset({0}))
    assert found.views.tolist() == [1]
    assert Neighbours.around(half, half.locate(6, 0.5)).views.tolist() == [6, 7]
    with refused(ValueError, by="around"):
        Neighbours.around(half, 0.0, without=frozenset(range(8)))
