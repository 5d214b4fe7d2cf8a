"""The command `convert` on folders as strangers have them: each becomes what it should, or is refused with a remedy."""

import json
import unicodedata

import cv2
import numpy as np
import pytest

from nishiki.capture.convert import LAYOUTS
from nishiki.capture.folder import load_capture
from nishiki.capture.options import ConvertOptions
from nishiki.cli import main

LIGHTS = np.array([[0.6, 0, 0.8], [0, 0.6, 0.8], [-0.6, 0, 0.8], [0, -0.48, 0.8773], [0.1, 0.2, 0.9747]])
PNG = [f"a{i}.png" for i in range(5)]
JPG = [f"IMG_{i}.jpg" for i in range(5)]


def photographs(folder, names, *, size=(6, 8), sample=np.uint8, channels=3):
    """Each of a brightness of its own, by which it is known again."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        codes = np.full((*size, channels), 40 * (i + 1) * (257 if sample is np.uint16 else 1), sample)
        kind = "." + name.rpartition(".")[2].lower()
        (folder / name).write_bytes(cv2.imencode(kind, codes)[1].tobytes())


def listed(names, *, count=None, blank=" ", end="\n", point=".", vectors=LIGHTS):
    """Text of a `.lp`; names may be fewer than vectors."""
    rows = [
        blank.join([name, *(f"{v:.4f}".replace(".", point) for v in vector)])
        for name, vector in zip(names, vectors, strict=False)
    ]
    return end.join([str(len(rows) if count is None else count), *rows, ""])


def project(names, folder):
    images = [
        {"filename": name, "direction": dict(zip("xyz", vector, strict=True))}
        for name, vector in zip(names, LIGHTS.tolist(), strict=True)
    ]
    return json.dumps({"images": images, "folder": folder})


def umlauts(form):
    return [unicodedata.normalize(form, f"Größe Münze {i} 2.jpg") for i in range(5)]


def umlaut_names(folder, encoding="utf-8", on_disk="NFC"):
    photographs(folder, umlauts(on_disk))
    (folder / "Münze 1.lp").write_bytes(listed(umlauts("NFC")).encode(encoding))


def windows_paths(folder):
    names = [f"DSC_{i:04d}.JPG" for i in range(5)]
    photographs(folder, names)
    text = listed([f"C:\\RTI Data\\Coin 1\\jpeg-exports\\{name}" for name in names], end="\r\n")
    (folder / "DOME.LP").write_text(text, encoding="utf-8-sig")


def tabs_and_decimal_commas(folder):
    photographs(folder, PNG)
    text = listed(PNG, blank="\t", end="\r\n", point=",")
    assert "0,6000\t" in text
    (folder / "a.lp").write_text(text, encoding="utf-8-sig")


def tiff_of_16_bits(folder):
    names = [f"Scan {i}.TIF" for i in range(5)]
    photographs(folder, names, sample=np.uint16)
    (folder / "a.lp").write_text(listed(names))


def names_of_raw_files(folder):
    photographs(folder, JPG)
    (folder / "a.lp").write_text(listed([name.replace(".jpg", ".CR2") for name in JPG]))


def lengths_of_metres(folder):
    photographs(folder, PNG)
    (folder / "a.lp").write_text(listed(PNG, vectors=LIGHTS * 1.7))


def macintosh_disk(folder, names=JPG):
    photographs(folder, JPG)
    (folder / "a.lp").write_text(listed(names))
    for path in list(folder.iterdir()):
        (folder / f"._{path.name}").write_bytes(b"\0\5\x16\7" + bytes(80))
    (folder / ".DS_Store").write_bytes(b"\0")


def photographs_below(folder):
    photographs(folder / "photos", PNG)
    (folder / "photos.lp").write_text(listed([f"photos/{name}" for name in PNG]))


def folder_below_in_capitals(folder):
    photographs(folder / "JPEG", JPG)
    (folder / "a.lp").write_text(listed([f"D:\\coin\\jpeg\\{name}" for name in JPG]))


def project_beside_its_folder(folder, named="Coin 1"):
    photographs(folder / "Coin 1", JPG)
    (folder / "coin.RELIGHT").write_text(project(JPG, named))


CONVERTED = {
    "umlauts": umlaut_names,
    "umlauts taken apart on the disk": lambda folder: umlaut_names(folder, on_disk="NFD"),
    "umlauts of an old code page": lambda folder: umlaut_names(folder, "cp1252"),
    "two bytes a character": lambda folder: umlaut_names(folder, "utf-16"),
    "Windows paths": windows_paths,
    "tabs and decimal commas": tabs_and_decimal_commas,
    "TIFF": tiff_of_16_bits,
    "names of raw files": names_of_raw_files,
    "vectors of other length": lengths_of_metres,
    "a Macintosh's disk": macintosh_disk,
    "a Macintosh's disk, without names": lambda folder: macintosh_disk(folder, [""] * 5),
    "photographs in a folder below": photographs_below,
    "a folder below, in capitals": folder_below_in_capitals,
    "a project and its folder": project_beside_its_folder,
    "a project and its folder by its path": lambda folder: project_beside_its_folder(folder, "D:/scans/Coin 1/"),
}


@pytest.mark.parametrize("kind", CONVERTED)
def test_each_lamp_gets_its_photograph(tmp_path, kind):
    CONVERTED[kind](tmp_path / "source")
    with pytest.raises(SystemExit, match="0"):
        main(["convert", str(tmp_path / "source"), str(tmp_path / "c")])
    capture = load_capture(tmp_path / "c")
    np.testing.assert_allclose(capture.directions, LIGHTS / np.linalg.norm(LIGHTS, axis=1, keepdims=True), atol=1e-3)
    codes = [cv2.imread(str(frame.path), cv2.IMREAD_UNCHANGED) for frame in capture.observed]
    brightness = [each.mean() / (257 if each.dtype == np.uint16 else 1) for each in codes]
    np.testing.assert_allclose(brightness, [40, 80, 120, 160, 200], atol=2)
    assert [frame.light for frame in capture.observed] == list(capture.lights.names)


def with_lights(text):
    def write(folder):
        photographs(folder, PNG)
        (folder / "a.lp").write_text(text)

    return write


def one_other(**other):
    def write(folder):
        photographs(folder, PNG)
        photographs(folder, [PNG[3]], **other)
        (folder / "a.lp").write_text(listed(PNG))

    return write


def empty_photograph(folder):
    photographs(folder, PNG)
    (folder / PNG[0]).write_bytes(b"")
    (folder / "a.lp").write_text(listed(PNG))


def cut_off(folder):
    photographs(folder, JPG, size=(64, 80))
    whole = (folder / JPG[3]).read_bytes()
    (folder / JPG[3]).write_bytes(whole[: len(whole) - 20])
    (folder / "a.lp").write_text(listed(JPG))


def other_formats(folder):
    folder.mkdir()
    for i in range(3):
        (folder / f"b{i}.HEIC").write_bytes(b"x")
    (folder / "a.lp").write_text(listed([f"b{i}.HEIC" for i in range(3)]))


def two_bytes_cut_off(folder):
    photographs(folder, PNG)
    (folder / "a.lp").write_bytes(listed(PNG).encode("utf-16")[:-1])


def lights_file_in_place_of_a_folder(source):
    source.write_text(listed(PNG))


PLANE = np.stack([np.sin(np.linspace(-1, 1, 5)), np.zeros(5), np.cos(np.linspace(-1, 1, 5))], axis=1)
REFUSED = {
    "lines are missing": (with_lights(listed(PNG[:3], count=5)), "a.lp: expected 5", "found 3"),
    "a line too many": (with_lights(listed(PNG, count=4)), "a.lp: expected 4", "found 5"),
    "no count": (with_lights(listed(PNG).split("\n", 1)[1]), "a.lp: not a .lp file", "the number of lights"),
    "a word for a number": (with_lights(listed(PNG).replace("-0.6000", "n/a")), "a.lp line 4", "x y z"),
    "half of the names": (with_lights(listed(PNG).replace("a1.png ", "")), "a.lp: some lines", "in all"),
    "a photograph is missing": (with_lights(listed([*PNG[:4], "b.png"])), "no photograph 'b.png'", "Put it there"),
    "twice the same": (with_lights(listed([*PNG[:4], PNG[0]])), "a.lp: light 'a0' appears twice", "1 and 5"),
    "lamps behind": (with_lights(listed(PNG, vectors=-LIGHTS)), "a.lp: light 'a0' lies in or behind", "z > 0"),
    "lamps in one plane": (with_lights(listed(PNG, vectors=PLANE)), "all lights lie in one plane", "Add a light"),
    "two lamps": (with_lights(listed(PNG[:2])), "at least 3 lights", "found 2"),
    "another size": (one_other(size=(8, 6)), "a3.png: size differs", "without rotation"),
    "another depth": (one_other(sample=np.uint16), "a3.png: depth differs", "Develop all photographs alike"),
    "grey among colours": (one_other(channels=1), "a3.png: number of channels", "Leave it out"),
    "an empty file": (empty_photograph, "a0.png: not an image", "Copy the file again"),
    "a photograph cut off": (cut_off, "IMG_3.jpg: image is cut off", "Copy the file again"),
    "another format": (other_formats, "b0.HEIC and 2 more", "mogrify -format png *.HEIC"),
    "half a letter": (two_bytes_cut_off, "a.lp: not UTF-16-LE text", "Save it as UTF-8"),
    "a lights file": (lights_file_in_place_of_a_folder, "no folder, no table", "Name the folder of the photographs"),
    "no lamps": (lambda folder: photographs(folder, PNG), "no lamps found", "--lights"),
    "nothing": (lambda folder: folder.mkdir(), "no photographs", "--list"),
    "a folder of folders": (lambda folder: photographs(folder / "day 2", PNG), "some in day 2", "run '"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kind", REFUSED)
def test_what_cannot_be_used_is_named_with_a_remedy(tmp_path, kind, capsys):
    write, named, remedy = REFUSED[kind]
    write(tmp_path / "source")
    with pytest.raises(SystemExit) as ended:
        main(["convert", str(tmp_path / "source"), str(tmp_path / "c")])
    assert ended.value.code == 2
    told = capsys.readouterr().err
    assert named in told
    assert remedy in told
    assert {path.name for path in tmp_path.iterdir()} == {"source"}


@pytest.mark.parametrize("option", ["--lights", "--mask"])
@pytest.mark.parametrize("given", ["nowhere.png", "source"])
def test_options_that_name_no_file_are_told_before_anything_is_read(tmp_path, option, given, capsys):
    with_lights(listed(PNG))(tmp_path / "source")
    with pytest.raises(SystemExit) as ended:
        main(["convert", str(tmp_path / "source"), str(tmp_path / "c"), option, str(tmp_path / given)])
    assert ended.value.code == 2
    assert f"{option} {tmp_path / given}" in capsys.readouterr().err
    assert not (tmp_path / "c").exists()


def test_what_is_to_be_completed_by_hand_is_not_examined(tmp_path):
    with_lights(listed(PNG[:2]))(tmp_path / "source")
    with pytest.raises(SystemExit, match="0"):
        main(["convert", str(tmp_path / "source"), str(tmp_path / "c"), "--unsealed"])
    assert (tmp_path / "c/frames.csv").is_file()


def test_an_archive_is_listed_and_nothing_is_made(tmp_path, capsys):
    archive = tmp_path / "archive"
    with_lights(listed(PNG))(archive / "a/dome")
    with_lights(listed(JPG))(archive / "a/lamps of others")
    photographs(archive / "b", ["0_0.png", "0_45.png", "45_0.png", "45_45.png"])
    photographs(archive / "c/holiday", PNG)
    (archive / "d/maps.zarr/normals/c/0").mkdir(parents=True)
    (archive / "d/maps.zarr/normals/c/0/0").write_bytes(b"")
    main_of = ["convert", str(archive / "a/dome"), str(archive / "made")]
    with pytest.raises(SystemExit, match="0"):
        main(main_of)
    before = sorted(archive.rglob("*"))
    capsys.readouterr()
    with pytest.raises(SystemExit, match="0"):
        main(["convert", str(archive), "--list"])
    *lines, total = capsys.readouterr().out.splitlines()
    assert [line.split("  ")[0] for line in lines] == ["a/dome", "a/lamps of others", "b", "c/holiday", "d", "made"]
    assert lines[0].count("5 ") == 2
    assert "4 " in lines[2]
    assert not any("--list" in line for line in lines)
    assert total.startswith("2 of 6")
    assert sorted(archive.rglob("*")) == before


@pytest.mark.parametrize("entry", LAYOUTS, ids=lambda entry: entry.name)
def test_no_layout_is_found_in_an_empty_folder(tmp_path, entry):
    assert entry.matches(tmp_path, ConvertOptions()) is None
