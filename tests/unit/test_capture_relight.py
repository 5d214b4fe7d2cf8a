"""Files of the program Relight as lights files, and pictures that are not read."""

import json
import shutil

import numpy as np
import pytest
from captures import RING, write_frame
from refusals import refused

from nishiki.capture.convert import convert
from nishiki.capture.folder import load_capture
from nishiki.capture.lights import read_lights
from nishiki.capture.rti_projects import read_relight
from nishiki.formats.problems import CaptureError

NAMES = ["a.png", "b.png", "c.png", "d.png", "e.png"]


def project(**changes):
    images = [
        {"filename": name, "direction": dict(zip("xyz", map(float, light), strict=True)), "skip": False}
        for name, light in zip(NAMES, RING, strict=True)
    ]
    return {"folder": ".", "images": images} | changes


def photographs(folder, names=NAMES):
    for i, name in enumerate(names):
        write_frame(folder / name, np.full((16, 24, 3), 40.0 + i), np.uint8)


def test_a_project_names_the_photographs_and_tells_which_it_skips(tmp_path):
    photographs(tmp_path / "s")
    content = project()
    content["images"][1]["skip"] = True
    (tmp_path / "s/dome.relight").write_text(json.dumps(content))
    made = convert(tmp_path / "s", tmp_path / "c")
    assert [w.found for w in made.warnings if w.kind == "photograph-unlisted"] == ["1", "b.png"]
    capture = load_capture(tmp_path / "c")
    assert [f.light for f in capture.observed] == ["a", "c", "d", "e"]
    np.testing.assert_allclose(capture.lights.vectors, np.array(RING)[[0, 2, 3, 4]], atol=1e-8)


def test_info_json_gives_its_lights_in_the_order_of_the_photographs(tmp_path):
    photographs(tmp_path / "s")
    (tmp_path / "s/info.json").write_text(json.dumps({"width": 24, "lights": np.array(RING).ravel().tolist()}))
    made = convert(tmp_path / "s", tmp_path / "c")
    assert "lights-in-order" in {w.kind for w in made.warnings}
    np.testing.assert_allclose(load_capture(tmp_path / "c").lights.vectors, RING, atol=1e-8)


def test_an_lp_file_comes_first_and_another_info_json_is_none(tmp_path):
    photographs(tmp_path / "s")
    (tmp_path / "s/info.json").write_text('{"lights": "none"}')
    rows = [f"{name} {x} {y} {z}" for name, (x, y, z) in zip(NAMES, RING, strict=True)]
    (tmp_path / "s/l.lp").write_text("5\n" + "\n".join(rows) + "\n")
    convert(tmp_path / "s", tmp_path / "c")
    (tmp_path / "s/l.lp").unlink()
    (tmp_path / "s/info.json").write_text('{"title": "something else"}')
    with pytest.raises(CaptureError) as caught:
        convert(tmp_path / "s", tmp_path / "d")
    assert caught.value.problems[0].kind == "layout-unknown"


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("", "lights-unreadable"),
        ("[" * 100_000, "lights-unreadable"),
        ("[1, 2]", "lights-unreadable"),
        ('{"lights": [0, 0]}', "lights-unreadable"),
        ('{"lights": [0, 0, NaN]}', "lights-unreadable"),
        ('{"lights": [0, 0, 1e999]}', "lights-unreadable"),
        ('{"lights": [0, 0, ' + "9" * 400 + "]}", "lights-unreadable"),
        ('{"lights": [0, 0, true]}', "lights-unreadable"),
        ('{"lights": [0, 0, 0]}', "light-zero"),
        ('{"lights": [0, 0, -1]}', "light-behind"),
        ('{"lights": []}', "lights-none"),
        ('{"images": [1]}', "lights-unreadable"),
        ('{"images": [{"filename": "a.png", "direction": {"x": 0, "y": 0}}]}', "lights-unreadable"),
        ('{"images": [{"filename": 3, "direction": {"x": 0, "y": 0, "z": 1}}]}', "lights-unreadable"),
        ('{"lights": [' + "0," * 3 * 5000 + "0]}", "lights-many"),
        (json.dumps(project(images=project()["images"] * 2)), "light-duplicate"),
    ],
)
def test_what_is_no_such_file_is_reported(tmp_path, text, kind):
    (tmp_path / "x.relight").write_text(text)
    with pytest.raises(CaptureError) as caught:
        read_relight(tmp_path / "x.relight")
    assert caught.value.problems[0].kind == kind


def test_pictures_of_formats_that_are_not_read_are_reported(tmp_path):
    (tmp_path / "s").mkdir()
    for i in range(3):
        (tmp_path / f"s/{i}.tga").write_bytes(b"tga")
    (tmp_path / "s/l.lp").write_text("3\n0.tga 0 0 1\n1.tga 0.5 0 0.8\n2.tga 0 0.5 0.8\n")
    with refused(CaptureError, "0.tga", "2", kind="image-unsupported") as caught:
        convert(tmp_path / "s", tmp_path / "c")
    assert caught.value.problems[0].kind == "image-unsupported"
    for path in list((tmp_path / "s").glob("*.tga")):
        path.unlink()
    photographs(tmp_path / "s", ["0.png", "1.png", "2.png"])  # as after the conversion that is advised
    convert(tmp_path / "s", tmp_path / "c")
    assert load_capture(tmp_path / "c").lights.names == ("0", "1", "2")


@pytest.mark.data
def test_measured_files_hold_the_same_directions_as_the_lp_file(data, tmp_path):
    folder = data / "rti_marble"
    listed = read_lights(folder / "lights.lp")
    for name, digits in (("marble.relight", 3), ("info.json", 3)):
        found = read_relight(folder / name).lights
        np.testing.assert_allclose(found.vectors, listed.vectors, atol=0.6 * 10**-digits)
    assert read_relight(folder / "marble.relight").lights.names == listed.names
    shutil.copytree(folder, tmp_path / "s", ignore=shutil.ignore_patterns("lights.lp"))
    made = convert(tmp_path / "s", tmp_path / "c", link=True)
    assert made.photographs == 40
