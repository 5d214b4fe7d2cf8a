"""Relightable images become captures: files written here by the formats' descriptions, decoded pixel by pixel."""

import io
import json
import math
import re
import shutil
import struct

import numpy as np
import pytest
from PIL import Image
from small_painting import dome
from unit.test_capture_colmap import around, photographs, write_model
from unit.test_capture_meshroom import write_cameras

from nishiki.api import read_observations
from nishiki.capture.convert import convert
from nishiki.capture.folder import load_capture
from nishiki.capture.relightable import lamps_for, open_relightable, recognise_relightable
from nishiki.cli import main
from nishiki.colour.colour import srgb_encode
from nishiki.colour.encoding import decode
from nishiki.formats.hsh import hemispherical_harmonics
from nishiki.formats.picture_tiles import write_deep_zoom
from nishiki.formats.problems import CaptureError
from nishiki.formats.ptm import write_ptm
from nishiki.observations.check import check_capture
from nishiki.photometric.solve import estimate_normals
from nishiki.stages.export.light_models import HarmonicModel, ptm_weights

ROWS, COLUMNS = 5, 7
SCALE, BIAS = [1.5, 0.75, 2.0, 1.25, 0.5, 1.0], [120, 100, 131, 127, 90, 3]
LIGHT = np.array([0.3, -0.5, math.sqrt(0.66)])


def random_codes(*shape, seed=0):
    return np.random.default_rng(seed).integers(0, 256, shape).astype(np.uint8)


def heading(layout, version="PTM_1.2"):
    numbers = f"{COLUMNS}\n{ROWS}\n{' '.join(map(str, SCALE))} \n{' '.join(map(str, BIAS))}\n"
    return f"{version}\n{layout}\n{numbers}".encode()


def polynomial(codes, light):
    """0 to 255 of six bytes, term by term."""
    u, v, _ = map(float, light)
    monomials = [u * u, v * v, u * v, u, v, 1.0]
    return sum(s * (int(c) - b) * m for s, c, b, m in zip(SCALE, codes, BIAS, monomials, strict=True))


def rgb_file():
    """Bytes, and the value (0 to 1) of a pixel and colour."""
    codes = random_codes(3, ROWS, COLUMNS, 6)  # rows from the bottom
    return heading(
        "PTM_FORMAT_RGB"
    ) + codes.tobytes(), lambda r, c, k: polynomial(codes[k, ROWS - 1 - r, c], LIGHT) / 255


def brightness_and_colour(terms, colours):
    """Of planes from the bottom."""
    return lambda r, c, k: polynomial(terms[ROWS - 1 - r, c], LIGHT) / 255 * int(colours[ROWS - 1 - r, c, k]) / 255


def lrgb_file():
    terms, colours = random_codes(ROWS, COLUMNS, 6), random_codes(ROWS, COLUMNS, 3, seed=1)
    return heading("PTM_FORMAT_LRGB") + terms.tobytes() + colours.tobytes(), brightness_and_colour(terms, colours)


def older_lrgb_file():
    terms, colours = random_codes(ROWS, COLUMNS, 6), random_codes(ROWS, COLUMNS, 3, seed=1)
    stored = b"".join(terms[r, c].tobytes() + colours[r, c].tobytes() for r in range(ROWS) for c in range(COLUMNS))
    return heading("PTM_FORMAT_LRGB", "PTM_1.1") + stored, brightness_and_colour(terms, colours)


def jpeg_file(transforms=(0, 0, 1, 0, 0, 0, 0, 0, 0), motion=0):
    """Stream 2 is the difference from stream 4 inverted, stream 0 that from stream 2; stream 1 has two corrections."""
    streams, stored = [], []
    for plane in random_codes(9, ROWS, COLUMNS, seed=2):
        buffer = io.BytesIO()
        Image.fromarray(plane).save(buffer, "JPEG", quality=95)
        streams.append(buffer.getvalue())
        stored.append(np.asarray(Image.open(io.BytesIO(buffer.getvalue()))).astype(int))
    order, references = [5, 0, 3, 1, 2, 4, 6, 7, 8], [2, -1, 4, -1, -1, -1, -1, -1, -1]
    planes = [plane.copy() for plane in stored]
    planes[2] = (stored[2] + (255 - stored[4]) - 128) % 256
    planes[0] = (stored[0] + planes[2] - 128) % 256
    corrections = struct.pack(">IB", 8, 250) + struct.pack(">IB", ROWS * COLUMNS - 1, 7)
    planes[1][8 // COLUMNS, 8 % COLUMNS], planes[1][-1, -1] = 250, 7
    sizes, extra = [len(s) for s in streams], [0, len(corrections), *[0] * 7]
    lists = [transforms, [motion] * 9, [0] * 9, order, references, sizes, extra]
    head = (
        heading("PTM_FORMAT_JPEG_LRGB") + b"90\n" + "".join(" ".join(map(str, each)) + "\n" for each in lists).encode()
    )
    data = b"".join(stream + (corrections if i == 1 else b"") for i, stream in enumerate(streams))
    terms, colours = np.stack(planes[:6], axis=-1), np.stack(planes[6:], axis=-1)
    return head + data, brightness_and_colour(terms, colours)


def hsh_file(terms=9, line="\n"):
    codes = random_codes(ROWS, COLUMNS, 3, terms)  # rows from the top
    random = np.random.default_rng(5)
    scale, bias = random.uniform(0.5, 2, terms).astype("<f4"), random.uniform(-1, 0, terms).astype("<f4")
    head = line.join(["#HSH1.2", "# another", "3", f"{COLUMNS} {ROWS} 3", f"{terms} 2 1", ""]).encode()
    weights = harmonics_as_viewers_have_them(LIGHT)[:terms]

    def value(r, c, k):
        numbers = zip(codes[r, c, k], scale, bias, weights, strict=True)
        return sum((int(code) / 255 * float(s) + float(b)) * w for code, s, b, w in numbers)

    return head + scale.tobytes() + bias.tobytes() + codes.tobytes(), value


def harmonics_as_viewers_have_them(light):
    """Sixteen values, written out."""
    turn, c = math.atan2(light[1], light[0]), light[2]
    s, pi = math.sqrt(c - c * c), math.pi
    cubic = 1 - 5 * c + 5 * c * c
    return [
        *(1 / math.sqrt(2 * pi), math.sqrt(6 / pi) * math.cos(turn) * s),
        *(math.sqrt(3 / (2 * pi)) * (2 * c - 1), math.sqrt(6 / pi) * math.sin(turn) * s),
        math.sqrt(30 / pi) * math.cos(2 * turn) * (c * c - c),
        math.sqrt(30 / pi) * math.cos(turn) * (2 * c - 1) * s,
        math.sqrt(5 / (2 * pi)) * (1 - 6 * c + 6 * c * c),
        math.sqrt(30 / pi) * math.sin(turn) * (2 * c - 1) * s,
        math.sqrt(30 / pi) * math.sin(2 * turn) * (c * c - c),
        2 * math.sqrt(35 / pi) * math.cos(3 * turn) * s**3,
        math.sqrt(210 / pi) * math.cos(2 * turn) * (2 * c - 1) * (c * c - c),
        2 * math.sqrt(21 / pi) * math.cos(turn) * s * cubic,
        math.sqrt(7 / (2 * pi)) * (-1 + 12 * c - 30 * c * c + 20 * c**3),
        2 * math.sqrt(21 / pi) * math.sin(turn) * s * cubic,
        math.sqrt(210 / pi) * math.sin(2 * turn) * (2 * c - 1) * (c * c - c),
        2 * math.sqrt(35 / pi) * math.sin(3 * turn) * s**3,
    ]


RELIGHT = {
    ("ptm", "rgb"): 18, ("ptm", "lrgb"): 9, ("hsh", "rgb"): 27, ("hsh", "lrgb"): 12, ("sh", "rgb"): 27,
    ("rbf", "mrgb"): 5,
}  # fmt: skip


def write_relight(folder, kind, space, count, rows=ROWS, columns=COLUMNS):
    """A folder of relight; returns info.json's content and its planes (rows, columns, planes) as JPEG keeps them."""
    folder.mkdir()
    random, planes = np.random.default_rng(8), []
    for number in range(-(-count // 3)):
        picture = np.repeat(np.repeat(random.integers(0, 256, (-(-rows // 8), -(-columns // 8), 3)), 8, 0), 8, 1)
        picture = Image.fromarray(picture[:rows, :columns].astype(np.uint8))
        picture.save(folder / f"plane_{number}.jpg", quality=95, subsampling=0)
        with Image.open(folder / f"plane_{number}.jpg") as stored:
            planes.append(np.asarray(stored))
    material = {"scale": random.uniform(0.2, 1, count).tolist(), "bias": random.uniform(0, 0.6, count).tolist()}
    info = {"width": columns, "height": rows, "format": "jpg", "type": kind, "colorspace": space, "nplanes": count}
    info |= {"materials": [material], "lights": dome(6, 1).ravel().tolist(), "sigma": 0.4}
    if kind == "rbf":
        info["basis"] = random.integers(0, 256, (count + 1) * 18).tolist()
        material["range"] = random.uniform(100, 400, count).tolist()
    (folder / "info.json").write_text(json.dumps(info))
    return info, np.concatenate(planes, axis=-1)[..., :count]


def relight_value(info, codes, light, k):
    """0 to 1 of a pixel's planes, term by term."""
    (material,), count = info["materials"], info["nplanes"]
    numbers = [(int(c) / 255 - b) * s for c, b, s in zip(codes, material["bias"], material["scale"], strict=True)]
    x, y, z = map(float, light)
    if info["type"] == "rbf":
        lights = np.reshape(info["lights"], (-1, 3))
        weights = [math.exp(-sum((each - light) ** 2) / info["sigma"] ** 2) for each in lights]
        weights = [0 if w <= 0.001 * sum(weights) else w for w in weights]
        basis, value = np.reshape(info["basis"], (count + 1, 6, 3)), 0
        for number, weight in enumerate(weights):
            value += weight * basis[0, number, k] / 255
            for plane in range(count):
                value += weight * numbers[plane] * (basis[plane + 1, number, k] - 127) / material["range"][plane]
        return value / sum(weights)
    if info["type"] == "ptm":
        terms = [1, x, y, x * x, x * y, y * y]
    elif info["type"] == "hsh":
        terms = harmonics_as_viewers_have_them(light)[:9]
    else:
        terms = [0.282095, 0.488603 * x, 0.488603 * z, 0.488603 * y, 1.092548 * x * y, 1.092548 * x * z]
        terms += [0.630783 * (3 * z * z - 1), 1.092548 * y * z, 0.546274 * (y * y - x * x)]
    if info["colorspace"] == "lrgb":
        return numbers[k] * sum(t * n for t, n in zip(terms, numbers[3:], strict=True))
    return sum(t * n for t, n in zip(terms, numbers[k::3], strict=True))


@pytest.mark.parametrize(("kind", "space"), RELIGHT)
def test_values_of_a_relight_folder_are_those_of_a_slow_decoder(tmp_path, kind, space):
    info, planes = write_relight(tmp_path / "r", kind, space, RELIGHT[kind, space])
    shown = open_relightable(tmp_path / "r").shown(LIGHT)
    expected = [
        [[relight_value(info, planes[r, c], LIGHT, k) for k in range(3)] for c in range(COLUMNS)] for r in range(ROWS)
    ]
    np.testing.assert_allclose(shown, expected, atol=2e-5)


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
    Image.new("RGB", (COLUMNS, ROWS)).save(tmp_path / "r/normals.jpg")
    made = convert(tmp_path / "r", tmp_path / "c")
    assert made.layout == "rendered from r"
    assert {"rendered", "rendered-clipped"} >= {each.kind for each in made.warnings} >= {"rendered"}
    assert load_capture(tmp_path / "c").settings.rendered_from == "relight/info.json"
    for number in range(6):
        Image.new("RGB", (COLUMNS, ROWS)).save(tmp_path / f"r/photo{number}.jpg")
    assert recognise_relightable(tmp_path / "r") is None


def without(key):
    return lambda info: info.pop(key)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda info: info.update(type="bilinear"), "bilinear in rgb"),
        (lambda info: info.update(colorspace="mycc"), "ptm in mycc"),
        (lambda info: info.update(nplanes=21), "21 planes"),
        (lambda info: info.update(nplanes=18.0), "'nplanes'"),
        (lambda info: info.update(width=99), "another size"),
        (lambda info: info.update(width=COLUMNS - 1), "r/plane_0.jpg: a plane of another size"),
        (lambda info: info.update(width=1 << 19, height=1 << 19), "larger than is read"),
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
        (lambda info: info.update(sigma=1e-300), "'sigma' cannot be used: expected at least 0.001, found 1e-300"),
        (lambda info: info.update(sigma=-0.4), "'sigma'"),
        (lambda info: info["materials"][0]["range"].__setitem__(2, 1e-300), "'range'"),
        (lambda info: info.update(lights=[1.02 * v for v in info["lights"]]), "'lights'"),
        (lambda info: info.update(lights=[0] * 18), "vectors of length 1, found length 0"),
        (lambda info: info.update(lights=[], basis=[]), "'lights'"),
    ],
)
def test_gaussians_that_cannot_be_evaluated_are_refused(tmp_path, change, text):
    info, _ = write_relight(tmp_path / "r", "rbf", "mrgb", 5)
    info["lights"] = [round(v, 3) for v in info["lights"]]
    (tmp_path / "r/info.json").write_text(json.dumps(info))
    assert np.isfinite(open_relightable(tmp_path / "r").shown(LIGHT)).all()
    change(info)
    (tmp_path / "r/info.json").write_text(json.dumps(info))
    with pytest.raises(CaptureError, match=re.escape(text)):
        open_relightable(tmp_path / "r")


def write_tiles(folder):
    """One plane of three, of two tiles in each direction, as deep zoom."""
    write_relight(folder, "rbf", "mrgb", 3, 300, 300)
    write_deep_zoom(folder, "plane_0", open_relightable(folder).codes, folder.parent, 90)
    (folder / "plane_0.jpg").unlink()


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        (b'Width="300"', b'Width="301"', "r/plane_0.dzi: a plane of another size than info.json says: expected 300 x"),
        (b'Height="300"', b"", "r/plane_0.dzi: no deep zoom"),
        (b'TileSize="254"', 'TileSize="\u00b2"'.encode(), "r/plane_0.dzi: no deep zoom"),
        (b'TileSize="254"', 'TileSize="\u0662\u0662"'.encode(), "r/plane_0.dzi: no deep zoom"),
        (b'TileSize="254"', b'TileSize="8"', "r/plane_0.dzi: tiles too small"),
        (b"<?xml", b"\xff\xfe<?xml", "r/plane_0.dzi: not UTF-8 text"),
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
    with pytest.raises(CaptureError, match=r"r/plane_0_files/01/1_0\.jpg: file is missing"):
        open_relightable(tmp_path / "r")
    shutil.rmtree(tiles / "01")
    shutil.rmtree(tiles / "0")
    with pytest.raises(CaptureError, match=r"plane_0\.dzi: no deep zoom"):
        open_relightable(tmp_path / "r")


@pytest.mark.parametrize("name", ["info.json", "plane_0.dzi", "plane_0_files/1/1_1.jpg"])
def test_nothing_is_read_through_links_that_leave_a_relight_folder(tmp_path, name):
    write_tiles(tmp_path / "r")
    (tmp_path / "r" / name).rename(tmp_path / "elsewhere")
    (tmp_path / "r" / name).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(CaptureError, match=f"r/{name}: a link that leads out of the folder"):
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
    assert (made.photographs, made.layout) == (6, "directions in order")
    capture = load_capture(tmp_path / "c")
    np.testing.assert_allclose(capture.lights.vectors.ravel(), info["lights"], atol=1e-8)
    assert [frame.file for frame in capture.observed] == [f"frames/photo{number}.jpg" for number in range(6)]


FILES = {
    "rgb.ptm": rgb_file,
    "lrgb.ptm": lrgb_file,
    "older.ptm": older_lrgb_file,
    "jpeg.ptm": jpeg_file,
    "four.rti": lambda: hsh_file(4),
    "nine.rti": lambda: hsh_file(9, "\r\n"),
    "sixteen.RTI": lambda: hsh_file(16),
}


@pytest.mark.parametrize("name", FILES)
def test_values_are_those_of_a_slow_decoder(tmp_path, name):
    content, value = FILES[name]()
    (tmp_path / name).write_bytes(content)
    shown = open_relightable(tmp_path / name).shown(LIGHT)
    expected = [[[value(r, c, k) for k in range(3)] for c in range(COLUMNS)] for r in range(ROWS)]
    assert np.ptp(expected) > 0.5
    np.testing.assert_allclose(shown, expected, atol=2e-5)


def nine_harmonics(light):
    """The first nine of the basis, each written out."""
    azimuth, cosine = np.arctan2(light[1], light[0]), max(light[2], np.cos(3.1415 / 2 - 0.15))
    root, c, s = np.sqrt(cosine - cosine**2), np.cos(azimuth), np.sin(azimuth)
    return [
        1 / np.sqrt(2 * np.pi),
        np.sqrt(6 / np.pi) * c * root,
        np.sqrt(3 / (2 * np.pi)) * (2 * cosine - 1),
        np.sqrt(6 / np.pi) * s * root,
        np.sqrt(30 / np.pi) * np.cos(2 * azimuth) * (cosine**2 - cosine),
        np.sqrt(30 / np.pi) * c * (2 * cosine - 1) * root,
        np.sqrt(5 / (2 * np.pi)) * (1 - 6 * cosine + 6 * cosine**2),
        np.sqrt(30 / np.pi) * s * (2 * cosine - 1) * root,
        np.sqrt(30 / np.pi) * np.sin(2 * azimuth) * (cosine**2 - cosine),
    ]


def test_harmonics_are_those_written_out():
    lights = dome(30, 0)
    np.testing.assert_allclose(
        hemispherical_harmonics(lights, 3), [nine_harmonics(each) for each in lights], atol=1e-12
    )


@pytest.mark.parametrize("name", FILES)
def test_files_that_end_anywhere_or_claim_too_much_are_refused(tmp_path, name):
    content, _ = FILES[name]()
    path = tmp_path / name
    for length in range(0, len(content), 7):
        path.write_bytes(content[:length])
        with pytest.raises(CaptureError) as caught:
            open_relightable(path)
        assert caught.value.problems[0].kind == "relightable-unreadable"
    size = (f"{COLUMNS}\n{ROWS}\n" if name.endswith("ptm") else f"{COLUMNS} {ROWS} 3").encode()
    for claim in (b"100000 100000 3", b"999999999 1 3", b"0 5 3", b"-3 5 3", b"9" * 30 + b" 1 3", b"x 5 3"):
        path.write_bytes(content.replace(size, claim if name.lower().endswith("rti") else claim[:-2] + b"\n", 1))
        with pytest.raises(CaptureError):
            open_relightable(path)


@pytest.mark.parametrize(
    ("name", "content", "text"),
    [
        ("a.ptm", heading("PTM_FORMAT_LUM") + bytes(900), "PTM_FORMAT_LUM"),
        ("a.ptm", heading("PTM_FORMAT_RGB", "PTM_2.0") + bytes(900), r"PTM_2\.0"),
        ("a.ptm", heading("PTM_FORMAT_RGB").replace(b"1.5", b"nan") + bytes(900), "numbers"),
        ("a.ptm", jpeg_file(motion=3)[0], "motion"),
        ("a.ptm", jpeg_file(transforms=[2] * 9)[0], "transforms"),
        ("a.ptm", jpeg_file()[0].replace(b"2 -1 4", b"2 -1 0"), "not made before"),
        ("a.ptm", jpeg_file()[0].replace(struct.pack(">I", ROWS * COLUMNS - 1), b"\0\0\1\0"), "beyond the picture"),
        ("a.ptm", jpeg_file()[0].replace(b"\xff\xc0", b"\xff\xc3"), "JPEG"),
        ("a.rti", rgb_file()[0], "#HSH"),
        ("a.rti", hsh_file()[0].replace(b"9 2 1", b"9 1 1"), "basis 1"),
        ("a.rti", hsh_file()[0].replace(b"9 2 1", b"8 2 1"), "8 terms"),
    ],
)
def test_other_kinds_are_refused_by_name(tmp_path, name, content, text, capsys):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(CaptureError, match=text):
        convert(tmp_path / name, tmp_path / "c")
    assert not (tmp_path / "c").exists()
    with pytest.raises(SystemExit) as ended:
        main(["convert", str(tmp_path / name), str(tmp_path / "c")])
    assert ended.value.code == 2
    assert name in capsys.readouterr().err


def test_a_capture_says_that_its_pictures_were_rendered(tmp_path):
    folder = tmp_path / "source"
    folder.mkdir()
    (folder / "relief.ptm").write_bytes(lrgb_file()[0])
    made = convert(folder, tmp_path / "c", region=(0, 0, 4, 6))
    assert {"rendered", "rendered-clipped"} == {each.kind for each in made.warnings}
    capture = load_capture(tmp_path / "c")
    assert capture.settings.rendered_from == "relief.ptm"
    assert (tmp_path / "c/relief.ptm").read_bytes() == (folder / "relief.ptm").read_bytes()
    assert "no photographs" in capture.settings.notes
    assert capture.settings.camera.encoding == "srgb"
    problems = check_capture(tmp_path / "c", level="full")
    assert "rendered" in {each.kind for each in problems}
    assert "file-unlisted" not in {each.kind for each in problems}
    lamps = lamps_for(None)
    np.testing.assert_allclose(capture.directions, lamps.directions, atol=1e-8)
    (tmp_path / "own.lp").write_text("3\n0 0 1\n0.6 0 0.8\n0 0.6 0.8\n")
    made = convert(folder / "relief.ptm", tmp_path / "d", lights_file=tmp_path / "own.lp", encoding="linear")
    assert made.photographs == 3
    with pytest.raises(CaptureError, match="check"):
        convert(folder, tmp_path / "e", checks=("a",))
    (folder / "other.rti").write_bytes(b"")
    with pytest.raises(CaptureError, match="several"):
        convert(folder, tmp_path / "e")


@pytest.mark.parametrize("program", ["COLMAP", "Meshroom"])
def test_photographs_below_a_folder_win_over_its_relightable_images(tmp_path, program):
    source = tmp_path / "source"
    photographs(source / "images", [name for name, _, _ in around()])
    if program == "COLMAP":
        write_model(source / "sparse/0", "text")
    else:
        write_cameras(source)
    for name in ("finished.ptm", "finished.rti"):
        (source / name).write_bytes(lrgb_file()[0])
        assert convert(source, tmp_path / name).layout == f"turntable with cameras of {program}"
    write_relight(tmp_path / "r", "ptm", "lrgb", 9)
    shutil.copytree(tmp_path / "r", source, dirs_exist_ok=True)
    assert convert(source, tmp_path / "c").layout == f"turntable with cameras of {program}"


@pytest.mark.parametrize("found", ["a/circle_data.txt", "jpeg-exports/a.jpg"])
def test_spheres_and_projects_of_rtibuilder_win_over_a_relight_folder(tmp_path, found):
    write_relight(tmp_path / "r", "ptm", "lrgb", 9)
    (tmp_path / "r" / found).parent.mkdir()
    (tmp_path / "r" / found).touch()
    assert recognise_relightable(tmp_path / "r") is None
    with pytest.raises(CaptureError, match=r"photographs is expected beside the mirror spheres|\.lp"):
        convert(tmp_path / "r", tmp_path / "c")


def test_normals_survive_our_own_export(tmp_path):
    """A matte relief under 24 lamps: fitted, written and converted as a user would; normals by least squares."""
    rows, columns = 40, 48
    y, x = np.mgrid[0:rows, 0:columns] / 6
    normals = np.stack([0.35 * np.sin(x), 0.3 * np.cos(y + x / 2), np.ones_like(x)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    colour = np.array([0.5, 0.35, 0.2])
    lights = dome(24, 0)
    values = np.maximum(normals.reshape(-1, 3) @ lights.T, 0)[..., None] * colour
    coded = srgb_encode(values)
    model = HarmonicModel.of("ptm", lights, coded, np.ones(coded.shape[:2], bool))
    fitted = model.fit(coded, np.ones(coded.shape[:2], bool)).reshape(rows, columns, 6, 3)
    low, span = fitted.min(axis=(0, 1)), np.ptp(fitted, axis=(0, 1))
    planes = np.rint(255 * (fitted - low) / span).astype(np.uint8)
    write_ptm(tmp_path / "relief.ptm", [planes[:, :, term] for term in range(6)], span, -low / span)
    convert(tmp_path / "relief.ptm", tmp_path / "c")
    observed = read_observations(tmp_path / "c")
    field = estimate_normals(observed.values.mean(axis=-1), observed.directions, valid=observed.valid)
    exact = np.einsum("lb,rcbk->lrck", ptm_weights(observed.directions), fitted)  # what the fit says, in full precision
    unrounded = estimate_normals(decode(np.clip(exact, 0, 1), "srgb").mean(axis=-1), observed.directions)
    assert degrees_apart(field.normals, unrounded.normals).mean() < 0.3
    assert degrees_apart(field.normals, normals).mean() < 3.5  # the polynomials themselves


def degrees_apart(some, others):
    return np.degrees(np.arccos(np.clip((some * others).sum(axis=-1), -1, 1)))
