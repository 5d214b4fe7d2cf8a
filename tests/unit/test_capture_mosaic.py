"""A capture of several fields: its table, what is refused, its identity, its seals, and how it is made of folders."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from captures import CHANNELS, RING, TITLE, make_capture, write_frame
from relightable_images import rgb_file, write_relight

from nishiki.capture.convert import convert
from nishiki.capture.folder import examine, load_capture
from nishiki.capture.mosaic import MosaicCapture, is_capture
from nishiki.capture.seal import seal
from nishiki.commands.capturing import seal_folder
from nishiki.formats.problems import CaptureError
from nishiki.observations.check import check_capture

TABLE = "field,path,x_mm,y_mm\na1,fields/a1,0,0\na2,fields/a2,,\n"


def make_mosaic(folder, table=TABLE, **second):
    make_capture(folder / "fields/a1", seed=1)
    make_capture(folder / "fields/a2", **{"seed": 2, **second})
    (folder / "fields.csv").write_text(table)
    return folder


def found(folder):
    return {(problem.kind, problem.file) for problem in examine(folder)[1] if problem.severity == "error"}


def test_fields_are_read_with_their_captures_and_positions(tmp_path):
    capture = load_capture(make_mosaic(tmp_path))
    assert isinstance(capture, MosaicCapture)
    assert [(field.name, field.position_mm) for field in capture.fields] == [("a1", (0, 0)), ("a2", None)]
    assert [len(each.observed) for each in capture.captures] == [5, 5]
    assert (capture.geometry, capture.sealed, capture.settings.title) == ("mosaic", False, TITLE)


@pytest.mark.parametrize(
    ("table", "problem"),
    [
        ("field,path\na1,fields/a1\n", ("fields-few", "fields.csv")),
        ("field,place\na1,fields/a1\na2,fields/a2\n", ("fields-columns", "fields.csv")),
        ("field,path\na1,fields/a1\nA1,fields/a2\n", ("field-repeated", "fields.csv row 3")),
        ("field,path\na1,fields/a1\na2,fields/a1\n", ("field-repeated", "fields.csv row 3")),
        ("field,path\na1,fields/a1\na--2,fields/a2\n", ("field-name", "fields.csv row 3")),
        ("field,path\na1,fields/a1\na2,../a2\n", ("outside-folder", "fields.csv row 3")),
        ("field,path\na1,fields/a1\na2,.\n", ("outside-folder", "fields.csv row 3")),
        ("field,path\na1,fields/a1\na2,./fields//a1\n", ("field-repeated", "fields.csv row 3")),
        ("field,path\na1,fields/a1\na2,fields/a3\n", ("folder-missing", "fields.csv row 3")),
        ("field,path,x_mm\na1,fields/a1,3\na2,fields/a2,\n", ("field-position", "fields.csv row 2")),
        ("field,path,x_mm,y_mm\na1,fields/a1,3,4\na2,fields/a2,one,2\n", ("field-position", "fields.csv row 3")),
    ],
)
def test_a_table_that_breaks_the_rules_is_refused_by_row(tmp_path, table, problem):
    assert found(make_mosaic(tmp_path, table)) == {problem}


def give_a_lamp(folder):
    (folder / "lamp.csv").write_text("wavelength_nm,power\n400,1\n700,2\n")
    settings = (folder / "capture.yaml").read_text()
    (folder / "capture.yaml").write_text(settings + "illuminant: lamp.csv\n")


def test_fields_of_other_channels_lamps_or_scales_are_refused_by_file(tmp_path):
    folder = make_mosaic(tmp_path, channels=("blue",), yaml_extra={"pixel_pitch_mm": 0.1})
    give_a_lamp(folder / "fields/a2")
    keys = ("camera.channels", "illuminant", "pixel_pitch_mm")
    assert found(folder) == {("fields-differ", f"fields/a2/capture.yaml {key}") for key in keys}


def test_a_field_that_cannot_be_read_is_named_with_its_file(tmp_path):
    folder = make_mosaic(tmp_path)
    (folder / "fields/a2/lights.lp").unlink()
    assert all(file.startswith("fields/a2/") for _, file in found(folder))
    assert found(folder)


def test_sealing_seals_each_field_and_the_same_photographs_twice_are_refused(tmp_path):
    folder = make_mosaic(tmp_path)
    digest = seal_folder(folder)
    assert load_capture(folder).sealed
    assert seal_folder(folder) == digest
    shutil.rmtree(folder / "fields/a2")
    shutil.copytree(folder / "fields/a1", folder / "fields/a2")
    assert found(folder) == {("field-repeated", "fields/a2")}


def test_the_identity_depends_on_photographs_names_and_positions_and_not_on_the_order(tmp_path):
    folder = make_mosaic(tmp_path)
    seal_folder(folder)
    digests = []
    for table in (
        TABLE,
        "field,path\na2,fields/a2\na1,fields/a1\n",
        TABLE.replace("0,0", "0,1"),
        TABLE.replace("a2,f", "b2,f"),
    ):
        (folder / "fields.csv").write_text(table)
        digests.append(load_capture(folder).digest)
    (folder / "fields.csv").write_text("field,path,y_mm,x_mm\na2,fields/a2,,\na1,fields/a1,0,0\n")
    assert load_capture(folder).digest == digests[0]
    assert len(set(digests)) == 4


def test_check_tells_what_is_wrong_in_a_field_with_the_place_of_its_file(tmp_path):
    folder = make_mosaic(tmp_path)
    seal(folder / "fields/a1")
    frame = folder / "fields/a1/data/frames/L01.png"
    frame.write_bytes(frame.read_bytes()[:-40])
    problems = check_capture(folder, level="full")
    errors = {problem.file for problem in problems if problem.severity == "error"}
    assert errors
    assert all(file.startswith("fields/a1/") for file in errors)


def photographs(folder, fields=("left", "right"), *, lamps_beside=True):
    """Folders of photographs under the same lamps, which are listed beside them."""
    rng = np.random.default_rng(5)
    lines = [f"L{i}.png {x} {y} {z}" for i, (x, y, z) in enumerate(RING)]
    for name in fields:
        texture = 0.3 + 0.4 * rng.random((24, 32, 3))
        for i, (_, _, z) in enumerate(RING):
            write_frame(folder / name / f"L{i}.png", 40000 * z * texture)
        if not lamps_beside:
            (folder / name / "lamps.lp").write_text(f"{len(RING)}\n" + "\n".join(lines) + "\n")
    if lamps_beside:
        (folder / "lamps.lp").write_text(f"{len(RING)}\n" + "\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize("lamps_beside", [True, False])
def test_folders_of_photographs_become_fields(tmp_path, lamps_beside):
    source = photographs(tmp_path / "wall", lamps_beside=lamps_beside)
    made = convert(source, tmp_path / "capture", fields=True, width_mm=64.0)
    capture = load_capture(tmp_path / "capture")
    assert (made.geometry, made.layout, made.photographs) == ("mosaic", "fields", 10)
    assert [(field.name, field.place, field.position_mm) for field in capture.fields] == [
        ("left", "fields/left", None),
        ("right", "fields/right", None),
    ]
    assert [each.settings.camera.channels for each in capture.captures] == [CHANNELS, CHANNELS]
    assert {each.settings.title for each in capture.captures} == {"wall"}


def test_a_table_beside_the_folders_names_the_fields_and_their_positions(tmp_path):
    source = photographs(tmp_path / "wall", ("one", "two", "tests"))
    (source / "fields.csv").write_text("field;path;x_mm;y_mm\nb;two;10,5;0\na;one;;\n")
    assert not is_capture(source)
    convert(source, tmp_path / "capture")
    fields = load_capture(tmp_path / "capture").fields
    assert [(field.name, field.position_mm) for field in fields] == [("b", (10.5, 0.0)), ("a", None)]
    assert is_capture(tmp_path / "capture")


def test_relightable_images_become_fields(tmp_path):
    (tmp_path / "wall/right").mkdir(parents=True)
    write_relight(tmp_path / "wall/left", "hsh", "rgb", 27)
    (tmp_path / "wall/right/object.ptm").write_bytes(rgb_file()[0])
    made = convert(tmp_path / "wall", tmp_path / "capture", fields=True)
    capture = load_capture(tmp_path / "capture")
    assert made.geometry == capture.geometry == "mosaic"
    assert [each.settings.rendered_from for each in capture.captures] == ["relight/info.json", "object.ptm"]
    assert made.photographs == sum(len(each.frames) for each in capture.captures)
    assert {problem.kind for problem in made.warnings} >= {"rendered"}


@pytest.mark.parametrize(
    ("fields", "given", "kind"),
    [
        (("left", "right"), {}, "layout-unknown"),
        (("left",), {"fields": True}, "fields-few"),
        (("left", "far right"), {"fields": True}, "field-name"),
        (("left", "right"), {"fields": True, "mask": Path("mask.png")}, "option-unusable"),
    ],
)
def test_folders_that_nobody_calls_fields_and_unusable_ones_are_refused(tmp_path, fields, given, kind):
    source = photographs(tmp_path / "wall", fields, lamps_beside=False)
    with pytest.raises(CaptureError) as refused:
        convert(source, tmp_path / "capture", **given)
    assert refused.value.problems[0].kind == kind
    assert not (tmp_path / "capture").exists()
