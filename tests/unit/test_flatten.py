"""Normals of flat objects flattened before the integration: detail is kept, the bowl goes."""

import numpy as np
import pytest

from nishiki.photometric import height
from nishiki.photometric.height import block_means, integrate_normals

ROWS, COLUMNS = 160, 240
ALL = np.ones((ROWS, COLUMNS), dtype=bool)


def flatten_normals(normals, valid):
    """Of fields in memory: the turned normals and the angle."""
    turned = np.full(normals.shape, np.nan, np.float32)
    return turned, height.flatten_normals(valid.shape, lambda rows: (normals[rows], valid[rows]), turned.__setitem__)


def normals_of(height):
    """Of heights (rows, columns) in pixels; y up."""
    slope_y, slope_x = np.gradient(height)
    normals = np.dstack([-slope_x, slope_y, np.ones_like(height)])
    return normals / np.linalg.norm(normals, axis=2, keepdims=True)


def places():
    """x to the right and y up, both 0 in the middle, in half widths."""
    row, column = np.mgrid[0:ROWS, 0:COLUMNS]
    return (column - (COLUMNS - 1) / 2) / (COLUMNS / 2), -(row - (ROWS - 1) / 2) / (COLUMNS / 2)


def ripples():
    """A relief of 3 pixels' amplitude on a plane, with a raised disk as of a coin that lies on a table."""
    x, y = places()
    row, column = np.mgrid[0:ROWS, 0:COLUMNS]
    disk = 8 / (1 + np.exp((np.hypot(x - 0.3, y) - 0.2) * 60))
    return 3 * np.sin(row / 4) * np.cos(column / 5) + disk


def tilted_by_near_lamps(normals, strength):
    """Turn each normal outwards by an angle that grows with the distance from the middle, and not only linearly."""
    x, y = places()
    lean = strength * np.stack([x + 0.3 * x**3, y + 0.2 * x * y], axis=-1)
    smooth = np.dstack([lean, np.ones_like(x)])
    smooth /= np.linalg.norm(smooth, axis=2, keepdims=True)
    axis = np.stack([-smooth[..., 1], smooth[..., 0], np.zeros_like(x)], axis=-1)
    along = np.einsum("rci,rci->rc", axis, normals) / (1 + smooth[..., 2])
    return normals * smooth[..., 2:] + np.cross(axis, normals) + axis * along[..., None]


def rms(height, truth):
    """Of the difference less its plane."""
    x, y = places()
    difference = (height - truth).ravel()
    terms = np.stack([np.ones(x.size), x.ravel(), y.ravel()], axis=1)
    return np.std(difference - terms @ np.linalg.lstsq(terms, difference, rcond=None)[0])


@pytest.mark.parametrize("strength", [0.1, 0.5, 1.5])
def test_the_bowl_of_a_slow_tilt_goes_and_the_relief_stays(strength):
    truth = ripples()
    wrong = tilted_by_near_lamps(normals_of(truth), strength)
    bent = integrate_normals(wrong)
    flat = integrate_normals(flatten_normals(wrong, ALL)[0])
    assert bent.bow > 0.02
    assert flat.bow < 0.01
    assert rms(bent.height, truth) > truth.std()
    assert rms(flat.height, truth) < 0.5 * truth.std()


def test_a_flat_field_with_detail_is_hardly_turned():
    truth = ripples()
    normals = normals_of(truth)
    turned, angle = flatten_normals(normals, ALL)
    assert np.degrees(angle) < 1.5
    np.testing.assert_allclose(np.linalg.norm(turned, axis=2), 1, atol=1e-5)


def test_a_tilted_plane_faces_the_camera():
    x, y = places()
    turned, angle = flatten_normals(normals_of(40 * x - 20 * y), ALL)
    np.testing.assert_allclose(turned, np.broadcast_to([0, 0, 1], turned.shape), atol=1e-4)
    assert angle == pytest.approx(np.arctan(np.hypot(40, 20) / (COLUMNS / 2)), rel=1e-3)


def test_pixels_outside_the_mask_do_nothing():
    x, y = places()
    valid = x**2 + y**2 < 0.3
    normals = tilted_by_near_lamps(normals_of(ripples()), 0.5)
    spoilt = np.where(valid[..., None], normals, np.nan)
    first, _ = flatten_normals(normals, valid)
    second, _ = flatten_normals(spoilt, valid)
    np.testing.assert_array_equal(first, second)
    assert not first[~valid].any()


def test_a_body_keeps_its_shape_unless_it_is_flattened():
    """A cap of a sphere is not a flat object; its bow is reported."""
    x, y = places()
    cap = COLUMNS / 2 * np.sqrt(4 - x**2 - y**2)
    field = integrate_normals(normals_of(cap))
    assert rms(field.height, cap) < 0.01 * cap.std()
    assert field.bow > 0.1
    assert np.ptp(integrate_normals(flatten_normals(normals_of(cap), ALL)[0]).height) < 0.1 * np.ptp(cap)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (5, 1), (300, 3)])
def test_small_and_narrow_fields(shape):
    normals = np.broadcast_to([0.6, 0.0, 0.8], (*shape, 3)).copy()
    turned, angle = flatten_normals(normals, np.ones(shape, dtype=bool))
    np.testing.assert_allclose(turned, np.broadcast_to([0, 0, 1], turned.shape), atol=1e-6)
    assert angle == pytest.approx(np.arcsin(0.6))


def test_nothing_valid_is_nothing_turned():
    turned, angle = flatten_normals(normals_of(ripples()), ~ALL)
    assert not turned.any()
    assert angle == 0


def test_block_means_are_at_the_middle_of_their_squares():
    mean, y, x = block_means(
        (256, 256),
        lambda rows: (np.broadcast_to([0.0, 0.0, 1.0], (256, 256, 3))[rows], np.ones((256, 256), bool)[rows]),
    )
    assert mean.shape == (128 * 128, 3)
    assert x.min() == pytest.approx(-1 + 1 / 255)
    assert x.max() == pytest.approx(1 - 1 / 255)
    assert y[0] == x[0]
