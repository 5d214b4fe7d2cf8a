"""Given matrices: signs, mirrored worlds, the circle of the centres, the file of cameras."""

import numpy as np
import pytest
from refusals import refused

from nishiki.errors import UserError
from nishiki.geometry.camera import (
    Camera,
    cameras_of_matrices,
    load_cameras,
    point_in_sight,
    read_cameras,
    save_cameras,
)
from nishiki.geometry.turn import turn_of

ROWS, COLUMNS = 300, 400


def looking_at(centre, target, name="0", *, focal=500.0, up=(0, 0, 1)) -> Camera:
    """A camera at `centre` that has `target` in the middle of its picture, `up` pointing to row 0."""
    ahead = np.subtract(target, centre) / np.linalg.norm(np.subtract(target, centre))
    right = np.cross(ahead, up) / np.linalg.norm(np.cross(ahead, up))
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    intrinsics = np.array([[focal, 0, (COLUMNS - 1) / 2], [0, focal, (ROWS - 1) / 2], [0, 0, 1]])
    return Camera(name, intrinsics, rotation, -rotation @ np.asarray(centre, float), ROWS, COLUMNS)


def ring(count=12, *, radius=5.0, height=2.0, target=(0.1, -0.2, 0.3)) -> list[Camera]:
    angles = 2 * np.pi * np.arange(count) / count
    return [looking_at((radius * np.cos(a), radius * np.sin(a), height), target, str(k)) for k, a in enumerate(angles)]


@pytest.mark.parametrize("scale", [1.0, -1.0, -3e-7, 5e6])
def test_matrices_of_any_scale_and_sign_give_the_same_cameras(scale):
    cameras = ring()
    found = cameras_of_matrices({c.name: scale * c.matrix for c in cameras}, rows=ROWS, columns=COLUMNS)
    assert found.mirror is None
    np.testing.assert_allclose(found.target, (0.1, -0.2, 0.3), atol=1e-9)
    for a, b in zip(found.cameras, cameras, strict=True):
        np.testing.assert_allclose(a.matrix, b.matrix, rtol=1e-9, atol=1e-9)
        assert np.linalg.det(a.rotation) == pytest.approx(1)


@pytest.mark.parametrize("negated", [0, 1, 2])
def test_a_mirrored_world_is_turned_back_and_the_pictures_stay(negated):
    """Negating any axis of the world mirrors it; the repaired cameras see the mirrored points where they were."""
    flip = np.ones(4)
    flip[negated] = -1
    cameras = ring()
    found = cameras_of_matrices({c.name: c.matrix @ np.diag(flip) for c in cameras}, rows=ROWS, columns=COLUMNS)
    assert found.mirror == (1, 1, -1), "the axis of the turn is the world's z"
    points = np.random.default_rng(3).uniform(-1, 1, (50, 3))
    for repaired, true in zip(found.cameras, cameras, strict=True):
        pixels, depth = repaired.project(points * flip[:3] * found.mirror)
        expected, expected_depth = true.project(points)
        np.testing.assert_allclose(pixels, expected, atol=1e-8)
        np.testing.assert_allclose(depth, expected_depth, rtol=1e-9)


def test_views_that_look_away_from_the_others_are_named():
    matrices = {c.name: c.matrix for c in ring()}
    matrices["7"] = matrices["7"] @ np.diag([1, 1, -1, 1.0])
    with refused(UserError, "7", by="cameras_of_matrices"):
        cameras_of_matrices(matrices, rows=ROWS, columns=COLUMNS)


def test_one_camera_and_parallel_cameras_have_no_point_in_sight():
    cameras = ring()
    assert point_in_sight(cameras[:1]) is None
    assert point_in_sight([cameras[0], Camera("b", *vars_of(cameras[0], shift=(1, 0, 0)))]) is None
    assert cameras_of_matrices({"0": cameras[0].matrix}, rows=ROWS, columns=COLUMNS).mirror is None


def vars_of(camera, *, shift):
    moved = camera.translation - camera.rotation @ np.array(shift, float)
    return camera.intrinsics, camera.rotation, moved, ROWS, COLUMNS


@pytest.mark.parametrize("bad", [np.zeros((3, 4)), np.full((3, 4), np.nan), np.ones((4, 4))])
def test_matrices_that_are_no_cameras_are_named(bad):
    with pytest.raises(UserError, match="view 'odd'"):
        cameras_of_matrices({"odd": bad}, rows=ROWS, columns=COLUMNS)


def test_circle_of_a_known_turn():
    rotation = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    angles = np.radians([0, 10, 25, 37, 90, 200, 300])
    flat = np.column_stack([3 * np.cos(angles), 3 * np.sin(angles), np.zeros(7)])
    turn = turn_of(flat @ rotation.T + [5, 6, 7])
    np.testing.assert_allclose(turn.axis, rotation[:, 2], atol=1e-9)
    np.testing.assert_allclose(turn.centre, (5, 6, 7), atol=1e-9)
    np.testing.assert_allclose(turn.steps_deg, (10, 15, 12, 53, 110, 100, 60), atol=1e-8)
    assert (turn.radius, turn.radius_min, turn.radius_max) == pytest.approx((3, 1, 1))
    assert turn.off_plane < 1e-12
    backwards = turn_of((flat @ rotation.T)[::-1])
    np.testing.assert_allclose(backwards.axis, -rotation[:, 2], atol=1e-9)


def test_no_circle_through_two_places_or_a_line():
    assert turn_of(np.eye(3)[:2]) is None
    assert turn_of(np.outer(np.arange(5), [1, 2, 3])) is None
    assert turn_of(np.ones((4, 3))) is None


def test_file_of_cameras_round_trips(tmp_path):
    cameras = ring(4)
    path = tmp_path / "cameras.json"
    save_cameras(
        path,
        cameras,
        unit="mm",
        full_turn=True,
        source="matrices",
        reprojection_px=[None, 0.5, 0.25, None],
        mirror=(1, 1, -1),
    )
    for a, b in zip(load_cameras(path), cameras, strict=True):
        assert a.name == b.name
        assert (a.rows, a.columns, a.distortion) == (b.rows, b.columns, b.distortion)
        np.testing.assert_array_equal(a.matrix, b.matrix)
    document = read_cameras(path)
    assert document["mirror"] == [1, 1, -1]
    assert document["views"][1]["reprojection_px"] == 0.5
    path.write_text("[]")
    with refused(UserError, "cameras.json"):
        load_cameras(path)


@pytest.mark.data
def test_measured_turntable(data):
    """36 matrices of a real turn: circle and steps as published with the data, object in front of every camera."""
    from scipy.io import loadmat

    given = loadmat(data / "oxford_dino" / "dino_Ps.mat")["P"][0]
    found = cameras_of_matrices({f"{k:02}": matrix for k, matrix in enumerate(given)}, rows=576, columns=720)
    turn = turn_of(np.array([camera.centre for camera in found.cameras]))
    assert found.mirror == (1, 1, -1)
    assert 0.9993 < turn.radius_min <= turn.radius_max < 1.0007
    assert 9.88 < min(turn.steps_deg)
    assert max(turn.steps_deg) < 10.46
    assert turn.off_plane < 1e-4
    assert sum(turn.steps_deg) == pytest.approx(360)
    points = np.random.default_rng(1).uniform(-0.05, 0.05, (20, 3)) + found.target * [1, 1, 1]
    for camera, matrix in zip(found.cameras, given, strict=True):
        pixels, depth = camera.project(points)
        projected = np.column_stack([points * found.mirror, np.ones(20)]) @ matrix.T
        np.testing.assert_allclose(pixels, projected[:, :2] / projected[:, 2:], rtol=1e-6)
        assert (depth > 0).all()
        assert ((pixels > 0) & (pixels < [720, 576])).all()
