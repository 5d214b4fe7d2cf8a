"""Views of an object as linear light: values, validity, white boards, silhouettes, the store and the encoding."""

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from captures import edit_block, edit_text, edit_yaml, make_turntable, turntable_value, write_frame
from hypothesis import given
from hypothesis import strategies as st
from refusals import refused

from nishiki.capture.folder import load_capture
from nishiki.errors import UserError
from nishiki.formats.coding import LINEAR, SRGB
from nishiki.observations.kernels import ANY_CODE, decode_codes
from nishiki.observations.linearise import code_table, picture_edges
from nishiki.observations.views import Views, decode, encode
from nishiki.observations.views_store import write_views
from nishiki.stages.ingest import IngestSettings

ROWS, COLUMNS, TOP = 20, 24, 4095
PROJECT = Path(__file__).resolve().parents[2]


def ingested(folder, output, **settings):
    result = write_views(load_capture(folder), output, settings=IngestSettings(**settings))
    return Views(output), result


def codes_of(view, light=0, state=0):
    return np.rint(TOP * turntable_value(view, light, state, ROWS, COLUMNS)) / TOP


def test_views_are_the_codes_as_fractions_of_full_scale(tmp_path):
    views, result = ingested(make_turntable(tmp_path / "c"), tmp_path)
    assert views.views == ("v0", "v1", "v2", "v3", "v4")
    assert (views.lights, views.states, views.shape) == (("",), ("",), (ROWS, COLUMNS))
    assert (views.channels, views.encoding) == (("red", "green", "blue"), "linear")
    assert views.full_turn
    assert views.unit == "mm"
    assert views.lamp == {"kind": "unknown", "vectors": None}
    for i, name in enumerate(views.views):
        values, valid = views.read(name)
        assert values.dtype == np.float32
        np.testing.assert_allclose(values, codes_of(i), rtol=1e-6)
        assert valid.all()
        assert (views.read(i)[0] == values).all()
    assert (views.silhouette("v2").sum(), views.silhouette(2).dtype) == (120, bool)
    assert result["silhouettes"] == 5
    assert views.matrices["v3"].shape == (3, 4)


def test_every_light_and_state_is_found(tmp_path):
    folder = make_turntable(tmp_path / "c", lights=("a", "b"), states=("on", "off"))
    views, _ = ingested(folder, tmp_path)
    assert views.states == ("off", "on")
    for j, light in enumerate(("a", "b")):
        for k, state in enumerate(("on", "off")):
            for i in range(5):
                values, _ = views.read(i, light=light, state=state)
                np.testing.assert_allclose(values, codes_of(i, j, k), rtol=1e-6)
    first, _ = views.read(3)
    np.testing.assert_allclose(first, codes_of(3, 0, 1), rtol=1e-6)
    with refused(UserError, "crossed", "off"):
        views.read(0, state="crossed")
    with refused(UserError, "5", by="_view"):
        views.read(5)


def test_dark_level_white_board_and_exposures_divide_out(tmp_path):
    """A surface of reflectance r in front of a board of 0.9 is r, whatever the exposure; 0.5 of full scale is white."""
    folder = make_turntable(tmp_path / "c", dark=True, white=True, yaml_extra={"white": {"reflectance": 0.9}})
    rows = (folder / "frames.csv").read_text().splitlines()
    times = {"frames/0_0_0.png": 0.25, "frames/1_0_0.png": 0.5, "white/0.png": 0.125, "dark/dark.png": ""}
    timed = [rows[0] + ",exposure_s", *(f"{row},{times.get(row.split(',')[0], 1)}" for row in rows[1:])]
    (folder / "frames.csv").write_text("\n".join(timed) + "\n")
    views, result = ingested(folder, tmp_path)
    # at the longest time of 1 s the board of 0.125 s would be at 8 * 0.5
    for i, seconds in enumerate((0.25, 0.5, 1, 1, 1)):
        expected = (np.rint(100 + TOP * turntable_value(i, 0, 0, ROWS, COLUMNS)) - 100) / TOP / seconds
        values, valid = views.read(i)
        np.testing.assert_allclose(values, expected * 0.9 / (8 * 0.5), rtol=2e-3)
        assert valid.all()
    assert abs(result["white_level"][0] - 0.5) < 1e-3
    iso = [rows[0] + ",iso", *(f"{row},{100 * float(times.get(row.split(',')[0], 1) or 1):g}" for row in rows[1:])]
    (folder / "frames.csv").write_text("\n".join(iso) + "\n")
    (tmp_path / "iso").mkdir()
    sensitive, _ = ingested(folder, tmp_path / "iso")
    for i in range(5):
        np.testing.assert_allclose(sensitive.read(i)[0], views.read(i)[0], rtol=1e-6)


def test_boards_of_polariser_states_are_kept_as_means(tmp_path):
    folder = make_turntable(tmp_path / "c", states=("off", "on"), boards=("off", "on"), dark=True)
    write_frame(folder / "white/more.png", np.full((ROWS, COLUMNS, 3), 100 + 0.2 * TOP))
    with (folder / "frames.csv").open("a") as table:
        table.write("white/more.png,white,,,on,\n")
    views, result = ingested(folder, tmp_path)
    np.testing.assert_allclose(views.board("off")[5, 7], [0.6, 0.54, 0.48], atol=2e-4)
    np.testing.assert_allclose(views.board("on")[5, 7], [0.25, 0.235, 0.22], atol=2e-4)
    assert views.board("on").shape == (ROWS, COLUMNS, 3)
    assert views.board("on").dtype == np.float32
    assert views.board("45") is None
    assert result["boards"] == 2
    values, _ = views.read(0, state="off")  # not divided by a board that is kept apart
    np.testing.assert_allclose(values, codes_of(0), atol=2 / TOP)


def test_both_kinds_of_boards_share_their_units(tmp_path):
    folder = make_turntable(tmp_path / "c", states=("off", "on"), boards=("off", "on"), white=True)
    views, _ = ingested(folder, tmp_path)
    np.testing.assert_allclose(views.board("off")[9, 9], [1.2, 1.08, 0.96], atol=1e-3)
    np.testing.assert_allclose(views.read(0)[0], codes_of(0) / 0.5, rtol=2e-3)


def test_lamps_in_the_cameras_frame(tmp_path):
    folder = make_turntable(tmp_path / "c", lights=("b", "a"), white=True)
    (folder / "l.csv").write_text("light,x,y,z\na,0,0,-3\nb,3,0,4\n")
    edit_yaml(folder, lights={"file": "l.csv"})
    edit_text(folder / "l.csv", "a,0,0,-3", "a,0,0,3")
    views, _ = ingested(folder, tmp_path)
    assert views.lamp["kind"] == "direction"
    np.testing.assert_allclose(views.lamp["vectors"], [[0.6, 0, 0.8], [0, 0, 1]])
    # the board faces the camera: under lamp b it is at 0.8 of a white that faces the lamp
    np.testing.assert_allclose(views.read(0, light="b")[0], 0.8 * codes_of(0, 0) / 0.5, rtol=2e-3)
    np.testing.assert_allclose(views.read(0, light="a")[0], codes_of(0, 1) / 0.5, rtol=2e-3)
    edit_yaml(folder, lights={"kind": "camera"})
    again, _ = ingested(folder, tmp_path / "again")
    assert again.lamp == {"kind": "camera", "vectors": None}


def test_saturated_and_hot_pixels_are_not_valid_black_ones_are(tmp_path):
    folder = make_turntable(tmp_path / "c", dark=True)
    values = 100 + TOP * 0.3 * np.ones((ROWS, COLUMNS, 3))
    values[2, 3, 1], values[4, 5] = TOP, 0
    write_frame(folder / "frames/1_0_0.png", values)
    darkness = np.full((ROWS, COLUMNS, 3), 100.0)
    darkness[6, 7] = 900
    write_frame(folder / "dark/dark.png", darkness)
    views, result = ingested(folder, tmp_path, white_block=4)
    _, valid = views.read("v1")
    assert set(zip(*np.nonzero(~valid), strict=True)) == {(2, 3), (6, 7)}
    assert not views.read("v0")[1][6, 7]
    assert result["defects"] == 1


def test_samples_that_are_not_finite_become_zero_and_invalid(tmp_path):
    folder = make_turntable(tmp_path / "c", views=1, cameras=False, silhouettes=False, camera={"bits": None})
    for name, value in (("a", np.nan), ("b", np.inf)):
        pixels = np.full((ROWS, COLUMNS), 0.25, np.float32)
        pixels[1, 2] = value
        with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, dict.fromkeys("RGB", pixels)) as file:
            file.write(str(folder / f"frames/{name}.exr"))
    (folder / "frames.csv").write_text("file,role,polariser\nframes/a.exr,sample,off\nframes/b.exr,sample,on\n")
    views, result = ingested(folder, tmp_path)
    for state in views.states:
        values, valid = views.read(0, state=state)
        assert np.isfinite(values).all()
        assert (values[1, 2] == 0).all()
        assert not valid[1, 2]
        assert valid.sum() == ROWS * COLUMNS - 1
    assert result["not_finite"] == (1, 1)


def test_srgb_pictures_are_decoded_and_encoded_back(tmp_path):
    folder = make_turntable(tmp_path / "c", camera={"encoding": "srgb", "bits": None})
    codes = np.arange(ROWS * COLUMNS * 3).reshape(ROWS, COLUMNS, 3) % 250
    for i in range(5):
        write_frame(folder / f"frames/{i}_0_0.png", np.roll(codes, i), np.uint8)
    views, _ = ingested(folder, tmp_path)
    values, _ = views.read(0)
    assert views.encoding == "srgb"
    np.testing.assert_allclose(values, decode(codes / 255, "srgb"), rtol=1e-6)
    np.testing.assert_allclose(encode(values, views.encoding) * 255, codes, atol=1e-4)


def test_luminance_only(tmp_path):
    views, _ = ingested(make_turntable(tmp_path / "c"), tmp_path, channels="luminance")
    assert views.channels == ("luminance",)
    expected = codes_of(2) @ [0.299, 0.587, 0.114]
    np.testing.assert_allclose(views.read(2)[0][..., 0], expected, atol=0.6 / TOP)


def test_calibration_pictures_are_grey_and_named(tmp_path):
    folder = make_turntable(tmp_path / "c", cameras=False)
    board = np.zeros((ROWS, COLUMNS, 3))
    board[:, 12:] = 0.25 * TOP
    with (folder / "frames.csv").open("a") as table:
        for i in range(5):
            write_frame(folder / f"board/{i}.png", board + 40 * i)
            table.write(f"board/{i}.png,board,v{i},,,\n")
        write_frame(folder / "board/alone.png", board)
        table.write("board/alone.png,board,,,,\n")
    description = {"squares_x": 5, "squares_y": 7, "square_mm": 20.0, "marker_mm": 15.0, "dictionary": "DICT_4X4_50"}
    edit_block(folder, board=description)
    views, _ = ingested(folder, tmp_path)
    pictures = list(views.board_pictures())
    assert [named["view"] for named, _ in pictures] == ["v0", "v1", "v2", "v3", "v4", None]
    named, last = pictures[-1]
    assert named["name"] == "board/alone.png"
    assert last.dtype == np.uint8
    np.testing.assert_array_equal(np.unique(last), [0, round(255 * float(encode(0.25, "srgb")))])
    assert views.board_description == description


@pytest.mark.slow
def test_the_script_copies_geometry_and_stamps(tmp_path):
    """By hand as a user calls it: the artifact holds the views, the files of the geometry, and where they come from."""
    folder = make_turntable(tmp_path / "c", views=3)
    ply = (
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nelement face 1\n"
        "property list uchar int vertex_indices\nend_header\n0\n0\n0\n3 0 1 2\n"
    )
    (folder / "a").mkdir()
    for name in ("object.PLY", "scan.ply", "a/scan.ply"):
        (folder / name).write_text(ply + f"# {name}\n")
    edit_block(folder, mesh="object.PLY", scans=["scan.ply", "a/scan.ply"])
    call = [
        sys.executable,
        "scripts/stage.py",
        "ingest",
        "--capture",
        folder,
        "--scene",
        "thing",
        "--output",
        tmp_path / "o",
    ]
    done = subprocess.run([*map(str, call)], cwd=PROJECT, capture_output=True, text=True, check=False,
                          env={"PYTHONPATH": str(PROJECT / "workflow/src"), "PATH": "/usr/bin:/bin"})  # fmt: skip
    assert done.returncode == 0, done.stderr
    (artifact,) = (tmp_path / "o").iterdir()
    views = Views(artifact)
    assert views.geometry["mesh"] == "geometry/mesh.ply"
    assert (artifact / views.geometry["mesh"]).read_text().endswith("# object.PLY\n")
    assert [(artifact / scan).read_text().split("# ")[1] for scan in views.geometry["scans"]] == [
        "scan.ply\n",
        "a/scan.ply\n",
    ]
    assert (artifact / "geometry/cameras.csv").read_bytes() == (folder / "cameras.csv").read_bytes()
    assert views.attributes["stamp"]["scene"] == "thing"
    diagnostics = json.loads((artifact / "artifact.json").read_text())["diagnostics"]
    assert diagnostics["views"] == ["v0", "v1", "v2"]
    assert diagnostics["capture"]["geometry"] == "turntable"


def test_store_is_deterministic_and_damage_is_found(tmp_path):
    folder = make_turntable(tmp_path / "c", states=("off", "on"))
    for name in ("a", "b"):
        views, _ = ingested(folder, tmp_path / name)
    files = [p.relative_to(tmp_path / "a") for p in sorted((tmp_path / "a").rglob("*")) if p.is_file()]
    assert len(files) > 15
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    chunk = tmp_path / "b/views.zarr/codes/c/3/0/0/0"
    data = bytearray(chunk.read_bytes())
    for place in (0, len(data) // 2, len(data) - 1):
        chunk.write_bytes(data[:place] + bytes([data[place] ^ 4]) + data[place + 1 :])
        with pytest.raises(UserError, match="damaged"):
            views.read(1, state="on")
    chunk.unlink()
    with pytest.raises(UserError, match="missing"):
        views.read(1, state="on")
    with refused(UserError, "views.zarr"):
        Views(tmp_path / "c")


def test_zarr_itself_reads_the_same_codes(tmp_path):
    import zarr

    views, _ = ingested(make_turntable(tmp_path / "c"), tmp_path)
    stored = zarr.open_group(tmp_path / "views.zarr", mode="r")["codes"][...]
    for i in range(5):
        np.testing.assert_array_equal(stored[i], views.codes(i))
        original = cv2.imread(str(tmp_path / f"c/frames/{i}_0_0.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(stored[i], original[..., ::-1])


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("nodes", ["one", "grid"])
@pytest.mark.parametrize("encoding", ["linear", "srgb"])
def test_kernel_is_the_obvious_formula(dtype, nodes, encoding):
    rng = np.random.default_rng(7)
    shape, block = (37, 53), 8
    edges = picture_edges(shape, block)
    grid = (1, 1) if nodes == "one" else tuple(len(e) - 1 for e in edges)
    gain = rng.uniform(0.5, 3, (*grid, 2)).astype(np.float32)
    dark = rng.uniform(0, 0.1, (*grid, 2)).astype(np.float32)
    if nodes == "grid":
        gain[1, 2, 1] = np.nan
    if dtype == np.float32:
        codes, table, saturated = rng.normal(0.5, 0.3, (*shape, 2)).astype(dtype), np.zeros(2, np.float32), 0.9
        codes[3, 4, 0] = np.nan
        linear = codes.astype(np.float64)
    else:
        top = np.iinfo(dtype).max
        codes = rng.integers(0, top + 1, (*shape, 2)).astype(dtype)
        table, saturated = code_table(dtype, SRGB if encoding == "srgb" else LINEAR), 0.9 * top
        linear = table[codes].astype(np.float64)
    usable = (rng.random(shape) > 0.1).astype(np.uint8)
    coding = table, dtype(saturated), ANY_CODE
    (out,), (valid,) = decode_codes(codes[None], coding, (gain[None], dark[None], usable), edges)

    def interpolated(field):
        if nodes == "one":
            return np.broadcast_to(field[0, 0].astype(np.float64), (*shape, 2))
        centres = [(e[:-1] + e[1:] - 1) / 2 for e in edges]
        whole = np.empty((*shape, 2))
        for y in range(shape[0]):
            for x in range(shape[1]):
                node, weight = [], []
                for position, centre in ((y, centres[0]), (x, centres[1])):
                    i = int(np.clip(np.searchsorted(centre, position, side="right") - 1, 0, len(centre) - 2))
                    node.append(i)
                    weight.append((position - centre[i]) / (centre[i + 1] - centre[i]))
                corners = field[node[0] : node[0] + 2, node[1] : node[1] + 2].astype(np.float64)
                rows = corners[0] + weight[0] * (corners[1] - corners[0])
                whole[y, x] = rows[0] + weight[1] * (rows[1] - rows[0])
        return whole

    expected = (linear - interpolated(dark)) * interpolated(gain)
    known = np.isfinite(expected) & (interpolated(gain) > 0)
    np.testing.assert_allclose(out, np.where(known, expected, 0), rtol=2e-5, atol=2e-6)
    np.testing.assert_array_equal(valid, (usable != 0) & known.all(axis=2) & (codes < dtype(saturated)).all(axis=2))


@given(st.floats(-1e6, 1e6, allow_nan=False))
def test_encoding_is_undone(value):
    assert decode(encode(value, "srgb"), "srgb") == pytest.approx(value, rel=1e-12, abs=1e-8)
    assert encode(value, "linear") == value


def test_encoding_has_the_standards_values_and_the_type_given():
    linear = np.array([0, 0.0031308, 0.18, 0.5, 1.0, 4.0, -0.1])
    power = 1.055 * np.abs(linear) ** (1 / 2.4) - 0.055
    expected = np.where(linear <= 0.0031308, 12.92 * linear, power)
    np.testing.assert_allclose(encode(linear, "srgb"), expected, rtol=1e-14)
    single = encode(linear.astype(np.float32).reshape(1, 7, 1), "srgb")
    assert (single.dtype, single.shape) == (np.float32, (1, 7, 1))
    np.testing.assert_allclose(single.ravel(), expected, rtol=1e-6)
    coded = np.arange(256) / 255
    exact = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(decode(coded, "srgb"), exact, rtol=1e-13)
    near = np.linspace(0.0031, 0.00316, 10_001)  # the standard's two pieces meet to within its rounding only
    np.testing.assert_allclose(decode(encode(near, "srgb"), "srgb"), near, atol=1e-8)
    monotone = np.linspace(-1, 2, 200_001)
    assert (np.diff(encode(monotone, "srgb")) > 0).all()
    broken = np.array([np.nan, np.inf, -np.inf], np.float32)
    np.testing.assert_array_equal(encode(broken, "srgb"), broken)
    assert encode(np.zeros((0, 3), np.float32), "srgb").shape == (0, 3)
    assert encode(np.array([0, 1]), "srgb").dtype == np.float64
    with pytest.raises(ValueError, match="gamma"):
        encode(linear, "gamma")


@pytest.mark.data
def test_measured_views_keep_their_codes(data, tmp_path):
    """Of real photographs nothing is lost: encoding the linear values back gives the codes."""
    from nishiki.capture.convert import convert

    sources = sorted(p.parent for p in data.glob("*/*_Ps.mat"))
    assert sources, "no turntable in the data"
    convert(sources[0], tmp_path / "c")
    views, result = ingested(tmp_path / "c", tmp_path / "o")
    for i in (0, len(views.views) // 2):
        values, valid = views.read(i)
        assert np.abs(encode(values, views.encoding) * 255 - views.codes(i)).max() < 1e-3
        assert valid.mean() > 0.9
    assert max(result["saturated"]) < 0.1
