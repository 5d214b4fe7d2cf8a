"""Expected error of normals: its parts against slow loops, and what it says of surfaces, errors and gaps."""

import numpy as np
import pytest

from nishiki.photometric import expected_error as module
from nishiki.photometric.expected_error import WINDOW, correction_error, direction_groups, expected_error, slope_error


def relief(rows=40, columns=56, steep=0.5):
    """Normals of a smooth surface, whose slopes have no curl but for the pixel grid."""
    y, x = np.mgrid[:rows, :columns].astype(float)
    p = steep * np.cos(x / 9) * np.cos(y / 11)
    q = steep * 9 / 11 * np.sin(x / 9) * np.sin(y / 11)  # rows run down, y up
    return from_slopes(p, q)


def from_slopes(p, q):
    normals = np.dstack([-p, -q, np.ones_like(p)])
    return (normals / np.linalg.norm(normals, axis=2, keepdims=True)).astype(np.float32)


def slow_slope_error(normals, valid):
    """By the module's equations, pixel by pixel."""
    rows, columns = valid.shape
    p, q = -normals[..., 0] / normals[..., 2], -normals[..., 1] / normals[..., 2]
    curl = np.full((rows, columns), np.nan)
    for i in range(rows - 1):
        for j in range(columns - 1):
            if valid[i : i + 2, j : j + 2].all():
                across = (q[i, j + 1] - q[i, j] + q[i + 1, j + 1] - q[i + 1, j]) / 2
                upward = -(p[i + 1, j] - p[i, j] + p[i + 1, j + 1] - p[i, j + 1]) / 2
                curl[i, j] = upward - across
    for power in (1, 2):
        source, curl = curl, np.full_like(curl, np.nan)
        for i in range(rows):
            for j in range(columns):
                half = WINDOW // 2
                window = source[max(i - half, 0) : i + half + 1, max(j - half, 0) : j + half + 1]
                if np.isfinite(window).any():
                    curl[i, j] = np.nanmean(window**power) * (WINDOW / 4 if power == 1 else 1)
        if power == 1:
            curl[~np.isfinite(source)] = np.nan
    return np.sqrt(np.nan_to_num(curl))


def test_slope_error_agrees_with_slow_loops():
    random = np.random.default_rng(1)
    normals = from_slopes(*random.normal(0, 0.3, (2, 20, 24)))
    valid = random.uniform(size=(20, 24)) > 0.05
    assert slope_error(normals, valid) == pytest.approx(slow_slope_error(normals, valid), abs=2e-5)


def test_a_surface_has_less_than_normals_that_no_surface_has():
    normals = relief()
    valid = np.ones(normals.shape[:2], bool)
    sigma = np.full(valid.shape, 0.005, np.float32)
    good = expected_error(normals, sigma, valid)
    y, x = np.mgrid[: valid.shape[0], : valid.shape[1]]
    patch = np.exp(-((x - 28.0) ** 2 + (y - 20.0) ** 2) / 60)  # a smooth error of 6 degrees, which no residual shows
    p, q = -normals[..., 0] / normals[..., 2], -normals[..., 1] / normals[..., 2]
    bad = expected_error(from_slopes(p + 0.1 * patch, q), sigma, valid)
    assert bad[16:24, 24:32].mean() > 1.5 * good[16:24, 24:32].mean()
    assert np.allclose(bad[:, :4], good[:, :4], rtol=0.02)


def test_is_the_mean_square_of_sigma_where_no_curl_adds_to_it():
    flat, valid = from_slopes(np.zeros((20, 20)), np.zeros((20, 20))), np.ones((20, 20), bool)
    sigma = np.where(np.arange(20) % 2, 0.01, 0.03) * np.ones((20, 1))
    found = expected_error(flat, sigma, valid)
    assert np.allclose(found[5:15, 5:15], np.sqrt((0.01**2 + 0.03**2) / 2), rtol=0.1)


def test_groups_hold_neighbouring_lamps():
    """Of a dome every group is compact; a few lamps are a group each, also where two are alike."""
    random = np.random.default_rng(4)
    directions = random.normal([0, 0, 2], 1, (96, 3))
    directions[:, 2] = np.abs(directions[:, 2])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    groups = direction_groups(directions)
    assert sorted(set(groups)) == list(range(module.GROUPS))
    means = np.array([directions[groups == k].mean(axis=0) for k in range(module.GROUPS)])
    own = (directions * means[groups]).sum(axis=1)
    assert own.mean() > (directions @ means.T).mean() + 0.1
    assert (
        np.mean(own >= (directions @ (means / np.linalg.norm(means, axis=1, keepdims=True)).T).max(axis=1) - 0.1) > 0.9
    )
    assert len(set(direction_groups(directions[:5]))) == 5
    assert len(set(direction_groups(directions[[0, 1, 2, 2]]))) == 3


def test_pixels_without_an_estimate_are_unknown_and_touch_no_others():
    normals = relief()
    valid = np.ones(normals.shape[:2], bool)
    valid[:, 30:] = False
    sigma = np.full(valid.shape, 0.005, np.float32)
    found = expected_error(normals, sigma, valid)
    spoilt = normals.copy()
    spoilt[:, 30:] = [0, 0, 1]
    assert np.array_equal(found, expected_error(spoilt, sigma, valid))
    assert (found[~valid] == np.float32(module.UNKNOWN)).all()
    assert np.isfinite(expected_error(normals, sigma, np.zeros_like(valid))).all()


def test_slope_error_is_finite_beside_rough_ground():
    """Running sums leave a rest, of either sign, where a flat surface follows slopes of very different size."""
    random = np.random.default_rng(2)
    slopes = random.normal(0, 2, (2, 60, 90))
    slopes[:, :, 30:50] *= 1e-4
    slopes[:, :, 50:] = 0
    error = slope_error(from_slopes(*slopes), np.ones((60, 90), bool))
    assert np.isfinite(error).all()
    assert error[:, 62:].max() < 1e-5 < 0.1 < error[:, :25].min()


def test_errors_of_corrections_turn_normals_by_the_angle_that_is_stated():
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:20, :30]
    normals = np.stack([0.4 * np.sin(x / 4), 0.3 * np.cos(y / 3), np.ones((20, 30))], axis=2)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    albedo = 0.5 + 0.2 * np.sin(x / 3 + y / 5)
    azimuth, elevation = np.radians(np.arange(9) * 80), np.radians(np.tile([50.0, 60.0, 75.0], 3))
    lamps = np.column_stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)])
    lamps = np.column_stack([lamps, np.sin(elevation)])
    root, ambient, shift = 0.02 * rng.normal(size=(9, 9)), 0.01, np.linspace(0, 0.1, 9)
    stated = correction_error(normals, albedo, lamps, {"gains": root @ root.T, "ambient": ambient, "shift_px": shift})
    light = np.einsum("rcx,jx->jrc", normals * albedo[..., None], lamps)
    down, right = np.gradient(light, axis=(1, 2))
    squares = []
    for _ in range(400):
        gains, (dx, dy) = root @ rng.normal(size=9), shift * rng.normal(size=(2, 9))
        wrong = light * (1 + gains)[:, None, None] + ambient * rng.normal() * albedo
        wrong += dx[:, None, None] * right + dy[:, None, None] * down
        body = np.einsum("xj,jrc->rcx", np.linalg.pinv(lamps), wrong)
        body /= np.linalg.norm(body, axis=2, keepdims=True)
        squares.append(np.arccos(np.clip((body * normals).sum(axis=2), -1, 1)) ** 2)
    assert np.allclose(stated, np.sqrt(np.mean(squares, axis=0)), rtol=0.2)
