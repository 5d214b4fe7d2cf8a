"""Cameras of a turn from outlines and features: against slow references and exact silhouettes; and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import approx_fprime
from turned_cameras import FOCAL, SQUARE, TILT, cameras_at, outlines

from nishiki.errors import UserError
from nishiki.geometry.turn import turn_of
from nishiki.geometry.turn_estimate import Adjustment, Evidence, Matches, estimate_turn, reduce_grey


def estimate(masks, pictures=None, **how):
    pictures = pictures or [np.repeat(mask[..., None] * np.uint8(200), 3, axis=2) for mask in masks]
    return estimate_turn(
        [reduce_grey(picture) for picture in pictures], masks, tuple(map(str, range(len(masks)))), **how
    )


EVEN = np.arange(18) * 20.0


@pytest.fixture(scope="module")
def even():
    return outlines(EVEN)


def points_seen(angles_deg, count=40):
    """Matches of points that every neighbouring pair of views shares, exact."""
    points, cameras = np.random.default_rng(3).uniform(-0.6, 0.6, (count, 3)), cameras_at(angles_deg)
    seen = [camera.project(points)[0] for camera in cameras]
    pairs = [(k, (k + 1) % len(cameras)) for k in range(len(cameras))]
    pixels = np.concatenate([np.stack([seen[a], seen[b]], axis=1) for a, b in pairs])
    return Matches(np.repeat(pairs, count, axis=0), pixels)


def true_start():
    return np.array([np.log(FOCAL / 320), TILT, 0.0, 0.0])


def test_exact_points_leave_no_residual_and_wrong_cameras_leave_that_of_the_sampson_kind(even):
    evidence = Evidence(even, points_seen(EVEN))
    exact = Adjustment(evidence, 1, true_start())
    assert np.abs(exact.residuals(exact.values)[evidence.kinds]).max() < 1e-9
    # to first order the residual is the distance in pixels by which one must move points for the rays to meet
    moved = replace(
        evidence.matches, pixels=evidence.matches.pixels + np.random.default_rng(1).normal(0, 0.01, (720, 2, 2))
    )
    evidence.matches = moved
    off = exact.residuals(exact.values)[evidence.kinds] * exact.sigmas[1]
    # (a little off the axis of the camera a pixel is a smaller angle)
    np.testing.assert_allclose(np.abs(off), slow_distances(moved), rtol=0.03, atol=1e-5)


def slow_distances(matches):
    """Sampson's distance of each match, by its fundamental matrix, one match at a time."""
    cameras, out = cameras_at(EVEN), []
    centre = np.array([159.5, 119.5])
    for (a, b), pixels in zip(matches.views, matches.pixels, strict=True):
        rotation = cameras[b].rotation @ cameras[a].rotation.T
        shift = cameras[b].rotation @ (cameras[a].centre - cameras[b].centre)
        cross = np.cross(np.eye(3), shift)
        inverse = np.linalg.inv(SQUARE)
        fundamental = inverse.T @ cross.T @ rotation @ inverse
        first, second = (np.append(pixel + centre, 1) for pixel in pixels)
        lines = np.concatenate([(fundamental @ first)[:2], (fundamental.T @ second)[:2]])
        out.append(abs(second @ fundamental @ first) / np.linalg.norm(lines))
    return np.array(out)


def test_the_jacobian_is_that_of_dense_differences(even):
    evidence = Evidence(even[::2], points_seen(EVEN[::2], 5))
    fit = Adjustment(evidence, 1, true_start() + 0.01, free=True)
    values = fit.values + np.random.default_rng(2).normal(0, 0.01, len(fit.values))
    found = fit.jacobian(values)
    dense = approx_fprime(values, fit.residuals, 1e-7)
    # where the tangent goes over to the next corner of an outline the difference of the slow one is none
    assert np.mean(np.isclose(found, dense, rtol=1e-3, atol=1e-2 * np.abs(dense).max())) > 0.999


@pytest.mark.parametrize("backwards", [False, True])
def test_outlines_alone_give_focal_length_tilt_and_sense(even, backwards):
    found = estimate(even[::-1] if backwards else even)
    assert found.steps == "equal"
    assert not found.uneven_steps_deg
    assert abs(found.focal_px / FOCAL - 1) < max(0.03, 2.5 * found.focal_sd_px / FOCAL)
    assert found.tilt_deg == pytest.approx(np.degrees(TILT), abs=0.5)
    assert np.sign(found.angles_deg[1]) == (-1 if backwards else 1)
    assert found.left_out_px < 0.3
    circle = turn_of(np.array([camera.centre for camera in found.cameras]))
    assert circle.full
    assert abs(circle.axis[2]) == pytest.approx(1, abs=1e-9)
    assert circle.radius == pytest.approx(1)


def test_a_stated_height_gives_the_scale(even):
    found = estimate(even, height=160.0)  # of balls from -0.85 to 0.82
    assert found.height == pytest.approx(160)
    distance = 5 * np.cos(TILT) * 160 / 1.67
    assert turn_of(np.array([c.centre for c in found.cameras])).radius == pytest.approx(distance, rel=0.06)


def test_a_known_lens_is_kept(even):
    found = estimate(even, intrinsics=SQUARE)
    assert found.focal_px == FOCAL
    assert found.focal_sd_px < 1e-6
    assert found.tilt_deg == pytest.approx(np.degrees(TILT), abs=0.5)


@pytest.mark.parametrize("fault", ["missing", "slipped", "twice", "exchanged"])
def test_unequal_steps_are_found(fault):
    angles = {
        "missing": np.delete(EVEN, 7),
        "slipped": EVEN + 6.0 * (EVEN >= 180),
        "twice": np.sort(np.append(EVEN, EVEN[5])),
        "exchanged": EVEN[[*range(4), 5, 4, *range(6, 18)]],
    }[fault]
    found = estimate(outlines(angles))
    error = np.array(found.angles_deg) - angles
    assert found.steps == "free"
    assert np.abs(error - np.median(error)).max() < max(1.0, 3 * found.angle_sd_deg)
    assert found.left_out_px < 0.7 * found.left_out_equal_px
    odd = {
        "missing": ["6 to 7"],
        "slipped": ["8 to 9", "17 to 0"],
        "twice": ["5 to 6"],
        "exchanged": ["3 to 4", "4 to 5", "5 to 6"],
    }[fault]
    assert list(found.uneven_steps_deg) == odd


@pytest.mark.parametrize("body", ["round", "nearly", "still", "few", "empty", "cut"])
def test_what_is_not_determined_is_refused(even, body):
    masks = {
        "round": lambda: outlines(EVEN, (((0.0, 0.0, 0.0), 0.7),)),
        # both senses fit far within a pixel's rounding, and the wrong one better
        "nearly": lambda: outlines(np.arange(12) * 30.0, (((0.0, 0.0, 0.0), 0.7), ((0.3, 0.0, 0.3), 0.3))),
        "still": lambda: [even[0]] * 18,
        "few": lambda: even[:7],
        "empty": lambda: [*even[:-1], np.zeros_like(even[0])],
        "cut": lambda: [mask[60:] for mask in even],
    }[body]()
    with pytest.raises(UserError):
        estimate(masks)
