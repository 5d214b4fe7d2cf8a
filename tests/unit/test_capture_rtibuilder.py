"""Project folders of RTIBuilder become captures; what was paired is said."""

import numpy as np
import pytest
from captures import RING, write_frame
from refusals import expect_facts, refused

from nishiki.capture.convert import convert
from nishiki.capture.folder import load_capture
from nishiki.formats.problems import CaptureError
from nishiki.observations.check import check_capture

NAMES = [f"IMG_{i:04d}" for i in (7, 8, 9, 10, 11)]


def pictures(folder, suffix, *, level, names=NAMES, rows=16):
    for i, name in enumerate(names):
        write_frame(folder / f"{name}{suffix}", np.full((rows, 24, 3), level + i), np.uint8)


def project(root, *, named="jpeg-exports", prefix="C:\\Users\\me\\Coin 1"):
    """As RTIBuilder leaves one: absolute Windows paths in the lights file, pictures of the spheres beside it."""
    lines = [
        f"{prefix}\\{named}\\{name}.jpg {x:.6f} {y:.6f} {z:.6f}" for name, (x, y, z) in zip(NAMES, RING, strict=True)
    ]
    (root / "assembly-files").mkdir(parents=True)
    (root / "assembly-files/Coin 1.lp").write_text(f"{len(lines)}\r\n" + "\r\n".join(lines) + "\r\n")
    pictures(root / "assembly-files", ".jpg", level=200, names=["Coin 1_ball_0_blend", "Coin 1_ball_0_edge"])
    pictures(root / "jpeg-exports", ".jpg", level=60)
    pictures(root / "original-captures", ".tif", level=30)
    (root / "finished-files").mkdir()
    (root / "finished-files/Coin 1.rti").write_bytes(b"#HSH1.2\n")
    (root / "Coin 1.xml").write_text("<project/>")
    return root


def level_of(capture):
    """Of the first photograph's codes, which tells the folder that it is from."""
    import cv2

    return round(float(cv2.imread(str(capture.payload / capture.observed[0].file)).mean()))


def test_a_project_is_read_and_its_pairing_said(tmp_path):
    source = project(tmp_path / "Coin 1")
    made = convert(source, tmp_path / "c")
    assert (made.layout.split()[0], made.photographs) == ("RTIBuilder", 5)
    (note,) = [note for note in made.warnings if note.kind == "project-folders"]
    expect_facts(str(note), "Coin 1.lp", "jpeg-exports", "original-captures")
    capture = load_capture(tmp_path / "c")
    assert [frame.light for frame in capture.observed] == NAMES
    np.testing.assert_allclose(capture.lights.vectors, RING, atol=1e-6)
    assert capture.settings.camera.encoding == "srgb"
    assert level_of(capture) == 60
    assert not [p for p in check_capture(tmp_path / "c", level="full") if p.severity == "error"]


def test_the_folder_that_the_lights_file_names_comes_first(tmp_path):
    source = project(tmp_path / "p", named="cropped-files")
    pictures(source / "cropped-files", ".jpg", level=90, rows=8)
    convert(source, tmp_path / "c")
    assert level_of(load_capture(tmp_path / "c")) == 90
    for path in (source / "cropped-files").iterdir():
        path.unlink()
    made = convert(source, tmp_path / "d")
    assert "jpeg-exports" in str(made.warnings[0])


def test_the_originals_are_read_as_the_note_advises(tmp_path):
    source = project(tmp_path / "p")
    (remedy,) = [note.remedy for note in convert(source, tmp_path / "c").warnings if note.kind == "project-folders"]
    lights = source / "assembly-files/Coin 1.lp"
    assert remedy.endswith(f"./nishiki convert {source / 'original-captures'} --lights '{lights}'")
    convert(source / "original-captures", tmp_path / "d", lights_file=lights)
    capture = load_capture(tmp_path / "d")
    assert capture.observed[0].file == "frames/IMG_0007.tif"
    assert level_of(capture) == 30


def test_a_project_that_kept_only_its_originals_is_read(tmp_path):
    source = project(tmp_path / "p")
    for path in (source / "jpeg-exports").iterdir():
        path.unlink()
    convert(source, tmp_path / "c")
    assert level_of(load_capture(tmp_path / "c")) == 30


def test_pictures_that_the_lights_file_leaves_out_are_named(tmp_path):
    source = project(tmp_path / "p")
    pictures(source / "jpeg-exports", ".jpg", level=10, names=["IMG_0001"])
    made = convert(source, tmp_path / "c")
    assert [note.found for note in made.warnings if note.kind == "photograph-unlisted"] == ["IMG_0001.jpg"]


def test_what_is_missing_or_double_is_named(tmp_path):
    source = project(tmp_path / "p")
    (source / "assembly-files/other.lp").write_text("3\n")
    with pytest.raises(CaptureError, match=r"several .lp files.*--lights"):
        convert(source, tmp_path / "c")
    made = convert(source, tmp_path / "c", lights_file=source / "assembly-files/Coin 1.lp")
    assert made.layout.startswith("RTIBuilder")
    for path in (source / "assembly-files").glob("*.lp"):
        path.unlink()
    with pytest.raises(CaptureError, match=r"without a .lp file.*finished-files/Coin 1.rti"):
        convert(source, tmp_path / "d")
    (source / "p.lp").write_text("3\n0 0 1\n0.6 0 0.8\n0 0.6 0.8\n")
    with refused(CaptureError, kind="layout-unknown"):
        convert(source, tmp_path / "d")
    lost = project(tmp_path / "lost")
    (lost / "jpeg-exports/IMG_0009.jpg").unlink()
    (lost / "original-captures/IMG_0008.tif").unlink()
    with refused(CaptureError, "4", "jpeg-exports", "original-captures", kind="photograph-missing"):
        convert(lost, tmp_path / "d")


@pytest.mark.parametrize("empty", ["jpeg-exports", "assembly-files"])
def test_photographs_in_the_folder_itself_are_no_project(tmp_path, empty):
    source = tmp_path / "s"
    pictures(source, ".jpg", level=70)
    (source / empty).mkdir()
    lines = [f"{name}.jpg {x:.6f} {y:.6f} {z:.6f}" for name, (x, y, z) in zip(NAMES, RING, strict=True)]
    (source / "lamps.lp").write_text("\n".join([f"{len(lines)}", *lines]))
    made = convert(source, tmp_path / "c")
    assert made.photographs == 5
    assert level_of(load_capture(tmp_path / "c")) == 70
