"""Silhouettes of painted bodies whose true outline is known, before backgrounds of several kinds."""

import cv2
import numpy as np
import pytest
from turned_cameras import box, torus, turn

from nishiki.geometry.hull import carve
from nishiki.geometry.placement import agreement, find_overruled, outline_of, shade_from_camera
from nishiki.geometry.silhouettes import cover_of, display, inside_of, live_area, nearest_colour, segment

ROWS, COLUMNS = 240, 320


def body_mask():
    """A ring with an arm: one part, one hole."""
    fine = np.zeros((4 * ROWS, 4 * COLUMNS), np.uint8)
    cv2.circle(fine, (640, 480), 300, 1, -1)
    cv2.circle(fine, (620, 500), 110, 0, -1)
    cv2.rectangle(fine, (900, 440), (1150, 500), 1, -1)
    return fine


def photograph(background, body, *, seed=0, shadow=0.0, noise=2.0, times=1):
    """sRGB picture of the body: smooth background, texture on the body, edges mixed in linear light, noise; and the
    truth: at least half a pixel covered."""
    rng = np.random.default_rng(seed)
    rows, columns = times * ROWS, times * COLUMNS
    cover = cv2.resize(body_mask().astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA)
    x, y = np.meshgrid(np.linspace(-1, 1, columns), np.linspace(-1, 1, rows))
    behind = np.asarray(background, float) * (1 + 0.15 * x + 0.1 * y)[..., None]
    behind *= (1 - shadow * np.exp(-((x - 0.1) ** 2 + (y - 0.8) ** 2) / 0.05))[..., None]
    texture = cv2.GaussianBlur(rng.normal(size=(rows, columns)), (0, 0), 2)
    front = np.asarray(body, float) * (1 + 1.2 * texture)[..., None].clip(0.4, 2)
    light = np.clip(front * cover[..., None] + behind * (1 - cover[..., None]), 0, 1)
    light = cv2.GaussianBlur(light, (0, 0), 0.7)
    coded = 255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.clip(np.round(coded + noise * rng.normal(size=coded.shape)), 0, 255).astype(np.uint8), cover >= 0.5


CASES = {
    "blue": ((0.10, 0.13, 0.45), (0.5, 0.25, 0.08)),
    "green": ((0.08, 0.4, 0.1), (0.5, 0.3, 0.25)),
    "dark": ((0.004, 0.004, 0.004), (0.3, 0.3, 0.28)),
    "bright": ((0.8, 0.8, 0.8), (0.15, 0.12, 0.1)),
}


@pytest.mark.parametrize("named", [False, True])
@pytest.mark.parametrize("kind", CASES)
def test_outline_is_where_the_body_ends(kind, named):
    picture, truth = photograph(*CASES[kind])
    found = segment(picture, background=kind if named else "auto")
    assert agreement(found.mask, truth) > 0.985
    assert found.parts == 1
    assert found.holes > 500
    assert found.separation > 2
    outline = cv2.dilate(truth.astype(np.uint8), np.ones((5, 5))) - cv2.erode(truth.astype(np.uint8), np.ones((5, 5)))
    assert (found.mask == truth)[outline == 0].mean() > 0.9995


def test_a_shadow_on_a_coloured_cloth_is_background():
    picture, truth = photograph(*CASES["blue"], shadow=0.6)
    assert agreement(segment(picture).mask, truth) > 0.98


def test_black_strips_of_a_camera_are_no_object():
    picture, truth = photograph(*CASES["blue"])
    picture[:, -12:] = 3
    picture[:4] = 2
    rows, columns = live_area(picture)
    assert (rows.start, rows.stop, columns.start, columns.stop) == (4, ROWS, 0, COLUMNS - 12)
    assert agreement(segment(picture).mask, truth) > 0.98


def test_a_black_background_has_no_black_strips():
    """A body that reaches into the border of a dark picture: its tip is no strip of a camera."""
    picture = np.full((200, 160, 3), 2, np.uint8)
    cv2.ellipse(picture, (80, 150), (20, 46), 0, 0, 360, (150, 160, 90), -1)
    truth = picture[..., 0] > 100
    assert truth[193:].any()
    rows, columns = live_area(picture)
    assert (rows.start, rows.stop, columns.start, columns.stop) == (0, 200, 0, 160)
    assert segment(picture, background="dark").mask[truth].mean() > 0.99


def test_dust_goes_and_large_pictures_keep_their_detail():
    picture, _truth = photograph(*CASES["blue"])
    picture[20:23, 30:34] = 250
    found = segment(picture)
    assert found.dropped[20:23, 30:34].sum() >= 6
    assert not found.mask[15:30, 25:40].any()
    large, whole = photograph(*CASES["blue"], times=4)
    assert agreement(segment(large).mask, whole) > 0.995


def test_cover_moves_an_outline_that_was_drawn_too_wide():
    picture, truth = photograph(*CASES["blue"], noise=0.5)
    wide = cv2.dilate(truth.astype(np.uint8), np.ones((3, 3))) > 0
    assert agreement(wide, truth) < 0.97
    assert agreement(inside_of(cover_of(picture, wide)), truth) > 0.985


@pytest.mark.parametrize("radius", [25, 60, 110])
def test_a_rim_that_shades_to_black_is_not_taken_for_background(radius):
    """A matt ball lit from the camera before black, blurred by a lens: as large as it is, to two thirds of a pixel."""
    size = 256
    fine = (np.arange(4 * size) + 0.5) / 4 - size / 2
    square = np.maximum(1 - (fine[:, None] ** 2 + fine**2) / radius**2, 0)
    linear = cv2.GaussianBlur(np.sqrt(square).astype(np.float32), (0, 0), 4 * 0.6)
    linear = cv2.resize(linear, (size, size), interpolation=cv2.INTER_AREA)[..., None] * np.array([0.8, 0.5, 0.3])
    noise = np.random.default_rng(radius).normal(0, 0.002, linear.shape)
    mask = segment(display((linear + noise).astype(np.float32)), background="dark").mask
    assert abs(np.sqrt(mask.sum() / np.pi) - radius) < 0.67


@pytest.mark.parametrize("radius", [2.5, 4.0, 20.0])
def test_cover_of_a_round_rod_lit_from_the_camera(radius):
    """The rod's rims shade to black: its width is right to 0.4 pixels, where 1.2 of 8 were lost."""
    row, column = np.mgrid[:480, :480] / 4.0
    across = ((column - 60) * np.cos(0.2) + (row - 60) * np.sin(0.2)) / radius
    linear = cv2.GaussianBlur(np.sqrt(np.maximum(1 - across**2, 0)).astype(np.float32), (0, 0), 4 * 0.5)
    linear = cv2.resize(linear, (120, 120), interpolation=cv2.INTER_AREA)[..., None] * np.array([0.8, 0.5, 0.3])
    noise = np.random.default_rng(1).normal(0, 0.002, linear.shape)
    found = segment(display((linear + noise).astype(np.float32)), background="dark")
    np.testing.assert_array_equal(found.mask, inside_of(found.cover))
    width = found.cover[20:-20].sum() / 255 / 80 * np.cos(0.2)
    assert width == pytest.approx(2 * radius, abs=0.45)


def test_display_of_one_channel_and_of_darkness():
    assert display(np.zeros((5, 6, 3), np.float32)).max() == 0
    grey = display(np.linspace(0, 0.01, 30, dtype=np.float32).reshape(5, 6, 1))
    assert grey.shape == (5, 6, 3)
    assert grey.max() > 230
    assert (grey[..., 0] == grey[..., 2]).all()


def test_background_that_a_view_sees_alone_is_overruled():
    cameras = turn(elevation=0.9)
    true = [torus(camera) for camera in cameras]
    masks = [mask.copy() for mask in true]
    masks[5][:4, :4] = True  # a thing that no other view confirms
    masks[8][:, 80:] &= False  # half of the body missed
    loose = carve(masks, cameras, cells=64, misses=1)
    bright = np.zeros(masks[0].shape, bool)
    more = [find_overruled(loose.mesh, *view, bright, loose.cell) for view in zip(cameras, masks, strict=True)]
    lost = true[8] & ~masks[8]
    assert (more[8] & lost).sum() > 0.9 * lost.sum()
    for each, mask, body in zip(more, masks, true, strict=True):
        assert not (each & mask).any()
        assert (each & ~body).sum() < 0.04 * body.sum()  # the hole stays open, and the outline where it is


def test_a_dark_gap_across_a_thin_part_is_overruled_and_a_bright_one_is_not():
    cameras = turn(elevation=0.9)
    masks = [torus(camera, small=0.05) for camera in cameras]
    true = masks[3].copy()
    middle = np.argwhere(true).mean(axis=0)
    gap = true & (np.abs(np.arange(true.shape[1]) - middle[1]) < 4) & (np.arange(len(true))[:, None] > middle[0])
    masks[3] = true & ~gap
    loose = carve(masks, cameras, cells=64, misses=1)
    left = true & (np.arange(true.shape[1]) < middle[1])  # half of the ring, too long a gap to be closed across
    without = find_overruled(loose.mesh, cameras[3], true & ~left, np.ones(true.shape, bool), loose.cell)
    assert (without & left).sum() > 0.9 * left.sum()
    for dark in (True, False):
        more = find_overruled(loose.mesh, cameras[3], masks[3], np.full(true.shape, dark), loose.cell)
        assert ((more & gap).sum() > 0.6 * gap.sum()) == dark


def test_outline_and_shading_of_a_mesh():
    import trimesh

    from nishiki.geometry.mesh import Mesh

    block = trimesh.creation.box((1.0, 0.7, 1.2))
    mesh = Mesh.of(block.vertices, block.faces)
    for camera in turn(5):
        assert agreement(outline_of(mesh, camera), box(camera)) > 0.999
        picture = shade_from_camera(mesh, camera)
        assert (picture[~outline_of(mesh, camera)] == 20).all()
        assert picture[outline_of(mesh, camera)].min() >= 30


def test_distance_to_the_background_against_its_definition():
    rng = np.random.default_rng(2)
    lab = rng.uniform(-40, 100, (200, 3)).astype(np.float32)
    centres = rng.uniform(-40, 100, (4, 3))
    roots = rng.normal(size=(4, 3, 3)) / 8
    inverses = roots @ roots.transpose(0, 2, 1) + 0.001 * np.eye(3)
    lowest = np.array([1.0, 0.5, 1.0, 0.8])
    found = np.full(200, 100, np.float32)
    nearest_colour(lab, centres, inverses, lowest, found)
    scales = [np.linspace(low, 1, 2001) for low in lowest]
    for colour, distance in zip(lab.astype(float), found, strict=True):
        each = []
        for centre, inverse, scale in zip(centres, inverses, scales, strict=True):
            off = colour - scale[:, None] * centre
            each.append(np.sqrt(np.einsum("si,ij,sj->s", off, inverse, off).min()))
        assert distance == pytest.approx(min(100, *each), rel=1e-3, abs=2e-3)
