"""Parcels: near lamps seen from every pixel, against the direction computed pixel by pixel."""

from types import SimpleNamespace

import numpy as np
import pytest

from nishiki.observations.plane import TOLERANCE_RAD, parcels

ROWS, COLUMNS, PITCH = 60, 90, 0.1
POSITIONS = np.array([[0.0, 30.0, 400.0], [300.0, 0.0, 250.0], [-100.0, -200.0, 300.0]])


def scene(positions=POSITIONS, white_board=True):
    directions = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    return SimpleNamespace(
        positions_mm=positions,
        directions=directions,
        shape=(ROWS, COLUMNS),
        pixel_pitch_mm=PITCH,
        image_centre=((ROWS - 1) / 2, (COLUMNS - 1) / 2),
        white_board=white_board,
    )


def towards(row, column, position):
    """Vector from a pixel to a lamp, written out."""
    x = (column - (COLUMNS - 1) / 2) * PITCH
    y = ((ROWS - 1) / 2 - row) * PITCH
    return np.array([position[0] - x, position[1] - y, position[2]])


@pytest.mark.parametrize("band", [slice(0, ROWS), slice(16, 32)])
def test_every_pixel_lies_in_one_parcel_whose_directions_are_its_own(band):
    seen = np.zeros((band.stop - band.start, COLUMNS), int)
    for parcel in parcels(scene(), band, np.arange(3)):
        seen[parcel.rows, parcel.columns] += 1
        for row in (parcel.rows.start, parcel.rows.stop - 1):
            for column in (parcel.columns.start, parcel.columns.stop - 1):
                for j, position in enumerate(POSITIONS):
                    own = towards(band.start + row, column, position)
                    cosine = parcel.directions[j] @ own / np.linalg.norm(own)
                    assert np.arccos(min(1.0, cosine)) < 1.05 * TOLERANCE_RAD
    assert (seen == 1).all()


def test_fall_off_is_undone_where_no_board_has_done_it():
    (first, *_) = parcels(scene(white_board=False), slice(0, ROWS), np.arange(3))
    row, column = (first.rows.stop - 1) / 2, (first.columns.stop - 1) / 2
    for j, position in enumerate(POSITIONS):
        squared = (np.linalg.norm(towards(row, column, position)) / np.linalg.norm(position)) ** 2
        assert first.scale[j] == pytest.approx(squared, rel=1e-6)
    (first, *_) = parcels(scene(white_board=True), slice(0, ROWS), np.arange(3))
    assert (first.scale == 1).all()


def test_distant_lamps_need_one_parcel():
    distant = scene()
    distant.positions_mm = None
    (only,) = parcels(distant, slice(8, 24), np.array([2, 0]))
    assert (only.rows, only.columns) == (slice(0, 16), slice(0, COLUMNS))
    assert np.array_equal(only.directions, distant.directions[[2, 0]])


def test_lamps_that_are_very_near_have_small_parcels_where_these_are_few():
    near = scene(POSITIONS / 20)
    sides = {parcel.rows.stop - parcel.rows.start for parcel in parcels(near, slice(0, ROWS), np.arange(3))}
    assert sides == {2}
    near.shape = (6000, COLUMNS)
    assert next(parcels(near, slice(0, ROWS), np.arange(3))).rows.stop == 8


@pytest.mark.parametrize("white_board", [True, False])
def test_normals_of_a_parcel_are_corrected_to_those_of_pixel_by_pixel_directions(white_board):
    near = scene(np.append(POSITIONS, [[20.0, -15.0, 90.0], [-60.0, 40.0, 70.0]], axis=0) / 3, white_board=white_board)
    rng = np.random.default_rng(1)
    true = np.concatenate([rng.uniform(-0.4, 0.4, (ROWS, COLUMNS, 2)), np.ones((ROWS, COLUMNS, 1))], axis=2)
    true /= np.linalg.norm(true, axis=2, keepdims=True)
    before, after, levels = [], [], []
    for parcel in parcels(near, slice(0, ROWS), np.arange(5)):
        area = true[parcel.rows, parcel.columns]
        places = np.mgrid[parcel.rows, parcel.columns].transpose(1, 2, 0)
        lamps = np.array([[[towards(*place, lamp) for lamp in near.positions_mm] for place in row] for row in places])
        distance = np.linalg.norm(lamps, axis=3)
        seen = 0.7 * np.einsum("rclk,rck->rcl", lamps, area) / distance
        if not white_board:
            seen *= np.square(np.linalg.norm(near.positions_mm, axis=1) / distance)
        vectors = (seen * parcel.scale) @ np.linalg.pinv(parcel.directions).T
        albedo = np.linalg.norm(vectors, axis=2)
        maps = {"normals": vectors / albedo[..., None], "albedo": albedo, "reflectance": albedo[..., None]}
        better = parcel.at_pixels(maps)
        for found, errors in ((maps, before), (better, after)):
            errors.append(np.linalg.norm(found["normals"] - area, axis=2).ravel())
        levels.append(better["albedo"].ravel())
        np.testing.assert_array_equal(better["albedo"], better["reflectance"][..., 0])
    assert np.concatenate(after).mean() < 0.1 * np.concatenate(before).mean()
    assert np.concatenate(levels) == pytest.approx(0.7, rel=0.02)
