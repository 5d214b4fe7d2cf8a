"""Turntables and polarisation series: tables, facts, conversion of known layouts, seal and check."""

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from capture_facts import turntable_facts
from captures import edit_block, edit_yaml, make_turntable, ring_of_cameras, write_frame
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from refusals import refused
from scipy.io import savemat

from nishiki.capture.convert import convert
from nishiki.capture.folder import load_capture
from nishiki.capture.frames import Frame, parse_state
from nishiki.capture.seal import seal
from nishiki.capture.tables import camera_centre, read_cameras
from nishiki.capture.turntable import estimates_cameras
from nishiki.cli import main
from nishiki.formats.problems import CaptureError
from nishiki.geometry.camera import Camera
from nishiki.geometry.turn import turn_of
from nishiki.observations.check import check_capture

PLY = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nelement face 1\n"
    "property list uchar int vertex_indices\nend_header\n0\n1\n2\n3 0 1 2\n"
)


def test_facts_of_a_plain_turntable(tmp_path):
    capture = load_capture(make_turntable(tmp_path / "c"))
    facts = turntable_facts(capture)
    assert capture.geometry == facts.geometry == "turntable"
    assert facts.views == ("v0", "v1", "v2", "v3", "v4")
    assert facts.lights == ("",)
    assert facts.states == ("",)
    assert (facts.rows, facts.columns, facts.pixels, facts.channels) == (20, 24, 480, 3)
    assert facts.cameras
    assert facts.silhouettes
    assert facts.full_turn
    assert facts.lamp == "unknown"
    assert not (facts.mesh)
    assert not (facts.scans)
    assert not (facts.boards)
    assert not (facts.correspondences)
    assert not (facts.intrinsics)
    assert facts.polarisation == "none"
    assert not facts.white_board
    assert facts.unit == "mm"


def test_frames_are_not_compared_one_with_another(tmp_path, monkeypatch):
    """Captures have thousands, which would take minutes."""
    folder = make_turntable(tmp_path / "c", lights=("a", "b"))
    monkeypatch.setattr(Frame, "__eq__", lambda *_: pytest.fail("two frames are compared"))
    assert len(load_capture(folder).frames) == 10


def test_facts_of_everything_that_can_be_given(tmp_path):
    folder = make_turntable(
        tmp_path / "c", states=("on", "off"), lights=("a", "b"), white=True, boards=("on", "off"), silhouettes=False
    )
    for name in ("object.ply", "one.ply", "two.ply"):
        (folder / name).write_text(PLY)
    points = [f"v{i},{j},{j + 1},{j * i},{j * j},{3 - j}" for i in range(5) for j in range(6)]
    (folder / "points.csv").write_text("view,column,row,x,y,z\n" + "\n".join(points) + "\n")
    (folder / "intrinsics.yaml").write_text("fx: 30\nfy: 31\ncx: 11.5\ncy: 9.5\ndistortion: [-0.1, 0, 0, 0, 0]\n")
    (folder / "lights.csv").write_text("light,x,y,z\na,0,0,0\nb,300,0,-20\n")
    board = {"squares_x": 5, "squares_y": 7, "square_mm": 20, "marker_mm": 15, "dictionary": "DICT_5X5_100"}
    write_frame(folder / "board/0.png", np.full((20, 24, 3), 900.0))
    with (folder / "frames.csv").open("a") as table:
        table.write("board/0.png,board,v0,,,\n")
    edit_block(folder, mesh="object.ply", scans=["one.ply", "two.ply"], correspondences="points.csv", board=board,
               intrinsics="intrinsics.yaml")  # fmt: skip
    edit_yaml(folder, lights={"kind": "position_mm", "file": "lights.csv"})
    capture = load_capture(folder)
    facts = turntable_facts(capture)
    assert facts.states == ("off", "on")
    assert facts.polarisation == "circular"
    assert facts.lights == ("a", "b")
    assert facts.lamp == "position_mm"
    assert facts.mesh
    assert facts.scans == 2
    assert facts.correspondences
    assert facts.intrinsics
    assert facts.boards == 1
    assert not facts.view_boards
    assert not facts.silhouettes
    assert facts.white_board
    assert set(facts.white_states) == {"", "on", "off"}
    assert capture.points["v3"].shape == (6, 5)
    assert capture.intrinsics.as_dict()["matrix"][1] == [0.0, 31.0, 9.5]
    assert len(capture.observed) == 20
    assert [f.view for f in capture.observed[:3]] == ["v0", "v0", "v1"]
    # The pictures made here are brighter in the state on.
    errors = {p.kind for p in check_capture(folder, level="full") if p.severity == "error"}
    assert errors == {"polarisers-exchanged"}


def test_a_series_of_one_view_needs_no_camera_and_no_name(tmp_path):
    folder = make_turntable(tmp_path / "c", views=1, states=("0", "45", "90", "135"), cameras=False, silhouettes=False)
    facts = turntable_facts(load_capture(folder))
    assert facts.views == ("",)
    assert facts.states == ("0", "45", "90", "135")
    assert facts.polarisation == "linear"
    assert not facts.cameras
    assert not facts.full_turn
    assert check_capture(folder, level="full") == []


def test_a_single_lamp_of_a_file_need_not_be_named_in_every_row(tmp_path):
    folder = make_turntable(tmp_path / "c")
    (folder / "lamp.lp").write_text("1\nflash.png 0.3 0.2 0.9\n")
    edit_yaml(folder, lights={"file": "lamp.lp"})
    assert turntable_facts(load_capture(folder)).lights == ("flash",)


@pytest.mark.parametrize(
    ("text", "name", "kind"),
    [("", "", "none"), ("off", "off", "circular"), ("45.0", "45", "linear"), ("-0", "0", "linear"),
     ("0/90", "0/90", "generator"), (" 22.5 / 45 ", "22.5/45", "generator")],
)  # fmt: skip
def test_polariser_states_have_one_spelling(text, name, kind):
    assert (parse_state(text).name, parse_state(text).kind) == (name, kind)
    assert parse_state(parse_state(text).name) == parse_state(text)


@pytest.mark.parametrize("text", ["yes", "Off", "0/", "0/45/90", "nan", "inf", "400", "45 deg"])
def test_anything_else_is_no_polariser_state(text):
    with refused(CaptureError, kind="polariser-unknown"):
        parse_state(text)


@given(
    views=st.integers(3, 60),
    jitter=st.floats(0, 0.2),
    start=st.floats(-np.pi, np.pi),
    height=st.floats(-3, 3),
    backwards=st.booleans(),
    seed=st.integers(0, 99),
)
def test_a_full_turn_is_known_by_its_cameras(views, jitter, start, height, backwards, seed):
    """Whatever the axis, the sense, the size and where it starts; and three quarters of a turn is none."""
    rng = np.random.default_rng(seed)
    steps = np.arange(views) + jitter * rng.uniform(-0.5, 0.5, views)
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]

    def ring(turn):
        angles = start + steps * turn / views * (-1 if backwards else 1)
        flat = np.column_stack([np.cos(angles), np.sin(angles), np.full(views, height)])
        return 7.0 * flat @ axes + rng.normal(size=3)

    assert turn_of(ring(2 * np.pi)).full
    if views >= 5:
        assert not turn_of(ring(1.5 * np.pi)).full
        shuffled = ring(2 * np.pi)[rng.permutation(views)]
        gaps = np.diff(np.append(shuffled, shuffled[:1], axis=0), axis=0)
        if np.linalg.norm(gaps, axis=1).max() > 2.5 * np.linalg.norm(gaps, axis=1).min():
            assert not turn_of(shuffled).full


def test_camera_centre_is_what_the_camera_maps_to_zero(tmp_path):
    folder = make_turntable(tmp_path / "c")
    for view, matrix in read_cameras(folder / "cameras.csv", "cameras.csv").matrices.items():
        centre = camera_centre(matrix)
        np.testing.assert_allclose(matrix @ [*centre, 1], 0, atol=1e-12)
        np.testing.assert_allclose(Camera.from_matrix(view, matrix, rows=20, columns=24).centre, centre, atol=1e-12)
        assert abs(np.linalg.norm(centre) - 5) < 1e-12


def pictures(folder, names, *, same=()):
    folder.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        write_frame(folder / name, np.full((20, 24, 3), 10.0 + i), np.uint8)
    for first, second in same:
        shutil.copy(folder / first, folder / second)


def cells(matrices):
    out = np.empty((1, len(matrices)), object)
    for i, matrix in enumerate(matrices):
        out[0, i] = matrix
    return out


@pytest.mark.parametrize("stored", ["cells", "array"])
def test_photographs_with_matrices_in_a_matlab_file(tmp_path, stored):
    """Natural order of the names; the last photograph repeats the first and is left out; matrices to the last digit."""
    names = [f"x.{i}.png" for i in range(12)]
    pictures(tmp_path / "s", names, same=[("x.0.png", "x.12.png")])
    matrices = ring_of_cameras(12) * 0.37
    savemat(tmp_path / "s/any.mat", {"P": cells(matrices) if stored == "cells" else np.moveaxis(matrices, 0, 2)})
    made = convert(tmp_path / "s", tmp_path / "c")
    capture = load_capture(tmp_path / "c")
    assert made.geometry == "turntable"
    assert made.photographs == 12
    assert capture.views == tuple(f"x.{i}" for i in range(12))
    assert capture.settings.turntable.full_turn
    assert capture.settings.camera.encoding == "srgb"
    for view, matrix in zip(capture.views, matrices, strict=True):
        assert (capture.matrices[view] == matrix).all()
    assert {p.kind for p in made.warnings} == {"photograph-repeats", "cameras-in-order", "encoding-assumed"}
    assert [p.kind for p in check_capture(tmp_path / "c", level="full")] == ["not-linear"]


def test_a_repeated_last_matrix_is_left_out_with_its_photograph(tmp_path):
    pictures(tmp_path / "s", ["0.png", "1.png", "2.png", "3.png"], same=[("0.png", "4.png")])
    ring = ring_of_cameras(4)
    savemat(tmp_path / "s/P.mat", {"P": cells([*ring, ring[0]])})
    convert(tmp_path / "s", tmp_path / "c")
    capture = load_capture(tmp_path / "c")
    assert len(capture.views) == 4
    assert capture.settings.turntable.full_turn


def test_recorded_exposures_are_taken_along_or_named(tmp_path):
    """Views of a turntable whose camera chose its exposure; a table without these columns is named by the check."""
    folder, times = tmp_path / "s", [1 / 50, 1 / 25, 1 / 50, 1 / 50]
    folder.mkdir()
    for i, seconds in enumerate(times):
        exif = Image.Exif()
        exif.get_ifd(0x8769).update({0x829A: seconds, 0x8827: 100})
        Image.fromarray(np.full((20, 24, 3), 60 + i, np.uint8)).save(folder / f"{i}.jpg", exif=exif)
    savemat(folder / "P.mat", {"P": cells(ring_of_cameras(4))})
    made = convert(folder, tmp_path / "c")
    assert "exposure-differs" in {p.kind for p in made.warnings}
    assert [f.exposure_s for f in load_capture(tmp_path / "c").observed] == pytest.approx(times)
    assert "exposure-differs" not in {p.kind for p in check_capture(tmp_path / "c")}
    table = tmp_path / "c/frames.csv"
    table.write_text("".join(line.rpartition(",")[0] + "\n" for line in table.read_text().splitlines()))
    assert "exposure-differs" in {p.kind for p in check_capture(tmp_path / "c")}


def test_an_arc_is_no_full_turn(tmp_path):
    pictures(tmp_path / "s", [f"{i}.png" for i in range(8)])
    savemat(tmp_path / "s/P.mat", {"P": cells(ring_of_cameras(8, turn=np.pi))})
    convert(tmp_path / "s", tmp_path / "c", encoding="linear")
    settings = load_capture(tmp_path / "c").settings
    assert not settings.turntable.full_turn
    assert settings.camera.encoding == "linear"


def camera_list(names, matrices):
    lines = [str(len(names))]
    for name, matrix in zip(names, matrices, strict=True):
        camera = Camera.from_matrix(name, matrix, rows=20, columns=24)
        numbers = [*camera.intrinsics.ravel(), *camera.rotation.ravel(), *camera.translation]
        lines.append(" ".join([name, *map(repr, map(float, numbers))]))
    return "\n".join(lines) + "\n"


def test_a_list_of_cameras_names_its_photographs(tmp_path):
    names = [f"o{i:04d}.png" for i in range(1, 7)]
    pictures(tmp_path / "s", [*names, "o9999.png"])
    matrices = ring_of_cameras(6)
    (tmp_path / "s/o_par.txt").write_text(camera_list(names, matrices))
    (tmp_path / "s/README.txt").write_text("Photographs of an object\n")
    made = convert(tmp_path / "s", tmp_path / "c")
    capture = load_capture(tmp_path / "c")
    assert capture.settings.turntable.full_turn
    assert len(capture.views) == 6
    for view, matrix in zip(capture.views, matrices, strict=True):
        np.testing.assert_allclose(capture.matrices[view], matrix, atol=1e-12)
    assert "photograph-unlisted" in {p.kind for p in made.warnings}


def series(folder, angles=(0, 45, 90, 135)):
    folder.mkdir()
    for i, (g, a) in enumerate((g, a) for g in angles for a in angles):
        write_frame(folder / f"{g}_{a}.png", np.full((10, 12, 1), 40.0 + i), np.uint8)


def test_photographs_named_by_generator_and_analyser(tmp_path):
    series(tmp_path / "s", (0, 90, 22.5))
    (tmp_path / "s/anything.mat").write_bytes(b"an instrument's own file")
    made = convert(tmp_path / "s", tmp_path / "c")
    facts = turntable_facts(load_capture(tmp_path / "c"))
    assert made.layout.startswith("polarisation")
    assert facts.views == ("",)
    assert facts.channels == 1
    assert facts.states == ("0/0", "0/22.5", "0/90", "22.5/0", "22.5/22.5", "22.5/90", "90/0", "90/22.5", "90/90")
    assert facts.polarisation == "generator"
    assert facts.encoding == "linear"
    assert (tmp_path / "c/anything.mat").read_bytes() == b"an instrument's own file"
    assert check_capture(tmp_path / "c", level="full") == []


def test_silhouettes_boards_and_dark_frames_are_taken_along(tmp_path):
    pictures(tmp_path / "s", [f"{i}.png" for i in range(4)])
    savemat(tmp_path / "s/P.mat", {"P": cells(ring_of_cameras(4))})
    for i in range(4):
        write_frame(tmp_path / f"m/{i}.png", np.eye(20, 24)[..., None] * 255, np.uint8)
    pictures(tmp_path / "w", ["board.png"])
    pictures(tmp_path / "d", ["d.png"])
    convert(tmp_path / "s", tmp_path / "c", mask=tmp_path / "m", white=tmp_path / "w", dark=tmp_path / "d")
    capture = load_capture(tmp_path / "c")
    facts = turntable_facts(capture)
    assert facts.silhouettes
    assert facts.white_board
    assert len(capture.frames_of("dark")) == 1
    assert capture.silhouette_of("2").silhouette == "silhouettes/2.png"


@pytest.mark.parametrize(
    ("channels", "dtype", "suffix", "coding"),
    [
        (1, np.uint8, "png", "srgb"),
        (3, np.uint8, "png", "srgb"),
        (3, np.uint16, "png", "linear"),
        (3, np.uint8, "jpg", "srgb"),
    ],
)
def test_encoding_of_a_turntable_follows_its_bits_and_can_be_given(tmp_path, channels, dtype, suffix, coding):
    for i in range(3):
        write_frame(tmp_path / f"s/{i}.{suffix}", np.full((20, 24, channels), 40.0 + i), dtype)
    savemat(tmp_path / "s/P.mat", {"P": cells(ring_of_cameras(3))})
    made = convert(tmp_path / "s", tmp_path / "c")
    assert load_capture(tmp_path / "c").settings.camera.encoding == coding
    told = "encoding-assumed" in {p.kind for p in made.warnings}
    assert told == (dtype == np.uint8 and suffix == "png")
    other = {"srgb": "linear", "linear": "srgb"}[coding]
    made = convert(tmp_path / "s", tmp_path / "d", encoding=other)
    assert load_capture(tmp_path / "d").settings.camera.encoding == other
    assert "encoding-assumed" not in {p.kind for p in made.warnings}


def test_boards_of_a_series_are_known_by_their_names(tmp_path):
    series(tmp_path / "s", (0, 90))
    series(tmp_path / "w", (0, 90))
    convert(tmp_path / "s", tmp_path / "c", white=tmp_path / "w")
    facts = turntable_facts(load_capture(tmp_path / "c"))
    assert facts.white_states == facts.states
    assert not facts.white_board


def broken_list(text):
    return lambda folder: (folder / "o_par.txt").write_text(text)


LINE = "o1.png " + " ".join(["30", "0", "12", "0", "30", "10", "0", "0", "1", *"100010001", "0", "0", "5"])
REFUSED = {
    "too few photographs": (lambda f: savemat(f / "a.mat", {"P": cells(ring_of_cameras(7))}), "photographs-count", "7"),
    "two files of matrices": (
        lambda f: [savemat(f / n, {"P": cells(ring_of_cameras(3))}) for n in ("a.mat", "b.mat")],
        "layout-unknown",
        "a.mat, b.mat",
    ),
    "matrix of another shape": (
        lambda f: savemat(f / "a.mat", {"P": cells([np.eye(3), *ring_of_cameras(2)])}),
        "camera-values",
        "P{1}",
    ),
    "singular matrix": (
        lambda f: savemat(f / "a.mat", {"P": cells([np.zeros((3, 4)), *ring_of_cameras(2)])}),
        "camera-singular",
        "view 'o1'",
    ),
    "matrix not finite": (
        lambda f: savemat(f / "a.mat", {"P": cells([np.full((3, 4), np.nan), *ring_of_cameras(2)])}),
        "camera-not-finite",
        "12 of 12",
    ),
    "damaged MATLAB file": (lambda f: (f / "a.mat").write_bytes(b"MATLAB 7.3 MAT-file" + b"\0" * 200),
                            "cameras-unreadable", "-v7"),
    "count of the list disagrees": (broken_list(f"2\n{LINE}\n"), "cameras-count", "expected 2"),
    "list names a missing photograph": (broken_list(f"1\n{LINE.replace('o1', 'o7')}\n"), "photograph-missing", "o7"),
    "list with a number too few": (broken_list(f"1\n{LINE[:-2]}\n"), "camera-values", "20 values"),
    "list with a word": (broken_list(f"1\n{LINE[:-1]}near\n"), "camera-values", "no number"),
    "nothing but photographs": (lambda f: None, "layout-unknown", "no lights file"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_convert_says_what_is_wrong_and_leaves_nothing(tmp_path, name):
    pictures(tmp_path / "s", ["o1.png", "o2.png", "o3.png"])
    make, kind, words = REFUSED[name]
    make(tmp_path / "s")
    with pytest.raises(CaptureError) as caught:
        convert(tmp_path / "s", tmp_path / "c")
    assert kind in {p.kind for p in caught.value.problems}
    assert words in str(caught.value)
    assert not (tmp_path / "c").exists()
    assert not list(tmp_path.glob(".c*"))


def test_options_of_planes_are_refused(tmp_path):
    pictures(tmp_path / "s", [f"{i}.png" for i in range(4)])
    savemat(tmp_path / "s/P.mat", {"P": cells(ring_of_cameras(4))})
    for options in ({"checks": ("1",)}, {"region": (0, 0, 5, 5)}):
        with pytest.raises(CaptureError) as caught:
            convert(tmp_path / "s", tmp_path / "c", **options)
        assert caught.value.problems[0].kind == "option-unusable"


def test_sealed_turntable_is_the_same_capture_and_changes_are_found(tmp_path):
    folder = make_turntable(tmp_path / "c", states=("off", "on"), dark=True)
    before = turntable_facts(load_capture(folder))
    seal(folder)
    capture = load_capture(folder)
    assert capture.sealed
    assert turntable_facts(capture) == before
    assert check_capture(folder, level="full") == []
    data = bytearray((folder / "data/silhouettes/1.png").read_bytes())
    data[len(data) // 2] ^= 1
    (folder / "data/silhouettes/1.png").write_bytes(data)
    assert "seal-changed" in {p.kind for p in check_capture(folder, level="full")}


def command(*words):
    with pytest.raises(SystemExit) as left:
        main([str(word) for word in words])
    return left.value.code


def test_commands_convert_check_and_seal(tmp_path, capsys, monkeypatch):
    pictures(tmp_path / "s", [f"{i}.png" for i in range(4)])
    savemat(tmp_path / "s/P.mat", {"P": cells(ring_of_cameras(4))})
    assert command("convert", tmp_path / "s", tmp_path / "c", "--unsealed", "--title", "Jar") == 0
    assert "turntable.mesh" in capsys.readouterr().out
    assert command("seal", tmp_path / "c") == 0
    assert command("check", tmp_path / "c") == 0
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()
    assert command("verify", "--capture", "c") == 0
    assert capsys.readouterr().out.startswith("c: ")
    assert command("verify", "s", "--capture", "c") == 0
    assert capsys.readouterr().out.splitlines()[1].startswith("0 ")
    assert load_capture(tmp_path / "c").settings.title == "Jar"
    assert command("convert", tmp_path / "s", tmp_path / "c") == 2
    write_frame(tmp_path / "c/data/frames/2.png", np.full((9, 9, 3), 5.0), np.uint8)
    assert command("check", tmp_path / "c") == 2
    assert command("verify", "--capture", "c") == 1


def test_the_example_of_the_documentation_is_a_sound_capture(tmp_path):
    """What the page shows as capture.yaml and frames.csv is what the reader accepts."""
    page = (Path(__file__).resolve().parents[2] / "docs/capture-folder.md").read_text().split("## Goniometers")[0]
    blocks = {
        title: text for title, text in re.findall(r"```\w*\n# (capture\.yaml|frames\.csv)\n(.*?)```", page, re.DOTALL)
    }
    assert set(blocks) == {"capture.yaml", "frames.csv"}
    for name, text in blocks.items():
        (tmp_path / name).write_text(text)
    rows = [line.split(",") for line in blocks["frames.csv"].splitlines()[1:]]
    for i, (file, *_) in enumerate(rows):
        level = (2000 if file.startswith("white") else 100 if file.startswith("dark") else 800) + 50 * i
        level *= 0.37 if "on" in Path(file).stem else 1.0
        write_frame(tmp_path / file, np.full((20, 24, 3), float(level)))
    views = sorted({row[2] for row in rows if row[2]})
    heading = "view," + ",".join(f"p{r}{c}" for r in (1, 2, 3) for c in (1, 2, 3, 4))
    lines = [f"{v},{','.join(map(repr, m.ravel().tolist()))}" for v, m in zip(views, ring_of_cameras(2), strict=True)]
    (tmp_path / "cameras.csv").write_text("\n".join([heading, *lines]) + "\n")
    assert check_capture(tmp_path, level="full") == []
    facts = turntable_facts(load_capture(tmp_path))
    assert (facts.polarisation, facts.lamp, facts.full_turn) == ("circular", "camera", True)


@pytest.mark.data
def test_measured_turntables_and_series_are_recognised(data, tmp_path):
    """Every folder of the measured data that holds matrices or angles becomes a capture without errors."""
    found = 0
    for source in sorted(p for p in data.iterdir() if p.is_dir()):
        angles = list(source.glob("[0-9]*_[0-9]*.png"))
        if not any(source.glob("*_Ps.mat")) and not (len(angles) > 3 and any(source.glob("*.mat"))):
            continue
        found += 1
        made = convert(source, tmp_path / source.name, link=False)
        capture = load_capture(tmp_path / source.name)
        assert made.geometry == "turntable"
        assert not [p for p in check_capture(tmp_path / source.name) if p.severity == "error"]
        if capture.matrices:
            assert turn_of(np.array([camera_centre(m) for m in capture.matrices.values()])).full
            picture = cv2.imread(str(capture.observed[0].path))
            assert picture.shape[:2] == (turntable_facts(capture).rows, turntable_facts(capture).columns)
        else:
            assert len(capture.states) == len(angles)
    assert found, "no turntable and no polarisation series in the data"


def test_photographs_of_a_turn_need_no_cameras(tmp_path):
    pictures(tmp_path / "s", [f"{k}.png" for k in range(1, 11)], same=[("1.png", "10.png")])
    made = convert(tmp_path / "s", tmp_path / "c", turntable=True, height_mm=80)
    capture = load_capture(tmp_path / "c")
    block = capture.settings.turntable
    assert (block.full_turn, block.unit, block.height, capture.matrices) == (True, "mm", 80, None)
    assert capture.views == tuple(map(str, range(1, 10)))
    assert {problem.kind for problem in made.warnings} >= {"photograph-repeats"}
    assert [problem.kind for problem in capture.warnings] == ["cameras-estimated"]
    assert estimates_cameras(block, capture.views)


@pytest.mark.parametrize("case", ["few", "cameras are there", "none asked for"])
def test_what_is_no_turn_to_estimate_is_refused(tmp_path, case):
    pictures(tmp_path / "s", [f"{k}.png" for k in range(1, 5 if case == "few" else 10)])
    if case == "cameras are there":
        savemat(tmp_path / "s/P.mat", {"P": cells(ring_of_cameras(9))})
    kind = {"few": "photographs-count", "cameras are there": "option-unusable"}.get(case, "layout-unknown")
    given = {} if case == "none asked for" else {"height_mm": 80}
    with pytest.raises(CaptureError) as raised:
        convert(tmp_path / "s", tmp_path / "c", **given)
    assert raised.value.problems[0].kind == kind
    assert not (tmp_path / "c").exists()
