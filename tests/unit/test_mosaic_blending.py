"""Levels and blends against obvious slow forms, and the mosaic of a cut relief against the whole."""

import numpy as np
import pytest
from mosaics import cut_relief, painted_relief

from nishiki.mosaic.adjustment import FieldPlacement, adjust
from nishiki.mosaic.blending import (
    CHOICES,
    Levels,
    Samples,
    blend_band,
    compare_fields,
    level_fields,
    slow_terms,
    solve_levels,
    turn_normals,
)
from nishiki.mosaic.registration import Field, register_fields

KINDS = {"normals": False, "reflectance": False, "sigma": False, "flags": True}


def shifted(count: int, seed: int = 1):
    """Maps of fields without distortion, at whole pixels, and their placement."""
    rng = np.random.default_rng(seed)
    rows, columns, maps = 40, 50, []
    for _ in range(count):
        normals = np.concatenate([0.2 * rng.standard_normal((rows, columns, 2)), np.ones((rows, columns, 1))], -1)
        maps.append(
            {
                "normals": (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32),
                "reflectance": rng.uniform(0.1, 0.9, (rows, columns, 3)).astype(np.float32),
                "sigma": rng.uniform(0.01, 0.1, (rows, columns)).astype(np.float32),
                "flags": np.where(rng.uniform(size=(rows, columns)) < 0.1, 1, 0).astype(np.uint8),
                "finish": rng.integers(0, 3, (rows, columns)).astype(np.uint8),
            }
        )
    centre = np.array([24.5, 19.5])
    fields = tuple(Field(f"f{k}", (rows, columns), None, centre) for k in range(count))
    position = centre + np.array([(0, 0), (30, 4), (12, 25)])[:count]
    zero = np.zeros(count)
    return FieldPlacement(fields, position, zero, zero + 1, np.zeros(4), zero), maps


def test_blend_is_the_weighted_mean_pixel_by_pixel():
    placement, maps = shifted(3)
    readers = [lambda name, rows, each=each: each[name][rows] for each in maps]
    levels = Levels(np.zeros((3, 5)), np.zeros((0, 5)))
    rows, columns = placement.shape
    parts = [slice(0, 17), slice(17, rows)]
    bands = [blend_band(placement, readers, levels, {**KINDS, "finish": True}, part) for part in parts]
    got = {name: np.concatenate([band[name] for band in bands]) for name in bands[0]}
    for row in range(0, rows, 3):
        for column in range(0, columns, 3):
            total, colour, normal, best, finish = 0.0, np.zeros(3), np.zeros(3), 0.0, 0
            for k, each in enumerate(maps):
                x, y = np.array([column, row]) - placement.position[k] + placement.fields[k].centre
                x, y = round(x), round(y)
                if not (0 <= x < 50 and 0 <= y < 40) or each["flags"][y, x]:
                    continue
                depth = (min(x, 49 - x, y, 39 - y) + 1) / 20
                weight = depth / float(each["sigma"][y, x]) ** 2
                total += weight
                colour += weight * each["reflectance"][y, x]
                normal += weight * each["normals"][y, x]
                if weight > best:
                    best, finish = weight, each["finish"][y, x]
            if total == 0:
                assert got["flags"][row, column] == 1
                continue
            assert np.allclose(got["reflectance"][row, column], colour / total, rtol=1e-4)
            assert np.allclose(got["normals"][row, column], normal / np.linalg.norm(normal), atol=1e-4)
            assert got["finish"][row, column] == finish
            scatter = 1 - np.sum((normal / total) ** 2)
            assert got["sigma"][row, column] ** 2 > scatter * 0.9


def test_normals_turn_with_the_field_and_tilt_by_angles():
    normals = np.array([[0.3, 0.1, 0.9], [0.0, 0.0, 1.0]])
    turned = turn_normals(normals, 0.2)
    expected = np.array([0.3 + 0.1j, 0]) * np.exp(-0.2j) / np.hypot(np.hypot(0.3, 0.1), (0.9, 1.0))
    assert np.allclose(turned[:, 0] + 1j * turned[:, 1], expected * [1, 0], atol=1e-3)
    tilted = turn_normals(np.array([[0.0, 0.0, 1.0]]), 0.0, np.array([0.05, 0.0]))
    assert np.allclose(tilted, [[-np.sin(0.05), 0, np.cos(0.05)]])


def pairs_of(own: np.ndarray, slow: np.ndarray, error: float = 0.01, seed: int = 3) -> Samples:
    """Samples of fields in a grid of 3 x 3, each 0.75 of a reach from the next."""
    rng, pair, place, values = np.random.default_rng(seed), [], [], []
    for i in range(9):
        for j in range(i + 1, 9):
            step = 1.1 * (np.array(divmod(j, 3)) - divmod(i, 3))[::-1]
            here = rng.uniform(-0.7, 0.7, (400, 2))
            here = here[(np.abs(here - step) < 0.7).all(axis=1)]
            level = Levels(own, slow)
            truth = rng.standard_normal((len(here), own.shape[1]))
            ends = [truth + level.at(k, q) for k, q in ((i, here), (j, here - step))]
            values.append(np.stack(ends, 1) + error * rng.standard_normal((len(here), 2, own.shape[1])))
            place.append(np.stack([here, here - step], 1))
            pair.append(np.tile((i, j), (len(here), 1)))
    return Samples(np.concatenate(pair), np.concatenate(place), np.concatenate(values))


def test_levels_of_fields_are_found():
    own = 0.05 * np.random.default_rng(1).standard_normal((9, 3))
    samples = pairs_of(own - own.mean(axis=0), np.zeros((0, 3)))
    levels, decision = level_fields(samples, 9)
    assert decision.decision != "none"
    assert np.abs(np.median(np.diff(levels.taken_off(samples), axis=1), axis=0)).max() < 0.002
    assert np.abs(levels.own.mean(axis=0)).max() < 0.01


def test_two_fields_are_levelled_by_halves_of_their_overlap():
    own = np.zeros((9, 1))
    own[:2, 0] = 0.04, -0.04
    samples = pairs_of(own, np.zeros((0, 1)))
    two = samples.only((samples.pair < 2).all(axis=1))
    levels, decision = level_fields(two, 2)
    assert decision.decision != "none"
    assert abs(np.median(np.diff(levels.taken_off(two), axis=1))) < 0.003


def test_levels_are_the_least_squares_of_a_dense_solver():
    own = 0.05 * np.random.default_rng(1).standard_normal((9, 2))
    samples = pairs_of(own, np.zeros((0, 2)))
    levels = solve_levels(samples, 9, 0)
    design = np.eye(9)[samples.pair[:, 0]] - np.eye(9)[samples.pair[:, 1]]
    expected = np.linalg.lstsq(design, samples.values[:, 0] - samples.values[:, 1], rcond=None)[0]
    assert np.abs(levels.own - expected).max() < 0.002


def test_nothing_is_levelled_where_nothing_is_gained():
    levels, decision = level_fields(pairs_of(np.zeros((9, 3)), np.zeros((0, 3))), 9)
    assert np.abs(levels.own).max() < 0.002
    assert decision.measured < 0.5


def test_a_bend_that_repeats_in_each_field_does_not_bend_the_mosaic():
    slow = np.zeros((5, 1))
    slow[0] = 0.1
    levels, _ = level_fields(pairs_of(np.zeros((9, 1)), slow, error=0.002), 9)
    assert abs(levels.slow[0, 0] - 0.1) < 0.05
    assert np.abs(levels.own).max() < 0.06  # 0.11 without the slow change


def test_squares_are_used_where_they_predict_overlaps():
    slow = np.array([[0.0], [0.0], [0.1], [0.05], [-0.08]])
    samples = pairs_of(np.zeros((9, 1)), slow, error=0.005)
    levels, decision = level_fields(samples, 9)
    assert CHOICES[decision.decision] == 5
    assert np.abs(levels.slow[2:] - slow[2:]).max() < 0.02
    assert slow_terms(np.array([2.0, 3.0]), 5).tolist() == [2, 3, 4, 6, 9]


@pytest.mark.slow
def test_mosaic_of_a_cut_relief_is_the_relief():
    relief = painted_relief(420, 560)
    mosaic = cut_relief(*relief, error=0.01)
    placement, _ = adjust(mosaic.fields, register_fields(mosaic.fields))
    samples = compare_fields(placement, mosaic.readers())
    assert len(samples.pair) > 50
    levels, _ = level_fields(samples, 4)
    rows, columns = placement.shape
    band = blend_band(placement, mosaic.readers(), levels, KINDS, slice(0, rows))
    x, y = np.meshgrid(np.arange(40, columns - 40, 7.0), np.arange(40, rows - 40, 7.0))
    # places of the mosaic in the picture, from the fields' corners
    corners = [placement.to_mosaic(i, f.centre) @ (1, 1j) for i, f in enumerate(placement.fields)]
    true = [np.array(f["centre"]) @ (1, 1j) for f in mosaic.truth]
    scale, offset = np.polyfit(corners, true, 1)
    places = scale * (x + 1j * y) + offset
    row, column = np.rint(places.imag).astype(int), np.rint(places.real).astype(int)
    inside = (row >= 0) & (column >= 0) & (row < 420) & (column < 560)
    inside &= (np.abs(places.imag - row) < 0.15) & (np.abs(places.real - column) < 0.15)
    picked = y.astype(int)[inside], x.astype(int)[inside]
    normals = turn_normals(band["normals"][picked], float(np.angle(scale)))
    cosine = (normals * relief[1][row[inside], column[inside]]).sum(axis=-1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() < 3
    ratio = band["reflectance"][picked] / relief[0][row[inside], column[inside]]
    assert np.median(np.abs(np.log(ratio))) < 0.02
    assert (band["flags"][picked] == 0).all()
