"""White boards that were given to other photographs are found; lamps, gloss and shadows are no reason to report any."""

import csv

import numpy as np
import pytest
from captures import make_capture
from refusals import expect_facts

from nishiki.capture.folder import load_capture
from nishiki.observations.check import check_capture
from nishiki.observations.pairs_check import find_exchanges, level_problems
from nishiki.observations.plane_store import write_observations
from nishiki.stages.ingest import IngestSettings


def dome(lamps=16, seed=0):
    """Directions (lamps, 3) on spirals between 10 and 65 degrees from the normal."""
    rng = np.random.default_rng(seed)
    polar = np.radians(np.linspace(10, 65, lamps) + rng.uniform(-3, 3, lamps))
    azimuth = np.arange(lamps) * 2.4
    return np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=1)


def levels(directions, *, seed=0, blocks=36, unequal=0.2, gloss=1.5, tilt=0.35, noise=0.02, near=0.0):
    """Photographs and boards (lamps, blocks) of a rough, glossy object; not what `find_exchanges` fits: Phong gloss
    about the mirror direction, attached shadows, unequal lamps, lamps nearer to one side."""
    rng = np.random.default_rng(seed)
    strength = np.exp(rng.normal(0, unequal, len(directions)))[:, None]
    side = np.linspace(-1, 1, blocks)[None, :]
    field = strength * np.exp(near * directions[:, :1] * side)
    normals = np.stack([*rng.normal(0, tilt, (2, blocks)), np.ones(blocks)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cosine = np.maximum(directions @ normals.T, 0.0)
    mirrored = np.maximum(2 * cosine * normals[:, 2] - directions[:, 2:3], 0.0)
    albedo = rng.uniform(0.1, 0.8, blocks)
    photographs = field * (albedo * cosine + 0.1 * gloss * mirrored**30) * np.exp(rng.normal(0, noise, cosine.shape))
    facing = np.broadcast_to(directions[:, 2:3], cosine.shape)
    return np.maximum(photographs, 1e-6), field * facing, facing


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(
    "options", [{}, {"gloss": 6.0}, {"unequal": 0.0}, {"unequal": 0.5}, {"tilt": 0.7}, {"near": 1.0}]
)
def test_right_pairs_are_not_reported(seed, options):
    directions = dome(seed=seed)
    found = find_exchanges(*levels(directions, seed=seed, **options), directions)
    assert (found.better == np.arange(len(directions))).all()


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("options", [{}, {"unequal": 0.0}, {"gloss": 3.0}, {"near": 1.0}])
def test_two_exchanged_boards_are_found(seed, options):
    directions = dome(seed=seed)
    photographs, boards, cosines = levels(directions, seed=seed, **options)
    size = np.log(np.median(boards, axis=1))
    i, j = max(((a, b) for a in range(16) for b in range(a)), key=lambda p: abs(size[p[0]] - size[p[1]]))
    order = np.arange(16)
    order[[i, j]] = j, i
    found = find_exchanges(photographs, boards[order], cosines, directions)
    assert set(np.flatnonzero(found.better != np.arange(16))) >= {i, j}
    assert (found.better[i], found.better[j]) == (j, i)


@pytest.mark.parametrize("seed", range(6))
def test_boards_in_any_order_are_found(seed):
    directions = dome(seed=seed)
    photographs, boards, cosines = levels(directions, seed=seed)
    order = np.random.default_rng(seed).permutation(16)
    found = find_exchanges(photographs, boards[order], cosines, directions)
    moved = found.better != np.arange(16)
    assert moved.sum() >= 6
    size = np.log(np.median(boards, axis=1))
    was, would = np.abs(size[order] - size).mean(), np.abs(size[order[found.better]] - size).mean()
    assert would < 0.5 * was


def test_boards_of_equal_level_that_differ_in_their_course_over_the_picture_are_told_apart():
    """Near lamps on a ring shine alike on the whole, but each more on its own side."""
    azimuth = np.arange(8) * np.pi / 4
    directions = np.stack([0.7 * np.cos(azimuth), 0.7 * np.sin(azimuth), np.full(8, 0.714)], axis=1)
    photographs, boards, cosines = levels(directions, near=1.0, unequal=0.0)
    order = np.array([4, 1, 2, 3, 0, 5, 6, 7])
    assert np.abs(np.log(np.median(boards[order], axis=1) / np.median(boards, axis=1))).max() < 0.05
    found = find_exchanges(photographs, boards[order], cosines, directions)
    np.testing.assert_array_equal(found.better, order)


def test_a_photograph_that_no_board_explains_is_told_with_its_sign():
    directions = dome()
    photographs, boards, cosines = levels(directions, unequal=0.05)
    photographs[9] /= 6
    found = find_exchanges(photographs, boards, cosines, directions)
    assert (found.better == np.arange(16)).all()
    np.testing.assert_array_equal(np.flatnonzero(found.alone), [9])
    assert found.alone[9] == pytest.approx(-np.log(6), abs=0.3)


def test_too_little_to_tell_is_not_judged():
    directions = dome()
    photographs, boards, cosines = levels(directions)
    assert find_exchanges(photographs[:4], boards[:4], cosines[:4], directions[:4]) is None
    assert find_exchanges(photographs * np.nan, boards, cosines, directions) is None


def test_lights_whose_boards_do_not_follow_the_cosine_are_reported():
    directions = dome()
    expected, names = np.log(directions[:, 2]), [f"L{i}" for i in range(16)]
    strengths = np.random.default_rng(1).normal(0, 0.03, 16)
    assert level_problems(expected + strengths, expected, directions, names) == []
    exchanged = expected + strengths
    exchanged[[1, 15]] = exchanged[[15, 1]]
    (told,) = level_problems(exchanged, expected, directions, names)
    assert (told.kind, told.found) == ("white-levels", "L1 and L15")
    (told,) = level_problems(-expected, expected, directions, names)
    assert "cos(theta)" in str(told)


@pytest.mark.parametrize("unequal", [0.0, 0.1, 0.3])
def test_one_weak_lamp_or_lamps_of_unequal_strength_are_not_told(unequal):
    directions = dome(40)
    expected, names = np.log(directions[:, 2]), [f"L{i}" for i in range(40)]
    for seed in range(20):
        strengths = np.random.default_rng(seed).normal(0, unequal, 40)
        strengths[7] -= 0.7
        assert level_problems(expected + strengths, expected, directions, names) == []


def rename_boards(folder, order):
    """Give the boards in frames.csv to other lights."""
    rows = list(csv.reader((folder / "frames.csv").read_text().splitlines()))
    whites = [row for row in rows if row[1] == "white"]
    names = [row[2] for row in whites]
    for row, place in zip(whites, order, strict=True):
        row[2] = names[place]
    (folder / "frames.csv").write_text("".join(",".join(row) + "\n" for row in rows))


@pytest.mark.parametrize(
    "options", [{}, {"dark": False}, {"exposure_s": 0.25}, {"mask": np.eye(24, 32)[..., None] + 1}]
)
def test_check_and_ingest_tell_an_exchanged_board(tmp_path, options):
    lights = [tuple(v) for v in dome(9)]
    folder = make_capture(tmp_path / "c", lights=lights, **options)
    assert [p for p in check_capture(folder, level="full") if p.kind.startswith("white-")] == []
    rename_boards(folder, [8, 1, 2, 3, 4, 5, 6, 7, 0])
    (told,) = [p for p in check_capture(folder, level="full") if p.kind.startswith("white-")]
    assert told.kind == "white-exchanged"
    expect_facts(told.found, "white/L01.png", "L01", "white/L09.png", "L09")
    diagnostics = write_observations(load_capture(folder), tmp_path, settings=IngestSettings())
    assert any("white/L01.png" in text for text in diagnostics.warnings)
