"""Goniometer captures: tables, facts, conversion of measured tables, seal, check, and every way to get them wrong."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from capture_facts import goniometer_facts
from captures import edit_text, edit_yaml, write_frame
from goniometer_captures import HEADING, cloth, directions, edit_goniometer, make_goniometer, make_table, quarter_views
from refusals import refused

from nishiki.capture.convert import convert
from nishiki.capture.folder import load_capture
from nishiki.capture.goniometer import SAME_DEG, nearest
from nishiki.capture.goniometer_tables import is_table, read_table
from nishiki.capture.seal import seal
from nishiki.cli import main
from nishiki.errors import UserError
from nishiki.formats.problems import CaptureError
from nishiki.observations.check import check_capture
from nishiki.observations.goniometer_store import write_goniometer
from nishiki.stages.ingest import IngestSettings

OBLIQUE = [(30.0, 90.0, t, p) for t in (0.0, 30.0) for p in (0.0, 90.0, 270.0)]


def test_facts_of_photographs(tmp_path):
    normal = [(0.0, 0.0, t, p) for t, p in quarter_views()]
    folder = make_goniometer(tmp_path / "c", samples=normal + OBLIQUE, whites=[(0, 0, "", ""), (30, 90, 0, 0)])
    facts = goniometer_facts(load_capture(folder))
    assert facts.geometry == "goniometer"
    assert (facts.measurements, facts.normal, facts.oblique, facts.incidences) == (35, 29, 6, 2)
    assert (facts.pixels, facts.channels) == (256, 3)
    assert (facts.symmetry, facts.weave) == ("unknown", "satin")
    assert not facts.table
    assert not facts.regions
    kinds = {p.kind for p in check_capture(folder, level="full") if p.kind != "image-repeated"}
    assert kinds == set()  # far from the lobe the even test frames are the same files


def test_facts_of_a_table_and_of_regions(tmp_path):
    facts = goniometer_facts(load_capture(make_table(tmp_path / "t")))
    assert (facts.table, facts.pixels, facts.measurements, facts.normal) == (True, 1, 58, 29)
    folder = make_goniometer(tmp_path / "c", goniometer={"regions": "regions.png", "region_names": {"ground": 1}})
    write_frame(folder / "regions.png", np.ones((20, 24, 1)), np.uint8)
    facts = goniometer_facts(load_capture(folder))
    assert facts.regions
    assert facts.pixels == 480


def test_a_capture_is_the_same_before_and_after_sealing(tmp_path):
    folder = make_goniometer(tmp_path / "c")
    before = load_capture(folder).angles_deg
    seal(folder)
    capture = load_capture(folder)
    assert capture.sealed
    assert capture.angles_deg == before
    assert not [p for p in check_capture(folder, level="full") if p.severity == "error"]


def test_csv_and_cornell_tables_hold_the_same_numbers(tmp_path):
    """The one written with angles in degrees, the columns in any order, the other with angles in radians."""
    angles = np.array([(10.0, 0.0, 20.0, -30.0), (10.0, 180.0, 89.0, 359.0), (0.0, 0.0, 0.0, 0.0)])
    values = np.array([[0.1, 0.2], [0.3, 0.4], [1.5, 2.5e-3]])
    lines = ["# by hand", "theta_r_deg, phi_r_deg,450 nm,theta_i_deg,phi_i_deg,550 nm", ""]
    lines += [f"{a[2]},{a[3]},{v[0]},{a[0]},{a[1]},{v[1]}" for a, v in zip(angles, values, strict=True)]
    (tmp_path / "a.csv").write_text("\n".join(lines))
    numbers = np.concatenate([np.radians(angles), values], axis=1)
    rows = "\n".join(" ".join(f"{x:.12f}" for x in row) for row in numbers)
    (tmp_path / "b.brdf").write_text(f"# heading\n\n# num wls\n2\n\n# wls\n450\n550\n# values\n{rows}\n")
    a, b = read_table(tmp_path / "a.csv", "a.csv"), read_table(tmp_path / "b.brdf", "b.brdf")
    assert a.channels == b.channels == ("450 nm", "550 nm")
    np.testing.assert_array_equal(a.values, values)
    np.testing.assert_allclose(b.values, values, atol=1e-12)
    np.testing.assert_array_equal(np.column_stack([a.incident_deg, a.outgoing_deg]), angles)
    np.testing.assert_allclose(np.column_stack([b.incident_deg, b.outgoing_deg]), angles, atol=1e-9)


@pytest.mark.parametrize(
    ("a", "b", "same"),
    [((0, 0), (0, 137), True), ((30, 359.99), (30, 0), True), ((30, 0.05), (30, 0), True), ((30, 0.3), (30, 0), False),
     ((30, 0), (30.05, 0), True), ((30, 0), (30.2, 0), False), ((0.05, 0), (0.04, 180), True)],
)  # fmt: skip
def test_directions_are_one_within_a_tenth_of_a_degree(a, b, same):
    assert (nearest([a], [(80.0, 10.0), b])[0] < SAME_DEG) == same
    assert (nearest([b], [a])[0] < SAME_DEG) == same


def test_nearest_directions_against_every_pair():
    rng = np.random.default_rng(3)
    some, others = (list(zip(rng.uniform(0, 90, n), rng.uniform(-360, 360, n), strict=True)) for n in (300, 7))
    vectors = [directions([(t, p, t, p) for t, p in group])[0] for group in (some, others)]
    angles = [[np.arctan2(np.linalg.norm(np.cross(u, v)), u @ v) for v in vectors[1]] for u in vectors[0]]
    expected = np.degrees(angles).min(axis=1)
    np.testing.assert_allclose(nearest(some, others), expected, atol=1e-9)
    assert np.isinf(nearest(some, [])).all()


def test_a_table_is_converted_sealed_and_read_again(tmp_path, capsys):
    source = make_table(tmp_path / "s") / "reflectances.csv"
    made = convert(source, tmp_path / "c", title="My satin")
    assert (made.geometry, made.photographs) == ("goniometer", 58)
    assert not made.warnings
    capture = load_capture(tmp_path / "c")
    assert capture.settings.title == "My satin"
    assert (tmp_path / "c/reflectances.csv").read_bytes() == source.read_bytes()
    np.testing.assert_allclose(capture.table.values, cloth(*directions(capture.angles_deg)))
    (tmp_path / "folder").mkdir()
    shutil.copy(source, tmp_path / "folder/one.csv")
    (tmp_path / "folder/notes.csv").write_text("a,b\n1,2\n")
    with pytest.raises(SystemExit) as ended:
        main(["convert", str(tmp_path / "folder"), str(tmp_path / "d")])
    assert ended.value.code == 0
    assert "58 measurements" in capsys.readouterr().out
    assert load_capture(tmp_path / "d").sealed


def test_conversion_refuses_what_it_cannot_know(tmp_path):
    source = make_table(tmp_path / "s")
    with refused(CaptureError, kind="option-unusable"):
        convert(source / "reflectances.csv", tmp_path / "c", white=tmp_path)
    shutil.copy(source / "reflectances.csv", source / "second.csv")
    with refused(CaptureError, kind="layout-unknown"):
        convert(source, tmp_path / "c")
    (source / "second.csv").write_text("theta_i_deg,phi_i_deg,theta_r_deg,phi_r_deg,grey\n0,0,95,0,1\n")
    with pytest.raises(CaptureError, match="angle"):
        convert(source / "second.csv", tmp_path / "c")
    assert not (tmp_path / "c").exists()


def text(name, old, new):
    return lambda folder: edit_text(folder / name, old, new)


def block(**changes):
    return lambda folder: edit_goniometer(folder, **changes)


def picture(name, value, dtype=np.uint16, shape=(20, 24, 3)):
    return lambda folder: write_frame(folder / name, np.full(shape, value), dtype)


def regions(values=None, *, shape=(20, 24), **more):
    def change(folder):
        labels = np.ones(shape) if values is None else values
        write_frame(folder / "regions.png", labels[..., None], np.uint8)
        edit_goniometer(folder, regions="regions.png", **more)

    return change


BROKEN = {
    "no photograph of the cloth": (lambda f: (f / "frames.csv").write_text(f"{HEADING}\nwhite/w0.png,white,0,0,,,\n"),
                                   "samples-none", "role sample"),
    "no white frame": (text("frames.csv", "white/w0.png,white,0,0,,,\n", ""), "white-missing", "diffuse white board"),
    "angle missing": (text("frames.csv", "s3.png,sample,0.0,0.0,18.75,", "s3.png,sample,0.0,0.0,,"), "angle-missing",
                      "row 5"),
    "light of a board missing": (text("frames.csv", "w0.png,white,0,0", "w0.png,white,,"), "angle-missing", "light"),
    "half a view": (text("frames.csv", "w0.png,white,0,0,,", "w0.png,white,0,0,10,"), "angle-missing", "half"),
    "angle that is no number": (text("frames.csv", "s3.png,sample,0.0", "s3.png,sample,zero"), "angle-invalid", "zero"),
    "angle not finite": (text("frames.csv", "s3.png,sample,0.0", "s3.png,sample,nan"), "angle-invalid", "90"),
    "view below the cloth": (text("frames.csv", "s28.png,sample,0.0,0.0,75.0", "s28.png,sample,0.0,0.0,105.0"),
                             "angle-invalid", "theta_r_deg"),
    "horizontal light": (text("frames.csv", "s3.png,sample,0.0", "s3.png,sample,90"), "angle-invalid", "90"),
    "azimuth of two turns": (text("frames.csv", "s3.png,sample,0.0,0.0", "s3.png,sample,0.0,720"), "angle-invalid",
                             "-360 to 360"),
    "board grazed": (text("frames.csv", "w0.png,white,0,0", "w0.png,white,88,0"), "white-grazing", "85"),
    "unknown column": (text("frames.csv", "theta_i_deg", "theta_in_deg"), "unknown-column", "theta_i_deg"),
    "role of a plane": (text("frames.csv", "s3.png,sample", "s3.png,check"), "role-unknown", "sample | white | dark"),
    "exposure of one frame": (text("frames.csv", "18.75,15.0,", "18.75,15.0,0.5"), "exposure-partial", "rows without"),
    "photograph missing": (lambda f: (f / "frames/s3.png").unlink(), "image-missing", "s3.png"),
    "unknown key": (block(crop=12), "unknown-key", "goniometer.crop"),
    "block of a plane": (lambda f: edit_yaml(f, white={"reflectance": 0.9}), "wrong-value", "white_reflectance"),
    "reflectance above what is possible": (block(white_reflectance=99), "wrong-value", "white_reflectance"),
    "reflectances of two channels": (block(white_reflectance=[0.9, 0.9]), "wrong-value", "2 values for 3"),
    "unknown weave": (block(weave="denim"), "wrong-value", "satin"),
    "unknown symmetry": (block(symmetry="full"), "wrong-value", "quarter"),
    "window of nothing": (block(crop_px=0), "wrong-value", "crop_px"),
    "names without regions": (block(region_names={"a": 1}), "wrong-value", "region_names"),
    "two names of one region": (regions(region_names={"a": 1, "b": 1}), "wrong-value", "label of its own"),
    "one pitch of two": (regions(pixel_pitch_mm=0.1), "wrong-value", "regions_pitch_mm"),
    "table and regions": (regions(table="t.csv"), "wrong-value", "no regions"),
    "table missing": (block(table="t.csv"), "image-missing", "t.csv"),
    "table and photographs": (lambda f: (shutil.copy(make_table(f.parent / "t") / "reflectances.csv", f / "t.csv"),
                                         edit_goniometer(f, table="t.csv")), "frames-unexpected", "goniometer.table"),
    "regions missing": (block(regions="r.png"), "image-missing", "r.png"),
    "file outside": (block(regions="../r.png"), "outside-folder", "goniometer.regions"),
}  # fmt: skip
CONTENT = {
    "regions of another size": (regions(shape=(19, 24)), "regions-size", "20 x 24 as the frames"),
    "regions without a label": (regions(np.zeros((20, 24))), "regions-empty", "no pixel"),
    "region that is named and nowhere": (regions(region_names={"a": 1, "b": 7}), "regions-name", "7 (b)"),
    "board saturated": (picture("white/w0.png", 65535), "white-saturated", "less"),
    "board dark": (picture("white/w0.png", 300), "white-dark", "longer"),
    "codes beyond the bits": (lambda f: edit_yaml(f, camera={"channels": ["red", "green", "blue"], "bits": 12}),
                              "bits-exceeded", "4095"),
    "frame of another size": (picture("frames/s3.png", 3000, shape=(20, 22, 3)), "image-size", "s3.png"),
    "frame of another depth": (picture("frames/s3.png", 90, np.uint8), "image-depth", "s3.png"),
    "frame of one channel": (picture("frames/s3.png", 3000, shape=(20, 24, 1)), "channels-differ", "s3.png"),
    "frame cut": (lambda f: (f / "frames/s3.png").write_bytes((f / "frames/s3.png").read_bytes()[:-30]),
                  "image-truncated", "s3.png"),
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN, ids=lambda name: name)
def test_broken_tables_are_refused_with_file_and_remedy(tmp_path, case):
    change, kind, words = BROKEN[case]
    folder = make_goniometer(tmp_path / "c")
    change(folder)
    with pytest.raises(CaptureError) as caught:
        load_capture(folder)
    problems = [p for p in caught.value.problems if p.kind == kind]
    assert problems, caught.value
    assert words in str(problems[0])
    assert problems[0].file
    assert [p for p in check_capture(folder) if p.kind == kind]


def test_frames_are_not_blamed_where_only_the_yaml_is_broken(tmp_path):
    folder = make_goniometer(tmp_path / "c")
    edit_text(folder / "capture.yaml", "format: 1", "format: [")
    with pytest.raises(CaptureError) as caught:
        load_capture(folder)
    assert [p.kind for p in caught.value.problems] == ["yaml-invalid"]


@pytest.mark.parametrize("case", CONTENT, ids=lambda name: name)
def test_broken_photographs_are_found_by_check_and_by_ingest(tmp_path, case):
    change, kind, words = CONTENT[case]
    folder = make_goniometer(tmp_path / "c")
    change(folder)
    found = [p for p in check_capture(folder, level="full") if p.kind == kind]
    assert found
    assert words in str(found[0])
    with pytest.raises(UserError, match=str(found[0].file)):
        write_goniometer(load_capture(folder), tmp_path, settings=IngestSettings())


HEAD = "theta_i_deg,phi_i_deg,theta_r_deg,phi_r_deg,grey\n"
TABLES = {
    "column missing": ("theta_i_deg,phi_i_deg,theta_r_deg,grey\n0,0,0,1\n", "table-columns", "phi_r_deg"),
    "no channel": ("theta_i_deg,phi_i_deg,theta_r_deg,phi_r_deg\n0,0,0,1\n", "table-columns", "column"),
    "channel twice": (HEAD.replace("grey", "a,a") + "0,0,0,0,1,1\n", "table-columns", "once"),
    "empty": ("", "table-columns", "line"),
    "heading alone": (HEAD, "table-empty", "row"),
    "row too short": (HEAD + "0,0,0,0,1\n0,0,0,0\n", "table-unreadable", "line 3"),
    "word for a number": (HEAD + "0,0,0,0,bright\n", "table-unreadable", "bright"),
    "not finite": (HEAD + "0,0,0,0,nan\n", "table-value", "finite"),
    "below the horizon": (HEAD + "# a remark\n0,0,0,0,1\n0,0,91,0,1\n", "angle-invalid", "line 4"),
    "nothing but zeros": (HEAD + "0,0,0,0,0\n0,0,9,0,-1\n", "table-value", "above 0"),
}


@pytest.mark.parametrize("case", TABLES, ids=lambda name: name)
def test_broken_reflectances_are_refused_with_line_and_remedy(tmp_path, case):
    rows, kind, words = TABLES[case]
    with pytest.raises(CaptureError) as caught:
        load_capture(make_table(tmp_path / "t", rows=rows))
    assert {p.kind for p in caught.value.problems} == {kind}
    assert words in str(caught.value)
    assert "reflectances.csv" in str(caught.value)


@pytest.mark.parametrize(
    ("content", "words"),
    [("2\n400 500\n0 0 0 0 1 1\n0 0 0 0 1\n", "found 5"), ("two\n", r"x\.brdf"),
     ("2.5\n400 500\n", r"x\.brdf"), ("# nothing\n", r"x\.brdf"), ("9\n400\n", "9"),
     ("1\n400\n0 0 3 0 1\n", "90")],
)  # fmt: skip
def test_broken_cornell_tables(tmp_path, content, words):
    (tmp_path / "x.brdf").write_text(content)
    with pytest.raises(CaptureError, match=words):
        read_table(tmp_path / "x.brdf", "x.brdf")


def test_what_is_worth_a_warning(tmp_path):
    samples = [(45.0, 0.0, t, p) for t, p in quarter_views()]
    folder = make_goniometer(tmp_path / "c", samples=samples)
    kinds = {p.kind: str(p) for p in check_capture(folder)}
    assert set(kinds) == {"normal-few", "white-cosine"}
    assert "29 of 29" in kinds["white-cosine"]
    write_frame(folder / "frames/s3.png", np.full((20, 24, 3), 65535.0))
    (folder / "forgotten.png").write_bytes(b"x")
    kinds = {p.kind: str(p) for p in check_capture(folder, level="full")}
    assert {"some-saturated", "file-unlisted"} <= set(kinds)
    assert "1 of 29: frames/s3.png" in kinds["some-saturated"]
    dim = make_table(tmp_path / "t", rows=HEAD + "0,0,0,0,1\n0,0,9,0,0\n")
    assert [p.kind for p in check_capture(dim, level="full")] == ["table-dark"]


def test_the_example_of_the_documentation_is_a_sound_capture(tmp_path):
    """What the page shows as capture.yaml and frames.csv is what the reader accepts."""
    page = (Path(__file__).resolve().parents[2] / "docs/capture-folder.md").read_text().split("## Goniometers")[1]
    blocks = dict(re.findall(r"```\w*\n# (capture\.yaml|frames\.csv)\n(.*?)```", page, re.DOTALL))
    assert set(blocks) == {"capture.yaml", "frames.csv"}
    for name, content in blocks.items():
        (tmp_path / name).write_text(content)
    for i, line in enumerate(blocks["frames.csv"].splitlines()[1:]):
        file = line.split(",")[0]
        level = (2000 if file.startswith("white") else 100 if file.startswith("dark") else 800) + 50 * i
        write_frame(tmp_path / file, np.full((20, 24, 3), float(level)))
    assert [p.kind for p in check_capture(tmp_path, level="full")] == ["normal-few"]  # the page shows three of 540
    facts = goniometer_facts(load_capture(tmp_path))
    assert (facts.normal, facts.oblique, facts.weave) == (3, 1, "satin")


@pytest.mark.data
def test_measured_tables_are_converted_and_checked(data, tmp_path):
    tables = sorted(data.glob("*/*.brdf"))
    assert tables, "no table of reflectances in the data"
    for table in tables:
        made = convert(table, tmp_path / table.stem)
        capture = load_capture(tmp_path / table.stem)
        assert made.photographs == len(capture.table.values) > 1000
        assert len(capture.channels) == 31
        assert capture.channels[0] == "400 nm"
        facts = goniometer_facts(capture)
        assert (facts.normal, facts.incidences) == (0, 8)
        assert not [p for p in check_capture(tmp_path / table.stem, level="full") if p.severity == "error"]


@pytest.mark.parametrize(
    ("columns", "held"),
    [
        (("red", "brdf_mc_stderr"), "error"),
        (("brdf_per_sr", "brdf_mc_stderr"), "error"),
        (("brdf_per_sr", "radiance_factor"), "radiance factor"),
        (("radiance_factor_r", "radiance_factor_g"), "radiance factor"),
        (("Reflectance factor 500 nm",), "radiance factor"),
        (("red", "brdf_green"), "BRDF"),
        (("theta_deg", "red"), "angle"),
    ],
)
def test_columns_of_other_quantities_are_not_taken_for_channels(tmp_path, columns, held):
    heading = "theta_i_deg,phi_i_deg,theta_r_deg,phi_r_deg," + ",".join(columns)
    (tmp_path / "t.csv").write_text(f"{heading}\n0,0,10,0{',0.1' * len(columns)}\n")
    with pytest.raises(CaptureError) as caught:
        read_table(tmp_path / "t.csv", "t.csv")
    (problem,) = caught.value.problems
    assert problem.kind == "table-quantities"
    assert held in problem.found


@pytest.mark.parametrize(
    "columns", [("red", "green", "blue"), ("brdf_r_per_sr", "brdf_g_per_sr"), ("400 nm", "410 nm"), ("r", "variety")]
)
def test_columns_of_one_quantity_are_channels(tmp_path, columns):
    heading = "theta_i_deg,phi_i_deg,theta_r_deg,phi_r_deg," + ",".join(columns)
    (tmp_path / "t.csv").write_text(f"{heading}\n0,0,10,0{',0.1' * len(columns)}\n")
    assert read_table(tmp_path / "t.csv", "t.csv").channels == columns
    assert convert(tmp_path / "t.csv", tmp_path / "c").channels == columns


def spreadsheet(text, mark, decimal):
    """The table as a spreadsheet of another country writes it."""
    return "\n".join(line.replace(",", mark).replace(".", decimal) for line in text.split("\n"))


@pytest.mark.parametrize("mark", [";", "\t"])
@pytest.mark.parametrize(("before", "decimal"), [("", "."), ("", ","), ("sep=;\n", ","), ("\ufeff", ",")])
def test_tables_of_spreadsheets_are_read(tmp_path, mark, before, decimal):
    path = make_table(tmp_path / "c") / "reflectances.csv"
    table = read_table(path, path.name)
    path.write_text(before + spreadsheet(path.read_text(), mark, decimal), encoding="utf-8")
    again = read_table(path, path.name)
    assert is_table(path)
    assert again.channels == table.channels
    np.testing.assert_array_equal(again.values, table.values)
    np.testing.assert_array_equal(again.outgoing_deg, table.outgoing_deg)


def test_frames_of_spreadsheets_are_read(tmp_path):
    folder = make_goniometer(tmp_path / "c", exposure_s=0.5)
    frames = load_capture(folder).frames
    text = (folder / "frames.csv").read_text()
    (folder / "frames.csv").write_text("\n".join(
        ";".join(c if "/" in c else c.replace(".", ",") for c in line.split(",")) for line in text.split("\n")
    ))  # fmt: skip
    assert load_capture(folder).frames == frames


def test_the_table_of_a_spreadsheet_gives_the_same_as_the_plain_one(data):
    folder = data / "faulty_captures" / "objects"
    plain = read_table(folder / "17-goniometer-radians" / "degrees.csv", "t")
    for name in ("19-goniometer-excel/semicolon.csv", "17-goniometer-radians/radians_named.csv"):
        table = read_table(folder / name, "t")
        np.testing.assert_array_equal(table.values, plain.values)
        np.testing.assert_allclose(table.outgoing_deg, plain.outgoing_deg, atol=5e-4)
        np.testing.assert_allclose(table.incident_deg, plain.incident_deg, atol=5e-4)
    with pytest.raises(CaptureError) as refused:
        read_table(folder / "17-goniometer-radians" / "radians.csv", "t")
    assert [p.kind for p in refused.value.problems] == ["angles-radians"]


@pytest.mark.parametrize(
    ("names", "radians", "kinds"),
    [
        ("theta_i_rad,phi_i_rad,theta_r_rad,phi_r_rad", True, []),
        ("theta_in (rad),phi_in (rad),theta_out (rad),phi_out (rad)", True, []),
        ("theta_i,phi_i,theta_o,phi_o", True, ["angles-unit"]),
        ("thetai,phii,thetar,phir", False, ["angles-unit"]),
        ("Theta_L [°],Phi_L [°],Theta_V [°],Phi_V [°]", False, []),
        ("theta_i_deg,phi_i_deg,theta_r_deg,phi_r_deg", True, None),
    ],
)
def test_angles_are_read_in_the_unit_that_is_named_or_certain(tmp_path, names, radians, kinds):
    path = make_table(tmp_path / "c") / "reflectances.csv"
    table = read_table(path, path.name)
    _, *lines = path.read_text().split("\n")
    rows = [line.split(",") for line in lines if line]
    if radians:
        rows = [[*(repr(float(np.radians(float(v)))) for v in row[:4]), *row[4:]] for row in rows]
    path.write_text("\n".join([f"{names},red,green,blue", *map(",".join, rows)]) + "\n")
    assert is_table(path)
    if kinds is None:
        with pytest.raises(CaptureError) as refused:
            read_table(path, path.name)
        assert [p.kind for p in refused.value.problems] == ["angles-radians"]
        path.write_text(path.read_text().replace("_deg", "_rad", 4))  # as the remedy says
        kinds = []
    again = read_table(path, path.name)
    assert [note.kind for note in again.warnings] == kinds
    np.testing.assert_allclose(again.incident_deg, table.incident_deg, atol=1e-9)
    np.testing.assert_allclose(again.outgoing_deg, table.outgoing_deg, atol=1e-9)


def test_frames_whose_angles_are_radians_are_named_and_read_as_such(tmp_path):
    folder = make_goniometer(tmp_path / "c")
    frames = load_capture(folder).frames
    heading, *lines = (folder / "frames.csv").read_text().strip().split("\n")
    rows = [line.split(",") for line in lines]
    rows = [[*row[:2], *(repr(float(np.radians(float(v)))) if v else "" for v in row[2:6]), *row[6:]] for row in rows]
    (folder / "frames.csv").write_text("\n".join([heading, *map(",".join, rows)]))
    with pytest.raises(CaptureError) as refused:
        load_capture(folder)
    assert "angles-radians" in {p.kind for p in refused.value.problems}
    (folder / "frames.csv").write_text("\n".join([heading.replace("_deg", "_rad"), *map(",".join, rows)]))
    for ours, theirs in zip(load_capture(folder).frames, frames, strict=True):
        pairs = zip(ours.angles_deg, theirs.angles_deg, strict=True)
        assert all(a == b or a == pytest.approx(b, abs=1e-9) for a, b in pairs)


def test_radiance_factors_are_read_where_they_are_stated(tmp_path):
    heading = "theta_i_deg,phi_i_deg,theta_r_deg,phi_r_deg,radiance_factor_r,radiance_factor_g"
    (tmp_path / "t.csv").write_text(f"{heading}\n0,0,10,0,0.5,0.25\n")
    np.testing.assert_allclose(
        read_table(tmp_path / "t.csv", "t.csv", values="radiance_factor").values, [[0.5 / np.pi, 0.25 / np.pi]]
    )


def write_cloth(
    path, *, lights=((0, 0), (30, 0), (30, 90), (60, 0), (60, 90)), change=lambda angles, values: (angles, values)
):
    """A table of the test's cloth over whole hemispheres, as `change` makes it of angles (n, 4) and values (n, 3)."""
    views = [(t, p) for t in range(0, 90, 10) for p in range(0, 360, 30) if t or not p]
    angles = np.array([(*light, *view) for light in lights for view in views], float)
    angles, values = change(angles, cloth(*directions(angles)))
    rows = [",".join(map(repr, [*map(float, a), *map(float, v)])) for a, v in zip(angles, values, strict=True)]
    path.write_text("theta_i_deg,phi_i_deg,theta_r_deg,phi_r_deg,red,green,blue\n" + "\n".join(rows) + "\n")


def counted_from(side):
    """phi_r counted from the lamp (0) or from the side opposite to it (180)."""

    def change(angles, values):
        angles = angles.copy()
        oblique = angles[:, 0] > 0
        angles[oblique, 3] = (angles[oblique, 3] - angles[oblique, 1] - side) % 360
        return angles, values

    return change


FAULTY_TABLES = {
    "per cent": (lambda a, v: (a, 100 * np.pi * v), "reflectance-energy", {"values": "radiance_factor_percent"}),
    "radiance factor": (lambda a, v: (a, 20 * np.pi * v), "reflectance-energy", None),
    "cosine of the view": (
        lambda a, v: (a, v * np.cos(np.radians(a[:, 2:3]))), "reciprocity", {"values": "brdf_cos_view"}
    ),
    "cosine of the light": (
        lambda a, v: (a, v * np.cos(np.radians(a[:, :1]))), "reciprocity", {"values": "brdf_cos_light"}
    ),
    "from the mirror direction": (counted_from(180), "reciprocity", {"azimuths": "mirror"}),
    "from the lamp": (counted_from(0), "reciprocity", {"azimuths": "lamp"}),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTY_TABLES)
def test_tables_that_no_surface_has_are_refused_with_what_makes_them_right(tmp_path, fault):
    change, kind, right = FAULTY_TABLES[fault]
    write_cloth(tmp_path / "sound.csv")
    write_cloth(tmp_path / "t.csv", change=change)
    with pytest.raises(CaptureError) as refused:
        convert(tmp_path / "t.csv", tmp_path / "c", examine=check_capture)
    (problem,) = refused.value.problems
    assert (problem.kind, problem.file) == (kind, "t.csv")
    for key, option in (right or {}).items():
        assert f"--{key} {option} " in problem.remedy
    if right is None:
        return
    convert(tmp_path / "t.csv", tmp_path / "c", examine=check_capture, **right)
    convert(tmp_path / "sound.csv", tmp_path / "sound", examine=check_capture)
    table, sound = load_capture(tmp_path / "c").table, load_capture(tmp_path / "sound").table
    np.testing.assert_allclose(table.values, sound.values, rtol=1e-9)
    np.testing.assert_allclose((table.outgoing_deg - sound.outgoing_deg) % 360 % 360, 0, atol=1e-9)
    assert "reciprocity" not in {p.kind for p in check_capture(tmp_path / "c")}
    stated = {key: {"values": "brdf", "azimuths": "cloth"}[key] for key in right}
    convert(tmp_path / "t.csv", tmp_path / "as it is", examine=check_capture, **stated)
    assert (kind, "warning") in {(p.kind, p.severity) for p in check_capture(tmp_path / "as it is")}


@pytest.mark.parametrize("symmetry", ["unknown", "quarter"])
def test_a_twill_without_mirror_planes_is_no_contradiction_unless_it_is_said_to_have_them(tmp_path, symmetry):
    def twilled(angles, values):
        incident, outgoing = directions(angles)
        half = incident + outgoing
        return angles, values * np.exp(2 * half[:, :1] * half[:, 1:2])

    lights = [(t, p) for t in (30, 60) for p in range(0, 360, 90 if t == 30 else 30)]
    write_cloth(tmp_path / "t.csv", lights=((0, 0), *lights), change=twilled)
    folder = tmp_path / "c"
    folder.mkdir()
    shutil.copy(tmp_path / "t.csv", folder)
    block = f"{{table: t.csv, values: brdf, azimuths: cloth, symmetry: {symmetry}}}"
    (folder / "capture.yaml").write_text(f"format: 1\ntitle: t\ngeometry: goniometer\ngoniometer: {block}\n")
    assert ("reciprocity" in {p.kind for p in check_capture(folder)}) == (symmetry == "quarter")


def test_azimuths_from_the_mirror_direction_show_where_the_surface_shines(tmp_path):
    """Lights in one plane have no pairs that tell."""
    write_cloth(tmp_path / "t.csv", lights=((30, 0), (45, 0), (60, 0)), change=counted_from(180))
    convert(tmp_path / "t.csv", tmp_path / "c", examine=check_capture)
    assert "shine-backward" in {p.kind for p in check_capture(tmp_path / "c")}


@pytest.mark.parametrize("name", ["garnet_red.brdf", "krylon_blue.brdf"])
def test_measured_paints_raise_no_alarm(data, tmp_path, name):
    convert(data / "cornell_brdf" / name, tmp_path / "c", examine=check_capture)
    assert {p.kind for p in check_capture(tmp_path / "c")} == {"table-dark"}


def test_options_of_tables_mean_nothing_to_photographs(tmp_path):
    with pytest.raises(CaptureError) as refused:
        convert(make_goniometer(tmp_path / "c") / "white", tmp_path / "d", values="brdf")
    assert refused.value.problems[0].kind in ("option-unusable", "layout-unknown")
    folder = make_goniometer(tmp_path / "e", goniometer={"values": "radiance_factor"})
    with pytest.raises(CaptureError) as refused:
        load_capture(folder)
    assert refused.value.problems[0].kind == "wrong-value"
