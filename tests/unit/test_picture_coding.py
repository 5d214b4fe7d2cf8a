"""Colour codings that files state: ICC profiles, PNG chunks, Exif, TIFF fields; what captures make of them."""

import struct
import zlib

import cv2
import numpy as np
import pytest
import tifffile
from captures import edit_yaml, make_capture
from PIL import Image, ImageCms

from nishiki.capture.convert import convert
from nishiki.capture.folder import load_capture
from nishiki.evaluate.camera_colour import assumed_colour
from nishiki.formats.coding import ROMM, RgbSpace, icc_profile
from nishiki.formats.images import read_codes, read_header
from nishiki.formats.problems import CaptureError
from nishiki.observations.check import check_capture
from nishiki.observations.frames import FrameReader

CODES = np.linspace(0, 1, 65)
SRGB = np.where(CODES <= 0.04045, CODES / 12.92, ((CODES + 0.055) / 1.055) ** 2.4)
ADOBE_D50 = ((0.6485, 0.3309), (0.2302, 0.7016), (0.1559, 0.0660))
P3_D50 = ((0.6800, 0.3200), (0.2650, 0.6900), (0.1500, 0.0600))
NAMES = ("red", "green", "blue")


def elements(tags, space=b"RGB "):
    """An ICC profile (version 2) of these elements."""
    table, data, start = struct.pack(">I", len(tags)), b"", 132 + 12 * len(tags)
    for tag, content in tags.items():
        table += tag + struct.pack(">II", start + len(data), len(content))
        data += content + bytes(-len(content) % 4)
    heading = struct.pack(
        ">I4sI4s4s4s", 132 + len(table) - 4 + len(data), bytes(4), 0x02400000, b"mntr", space, b"XYZ "
    )
    heading += bytes(12) + b"acsp" + bytes(28) + struct.pack(">3i", 63190, 65536, 54061) + bytes(48)
    return heading + table + data


def description(text):
    return b"desc" + bytes(4) + struct.pack(">I", len(text) + 1) + text.encode() + bytes(79)


def sampled_srgb():
    """The sRGB profile of version 2 as scanners and cameras embed it: a curve of 1024 points."""
    steps = np.linspace(0, 1, 1024)
    values = np.where(steps <= 0.04045, steps / 12.92, ((steps + 0.055) / 1.055) ** 2.4)
    curve = b"curv" + bytes(4) + struct.pack(">I", 1024) + np.rint(values * 65535).astype(">u2").tobytes()
    xyz = {b"rXYZ": (28578, 14581, 912), b"gXYZ": (25241, 46981, 6361), b"bXYZ": (9376, 3974, 46797)}
    columns = {tag: b"XYZ " + bytes(4) + struct.pack(">3i", *value) for tag, value in xyz.items()}
    curves = dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve)
    return elements({b"desc": description("sRGB IEC61966-2.1"), **columns, **curves})


def separate_curves():
    """A profile whose three channels have different powers, as calibrated displays have."""
    spaces = [RgbSpace("scanner", ROMM.primaries, gamma) for gamma in (1.8, 2.0, 2.2)]
    first = icc_profile(spaces[0])
    whole = bytearray(first)
    (count,) = struct.unpack(">I", first[128:132])
    for place in range(132, 132 + 12 * count, 12):
        tag, start, _ = struct.unpack(">4sII", first[place : place + 12])
        if tag in (b"gTRC", b"bTRC"):
            gamma = spaces[1 if tag == b"gTRC" else 2].gamma
            struct.pack_into(">i", whole, start + 12, round(gamma * 65536))
    return bytes(whole)


def tables(gamma=2.0):
    """A profile of tables (mft2): a power for each channel, then eight colours that are sums, in XYZ."""
    steps = np.linspace(0, 1, 4096)
    inputs = np.tile(np.rint(steps**gamma * 65535), 3).astype(">u2").tobytes()
    corners = [[r, g, b] for r in (0, 1) for g in (0, 1) for b in (0, 1)]
    colours = np.rint(np.array(corners) @ ROMM.to_xyz().T * 32768).astype(">u2").tobytes()
    outputs = np.tile(np.array([0, 65535]), 3).astype(">u2").tobytes()
    matrix = struct.pack(">9i", 65536, 0, 0, 0, 65536, 0, 0, 0, 65536)
    table = b"mft2" + bytes(4) + struct.pack(">BBBx", 3, 3, 2) + matrix + struct.pack(">HH", 4096, 2)
    element = table + inputs + colours + outputs
    white = b"XYZ " + bytes(4) + struct.pack(">3i", 63190, 65536, 54061)
    return elements({b"desc": description("tables"), b"wtpt": white, b"A2B0": element, b"cprt": b"text" + bytes(8)})


def space(name, gamma, primaries=ADOBE_D50):
    return icc_profile(RgbSpace(name, primaries, gamma))


PROFILES = {
    "Adobe RGB": (space("Adobe RGB (1998)", 2.19921875), CODES**2.19921875),
    "ProPhoto": (icc_profile(ROMM), CODES**1.8),
    "Display P3": (space("Display P3", 2.4, P3_D50), CODES**2.4),
    "sRGB v2": (sampled_srgb(), SRGB),
    "sRGB v4": (ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes(), SRGB),
    "gamma 1.0": (space("linear", 1.0), CODES),
    "gamma 1.8": (space("Apple", 1.8), CODES**1.8),
    "gamma 2.2": (space("PC", 2.2), CODES**2.2),
}


def write(path, codes, profile=None, exif=None):
    """An 8- or 16-bit picture with a profile."""
    options = ({"icc_profile": profile} if profile else {}) | ({} if exif is None else {"exif": exif})
    if path.suffix == ".tif":
        tifffile.imwrite(path, codes, photometric="rgb" if codes.ndim == 3 else "minisblack", iccprofile=profile)
    elif codes.dtype == np.uint16:
        cv2.imwrite(str(path), codes[..., ::-1])
        add_chunks(path, iCCP=b"p\0\0" + zlib.compress(profile))
    else:
        Image.fromarray(codes).save(path, **options)


def add_chunks(path, **chunks):
    """Put chunks behind the heading of a PNG."""
    content, inserted = path.read_bytes(), b""
    for name, data in chunks.items():
        part = name.encode() + data
        inserted += struct.pack(">I", len(data)) + part + struct.pack(">I", zlib.crc32(part))
    path.write_bytes(content[:33] + inserted + content[33:])


@pytest.mark.parametrize("suffix", ["tif", "png", "jpg"])
@pytest.mark.parametrize("name", PROFILES)
def test_an_embedded_profile_gives_the_curve(tmp_path, name, suffix):
    profile, linear = PROFILES[name]
    path = tmp_path / f"a.{suffix}"
    write(path, np.zeros((8, 9, 3), np.uint8 if suffix == "jpg" else np.uint16), profile)
    coding = read_header(path).coding
    assert coding.fault == ""
    np.testing.assert_allclose(coding.curve.decode(CODES), linear, atol=1e-4)
    assert coding.linear == (name == "gamma 1.0")
    assert (coding.to_srgb is None) == name.startswith("sRGB")


def test_a_profile_in_several_segments_is_joined(tmp_path):
    write(tmp_path / "a.jpg", np.zeros((8, 9, 3), np.uint8), sampled_srgb() + bytes(70_000))  # segments have 64 KiB
    np.testing.assert_allclose(read_header(tmp_path / "a.jpg").coding.curve.decode(CODES), SRGB, atol=1e-4)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize(("profile", "powers"), [(separate_curves(), (1.8, 2.0, 2.2)), (tables(), (2.0, 2.0, 2.0))])
def test_tables_and_separate_curves_are_applied_by_the_reader(tmp_path, profile, powers, dtype):
    top = np.iinfo(dtype).max
    codes = np.random.default_rng(0).integers(0, top, (20, 30, 3)).astype(dtype)
    codes[3, 4] = (top, 0, 0)
    write(tmp_path / "a.tif", codes, profile)
    header = read_header(tmp_path / "a.tif")
    assert header.coding.developed
    assert header.coding.linear
    assert header.sample == "uint16"
    read = read_codes(tmp_path / "a.tif", NAMES)
    assert (read[3, 4] == 65535).all(), "a saturated sample stays one"
    codes[3, 4], read[3, 4] = 0, 0
    # Primaries are those of ROMM RGB on both sides.
    np.testing.assert_allclose(read / 65534, (codes / top) ** np.array(powers), atol=2e-3)


@pytest.mark.parametrize(
    ("chunks", "linear"),
    [
        ({"sRGB": b"\0"}, SRGB),
        ({"gAMA": struct.pack(">I", 45455)}, CODES**2.2),
        ({"gAMA": struct.pack(">I", 100_000)}, CODES),
        ({"gAMA": struct.pack(">I", 45455), "sRGB": b"\0"}, SRGB),
        ({"cICP": bytes([1, 13, 0, 1])}, SRGB),
        ({"cICP": bytes([12, 8, 0, 1]), "sRGB": b"\0"}, CODES),
        ({"cICP": bytes([9, 1, 0, 1])}, np.where(CODES < 0.081, CODES / 4.5, ((CODES + 0.099) / 1.099) ** (1 / 0.45))),
    ],
)
def test_chunks_of_png_give_the_curve(tmp_path, chunks, linear):
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.zeros((8, 9, 3), np.uint16))
    add_chunks(path, **chunks)
    np.testing.assert_allclose(read_header(path).coding.curve.decode(CODES), linear, atol=1e-3)


def test_exif_and_tiff_fields_give_the_curve(tmp_path):
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0xA001: 65535, 0xA005: {1: "R03"}})
    write(tmp_path / "a.jpg", np.zeros((8, 9, 3), np.uint8), exif=exif)
    np.testing.assert_allclose(read_header(tmp_path / "a.jpg").coding.curve.decode(CODES), CODES**2.19921875)
    table = tuple(np.rint((np.arange(256) / 255) ** 1.8 * 65535).astype(int).tolist())
    codes = np.zeros((8, 9), np.uint8)
    tifffile.imwrite(tmp_path / "a.tif", codes, extratags=[(301, 3, 256, table, True)])
    np.testing.assert_allclose(read_header(tmp_path / "a.tif").coding.curve.decode(CODES), CODES**1.8, atol=1e-3)


@pytest.mark.parametrize("profile", [b"no profile", icc_profile(ROMM)[:200], elements({}, b"CMYK")])
def test_a_profile_that_cannot_be_used_is_a_fault(tmp_path, profile):
    write(tmp_path / "a.tif", np.zeros((8, 9, 3), np.uint16), profile)
    assert read_header(tmp_path / "a.tif").coding.fault


def photographs(folder, profile, odd=None):
    """A folder of twelve coded TIFF of the same scene under as many lamps; the fourth has another profile."""
    folder.mkdir()
    rng, lines = np.random.default_rng(0), ["12"]
    for i in range(12):
        codes = rng.integers(2000, 60_000, (20, 30, 3)).astype(np.uint16)
        write(folder / f"p{i:02d}.tif", codes, odd if i == 3 and odd is not None else profile)
        angle = 2 * np.pi * i / 12
        lines.append(f"p{i:02d}.tif {0.6 * np.cos(angle):.5f} {0.6 * np.sin(angle):.5f} 0.8")
    (folder / "dome.lp").write_text("\n".join(lines) + "\n")
    return folder


def test_a_capture_is_decoded_by_what_its_files_state(tmp_path):
    made = convert(photographs(tmp_path / "s", PROFILES["Adobe RGB"][0]), tmp_path / "c")
    assert {p.kind for p in made.warnings} == {"coding-stated"}
    capture = load_capture(tmp_path / "c")
    assert capture.settings.camera.encoding == "file"
    reader = FrameReader.of(capture, "all", prove=False)
    np.testing.assert_allclose(reader.table, (np.arange(65536) / 65535) ** 2.19921875, atol=1e-5)
    matrix = assumed_colour(3, reader.to_srgb.tolist()).matrix
    np.testing.assert_allclose(matrix.sum(axis=1), [0.9505, 1, 1.089], atol=2e-3)  # white stays white
    assert matrix[1, 1] < assumed_colour(3).matrix[1, 1]  # Adobe's green is darker: it has more chroma
    assert "not-linear" in {p.kind for p in check_capture(tmp_path / "c", level="full")}


def test_an_encoding_that_is_given_overrules_the_files_aloud(tmp_path):
    source = photographs(tmp_path / "s", PROFILES["ProPhoto"][0])
    made = convert(source, tmp_path / "c", encoding="linear")
    assert {p.kind for p in made.warnings} == {"encoding-overruled"}
    assert "encoding-overruled" in {p.kind for p in check_capture(tmp_path / "c")}
    assert FrameReader.of(load_capture(tmp_path / "c"), "all", prove=False).coding.linear
    linear = convert(photographs(tmp_path / "t", PROFILES["gamma 1.0"][0]), tmp_path / "d", encoding="linear")
    assert linear.warnings == ()


def test_the_usual_statement_of_a_camera_is_no_news(tmp_path):
    source = photographs(tmp_path / "s", None)
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0xA001: 1})
    for path in sorted(source.glob("*.tif")):
        write(path.with_suffix(".jpg"), (tifffile.imread(path) >> 8).astype(np.uint8), exif=exif)
        path.unlink()
    (source / "dome.lp").write_text((source / "dome.lp").read_text().replace(".tif", ".jpg"))
    assert convert(source, tmp_path / "c").warnings == ()
    reader = FrameReader.of(load_capture(tmp_path / "c"), "all", prove=False)
    np.testing.assert_allclose(reader.table[::51], SRGB_OF_FIFTHS, atol=1e-5)


SRGB_OF_FIFTHS = [0, 0.0331048, 0.1328683, 0.3185468, 0.6038273, 1]


def test_a_grey_profile_gives_the_curve(tmp_path):
    curve = b"curv" + bytes(4) + struct.pack(">IH", 1, round(2.2 * 256))
    write(
        tmp_path / "a.tif",
        np.zeros((8, 9), np.uint16),
        elements({b"desc": description("Dot"), b"kTRC": curve}, b"GRAY"),
    )
    coding = read_header(tmp_path / "a.tif").coding
    np.testing.assert_allclose(coding.curve.decode(CODES), CODES ** (round(2.2 * 256) / 256))
    assert coding.to_srgb is None


@pytest.mark.parametrize("odd", [PROFILES["sRGB v4"][0], PROFILES["Adobe RGB"][0], b"no profile"])
def test_one_photograph_of_another_coding_is_named(tmp_path, odd):
    with pytest.raises(CaptureError) as caught:
        convert(photographs(tmp_path / "s", PROFILES["ProPhoto"][0], odd), tmp_path / "c", examine=check_capture)
    assert {p.file for p in caught.value.problems} == {"frames/p03.tif"}
    assert {p.kind for p in caught.value.problems} <= {"coding-differs", "coding-unusable"}


def test_photographs_without_a_statement_are_linear_or_of_jpeg_srgb(tmp_path):
    folder = make_capture(tmp_path / "c", white=False, dark=False)
    edit_yaml(folder, camera={"channels": list(NAMES)})
    assert FrameReader.of(load_capture(folder), "all", prove=False).coding.linear
    kinds = {p.kind for p in check_capture(folder, level="full")}
    assert not kinds & {"coding-differs", "encoding-overruled", "coding-unusable", "not-linear", "orientation-differs"}


def test_a_photograph_that_was_turned_is_named_by_that(tmp_path):
    source = photographs(tmp_path / "s", None)
    turned = tifffile.imread(source / "p05.tif").transpose(1, 0, 2)
    tifffile.imwrite(source / "p05.tif", turned, photometric="rgb")
    with pytest.raises(CaptureError) as caught:
        convert(source, tmp_path / "c", examine=check_capture)
    (problem,) = caught.value.problems
    assert (problem.kind, problem.file) == ("image-size", "frames/p05.tif")
    assert "turned" in problem.what


@pytest.mark.parametrize("suffix", ["tif", "jpg", "png"])
def test_orientation_turns_no_format_and_differences_are_told(tmp_path, suffix):
    codes = np.random.default_rng(1).integers(0, 255, (20, 30, 3)).astype(np.uint8)
    read = []
    for orientation in (1, 3, 6):
        path = tmp_path / f"{orientation}.{suffix}"
        exif = Image.Exif()
        exif[274] = orientation
        if suffix == "tif":
            tifffile.imwrite(path, codes, photometric="rgb", extratags=[(274, 3, 1, orientation, True)])
        else:
            write(path, codes, exif=exif)
        assert read_header(path).exif.orientation == orientation
        read.append(read_codes(path, NAMES))
        assert np.array_equal(read[0], read[-1])
    if suffix != "jpg":
        assert np.array_equal(read[0], codes)
