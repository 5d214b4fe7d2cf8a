"""Poses from correspondences: noise, outliers, slow reference, degenerate cases; one axis for all views."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused

from nishiki.errors import UserError
from nishiki.geometry.camera import Camera
from nishiki.geometry.pose import Sight, choose_poses, estimate_pose, fit_turntable, refine_pose

ROWS, COLUMNS = 480, 640
LENS = np.array([[700.0, 0, 310.0], [0, 690.0, 250.0], [0, 0, 1]])
DISTORTION = (-0.15, 0.05, 0.001, -0.002, 0.0)


def rotation(vector) -> np.ndarray:
    return cv2.Rodrigues(np.asarray(vector, float))[0]


def camera_of(vector, shift, *, lens=LENS, distortion=DISTORTION, name="v") -> Camera:
    return Camera(name, np.asarray(lens, float), rotation(vector), np.asarray(shift, float), ROWS, COLUMNS, distortion)


def pose_of(camera, points, pixels, *, outlier_px=3.0):
    return estimate_pose(
        Sight("left", points, pixels),
        camera.intrinsics,
        camera.distortion,
        rows=ROWS,
        columns=COLUMNS,
        outlier_px=outlier_px,
    )


def slow_pose(camera: Camera, points, pixels) -> tuple[np.ndarray, np.ndarray]:
    """The same minimum by a general optimiser from the true pose, numeric derivatives, nothing shared but the lens."""
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    def residuals(x):
        seen = Rotation.from_rotvec(x[:3]).apply(points) + x[3:]
        a, b = seen[:, 0] / seen[:, 2], seen[:, 1] / seen[:, 2]
        k1, k2, p1, p2, k3 = camera.distortion
        r = a * a + b * b
        radial = 1 + k1 * r + k2 * r**2 + k3 * r**3
        ad = a * radial + 2 * p1 * a * b + p2 * (r + 2 * a * a)
        bd = b * radial + p1 * (r + 2 * b * b) + 2 * p2 * a * b
        k = camera.intrinsics
        return np.concatenate(
            [k[0, 0] * ad + k[0, 1] * bd + k[0, 2] - pixels[:, 0], k[1, 1] * bd + k[1, 2] - pixels[:, 1]]
        )

    start = np.concatenate([Rotation.from_matrix(camera.rotation).as_rotvec(), camera.translation])
    fit = least_squares(residuals, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return Rotation.from_rotvec(fit.x[:3]).as_matrix(), fit.x[3:]


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    scale=st.sampled_from([1e-6, 1.0, 1e6]),
    count=st.integers(6, 40),
    skew=st.sampled_from([0.0, 30.0]),
)
def test_exact_points_give_the_exact_pose_at_any_scale(seed, scale, count, skew):
    rng = np.random.default_rng(seed)
    lens = LENS + np.array([[0, skew, 0], [0, 0, 0], [0, 0, 0]])
    camera = camera_of(rng.normal(size=3), scale * np.array([0.3, -0.2, 6.0]), lens=lens)
    points = scale * rng.uniform(-1, 1, (count, 3))
    pixels, _ = camera.project(points)
    found = pose_of(camera, points, pixels)
    assert found.inliers.all()
    assert found.rms_px < 1e-5
    np.testing.assert_allclose(found.camera.rotation, camera.rotation, atol=1e-6)
    np.testing.assert_allclose(found.camera.translation, camera.translation, atol=1e-5 * scale)


@pytest.mark.parametrize("seed", range(4))
def test_noise_and_a_third_of_outliers_against_the_slow_reference(seed):
    rng = np.random.default_rng(seed)
    camera = camera_of(rng.normal(size=3), (0.2, 0.1, 7))
    points = rng.uniform(-1.5, 1.5, (30, 3))
    pixels = camera.project(points)[0] + rng.normal(0, 0.5, (30, 2))
    wrong = rng.choice(30, 10, replace=False)
    pixels[wrong] += rng.choice([-1, 1], (10, 2)) * rng.uniform(15, 200, (10, 2))
    found = pose_of(camera, points, pixels)
    right = np.setdiff1d(np.arange(30), wrong)
    np.testing.assert_array_equal(np.flatnonzero(found.inliers), right)
    expected_rotation, expected_shift = slow_pose(camera, points[right], pixels[right])
    np.testing.assert_allclose(found.camera.rotation, expected_rotation, atol=1e-6)
    np.testing.assert_allclose(found.camera.translation, expected_shift, atol=1e-5)
    assert 0.3 < found.rms_px < 1.0


def test_same_input_same_output():
    rng = np.random.default_rng(2)
    camera = camera_of((0.2, 0.4, -0.1), (0, 0, 5))
    points = rng.uniform(-1, 1, (25, 3))
    pixels = camera.project(points)[0] + rng.normal(0, 1, (25, 2))
    first, second = pose_of(camera, points, pixels), pose_of(camera, points, pixels)
    np.testing.assert_array_equal(first.camera.matrix, second.camera.matrix)


def seen(points):
    camera = camera_of((0.3, -0.2, 0.1), (0, 0, 5))
    return camera, points, camera.project(points)[0]


def test_degenerate_sets_name_view_and_remedy():
    rng = np.random.default_rng(7)
    scattered = rng.uniform(-1, 1, (12, 3))
    line = np.outer(np.linspace(-1, 1, 12), [1, 0.5, 0.2])
    with refused(UserError, "4", "3", by="_expect_spread"):
        pose_of(*seen(scattered[:3]))
    with refused(UserError, "left"):
        pose_of(*seen(line))
    with refused(UserError, "left"):
        pose_of(*seen(np.repeat(scattered[:2], 4, axis=0)))
    camera, points, pixels = seen(scattered)
    with pytest.raises(UserError, match=r"'left': .*swapped"):
        pose_of(camera, points, rng.uniform(0, 480, pixels.shape))
    with refused(UserError, "left"):
        pose_of(camera, points, np.where(np.arange(12)[:, None] == 3, np.nan, pixels))
    on_a_row = pixels * [1, 0] + [0, 200]
    with refused(UserError, "left"):
        pose_of(camera, points, on_a_row)


def test_points_of_a_mirrored_world_do_not_pass():
    """Left-handed coordinates would need the object behind the camera."""
    rng = np.random.default_rng(8)
    camera, points, pixels = seen(rng.uniform(-1, 1, (20, 3)))
    with pytest.raises(UserError, match=r"'left': .*right-handed"):
        pose_of(camera, points * [1, 1, -1], pixels)


def test_small_flat_sets_far_away_are_ambiguous_and_said_so():
    rng = np.random.default_rng(1)
    camera = camera_of((0.0, 0.6, 0.0), (0, 0, 60), distortion=(0.0,) * 5)
    corners = np.array([[x, y, 0.0] for x in (-1, 0, 1) for y in (-1, 0, 1)])
    pixels = camera.project(corners)[0] + rng.normal(0, 0.3, (9, 2))
    with refused(UserError, "left"):
        pose_of(camera, corners, pixels)
    near = camera_of((0.0, 0.6, 0.0), (0, 0, 6), distortion=(0.0,) * 5)
    found = pose_of(near, corners, near.project(corners)[0] + rng.normal(0, 0.3, (9, 2)))
    assert np.degrees(np.linalg.norm(cv2.Rodrigues(found.camera.rotation @ near.rotation.T)[0])) < 2


def turntable(*, views=12, noise=0.4, count=12, wobble=0.0, seed=0, steps=None):
    """Sights and true cameras of an object turned before a camera at rest."""
    rng = np.random.default_rng(seed)
    axis = np.array([0.1, 1.0, -0.2]) / np.linalg.norm([0.1, 1.0, -0.2])
    point, rest, shift = np.array([0.3, 0.0, -0.2]), rotation((0.4, 0.1, 0.05)), np.array([0.1, 0.2, 8.0])
    angles = 2 * np.pi * np.arange(views) / views if steps is None else np.concatenate([[0], np.cumsum(steps)])
    sights, cameras = [], []
    for k, angle in enumerate(angles):
        turn = rotation(angle * axis)
        shaken = rotation(rng.normal(0, wobble, 3))
        camera = Camera(
            str(k), LENS, shaken @ rest @ turn, shift + rest @ (point - turn @ point), ROWS, COLUMNS, DISTORTION
        )
        points = rng.uniform(-1, 1, (count, 3))
        cameras.append(camera)
        sights.append(Sight(str(k), points, camera.project(points)[0] + rng.normal(0, noise, (count, 2))))
    return sights, cameras, axis, point, np.degrees(angles)


def own_poses(sights, cameras):
    return [refine_pose(c, s.points, s.pixels) for c, s in zip(cameras, sights, strict=True)]


def centre_error(found, cameras):
    return np.sqrt(np.mean([np.sum((a.centre - b.centre) ** 2) for a, b in zip(found, cameras, strict=True)]))


@pytest.mark.parametrize("steps", ["free", "equal"])
def test_exact_turns_are_recovered_exactly(steps):
    sights, cameras, axis, point, angles = turntable(noise=0.0)
    found = fit_turntable(sights, own_poses(sights, cameras), steps=steps, full_turn=True)
    sense = np.sign(found.axis @ axis)
    np.testing.assert_allclose(found.axis * sense, axis, atol=1e-7)
    np.testing.assert_allclose(np.remainder(found.angles_deg * sense + 1e-3, 360), angles + 1e-3, atol=1e-4)
    across = np.eye(3) - np.outer(axis, axis)
    np.testing.assert_allclose(across @ found.point, across @ point, atol=1e-6)
    assert found.rms_px < 1e-5


def test_equal_steps_of_a_part_of_a_turn():
    sights, cameras, axis, _, angles = turntable(views=7, steps=np.radians([-8.0] * 6), noise=0.1)
    found = fit_turntable(sights, own_poses(sights, cameras), steps="equal")
    np.testing.assert_allclose(found.angles_deg * np.sign(found.axis @ axis), angles, atol=0.3)
    assert np.ptp(np.diff(found.angles_deg)) < 1e-9


def test_one_axis_helps_where_points_are_noisy():
    sights, cameras, *_ = turntable(noise=1.0, count=8)
    own = own_poses(sights, cameras)
    choice = choose_poses(sights, own)
    assert choice.on_axis
    assert choice.turn_px < choice.free_px
    assert centre_error(choice.cameras, cameras) < 0.6 * centre_error(own, cameras)


def test_one_axis_is_refused_where_the_table_wobbles():
    sights, cameras, *_ = turntable(noise=0.2, count=20, wobble=0.01)
    own = own_poses(sights, cameras)
    choice = choose_poses(sights, own)
    assert not choice.on_axis
    assert choice.turn_px > 2 * choice.free_px
    assert choice.cameras == tuple(own)


def test_too_few_points_to_leave_any_out():
    sights, cameras, *_ = turntable(noise=0.1, count=5)
    choice = choose_poses(sights, own_poses(sights, cameras))
    assert not choice.on_axis
    assert choice.free_px is None
