"""White boards, silhouettes and states belong to the photograph whose name varies in the same way."""

from pathlib import Path

import numpy as np
import pytest
from captures import RING, ring_of_cameras, write_frame
from refusals import refused
from scipy.io import savemat

from nishiki.capture.convert import convert
from nishiki.capture.folder import load_capture
from nishiki.capture.layouts import natural_key
from nishiki.capture.pairing import pair_by_name
from nishiki.formats.problems import CaptureError

LAMPS = [*(f"L{i}" for i in range(1, 14)), *(f"H{i}" for i in range(1, 9))]


def paths(names, suffix=".png"):
    return [Path(name + suffix) for name in names]


def paired(photographs, others):
    return pair_by_name(photographs, others, what="white boards", folder="boards")


def kind_of_refusal(photographs, others):
    with pytest.raises(CaptureError) as caught:
        paired(photographs, others)
    assert caught.value.problems[0].remedy
    return caught.value.problems[0].kind


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        ("{}", "{}"),
        ("painting_{}", "board_{}"),
        ("painting_{}", "{}"),
        ("{}", "white {} b"),
        ("2024-05-01 jar {} f8", "2024-05-02 board {} f11"),
        ("Lamp.{}", "lamp.{}.white"),
        ("LH{}", "HL{}"),
    ],
)
def test_boards_are_paired_by_the_part_that_varies_whatever_surrounds_it(ours, theirs):
    photographs, boards = paths([ours.format(x) for x in LAMPS]), paths([theirs.format(x) for x in LAMPS], ".tif")
    found = paired(photographs, sorted(boards, key=lambda p: hash(p.name)))
    assert found.partners == tuple(boards)
    assert found.warnings == ()


def test_any_names_are_paired_as_the_names_they_were_made_of():
    """Random labels between random surroundings, which share no character with the labels."""
    rng = np.random.default_rng(3)

    def word(letters, least, most):
        return "".join(rng.choice(list(letters), rng.integers(least, most)))

    for _ in range(200):
        labels = sorted({word("abc", 1, 5) for _ in range(12)})
        fixes = [word("xyz_-", 0, 6) for _ in range(4)]
        photographs = paths([fixes[0] + x + fixes[1] for x in labels])
        boards = paths([fixes[2] + x + fixes[3] for x in labels])
        order = rng.permutation(len(boards))
        assert paired(photographs, [boards[i] for i in order]).partners == tuple(boards)


def test_capitals_and_leading_zeros_do_not_matter():
    found = paired(paths(["a_L01", "a_L02", "a_L10"]), paths(["w_l10", "w_l2", "w_l1"]))
    assert [p.stem for p in found.partners] == ["w_l1", "w_l2", "w_l10"]
    assert found.warnings == ()


def test_the_natural_order_that_was_used_before_gives_wrong_pairs_here():
    photographs = paths([f"painting_{x}" for x in LAMPS])
    boards = sorted(paths([f"board_{x}" for x in LAMPS]), key=natural_key)
    assert [p.stem for p in boards] != [f"board_{x}" for x in LAMPS]
    assert [p.stem for p in paired(photographs, boards).partners] == [f"board_{x}" for x in LAMPS]


def test_running_numbers_without_a_common_value_are_paired_in_order_and_every_pair_is_reported():
    photographs, boards = paths([f"DSC{i:04d}" for i in range(8, 13)]), paths([f"DSC{i:04d}" for i in range(98, 103)])
    found = paired(photographs, boards[::-1])
    assert found.partners == tuple(boards)
    (told,) = found.warnings
    assert told.kind == "paired-in-order"
    for photograph, board in zip(photographs, boards, strict=True):
        assert f"{photograph.name} - {board.name}" in str(told)


@pytest.mark.parametrize(
    ("ours", "theirs", "kind"),
    [
        (["p_1", "p_2", "p_3"], ["b_0", "b_1", "b_2"], "pairing-unmatched"),  # which of them is off by one?
        (["p_1", "p_2", "p_4"], ["b_11", "b_12", "b_13"], "pairing-unmatched"),
        (["p_left", "p_right"], ["b_oben", "b_unten"], "pairing-unmatched"),
        (["p_1", "p_2", "p_3"], ["b_1", "b_2"], "pairing-count"),
        (["p_1", "p_2"], ["b_1", "b_2", "b_3"], "pairing-count"),
        (["p_1", "p_2"], [], "pairing-count"),
        (["p_1", "p_2"], ["b_1", "b_01"], "pairing-ambiguous"),
        (["p_1", "P_1"], ["b_1", "b_2"], "pairing-ambiguous"),
    ],
)
def test_what_cannot_be_paired_is_refused_with_a_remedy(ours, theirs, kind):
    assert kind_of_refusal(paths(ours), paths(theirs)) == kind


def test_boards_of_the_same_names_may_be_more_than_the_photographs():
    found = paired(paths(["3", "1"]), paths(["1", "2", "3", "x"]))
    assert [p.stem for p in found.partners] == ["3", "1"]
    assert "2.png, x.png" in found.warnings[0].found


def write_set(folder, names):
    for i, name in enumerate(names):
        write_frame(folder / f"{name}.png", np.full((16, 24, 3), 40.0 + i), np.uint8)


def test_convert_gives_every_photograph_its_own_board(tmp_path):
    lamps = ["L1", "L2", "L10", "H1", "C"]
    write_set(tmp_path / "s", [f"painting_{x}" for x in lamps])
    write_set(tmp_path / "w", [f"board_{x}" for x in lamps])
    rows = [f"painting_{x}.png {a:.6f} {b:.6f} {c:.6f}" for x, (a, b, c) in zip(lamps, RING, strict=True)]
    (tmp_path / "s/l.lp").write_text("5\n" + "\n".join(rows) + "\n")
    made = convert(tmp_path / "s", tmp_path / "c", white=tmp_path / "w")
    assert [w.kind for w in made.warnings] == ["encoding-assumed"]
    capture = load_capture(tmp_path / "c")
    assert {f.light: f.file for f in capture.frames_of("white")} == {
        f"painting_{x}": f"white/board_{x}.png" for x in lamps
    }


@pytest.mark.parametrize("option", ["white", "dark"])
def test_a_folder_that_is_missing_is_reported(tmp_path, option):
    write_set(tmp_path / "s", "abc")
    with pytest.raises(CaptureError) as caught:
        convert(tmp_path / "s", tmp_path / "c", **{option: tmp_path / "s/a.png"})
    assert caught.value.problems[0].kind == "folder-missing"


def test_lamps_that_exist_are_listed_where_one_does_not(tmp_path):
    write_set(tmp_path / "s", ["a", "b", "c"])
    (tmp_path / "s/l.lp").write_text("3\na.png 0 0 1\nb.png 0.5 0 0.8\nc.png 0 0.5 0.8\n")
    with refused(CaptureError, kind="light-unknown"):
        convert(tmp_path / "s", tmp_path / "c", checks=("a", "H1"))


def write_turntable(folder, names):
    write_set(folder, names)
    cells = np.empty((1, len(names)), object)
    for i, matrix in enumerate(ring_of_cameras(len(names))):
        cells[0, i] = matrix
    savemat(folder / "P.mat", {"P": cells})


def test_silhouettes_follow_the_same_rule(tmp_path):
    write_turntable(tmp_path / "s", [f"jar_{i}" for i in (8, 9, 10, 11)])
    for i in (8, 9, 10, 11):
        write_frame(tmp_path / f"m/outline_{i:03d}.png", np.eye(16, 24)[..., None] * i, np.uint8)
    convert(tmp_path / "s", tmp_path / "c", mask=tmp_path / "m")
    capture = load_capture(tmp_path / "c")
    assert capture.silhouette_of("jar_10").silhouette == "silhouettes/outline_010.png"
    (tmp_path / "m/outline_011.png").rename(tmp_path / "m/outline_x.png")
    with pytest.raises(CaptureError) as caught:
        convert(tmp_path / "s", tmp_path / "d", mask=tmp_path / "m")
    assert caught.value.problems[0].kind == "pairing-unmatched"


STATES = ["0_0", "0_45", "0_90"]


@pytest.mark.parametrize(
    ("names", "found"),
    [
        (["0_0", "0_45", "0_90"], ["0/0", "0/45", "0/90"]),
        (["board_0_90", "board_0_45", "board_0_0"], ["0/90", "0/45", "0/0"]),
        (["0_0 W", "0_45 W", "0_90 W", "plain W"], ["0/0", "0/45", "0/90", ""]),
        (["plain"], [""]),
    ],
)
def test_boards_are_known_by_their_polariser_states(tmp_path, names, found):
    write_set(tmp_path / "s", STATES)
    write_set(tmp_path / "w", names)
    convert(tmp_path / "s", tmp_path / "c", white=tmp_path / "w")
    boards = {f.file: f.polariser for f in load_capture(tmp_path / "c").frames_of("white")}
    assert boards == {f"white/{name}.png": state for name, state in zip(names, found, strict=True)}


@pytest.mark.parametrize("names", [["a", "b"], ["0_0", "0_45"], ["0_0", "0_45", "0_90", "x", "y"]])
def test_boards_without_a_state_are_refused(tmp_path, names):
    """They were taken for boards without polarisers before, whatever they were called."""
    write_set(tmp_path / "s", STATES)
    write_set(tmp_path / "w", names)
    with pytest.raises(CaptureError) as caught:
        convert(tmp_path / "s", tmp_path / "c", white=tmp_path / "w")
    assert caught.value.problems[0].kind == "white-unnamed"
