"""Broken captures of turntables and polarisation series: each kind has its own clear error."""

import shutil

import numpy as np
import pytest
from captures import edit_block, edit_text, edit_yaml, make_turntable, write_frame

from nishiki.capture.folder import load_capture
from nishiki.capture.seal import seal
from nishiki.formats.problems import CaptureError
from nishiki.observations.check import check_capture
from nishiki.observations.views_store import write_views
from nishiki.stages.ingest import IngestSettings

ROWS, COLUMNS = 20, 24
BOARD = {"squares_x": 5, "squares_y": 7, "square_mm": 20.0, "marker_mm": 15.0, "dictionary": "DICT_4X4_50"}


def text(name, old, new):
    return lambda folder: edit_text(folder / name, old, new)


def row(file, new):
    """Replace the row of frames.csv that lists this file ('' removes it)."""

    def change(folder):
        lines = (folder / "frames.csv").read_text().splitlines()
        assert any(line.startswith(file) for line in lines)
        kept = [new if line.startswith(file) else line for line in lines]
        (folder / "frames.csv").write_text("".join(line + "\n" for line in kept if line))

    return change


def more(line, name=None, value=500.0):
    """A further row of frames.csv, and its photograph."""

    def change(folder):
        with (folder / "frames.csv").open("a") as table:
            table.write(line + "\n")
        if name:
            write_frame(folder / name, np.full((ROWS, COLUMNS, 3), value))

    return change


def put(name, value, *, dtype=np.uint16, rows=ROWS, columns=COLUMNS, channels=3):
    return lambda folder: write_frame(folder / name, np.full((rows, columns, channels), float(value)), dtype)


def whole(name, content):
    def change(folder):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())

    return change


def keys(**changes):
    return lambda folder: edit_yaml(folder, **changes)


def block(**changes):
    return lambda folder: edit_block(folder, **changes)


def both(*changes):
    def change(folder):
        for one in changes:
            one(folder)

    return change


def camera_row(view, new):
    """Replace the numbers of one camera."""

    def change(folder):
        lines = (folder / "cameras.csv").read_text().splitlines()
        kept = [f"{view},{new}" if line.startswith(view + ",") else line for line in lines]
        assert kept != lines
        (folder / "cameras.csv").write_text("\n".join(kept) + "\n")

    return change


def described(**changes):
    return both(more("board/a.png,board,v1,,,", "board/a.png"), block(board={**BOARD, **changes}))


def points(content):
    heading = "view,column,row,x,y,z\n"
    return both(whole("p.csv", heading + content), block(correspondences="p.csv"))


def many_points(views=5, each=4):
    return "".join(f"v{i},{j},{j},{j},{i},1\n" for i in range(views) for j in range(each))


def mesh(content, name="m.ply", key="mesh"):
    return both(whole(name, content), block(**{key: [name] if key == "scans" else name}))


def lamps(content, **keys_of_lights):
    return both(whole("l.csv", "light,x,y,z\n" + content), keys(lights={"file": "l.csv", **keys_of_lights}))


def intrinsics(content):
    return both(whole("i.yaml", content), block(intrinsics="i.yaml"))


def cut(name, share):
    def change(folder):
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: int(share * len(data))])

    return change


def sealed_then(change):
    def broken(folder):
        seal(folder)
        change(folder / "data")

    return broken


HEAD = b"ply\nformat binary_little_endian 1.0\nelement vertex 9\n"
STATES = {"states": ("off", "on")}
LINEAR = {"states": ("0", "45", "90")}
NO_CAMERAS = {"cameras": False}
# name: (how the sound capture is made, what breaks it, the error's kind, words of the message)
BROKEN = {
    "view without camera": ({}, lambda f: edit_text(f / "cameras.csv", "v2,", "v9,"), "view-without-camera", "'v2'"),
    "camera without view": ({}, row("frames/4_", ""), "camera-without-view", "'v4' has no photograph"),
    "matrix of eleven values": ({}, camera_row("v1", ",".join("1" * 11)), "camera-values", "12 numbers"),
    "matrix of thirteen values": ({}, camera_row("v1", ",".join("1" * 13)), "camera-values", "12 numbers"),
    "matrix with a word": ({}, camera_row("v1", ",".join("1" * 11) + ",one"), "camera-values", "row 3"),
    "matrix not finite": ({}, camera_row("v1", ",".join("1" * 11) + ",nan"), "camera-not-finite", "1 of 12"),
    "matrix infinite": ({}, camera_row("v1", ",".join("1" * 11) + ",inf"), "camera-not-finite", "view 'v1'"),
    "matrix singular": ({}, camera_row("v1", ",".join("1" * 12)), "camera-singular", "K [R t]"),
    "camera twice": ({}, text("cameras.csv", "v2,", "v1,"), "camera-duplicate", "two cameras"),
    "cameras without heading": ({}, text("cameras.csv", "view,p11", "name,p11"), "cameras-columns", "p33,p34"),
    "cameras empty": ({}, whole("cameras.csv", ""), "cameras-columns", "no heading"),
    "cameras not text": ({}, whole("cameras.csv", b"\xff\xfe\x00"), "cameras-unreadable", "UTF-8"),
    "cameras missing": ({}, lambda f: (f / "cameras.csv").unlink(), "image-missing", "turntable.cameras"),
    "cameras outside": ({}, block(cameras="../cameras.csv"), "outside-folder", "turntable.cameras"),
    "view missing": ({}, row("frames/2_", "frames/2_0_0.png,sample,,,,"), "view-empty", "row 4"),
    "view twice": ({}, row("frames/2_", "frames/2_0_0.png,sample,v1,,,"), "frame-repeated", "view 'v1'"),
    "same view, light and polariser": (
        STATES, row("frames/2_0_1", "frames/2_0_1.png,sample,v2,,off,"), "frame-repeated", "polariser 'off'"),
    "polariser state unknown": (STATES, text("frames.csv", "v2,,on", "v2,,onn"), "polariser-unknown", "'on'"),
    "polariser angle absurd": (LINEAR, text("frames.csv", "v2,,45", "v2,,4500"), "polariser-unknown", "at most 360"),
    "polariser state missing for a view": (STATES, row("frames/2_0_1", ""), "polariser-missing", "view 'v2'"),
    "polariser empty for one frame": (STATES, text("frames.csv", "v2,,on", "v2,,"), "polariser-mixed", "several kinds"),
    "polarisers of two kinds": (STATES, text("frames.csv", "v2,,on", "v2,,45"), "polariser-mixed", "analyser angle"),
    "polariser only on": ({"states": ("on",)}, lambda f: None, "polariser-pair", "off and on"),
    "dark frame with a polariser": (STATES, more("d.png,dark,,,on,", "d.png", 1), "polariser-unexpected", "'on'"),
    "dark frame with a view": ({}, more("d.png,dark,v1,,,", "d.png", 1), "view-unexpected", "serves all views"),
    "silhouette of another size": (
        {}, put("silhouettes/1.png", 255, dtype=np.uint8, rows=19, channels=1), "silhouette-size", "19 x 24"),
    "silhouette empty": (
        {}, put("silhouettes/1.png", 0, dtype=np.uint8, channels=1), "silhouette-empty", "silhouettes/1.png"),
    "silhouette missing": ({}, lambda f: (f / "silhouettes/1.png").unlink(), "image-missing", "row 3 silhouette"),
    "silhouette damaged": ({}, cut("silhouettes/1.png", 0.6), "image-truncated", "silhouettes/1.png"),
    "silhouette outside": ({}, text("frames.csv", "silhouettes/1.png", "/etc/1.png"), "outside-folder", "row 3"),
    "two silhouettes of a view": (
        STATES, row("frames/2_0_1", "frames/2_0_1.png,sample,v2,,on,silhouettes/1.png"), "silhouette-several", "v2"),
    "silhouette of a dark frame": (
        {}, more("d.png,dark,,,,silhouettes/1.png", "d.png", 1), "silhouette-role", "sample frame"),
    "mesh missing": ({}, block(mesh="gone.ply"), "image-missing", "'gone.ply' is missing"),
    "mesh of another kind": ({}, mesh(b"solid", "m.stl"), "mesh-format", ".ply or .obj"),
    "mesh that is none": ({}, mesh(b"Dear colleague"), "mesh-unreadable", "not a PLY"),
    "mesh without faces": ({}, mesh(HEAD + b"property uchar x\nend_header\n" + bytes(9)), "mesh-empty", "without face"),
    "mesh with its heading cut off": ({}, mesh(HEAD), "mesh-unreadable", "end_header"),
    "OBJ without vertices": ({}, mesh(b"# only a comment\n", "m.obj"), "mesh-unreadable", "vertices"),
    "scan that is an OBJ": ({}, mesh(b"v 0 0 0\n", "m.obj", "scans"), "mesh-format", "expected .ply"),
    "scan without points": (
        {}, mesh(b"ply\nformat ascii 1.0\nend_header\n", "m.ply", "scans"), "mesh-empty", "without vertex"),
    "board not described": ({}, more("b.png,board,v1,,,", "b.png"), "board-undescribed", "turntable.board"),
    "board without a picture": ({}, block(board=BOARD), "board-without-frame", "role board"),
    "board twice for a view": (
        {}, both(described(), more("b.png,board,v1,,,", "b.png")), "board-repeated", "view 'v1'"),
    "board of an unknown view": ({}, both(described(), more("b.png,board,v9,,,", "b.png")), "view-unknown", "'v9'"),
    "board for some views only": (NO_CAMERAS, described(), "view-without-camera", "view 'v0'"),
    "board with markers too large": ({}, described(marker_mm=20.0), "wrong-value", "smaller than square_mm"),
    "board with too few markers": ({}, described(squares_x=20), "wrong-value", "need 70 markers"),
    "board of an unknown dictionary": ({}, described(dictionary="DICT_4x4_50"), "wrong-value", "DICT_4X4_50"),
    "board incomplete": (
        {}, both(more("b.png,board,v1,,,", "b.png"), block(board={"squares_x": 5})), "missing-key", "squares_y"),
    "board picture of another size": (
        {}, both(described(), put("board/a.png", 500, rows=10)), "image-size", "board/a.png"),
    "intrinsics with an unknown key": ({}, intrinsics("fx: 1\nfy: 1\ncx: 1\ncy: 1\ndistorsion: []\n"),
                                       "unknown-key", "did you mean 'distortion'"),
    "intrinsics without a key": ({}, intrinsics("fx: 1\nfy: 1\ncx: 1\n"), "missing-key", "'cy'"),
    "intrinsics of no length": ({}, intrinsics("fx: 0\nfy: 1\ncx: 1\ncy: 1\n"), "wrong-value", "'fx'"),
    "intrinsics that are no YAML": ({}, intrinsics("fx: [\n"), "yaml-invalid", "line"),
    "points of an unknown view": ({}, points(many_points() + "w,1,1,1,1,1\n"), "points-view", "no view 'w'"),
    "points not finite": ({}, points(many_points() + "v1,1,1,inf,1,1\n"), "points-values", "row 22"),
    "points with a value too few": ({}, points(many_points() + "v1,1,1,1,1\n"), "points-values", "5 finite numbers"),
    "too few points": ({}, points(many_points(each=3)), "points-few", "view 'v0'"),
    "points without heading": ({}, both(points(""), whole("p.csv", "1,2\n")), "points-columns", "view,column,row"),
    "lamps behind a missing file": ({}, keys(lights={"file": "gone.csv"}), "image-missing", "gone.csv"),
    "lamps of no kind": ({}, keys(lights={"kind": "flash"}), "wrong-value", "lights.kind"),
    "camera lamp with a file": ({}, lamps("a,0,0,1\n", kind="camera"), "wrong-value", "have no file"),
    "directions without a file": ({}, keys(lights={"kind": "direction"}), "wrong-value", "need their file"),
    "positions without a unit": (
        {}, both(lamps("a,0,0,1\n", kind="position_mm"), block(unit="arbitrary")), "wrong-value", "turntable.unit"),
    "lamp without a photograph": ({"lights": ("a",)}, lamps("a,0,0,1\nb,0,1,1\n"), "light-without-frame", "'b'"),
    "photograph without its lamp": ({"lights": ("a", "b")}, lamps("a,0,0,1\n"), "frame-without-light", "'b'"),
    "lamp not named": ({}, lamps("a,0,0,1\nb,0,1,1\n"), "light-empty", "row 2"),
    "lamp named for some": ({}, text("frames.csv", "v2,,", "v2,a,"), "light-empty", "row 2"),
    "lamp of zero length": ({"lights": ("a",)}, lamps("a,0,0,0\n"), "light-zero", "'a'"),
    "view not under every lamp": ({"lights": ("a", "b")}, row("frames/2_1", ""), "light-missing", "view 'v2'"),
    "white missing for a lamp": (
        {"lights": ("a", "b"), "white": True}, row("white/1.png", ""), "white-missing", "light 'b'"),
    "two whites of a lamp": (
        {"white": True}, more("w.png,white,,,,", "w.png", 2000), "light-repeated", "one white frame"),
    "white of an unknown state": (STATES, more("w.png,white,,,45,", "w.png"), "white-state", "'45'"),
    "white in one state only": (STATES, more("w.png,white,,,on,", "w.png"), "white-missing", "no 'off'"),
    "white too dark": ({"white": True}, put("white/0.png", 20), "white-dark", "white/0.png"),
    "white saturated": ({"white": True}, put("white/0.png", 4095), "white-saturated", "Expose the board less"),
    "exposure for one frame": (
        {}, both(text("frames.csv", "silhouette\n", "silhouette,exposure_s\n"),
                 lambda f: (f / "frames.csv").write_text("".join(
                     line + ("" if i == 0 else ",0.5" if i == 1 else ",") + "\n"
                     for i, line in enumerate((f / "frames.csv").read_text().splitlines())))),
        "exposure-partial", "4 of 5"),
    "photograph of another size": ({}, put("frames/2_0_0.png", 500, rows=21), "image-size", "expected 20 x 24"),
    "photograph of another depth": ({}, put("frames/2_0_0.png", 50, dtype=np.uint8), "image-depth", "uint8"),
    "photograph without colour": ({}, put("frames/2_0_0.png", 500, channels=1), "channels-differ", "camera.channels"),
    "photograph cut off": ({}, cut("frames/2_0_0.png", 0.6), "image-truncated", "frames/2_0_0.png"),
    "photograph missing": ({}, lambda f: (f / "frames/2_0_0.png").unlink(), "image-missing", "row 4"),
    "photograph outside": ({}, text("frames.csv", "frames/2_0_0.png", "../2.png"), "outside-folder", "../2.png"),
    "photograph listed twice": (
        {}, text("frames.csv", "frames/2_0_0.png", "frames/1_0_0.png"), "frame-duplicate", "twice"),
    "photograph saturated": ({}, put("frames/2_0_0.png", 4095), "all-saturated", "frames/2_0_0.png"),
    "photograph black": ({}, put("frames/2_0_0.png", 0), "all-dark", "frames/2_0_0.png"),
    "codes beyond the bits": ({}, put("frames/2_0_0.png", 5000), "bits-exceeded", "camera.bits"),
    "no photograph of the object": (
        {}, lambda f: (f / "frames.csv").write_text("file,role\nframes/0_0_0.png,dark\n"), "samples-none", "sample"),
    "role of a plane": ({}, text("frames.csv", "sample,v2", "check,v2"), "role-unknown", "| white | dark | board"),
    "column unknown": ({}, text("frames.csv", "polariser", "polarizer"), "unknown-column", "did you mean 'polariser'"),
    "key unknown": ({}, block(camera="cameras.csv"), "unknown-key", "did you mean 'cameras'"),
    "key of a plane": ({}, keys(region_of_interest=[0, 0, 5, 5]), "unknown-key", "region_of_interest"),
    "unit unknown": ({}, block(unit="inch"), "wrong-value", "turntable.unit"),
    "background unknown": ({}, block(background="pink"), "wrong-value", "turntable.background"),
    "full_turn unclear": ({}, block(full_turn="perhaps"), "wrong-value", "turntable.full_turn"),
    "photograph changed after sealing": (
        {}, sealed_then(put("frames/2_0_0.png", 321)), "seal-changed", "frames/2_0_0.png"),
    "silhouette changed after sealing": (
        {}, sealed_then(put("silhouettes/2.png", 9, dtype=np.uint8, channels=1)), "seal-changed", "silhouettes/2.png"),
    "cameras changed after sealing": (
        {}, sealed_then(text("cameras.csv", "v2,", "v2, ")), "seal-changed", "cameras.csv"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_each_kind_has_its_own_clear_error(tmp_path, name):
    options, change, kind, words = BROKEN[name]
    folder = make_turntable(tmp_path / "c", **options)
    change(folder)
    problems = check_capture(folder, level="full")
    errors = [p for p in problems if p.severity == "error"]
    assert kind in {p.kind for p in errors}, [str(p) for p in problems]
    said = " | ".join(str(p) for p in errors if p.kind == kind)
    assert words.casefold() in said.casefold()


@pytest.mark.parametrize("name", BROKEN)
def test_ingest_refuses_what_it_cannot_use(tmp_path, name):
    options, change, kind, _ = BROKEN[name]
    folder = make_turntable(tmp_path / "c", **options)
    change(folder)
    with pytest.raises(CaptureError) as caught:
        write_views(load_capture(folder), tmp_path, settings=IngestSettings())
    assert kind in {p.kind for p in caught.value.problems}


SOUND = [
    {},
    STATES,
    LINEAR,
    {"lights": ("a", "b")},
    {"white": True},
    {"boards": ("off", "on"), **STATES},
    {"dark": True},
]


@pytest.mark.parametrize("options", SOUND, ids=str)
def test_what_was_broken_is_sound_otherwise(tmp_path, options):
    """The errors above come from the change, not from how the captures are made."""
    folder = make_turntable(tmp_path / "c", **options)
    assert [p for p in check_capture(folder, level="full") if p.severity == "error"] == []


def test_there_are_many_kinds():
    assert len({kind for _, _, kind, _ in BROKEN.values()}) >= 50


WARNED = {
    "file that nothing names": ({}, whole("notes.txt", "x"), "file-unlisted"),
    "same photograph twice": (
        {}, lambda f: shutil.copy(f / "frames/1_0_0.png", f / "frames/2_0_0.png"), "image-repeated"),
    "silhouettes of some views": ({}, text("frames.csv", "silhouettes/1.png", ""), "silhouette-partial"),
    "silhouette of everything": (
        {}, put("silhouettes/1.png", 255, dtype=np.uint8, channels=1), "silhouette-full"),
    "nothing tells the cameras": (NO_CAMERAS, lambda f: None, "cameras-none"),
    "two analyser angles": ({"states": ("0", "90")}, lambda f: None, "polariser-few"),
    "half a turn counts once": ({"states": ("0", "90", "180", "270")}, lambda f: None, "polariser-few"),
    "a full turn not declared": ({}, block(full_turn=False), "turn-full"),
    "views out of order": (
        {"views": 8}, both(text("frames.csv", "v2,", "x,"), text("frames.csv", "v5,", "v2,"),
                           text("frames.csv", "x,", "v5,")), "turn-uneven"),
    "directions not of unit length": ({"lights": ("a",)}, lamps("a,0,0,7\n"), "light-not-unit"),
    "many saturated samples": (
        {}, lambda f: write_frame(f / "frames/1_0_0.png", np.where(
            np.arange(ROWS * COLUMNS * 3).reshape(ROWS, COLUMNS, 3) % 4 == 0, 4095.0, 700.0)), "many-saturated"),
    "bits that nobody tells": (
        {}, both(keys(camera={"channels": ["red", "green", "blue"]}), put("frames/2_0_0.png", 4090)), "bits-unsaid"),
    "dark frame of another exposure": (
        {}, lambda f: (more("d.png,dark,,,,", "d.png", 1)(f), (f / "frames.csv").write_text("".join(
            line + (",exposure_s" if i == 0 else ",2" if "dark" in line else ",1") + "\n"
            for i, line in enumerate((f / "frames.csv").read_text().splitlines())))), "dark-exposure"),
}  # fmt: skip


@pytest.mark.parametrize("name", WARNED)
def test_warnings_do_not_stop_ingest_but_are_reported(tmp_path, name):
    options, change, kind = WARNED[name]
    folder = make_turntable(tmp_path / "c", **options)
    change(folder)
    problems = check_capture(folder, level="full")
    assert kind in {p.kind for p in problems if p.severity == "warning"}, [str(p) for p in problems]
    assert not [p for p in problems if p.severity == "error"]
    write_views(load_capture(folder), tmp_path, settings=IngestSettings())


def test_every_mistake_is_told_at_once(tmp_path):
    folder = make_turntable(tmp_path / "c", states=("off", "on"))
    for change in (row("frames/2_0_1", ""), camera_row("v1", "1,2,3"), block(mesh="gone.ply")):
        change(folder)
    with pytest.raises(CaptureError) as caught:
        load_capture(folder)
    assert {"polariser-missing", "camera-values", "image-missing"} <= {p.kind for p in caught.value.problems}


def test_mistakes_of_a_turntables_yaml_do_not_hide_behind_a_planes_columns(tmp_path):
    folder = make_turntable(tmp_path / "c", states=("off", "on"))
    edit_block(folder, meshh="x.ply")
    with pytest.raises(CaptureError) as caught:
        load_capture(folder)
    assert [p.kind for p in caught.value.problems] == ["unknown-key"]
