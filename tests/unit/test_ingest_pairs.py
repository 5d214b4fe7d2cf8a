"""White boards that were given to other photographs are found; lamps, gloss and shadows are no reason to report any."""

import csv

import numpy as np
import pytest
from captures import make_capture
from lit_relief import dome as rings
from lit_relief import photographs as of_relief
from refusals import expect_facts

from nishiki.capture.folder import load_capture
from nishiki.observations.check import check_capture
from nishiki.observations.plane_store import write_observations
from nishiki.photometric.arrangement import arrange
from nishiki.photometric.board_pairs import pair_boards
from nishiki.stages.ingest import IngestSettings


def dome(lamps=16, seed=0):
    """Directions (lamps, 3) on spirals between 10 and 65 degrees from the normal."""
    rng = np.random.default_rng(seed)
    polar = np.radians(np.linspace(10, 65, lamps) + rng.uniform(-3, 3, lamps))
    azimuth = np.arange(lamps) * 2.4
    return np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=1)


def levels(directions, *, seed=0, blocks=36, unequal=0.2, gloss=1.5, tilt=0.35, noise=0.02, near=0.0):
    """Photographs and boards (lamps, blocks) of a rough, glossy object; not what `pair_boards` fits: Phong gloss
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


def pair(photographs, boards, cosines, directions):
    """`pair_boards` of photographs and boards (lamps, blocks), as pictures of six rows."""
    shape = (len(directions), 6, -1)
    return pair_boards((photographs / boards * cosines).reshape(shape), boards.reshape(shape), directions)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(
    "options", [{}, {"gloss": 6.0}, {"unequal": 0.0}, {"unequal": 0.5}, {"tilt": 0.7}, {"near": 1.0}]
)
def test_right_pairs_are_not_reported(seed, options):
    directions = dome(seed=seed)
    found = pair(*levels(directions, seed=seed, **options), directions)
    np.testing.assert_array_equal(found.board, np.arange(16))
    assert not found.alone.any()


RELIEFS = {
    "matt": {},
    "glossy": {"gloss": 0.5},
    "dark": {"albedo": (0.01, 0.03)},
    "flat": {"steep": 0.1},
    "flat and glossy": {"steep": 0.1, "gloss": 1.0},
    "near": {"width": 0.3},
}
DOMES = {
    "two rings": ((7, 35), (5, 60)),
    "one ring": ((6, 30),),
    "five": ((4, 35), (1, 90)),
    "forty": ((16, 30), (14, 55), (10, 75)),
}


def boards_of(directions, seed, unequal, shape):
    """Boards (lamps, rows, columns) of lamps of unequal strength that are brighter to one side of the picture."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[-1 : 1 : shape[0] * 1j, -1 : 1 : shape[1] * 1j]
    level = rng.normal(np.log(directions[:, 2]), unequal)[:, None, None]
    side = rng.normal(0, 0.1, (2, len(directions), 1, 1))
    return np.exp(level + side[0] * x + side[1] * y)


@pytest.mark.slow
@pytest.mark.parametrize("lamps", DOMES)
@pytest.mark.parametrize("matter", RELIEFS)
def test_lamps_of_any_strengths_are_no_reason_to_report(matter, lamps):
    directions = rings(DOMES[lamps])
    values = of_relief(directions, seed=4, **RELIEFS[matter])
    for seed, unequal in enumerate((0.0, 0.3, 0.6)):
        found = pair_boards(values, boards_of(directions, seed, unequal, values.shape[1:]), directions)
        assert found is None or ((found.board == np.arange(len(directions))).all() and not found.alone.any())


@pytest.mark.parametrize("gloss", [0.15, 0.6])
@pytest.mark.parametrize("seed", range(2))
def test_two_exchanged_boards_of_a_glossy_relief_are_found(gloss, seed):
    directions = rings(((8, 40), (4, 65)))
    values = of_relief(directions, seed=seed, gloss=gloss)
    boards, order = boards_of(directions, seed, 0.3, values.shape[1:]), np.arange(12)
    level = np.log(np.median(boards, axis=(1, 2)) / directions[:, 2])
    order[[level.argmin(), level.argmax()]] = level.argmax(), level.argmin()
    found = pair_boards(values * boards / boards[order], boards[order], directions)
    np.testing.assert_array_equal(order[found.board], np.arange(12))


def test_a_mirror_is_not_judged():
    directions = rings(DOMES["forty"])
    values = of_relief(directions, albedo=(0.001, 0.002), gloss=1.0)
    assert pair_boards(values, boards_of(directions, 1, 0.5, values.shape[1:]), directions) is None


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("options", [{}, {"unequal": 0.0}, {"gloss": 3.0}, {"near": 1.0}])
def test_two_exchanged_boards_are_found(seed, options):
    directions = dome(seed=seed)
    photographs, boards, cosines = levels(directions, seed=seed, **options)
    size = np.log(np.median(boards, axis=1))
    i, j = max(((a, b) for a in range(16) for b in range(a)), key=lambda p: abs(size[p[0]] - size[p[1]]))
    order = np.arange(16)
    order[[i, j]] = j, i
    found = pair(photographs, boards[order], cosines, directions)
    np.testing.assert_array_equal(found.board, order)
    assert np.abs(found.after[[i, j]]).max() < 0.2 * np.abs(found.before[[i, j]]).min()


@pytest.mark.parametrize("seed", range(6))
def test_boards_in_any_order_are_found(seed):
    directions = dome(seed=seed)
    photographs, boards, cosines = levels(directions, seed=seed)
    order = np.random.default_rng(seed).permutation(16)
    found = pair(photographs, boards[order], cosines, directions)
    assert (found.board != np.arange(16)).sum() >= 6
    size = np.log(np.median(boards, axis=1))
    was, would = np.abs(size[order] - size).mean(), np.abs(size[order[found.board]] - size).mean()
    assert would < 0.5 * was


@pytest.mark.parametrize("near", [0.5, 1.0])
def test_boards_of_equal_level_that_differ_in_their_course_over_the_picture_are_told_apart(near):
    """Near lamps on a ring shine alike on the whole, but each more on its own side."""
    azimuth = np.arange(8) * np.pi / 4
    directions = np.stack([0.7 * np.cos(azimuth), 0.7 * np.sin(azimuth), np.full(8, 0.714)], axis=1)
    photographs, boards, cosines = levels(directions, near=near, unequal=0.0)
    order = np.array([4, 1, 2, 3, 0, 5, 6, 7])
    assert np.abs(np.log(np.median(boards[order], axis=1) / np.median(boards, axis=1))).max() < 0.05
    found = pair(photographs, boards[order], cosines, directions)
    np.testing.assert_array_equal(found.board, order)


def test_exchanged_boards_that_shine_alike_do_no_harm_and_are_not_named():
    directions = rings(DOMES["one ring"])
    values = of_relief(directions)
    boards = np.broadcast_to(directions[:, 2, None, None], values.shape)
    found = pair_boards(values, boards * np.linspace(0.995, 1.005, 6)[:, None, None], directions)
    np.testing.assert_array_equal(found.board, np.arange(6))


@pytest.mark.parametrize("factor", [1 / 6, 6.0])
def test_a_photograph_that_no_board_explains_is_told_with_its_sign(factor):
    directions = dome()
    photographs, boards, cosines = levels(directions, unequal=0.05)
    photographs[9] *= factor
    found = pair(photographs, boards, cosines, directions)
    np.testing.assert_array_equal(found.board, np.arange(16))
    np.testing.assert_array_equal(np.flatnonzero(found.alone), [9])
    assert found.before[9] == pytest.approx(np.log(factor), abs=0.3)


def test_too_little_to_tell_is_not_judged():
    directions = dome()
    photographs, boards, cosines = levels(directions)
    assert pair(photographs[:3], boards[:3], cosines[:3], directions[:3]) is None
    assert pair(photographs * np.nan, boards, cosines, directions) is None


@pytest.mark.slow
def test_photographs_that_have_the_lamps_of_each_other_with_their_boards_are_told_by_the_order():
    directions = rings(DOMES["two rings"])
    listed = directions.copy()
    listed[[2, 9]] = directions[[9, 2]]
    values = of_relief(directions) * (listed[:, 2] / directions[:, 2])[:, None, None]  # divided by their boards
    found = arrange(values, listed)
    assert found.order == (0, 1, 9, 3, 4, 5, 6, 7, 8, 2, 10, 11)


def rename_boards(folder, order):
    """Give the boards in frames.csv to other lights."""
    rows = list(csv.reader((folder / "frames.csv").read_text().splitlines()))
    whites = [row for row in rows if row[1] == "white"]
    names = [row[2] for row in whites]
    for row, place in zip(whites, order, strict=True):
        row[2] = names[place]
    (folder / "frames.csv").write_text("".join(",".join(row) + "\n" for row in rows))


@pytest.mark.slow
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
    (told,) = (text for text in diagnostics["warnings"] if "white/" in text)
    expect_facts(told, "white/L01.png", "L01", "white/L09.png", "L09")
