"""Folders of relight become captures; their values are those of a slow decoder."""

import json
import math
import re
import shutil

import numpy as np
import pytest
from PIL import Image
from refusals import refused
from relightable_images import COLUMNS, LIGHT, RELIGHT, ROWS, corners, relight_value, write_relight

from nishiki.capture.convert import convert
from nishiki.capture.folder import load_capture
from nishiki.capture.layouts import photographs_in
from nishiki.capture.relightable import lamps_for, open_relightable, recognise_relightable
from nishiki.formats.banded_pictures import write_deep_zoom
from nishiki.formats.problems import CaptureError
from nishiki.formats.relight import bilinear_weights
from nishiki.observations.check import check_capture


@pytest.mark.parametrize(("kind", "space", "planes"), RELIGHT)
def test_values_of_a_relight_folder_are_those_of_a_slow_decoder(tmp_path, kind, space, planes):
    info, planes = write_relight(tmp_path / "r", kind, space, planes)
    shown = open_relightable(tmp_path / "r").relight(LIGHT)
    expected = [
        [[relight_value(info, planes[r, c], LIGHT, k) for k in range(3)] for c in range(COLUMNS)] for r in range(ROWS)
    ]
    np.testing.assert_allclose(shown, expected, atol=2e-5)
    assert recognise_relightable(tmp_path / "r") == tmp_path / "r"


def test_bilinear_weights_stay_on_the_grid():
    for light in [*lamps_for(None).directions, (0, 0, 1), (1, 0, 0), (0, -1, 0), (-0.6, 0.8, 0), (0.8, 0.6, 0)]:
        slow = corners(8, light)
        weights = bilinear_weights(8, np.array(light, float))
        np.testing.assert_allclose([weights[i] for i in slow], list(slow.values()), atol=1e-12)
        assert weights.sum() == pytest.approx(1)


def test_brightness_and_differences_are_those_that_relight_makes_of_a_colour(tmp_path):
    """R - B, then G less the middle of R and B, then brightness: that middle and half of what green has more."""
    info, _ = write_relight(tmp_path / "r", "rbf", "mycc", (1, 1, 1))
    red, green, blue = 180, 130, 40
    middle = blue + (red - blue) / 2
    info["basis"] = [middle + (green - middle) / 2, red - blue, green - middle] * 6 + [127] * 54
    (tmp_path / "r/info.json").write_text(json.dumps(info))
    shown = open_relightable(tmp_path / "r").relight(LIGHT)[0, 0] * 255
    np.testing.assert_allclose(shown, [red, green, blue], atol=1e-3)


@pytest.mark.parametrize("space", ["mrgb", "mycc"])
def test_components_of_older_folders_lie_in_a_file_of_their_own(tmp_path, space):
    info, _ = write_relight(tmp_path / "r", "rbf", space, 5 if space == "mrgb" else (3, 1, 1))
    expected = open_relightable(tmp_path / "r").relight(LIGHT)
    (tmp_path / "r/materials.bin").write_bytes(bytes(info.pop("basis")))
    (tmp_path / "r/info.json").write_text(json.dumps(info))
    image = open_relightable(tmp_path / "r")
    np.testing.assert_array_equal(image.relight(LIGHT), expected)
    convert(tmp_path / "r", tmp_path / "c")
    assert (tmp_path / "c/relight/materials.bin").read_bytes() == (tmp_path / "r/materials.bin").read_bytes()
    (tmp_path / "r/materials.bin").write_bytes(bytes(99))
    with refused(CaptureError, "r/materials.bin", "info.json", "108", kind="relightable-unreadable"):
        open_relightable(tmp_path / "r")


def test_tiles_of_a_relight_folder_are_put_together(tmp_path):
    write_relight(tmp_path / "r", "ptm", "lrgb", 9, 300, 520)
    whole = open_relightable(tmp_path / "r").codes
    for number in range(3):
        write_deep_zoom(tmp_path / "r", f"plane_{number}", whole[..., 3 * number : 3 * number + 3], tmp_path, 100)
        (tmp_path / f"r/plane_{number}.jpg").unlink()
    tiled = open_relightable(tmp_path / "r")
    assert np.abs(tiled.codes.astype(int) - whole).max() < 6
    made = convert(tmp_path / "r/info.json", tmp_path / "c")
    assert made.photographs == 24
    kept = {path.relative_to(tmp_path / "c/relight").as_posix() for path in (tmp_path / "c/relight").rglob("*.*")}
    assert kept == set(tiled.files)
    assert "file-unlisted" not in {each.kind for each in check_capture(tmp_path / "c", level="full")}


def test_a_relight_folder_becomes_a_capture_unless_photographs_lie_in_it(tmp_path):
    write_relight(tmp_path / "r", "hsh", "rgb", 27)
    for name in ("normals.jpg", "means.png", "medians.png", "materials.png", "error.png"):
        Image.new("RGB", (COLUMNS, ROWS)).save(tmp_path / "r" / name)
    made = convert(tmp_path / "r", tmp_path / "c")
    assert made.layout.startswith("rendered")
    assert {"rendered", "rendered-clipped"} >= {each.kind for each in made.warnings} >= {"rendered"}
    assert load_capture(tmp_path / "c").settings.rendered_from == "relight/info.json"
    for number in range(6):
        Image.new("RGB", (COLUMNS, ROWS)).save(tmp_path / f"r/photo{number}.jpg")
    assert recognise_relightable(tmp_path / "r") is None


def test_the_size_of_a_pixel_arrives(tmp_path):
    info, _ = write_relight(tmp_path / "r", "ptm", "rgb", 18)
    (tmp_path / "r/info.json").write_text(json.dumps(info | {"pixelSizeInMM": 0.0173729}))
    convert(tmp_path / "r", tmp_path / "c")
    assert load_capture(tmp_path / "c").settings.pixel_pitch_mm == 0.0173729
    convert(tmp_path / "r", tmp_path / "d", width_mm=10.0)
    assert load_capture(tmp_path / "d").settings.pixel_pitch_mm == pytest.approx(10 / COLUMNS)


def test_planes_whose_names_are_not_found_are_no_photographs(tmp_path):
    write_relight(tmp_path / "r", "hsh", "rgb", 27)
    (tmp_path / "r/plane_0.jpg").rename(tmp_path / "r/plane_0.JPG")
    assert recognise_relightable(tmp_path / "r") is None
    assert photographs_in(tmp_path / "r") == []


def without(key):
    return lambda info: info.pop(key)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda info: info.update(type="bilinear"), "bilinear"),
        (lambda info: info.update(colorspace="mycc", yccplanes=[6, 6, 6]), "mycc"),
        (lambda info: info.update(colorspace="mycc"), "'yccplanes'"),
        (lambda info: info.update(colorspace="ycc"), "ycc"),
        (lambda info: info.update(nplanes=21), "21"),
        (lambda info: info.update(nplanes=18.0), "'nplanes'"),
        (lambda info: info.update(width=99), "plane_0.jpg"),
        (lambda info: info.update(width=COLUMNS - 1), "r/plane_0.jpg"),
        (lambda info: info.update(width=1 << 19, height=1 << 19), str(1 << 19)),
        (lambda info: info["materials"][0].update(bias=[math.nan] * 18), "'bias'"),
        (lambda info: info["materials"][0]["scale"].pop(), "'scale'"),
        (without("materials"), "'scale'"),
    ],
)
def test_relight_folders_that_are_not_read_are_refused_by_name(tmp_path, change, text):
    info, _ = write_relight(tmp_path / "r", "ptm", "rgb", 18)
    change(info)
    (tmp_path / "r/info.json").write_text(json.dumps(info))
    with pytest.raises(CaptureError, match=re.escape(text)):
        convert(tmp_path / "r", tmp_path / "c")
    assert not (tmp_path / "c").exists()


def test_a_plane_that_is_missing_or_damaged_is_named(tmp_path):
    write_relight(tmp_path / "r", "ptm", "rgb", 18)
    whole = (tmp_path / "r/plane_4.jpg").read_bytes()
    (tmp_path / "r/plane_4.jpg").write_bytes(whole[: len(whole) // 3])
    with pytest.raises(CaptureError, match=r"plane_4\.jpg"):
        convert(tmp_path / "r", tmp_path / "c")
    (tmp_path / "r/plane_4.jpg").unlink()
    with pytest.raises(CaptureError, match=r"plane_4\.dzi"):
        convert(tmp_path / "r", tmp_path / "c")


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda info: info.update(sigma=1e-300), "'sigma'"),
        (lambda info: info.update(sigma=-0.4), "'sigma'"),
        (lambda info: info["materials"][0]["range"].__setitem__(2, 1e-300), "'range'"),
        (lambda info: info.update(lights=[1.02 * v for v in info["lights"]]), "'lights'"),
        (lambda info: info.update(lights=[0] * 18), "'lights'"),
        (lambda info: info.update(lights=[], basis=[]), "'lights'"),
    ],
)
def test_gaussians_that_cannot_be_evaluated_are_refused(tmp_path, change, text):
    info, _ = write_relight(tmp_path / "r", "rbf", "mrgb", 5)
    info["lights"] = [round(v, 3) for v in info["lights"]]
    (tmp_path / "r/info.json").write_text(json.dumps(info))
    assert np.isfinite(open_relightable(tmp_path / "r").relight(LIGHT)).all()
    change(info)
    (tmp_path / "r/info.json").write_text(json.dumps(info))
    with pytest.raises(CaptureError, match=re.escape(text)):
        open_relightable(tmp_path / "r")


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda info: info.update(resolution=6), "'basis'"),
        (lambda info: info.update(resolution=1), "'resolution'"),
        (without("resolution"), "'resolution'"),
        (without("basis"), "'basis'"),
        (lambda info: info.update(yccplanes=[4, 4, 3]), "'yccplanes'"),
        (lambda info: info.update(yccplanes=[3, 4, 4]), "'yccplanes'"),
        (lambda info: info.update(yccplanes=[4.5, 4, 4]), "'yccplanes'"),
        (lambda info: info.update(yccplanes=[0, 0, 0]), "'yccplanes'"),
        (lambda info: info["materials"][0]["range"].__setitem__(2, 1e-300), "'range'"),
    ],
)
def test_tables_of_directions_that_cannot_be_used_are_refused(tmp_path, change, text):
    info, _ = write_relight(tmp_path / "r", "bilinear", "mycc", (4, 4, 4))
    change(info)
    (tmp_path / "r/info.json").write_text(json.dumps(info))
    with pytest.raises(CaptureError, match=re.escape(text)):
        open_relightable(tmp_path / "r")


def write_tiles(folder):
    """One plane of three, of two tiles in each direction, as deep zoom."""
    write_relight(folder, "rbf", "mrgb", 3, 300, 300)
    write_deep_zoom(folder, "plane_0", open_relightable(folder).codes, folder.parent, 90)
    (folder / "plane_0.jpg").unlink()


def join_tiles(folder, names, joined):
    """The tiles of deep zooms in one file, as relight's tarzoom and itarzoom; returns the content of the `.tzi`."""
    offsets, stored, levels = [0], b"", [path.name for path in (folder / f"{names[0]}_files").iterdir()]
    for level in sorted(levels, key=int):
        tiles = [path.stem for path in (folder / f"{names[0]}_files/{level}").iterdir()]
        tiles.sort(key=lambda tile: [int(number) for number in tile.split("_")[::-1]])
        for tile in tiles:
            for name in names:
                stored += (folder / f"{name}_files/{level}/{tile}.jpg").read_bytes()
                offsets.append(len(stored))
    (folder / f"{joined}.tzb").write_bytes(stored)
    index = {"tilesize": 254, "overlap": 1, "format": "jpg", "width": 300, "height": 520, "nlevels": len(levels)}
    index |= {"offsets": offsets} | ({"stride": len(names)} if joined == "planes" else {})
    (folder / f"{joined}.tzi").write_text(json.dumps(index))
    return index


def write_zoomed(folder):
    """Three planes as deep zooms of three levels; their names, and the codes that are read of them."""
    write_relight(folder, "ptm", "lrgb", 9, 520, 300)
    codes, names = open_relightable(folder).codes, [f"plane_{number}" for number in range(3)]
    for number, name in enumerate(names):
        write_deep_zoom(folder, name, codes[..., 3 * number : 3 * number + 3], folder.parent, 90)
        (folder / f"{name}.jpg").unlink()
    return names, open_relightable(folder).codes


@pytest.mark.parametrize("interleaved", [False, True])
def test_tiles_in_one_file_are_those_of_the_deep_zoom(tmp_path, interleaved):
    names, expected = write_zoomed(tmp_path / "r")
    for joined in ["planes"] if interleaved else names:
        join_tiles(tmp_path / "r", names if interleaved else [joined], joined)
    for name in names:
        shutil.rmtree(tmp_path / f"r/{name}_files")
        (tmp_path / f"r/{name}.dzi").unlink()
    np.testing.assert_array_equal(open_relightable(tmp_path / "r").codes, expected)
    convert(tmp_path / "r", tmp_path / "c")
    kept = {path.name for path in (tmp_path / "c/relight").iterdir()}
    assert kept == {"info.json", *(f"{n}.tz{end}" for n in (["planes"] if interleaved else names) for end in "ib")}


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda index: index.update(width=301), "301"),
        (lambda index: index.update(tilesize=8), "r/planes.tzi"),
        (lambda index: index.update(nlevels=10**9), "r/planes.tzi"),
        (lambda index: index.update(stride=2), "r/planes.tzb"),
        (lambda index: index.pop("offsets"), "r/planes.tzi"),
        (lambda index: index["offsets"].pop(), "26"),
        (lambda index: index["offsets"].__setitem__(-1, 10**15), "bytes"),
        (lambda index: index["offsets"].__setitem__(-2, index["offsets"][-3] + 9), "JPEG"),
        (lambda index: index.update(tilesize=100, overlap=0), "tile"),
    ],
)
def test_tiles_in_one_file_that_cannot_be_found_are_refused_by_name(tmp_path, change, text):
    names, _ = write_zoomed(tmp_path / "r")
    index = join_tiles(tmp_path / "r", names, "planes")
    for name in names:
        (tmp_path / f"r/{name}.dzi").unlink()
    change(index)
    (tmp_path / "r/planes.tzi").write_text(json.dumps(index))
    with pytest.raises(CaptureError, match=re.escape(text)) as caught:
        open_relightable(tmp_path / "r")
    assert caught.value.problems[0].kind == "relightable-unreadable"


def test_the_file_of_joined_tiles_is_named_where_it_is_missing(tmp_path):
    names, _ = write_zoomed(tmp_path / "r")
    join_tiles(tmp_path / "r", names, "planes")
    for name in names:
        (tmp_path / f"r/{name}.dzi").unlink()
    (tmp_path / "r/planes.tzb").unlink()
    with refused(CaptureError, "r/planes.tzb", kind="relightable-unreadable"):
        open_relightable(tmp_path / "r")


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        (b'Width="300"', b'Width="301"', "301"),
        (b'Height="300"', b"", "r/plane_0.dzi"),
        (b'TileSize="254"', 'TileSize="\u00b2"'.encode(), "r/plane_0.dzi"),
        (b'TileSize="254"', 'TileSize="\u0662\u0662"'.encode(), "r/plane_0.dzi"),
        (b'TileSize="254"', b'TileSize="8"', "r/plane_0.dzi"),
        (b"<?xml", b"\xff\xfe<?xml", "UTF-8"),
    ],
)
def test_a_deep_zoom_that_is_not_read_is_refused_by_name(tmp_path, old, new, text):
    write_tiles(tmp_path / "r")
    file = tmp_path / "r/plane_0.dzi"
    content = file.read_bytes()
    assert old in content
    file.write_bytes(content.replace(old, new))
    with pytest.raises(CaptureError, match=re.escape(text)):
        open_relightable(tmp_path / "r")


def test_folders_of_levels_are_numbers_and_a_missing_tile_is_named_with_its_level(tmp_path):
    write_tiles(tmp_path / "r")
    tiles = tmp_path / "r/plane_0_files"
    whole = open_relightable(tmp_path / "r").codes
    (tiles / "\u00b2").mkdir()
    (tiles / "1").rename(tiles / "01")
    np.testing.assert_array_equal(open_relightable(tmp_path / "r").codes, whole)
    (tiles / "01/1_0.jpg").unlink()
    with refused(CaptureError, "r/plane_0_files/01/1_0.jpg", kind="image-missing"):
        open_relightable(tmp_path / "r")
    shutil.rmtree(tiles / "01")
    shutil.rmtree(tiles / "0")
    with refused(CaptureError, "plane_0.dzi", kind="relightable-unreadable"):
        open_relightable(tmp_path / "r")


@pytest.mark.parametrize("name", ["info.json", "plane_0.dzi", "plane_0_files/1/1_1.jpg"])
def test_nothing_is_read_through_links_that_leave_a_relight_folder(tmp_path, name):
    write_tiles(tmp_path / "r")
    (tmp_path / "r" / name).rename(tmp_path / "elsewhere")
    (tmp_path / "r" / name).symlink_to(tmp_path / "elsewhere")
    with refused(CaptureError, name, kind="relightable-unreadable"):
        convert(tmp_path / "r", tmp_path / "c")
    assert not (tmp_path / "c").exists()


def test_the_title_is_the_name_of_the_relight_folder(tmp_path, monkeypatch):
    write_relight(tmp_path / "coin 1.5 mm", "ptm", "lrgb", 9)
    monkeypatch.chdir(tmp_path / "coin 1.5 mm")
    for number, source in enumerate(("info.json", ".", tmp_path / "coin 1.5 mm")):
        convert(source, tmp_path / f"c{number}")
        assert load_capture(tmp_path / f"c{number}").settings.title == "coin 1.5 mm"


def test_photographs_beside_planes_and_lights_of_relight_are_what_is_converted(tmp_path):
    info, _ = write_relight(tmp_path / "r", "hsh", "rgb", 27)
    for number in range(6):
        Image.new("RGB", (COLUMNS, ROWS), (number, 0, 0)).save(tmp_path / f"r/photo{number}.jpg")
    Image.new("RGB", (COLUMNS, ROWS)).save(tmp_path / "r/normals.png")
    made = convert(tmp_path / "r", tmp_path / "c")
    assert made.photographs == 6
    capture = load_capture(tmp_path / "c")
    np.testing.assert_allclose(capture.lights.vectors.ravel(), info["lights"], atol=1e-8)
    assert [frame.file for frame in capture.observed] == [f"frames/photo{number}.jpg" for number in range(6)]
