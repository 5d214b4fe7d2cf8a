"""Overlaps of fields against the truth of a generator; flat areas and repeated ornaments are not matched silently."""

from dataclasses import replace

import numpy as np
import pytest
from mosaics import cut_relief, painted_relief

from nishiki.errors import UserError
from nishiki.mosaic.adjustment import adjust
from nishiki.mosaic.registration import enlarge, fit_similarity, match_window, reduce_field, register_fields, signals

ROWS, COLUMNS = 420, 560


@pytest.fixture(scope="module")
def mosaic():
    return cut_relief(*painted_relief(ROWS, COLUMNS))


@pytest.fixture(scope="module")
def overlaps(mosaic):
    return register_fields(mosaic.fields)


def apart(mosaic, overlap) -> np.ndarray:
    """Distance in pixels between the two places of each match, in truth."""
    ends = [mosaic.true_places(i, overlap.points[k]) for k, i in enumerate((overlap.first, overlap.second))]
    return np.linalg.norm(ends[0] - ends[1], axis=1)


def test_matches_of_all_neighbours_are_right_to_a_tenth_of_a_pixel(mosaic, overlaps):
    assert {(o.first, o.second) for o in overlaps} >= {(0, 1), (0, 2), (1, 3), (2, 3)}
    for overlap in overlaps:
        assert not overlap.problem
        assert np.sqrt(np.mean(apart(mosaic, overlap) ** 2)) < 0.1


def test_covariance_covers_the_errors(mosaic, overlaps):
    inverse = [np.linalg.inv(o.covariance) for o in overlaps]
    squares = []
    for overlap, weights in zip(overlaps, inverse, strict=True):
        ends = [mosaic.true_places(i, overlap.points[k]) for k, i in enumerate((overlap.first, overlap.second))]
        error = ends[1] - ends[0]
        squares.append(np.einsum("ni,nij,nj->n", error, weights, error))
    assert 0.2 < np.median(np.concatenate(squares)) / 1.39 < 5  # 1.39: median for two Gaussian components


def test_order_and_positions_need_not_be_known(mosaic, overlaps):
    blind = cut_relief(*painted_relief(ROWS, COLUMNS), stated=False)
    found = register_fields(blind.fields[::-1])
    assert {(o.first, o.second) for o in found} >= {(0, 1), (0, 2), (1, 3), (2, 3)}
    for overlap in found:
        ends = [mosaic.true_places(3 - i, overlap.points[k]) for k, i in enumerate((overlap.first, overlap.second))]
        assert np.sqrt(np.mean(np.square(ends[0] - ends[1]).sum(axis=1))) < 0.1


def test_fields_of_other_sizes_are_matched(mosaic):
    """A field at the object's edge is cropped to its mask: 95 rows of it are left."""
    whole, below = mosaic.fields[0], mosaic.fields[2]
    narrow = replace(below, shape=(95, below.shape[1]))
    (found,) = register_fields([replace(whole, stated=None), replace(narrow, stated=None)])
    ends = [mosaic.true_places(k, points) for k, points in zip((0, 2), found.points, strict=True)]
    assert not found.problem
    assert np.sqrt(np.mean(np.square(ends[0] - ends[1]).sum(axis=1))) < 0.1


def test_reduced_field_is_the_mean_over_squares_of_what_is_known(mosaic):
    field = mosaic.fields[0]
    values, known = field.read(slice(None), slice(None))
    step = 3
    reduced = reduce_field(field, step)
    got, _ = reduced.read(slice(None), slice(None))
    for row, column in ((0, 0), (5, 7), (reduced.shape[0] - 1, reduced.shape[1] - 1)):
        square = np.s_[row * step : (row + 1) * step, column * step : (column + 1) * step]
        assert np.allclose(got[row, column], values[square][known[square]].mean(axis=0), atol=1e-5)
    assert np.allclose(reduced.centre * step + (step - 1) / 2, field.centre)


def test_enlarged_matrix_takes_the_same_places_to_each_other():
    matrix = np.array([[1.01, -0.02, 7.3], [0.03, 0.99, -4.1]])
    whole = enlarge(matrix, 4)
    for point in np.array([[0.0, 0.0], [10.0, 3.0], [2.5, 40.0]]):
        there = (matrix[:, :2] @ point + matrix[:, 2]) * 4 + 1.5
        assert np.allclose(whole[:, :2] @ (point * 4 + 1.5) + whole[:, 2], there)


def test_window_on_a_line_is_uncertain_along_it():
    x, y = np.meshgrid(np.arange(96.0), np.arange(96.0))
    rng = np.random.default_rng(3)
    line = np.exp(-((x - 48) ** 2) / 8) + 0.001 * y
    noisy = [np.repeat((line + 0.01 * rng.standard_normal(line.shape))[..., None], 3, 2) for _ in range(2)]
    known = np.ones((96, 96), bool)
    match = match_window(*(part.astype(np.float32) for part in noisy), known)
    if match is not None:  # refused, or stated as uncertain
        assert match[1][1, 1] > 25 * match[1][0, 0]


def test_similarity_is_that_of_the_majority():
    rng = np.random.default_rng(2)
    places = rng.uniform(0, 1000, (40, 2))
    turn = np.array([[1.001, -0.01], [0.01, 1.001]])
    there = places @ turn.T + (300.0, -20.0) + 0.02 * rng.standard_normal((40, 2))
    there[:12] += rng.uniform(5, 40, (12, 2))
    matrix, agrees = fit_similarity(np.stack([places, there]), np.tile(0.01 * np.eye(2), (40, 1, 1)))
    assert np.abs(matrix[:, :2] - turn).max() < 1e-4
    assert not agrees[:12].any()
    assert agrees[12:].all()


def flattened(part: slice):
    """Maps of the relief with one part of the columns flat and uniform."""
    reflectance, normals = painted_relief(ROWS, COLUMNS)
    reflectance[:, part], normals[:, part] = 0.4, (0, 0, 1)
    return reflectance, normals


@pytest.mark.parametrize("stated", [True, False])
def test_flat_uniform_overlap_is_refused_by_name(stated):
    mosaic = cut_relief(*flattened(slice(190, 370)), grid=(1, 2), stated=stated)
    with pytest.raises(UserError, match=r"a1|a2"):
        adjust(mosaic.fields, register_fields(mosaic.fields))


def tiles(period: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """One tile repeated all over, with hardly a difference between its copies."""
    reflectance, normals = painted_relief(period, period)
    count = (-(-ROWS // period), -(-COLUMNS // period), 1)
    return np.tile(reflectance, count)[:ROWS, :COLUMNS], np.tile(normals, count)[:ROWS, :COLUMNS]


@pytest.mark.slow
def test_repeated_ornament_is_refused_without_positions():
    mosaic = cut_relief(*tiles(), stated=False)
    found = register_fields(mosaic.fields)
    assert all(o.problem or np.median(apart(mosaic, o)) < 0.5 for o in found)
    with pytest.raises(UserError):
        adjust(mosaic.fields, found)


def test_signals_of_known_values():
    found = signals(np.full((1, 1, 3), 0.48), np.array([[[0.6, 0.0, 0.8]]]))
    assert np.allclose(found[0, 0], (np.log(0.5), 0.6, 0.0))
