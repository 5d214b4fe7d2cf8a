"""Broken captures: each kind has its own clear error, from the check and, where it matters, from ingest."""

import os
import shutil
import struct

import cv2
import numpy as np
import OpenEXR
import pytest
from captures import RING, edit_text, edit_yaml, make_capture, write_frame

from nishiki.capture.folder import load_capture
from nishiki.capture.seal import seal
from nishiki.errors import UserError
from nishiki.formats.problems import CaptureError
from nishiki.observations.check import check_capture
from nishiki.observations.plane_store import write_observations
from nishiki.stages.ingest import IngestSettings

ROWS, COLUMNS = 24, 32
CAMERA = {"channels": ["red", "green", "blue"], "encoding": "linear", "bits": 12, "saturation": 0.98}


def frame(value, dtype=np.uint16, rows=ROWS, columns=COLUMNS, channels=3):
    return np.full((rows, columns, channels), value, np.float64), dtype


def put(name, *args, **kwargs):
    """Replace one photograph by an even one."""

    def change(folder):
        values, dtype = frame(*args, **kwargs)
        write_frame(folder / name, values, dtype)

    return change


def text(name, old, new):
    return lambda folder: edit_text(folder / name, old, new)


def whole(name, content):
    def change(folder):
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())

    return change


def keys(**changes):
    return lambda folder: edit_yaml(folder, **changes)


def cut(name, share):
    def change(folder):
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: int(share * len(data))])

    return change


def flipped(name):
    def change(folder):
        data = bytearray((folder / name).read_bytes())
        data[len(data) // 2] ^= 16
        (folder / name).write_bytes(data)

    return change


def bomb(folder):
    data = bytearray((folder / "frames/L02.png").read_bytes())
    data[16:24] = struct.pack(">II", 60_000, 60_000)
    (folder / "frames/L02.png").write_bytes(data)


def link_out(folder):
    outside = folder.parent / "outside.png"
    shutil.copy(folder / "frames/L02.png", outside)
    (folder / "frames/L02.png").unlink()
    os.symlink(outside, folder / "frames/L02.png")


def exr_with(value):
    def change(folder):
        for i in range(5):
            values = np.full((ROWS, COLUMNS), 0.2 + 0.1 * i, np.float32)
            if i == 1:
                values[3, 4] = value
            with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, dict.fromkeys("RGB", values)) as file:
                file.write(str(folder / f"frames/L{i + 1:02d}.exr"))
            for place in ("frames", "white"):
                (folder / f"{place}/L{i + 1:02d}.png").unlink()
        rows = "".join(f"frames/L{i:02d}.exr,sample,L{i:02d}\n" for i in range(1, 6))
        (folder / "frames.csv").write_text("file,role,light\n" + rows)
        edit_yaml(folder, camera={"channels": ["red", "green", "blue"]})

    return change


def spectra(rows):
    def change(folder):
        whole("spectra/camera.csv", "wavelength_nm,red,green,blue\n" + rows)(folder)
        edit_yaml(folder, camera={**CAMERA, "sensitivities": "spectra/camera.csv"})

    return change


def band(first, last, value="1,1,1"):
    return "".join(f"{w},{value}\n" for w in range(first, last + 1, 10))


def masked(values):
    def change(folder):
        write_frame(folder / "mask.png", values, np.uint8)
        edit_yaml(folder, mask="mask.png")

    return change


def lights(vectors):
    lines = [f"L{i + 1:02d} {x} {y} {z}" for i, (x, y, z) in enumerate(vectors)]
    return whole("lights.lp", f"{len(lines)}\n" + "\n".join(lines) + "\n")


def changed(vector):
    return lights([vector, *RING[1:]])


def three_few(folder):
    lights(RING[:2])(folder)
    rows = "".join(f"frames/L{i:02d}.png,sample,L{i:02d}\n" for i in (1, 2))
    (folder / "frames.csv").write_text("file,role,light\n" + rows)


def seal_then(change):
    def both(folder):
        seal(folder)
        change(folder / "data")

    return both


def nested(folder):
    shutil.rmtree(folder)
    folder.mkdir()


def half_sealed(folder):
    half = folder.with_name(folder.name + ".sealing")
    half.mkdir()
    folder.rename(half / "data")


# name: (what breaks it, the error's kind, words of the message)
BROKEN = {
    "truncated image": (cut("frames/L02.png", 0.6), "image-truncated", "frames/L02.png"),
    "header cut off": (cut("frames/L02.png", 0.01), "image-truncated", "frames/L02.png"),
    "damaged image": (flipped("frames/L02.png"), "image-truncated", "frames/L02.png"),
    "wrong size": (put("frames/L02.png", 500, rows=25), "image-size", "expected 24 x 32"),
    "not an image": (whole("frames/L02.png", "Dear colleague,"), "image-unreadable", "not an image"),
    "empty file": (whole("frames/L02.png", b""), "image-unreadable", "frames/L02.png"),
    "bit depth differs": (put("frames/L02.png", 90, dtype=np.uint8), "image-depth", "uint8"),
    "channels differ": (put("frames/L02.png", 500, channels=1), "channels-differ", "camera.channels"),
    "codes beyond the bits": (put("frames/L02.png", 5000), "bits-exceeded", "camera.bits"),
    "bits that the files cannot hold": (keys(camera={**CAMERA, "bits": 17}), "wrong-value", "bits"),
    "decompression bomb": (bomb, "image-absurd", "60000"),
    "light behind the plane": (changed((0.5, 0.2, -0.6)), "light-behind", "z > 0"),
    "light in the plane": (changed((1, 0, 0)), "light-behind", "L01"),
    "light of zero length": (changed((0, 0, 0)), "light-zero", "zero length"),
    "NaN in lights": (changed(("nan", 0, 1)), "light-not-finite", "nan"),
    "infinity in lights": (changed((0, "inf", 1)), "light-not-finite", "inf"),
    "duplicate light": (text("lights.lp", "L02.png", "L01.png"), "light-duplicate", "twice"),
    "light without frame": (text("frames.csv", "frames/L02.png,sample,L02,\n", ""), "light-without-frame", "L02"),
    "frame without light": (text("frames.csv", "sample,L02", "sample,L99"), "frame-without-light", "L99"),
    "light photographed twice": (text("frames.csv", "sample,L02", "sample,L03"), "light-repeated", "L03"),
    "count of lights disagrees": (text("lights.lp", "5\n", "7\n"), "lights-count", "7 lights"),
    "lights file missing": (lambda f: (f / "lights.lp").unlink(), "image-missing", "lights.lp"),
    "lights unreadable": (text("lights.lp", "L02.png 0.7", "L02.png up"), "lights-unreadable", "line 3"),
    "two lights only": (three_few, "lights-few", "at least 3"),
    "lights in one plane": (lights([(x, 0, 1) for x in (-1, -0.5, 0.1, 0.5, 1)]), "lights-coplanar", "one plane"),
    "white missing for a light": (text("frames.csv", "white/L02.png,white,L02,\n", ""), "white-missing", "L02"),
    "white too dark": (put("white/L02.png", 130), "white-dark", "white/L02.png"),
    "white saturated": (put("white/L02.png", 4095), "white-saturated", "Expose the board less"),
    "lamp behind the board": (keys(white={"normal": [1, 0, 0.01]}), "white-grazing", "white"),
    "everything saturated": (put("frames/L02.png", 4095), "all-saturated", "frames/L02.png"),
    "everything black": (put("frames/L02.png", 0), "all-dark", "frames/L02.png"),
    "dark frame of another size": (put("dark/dark.png", 100, columns=30), "image-size", "dark/dark.png"),
    "photograph missing": (lambda f: (f / "frames/L02.png").unlink(), "image-missing", "frames/L02.png"),
    "file above the folder": (text("frames.csv", "frames/L02.png", "../L02.png"), "outside-folder", "../L02.png"),
    "absolute file": (text("frames.csv", "frames/L02.png", "/etc/hostname"), "outside-folder", "/etc/hostname"),
    "Windows file": (text("frames.csv", "frames/L02.png", "C:\\L02.png"), "outside-folder", "forward slashes"),
    "link out of the folder": (link_out, "outside-folder", "outside.png"),
    "photograph listed twice": (text("frames.csv", "frames/L02.png", "frames/L01.png"), "frame-duplicate", "twice"),
    "unknown role": (text("frames.csv", "sample,L02", "smaple,L02"), "role-unknown", "smaple"),
    "unknown column": (text("frames.csv", "exposure_s", "exposures"), "unknown-column", "did you mean 'exposure_s'"),
    "column missing": (text("frames.csv", "file,role", "view,role"), "frames-unreadable", "columns file and role"),
    "value missing in a row": (text("frames.csv", "sample,L02,", "sample"), "frames-unreadable", "row 4"),
    "light of a frame missing": (text("frames.csv", "sample,L02", "sample,"), "light-empty", "row 4"),
    "exposure of zero": (text("frames.csv", "sample,L02,", "sample,L02,0"), "exposure-invalid", "above 0"),
    "exposure that is no number": (text("frames.csv", "sample,L02,", "sample,L02,1/60"), "exposure-invalid", "1/60"),
    "exposure for one frame only": (text("frames.csv", "sample,L02,", "sample,L02,0.5"), "exposure-partial", "rows"),
    "frames.csv missing": (lambda f: (f / "frames.csv").unlink(), "frames-missing", "frames.csv"),
    "frames.csv empty": (whole("frames.csv", "file,role,light\n"), "frames-none", "no photographs"),
    "capture.yaml missing": (lambda f: (f / "capture.yaml").unlink(), "capture-missing", "capture.yaml"),
    "unknown key": (keys(tilte="x"), "unknown-key", "did you mean 'title'"),
    "unknown key inside": (keys(camera={**CAMERA, "saturatoin": 1}), "unknown-key", "did you mean 'saturation'"),
    "missing key": (keys(lights=None), "missing-key", "'lights'"),
    "wrong type": (keys(camera={**CAMERA, "bits": "twelve"}), "wrong-value", "camera.bits"),
    "other format": (keys(format=2), "wrong-value", "format"),
    "saturation above one": (keys(camera={**CAMERA, "saturation": 98}), "wrong-value", "camera.saturation"),
    "pitch not finite": (keys(pixel_pitch_mm=float("nan")), "wrong-value", "pixel_pitch_mm"),
    "positions without pitch": (keys(lights={"file": "lights.lp", "kind": "position_mm"}), "wrong-value", "pitch"),
    "channel named twice": (keys(camera={"channels": ["red", "red", "blue"]}), "wrong-value", "distinct"),
    "lamps of a goniometer": (keys(geometry="goniometer"), "unknown-key", "lights"),
    "YAML tag": (whole("capture.yaml", "!!python/object/apply:os.system ['ls']\n"), "yaml-invalid", "YAML"),
    "invalid YAML": (whole("capture.yaml", "format: 1\n  camera: [\n"), "yaml-invalid", "line"),
    "key twice": (text("capture.yaml", "title: Test plane", "title: a\ntitle: b"), "yaml-invalid", "twice"),
    "YAML that is a list": (whole("capture.yaml", "- 1\n- 2\n"), "yaml-invalid", "list"),
    "unknown illuminant": (keys(illuminant="D66"), "illuminant-unknown", "D65"),
    "illuminant without a table": (keys(illuminant="D55"), "illuminant-unknown", "D50"),
    "spectra too short": (spectra(band(420, 680)), "spectra-range", "420-680 nm"),
    "spectra not increasing": (spectra(band(400, 700) + "690,1,1,1\n"), "spectra-order", "690"),
    "spectra not finite": (spectra(band(380, 720, "1,nan,1")), "spectra-not-finite", "not finite"),
    "spectra negative": (spectra(band(380, 720, "1,-1,1")), "spectra-negative", "negative"),
    "spectra zero": (spectra(band(380, 720, "1,0,1")), "spectra-zero", "zero everywhere"),
    "spectra not numbers": (spectra(band(380, 720, "1,low,1")), "spectra-unreadable", "low"),
    "spectra without a channel": (
        lambda f: (spectra(band(380, 720))(f), edit_text(f / "spectra/camera.csv", "green", "grün")),
        "spectra-columns",
        "green",
    ),
    "mask of no pixels": (masked(frame(0)[0]), "mask-empty", "no pixels"),
    "mask of another size": (masked(frame(255, rows=10)[0]), "mask-size", "10 x 32"),
    "mask outside the region": (
        lambda f: (
            masked(np.pad(np.full((4, 4, 1), 255.0), ((0, 20), (0, 28), (0, 0))))(f),
            edit_yaml(f, region_of_interest=[10, 10, 5, 5]),
        ),
        "mask-empty",
        "region of interest",
    ),
    "region outside the picture": (keys(region_of_interest=[0, 0, 25, 10]), "region-outside", "24 rows"),
    "region of negative rows": (keys(region_of_interest=[0, 0, -5, 10]), "wrong-value", "region_of_interest"),
    "regions of another size": (
        lambda f: (write_frame(f / "r.png", frame(1, channels=1, rows=9)[0], np.uint8), edit_yaml(f, regions="r.png")),
        "regions-size",
        "9 x 32",
    ),
    "regions in colour": (
        lambda f: (write_frame(f / "r.png", frame((1, 2, 3))[0], np.uint8), edit_yaml(f, regions="r.png")),
        "regions-unreadable",
        "one 8- or 16-bit channel",
    ),
    "NaN in EXR": (exr_with(np.nan), "not-finite", "frames/L02.exr"),
    "infinity in EXR": (exr_with(np.inf), "not-finite", "1 pixels"),
    "changed after sealing": (seal_then(flipped("frames/L02.png")), "seal-changed", "frames/L02.png"),
    "removed after sealing": (
        seal_then(lambda f: (f / "dark/dark.png").unlink()),
        "seal-missing",
        "data/dark/dark.png",
    ),
    "added after sealing": (seal_then(whole("frames/extra.png", b"x")), "seal-foreign", "frames/extra.png"),
    "manifest of a seal damaged": (
        lambda f: (seal(f), (f / "manifest-sha256.txt").write_text("not a manifest\n")),
        "seal-manifest",
        "line 1",
    ),
    "empty folder": (nested, "folder-empty", "empty"),
    "no folder": (lambda f: shutil.rmtree(f), "folder-missing", "no such"),
    "sealing interrupted": (half_sealed, "seal-interrupted", "nothing is lost"),
    "intensity of zero": (
        lambda f: (
            edit_yaml(f, lights={"file": "lights.lp", "intensities": "i.csv"}),
            whole("i.csv", "light,red,green,blue\n" + "".join(f"L{i:02d},1,0,1\n" for i in range(1, 6)))(f),
        ),
        "intensities-invalid",
        "above 0",
    ),
    "intensity missing": (
        lambda f: (
            edit_yaml(f, lights={"file": "lights.lp", "intensities": "i.csv"}),
            whole("i.csv", "light,red,green,blue\n" + "".join(f"L{i:02d},1,1,1\n" for i in range(1, 5)))(f),
        ),
        "intensities-light",
        "L05",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BROKEN)
def test_each_kind_has_its_own_clear_error(tmp_path, name):
    folder = make_capture(tmp_path / "c")
    change, kind, words = BROKEN[name]
    change(folder)
    for level in ("quick", "full"):  # the full check also compares the photographs, which takes most of its time
        problems = check_capture(folder, level=level)
        errors = [p for p in problems if p.severity == "error"]
        if kind in {p.kind for p in errors}:
            break
    assert kind in {p.kind for p in errors}, [str(p) for p in problems]
    said = " | ".join(str(p) for p in errors if p.kind == kind)
    assert words.casefold() in said.casefold()


# Ingest marks samples that are not finite, and does not look at label pictures or at files that no table names.
ONLY_CHECKED = ("not-finite", "regions", "seal-missing", "seal-foreign")


@pytest.mark.parametrize("name", [n for n, case in BROKEN.items() if not case[1].startswith(ONLY_CHECKED)])
def test_ingest_refuses_what_it_cannot_use(tmp_path, name):
    """No traceback of a library, no half-made result: a UserError that says what the check says."""
    folder = make_capture(tmp_path / "c")
    change, kind, _ = BROKEN[name]
    change(folder)
    with pytest.raises(UserError) as caught:
        write_observations(load_capture(folder), tmp_path / "o", settings=IngestSettings())
    assert isinstance(caught.value, CaptureError)
    assert kind in {p.kind for p in caught.value.problems}


def test_there_are_many_kinds():
    assert len({kind for _, kind, _ in BROKEN.values()}) >= 50


WARNED = {
    "file that nothing names": (whole("notes.txt", "x"), "file-unlisted"),
    "same photograph twice": (lambda f: shutil.copy(f / "frames/L01.png", f / "frames/L02.png"), "image-repeated"),
    "lights in the same direction": (changed(RING[1]), "light-same"),
    "directions not of unit length": (changed((0, 0, 30)), "light-not-unit"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", WARNED)
def test_what_is_only_odd_is_a_warning(tmp_path, name):
    folder = make_capture(tmp_path / "c")
    change, kind = WARNED[name]
    change(folder)
    problems = check_capture(folder, level="full")
    assert kind in {p.kind for p in problems}
    assert all(p.severity == "warning" for p in problems if p.kind == kind)


@pytest.mark.parametrize(
    ("largest", "bits"),
    [(1023, 10), (1000, 10), (990, None), (4095, 12), (3968, 12), (3967, None), (4096, None), (15871, None),
     (15900, 14), (16383, 14), (30000, None), (65535, None)],
)  # fmt: skip
def test_codes_near_the_top_of_fewer_bits_are_told_where_no_bits_are_stated(tmp_path, largest, bits):
    # three lamps: photographs of more are compared with each other, which takes most of the time
    folder = make_capture(tmp_path / "c", lights=RING[:3], checks=0, white=False, dark=False)
    for path in sorted((folder / "frames").glob("*.png")):
        write_frame(path, np.full((ROWS, COLUMNS, 3), largest // 2))
    bright = np.full((ROWS, COLUMNS, 3), largest // 2)
    bright[:, 3] = largest
    write_frame(folder / "frames/L02.png", bright)
    camera = {key: CAMERA[key] for key in CAMERA if key != "bits"}
    edit_yaml(folder, camera=camera)
    told = [p for p in check_capture(folder, level="full") if p.kind == "bits-unsaid"]
    assert [f"camera.bits: {bits};" in str(p) for p in told] == ([True] if bits else [])
    diagnostics = write_observations(load_capture(folder), tmp_path / "o", settings=IngestSettings())
    assert any("camera.bits" in text for text in diagnostics["warnings"]) == bool(bits)
    edit_yaml(folder, camera={**camera, "bits": 16})
    assert "bits-unsaid" not in {p.kind for p in check_capture(folder, level="full")}


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        (put("frames/L01.png", 500, rows=25), "image-size"),
        (put("frames/L01.png", 90, dtype=np.uint8), "image-depth"),
        (put("frames/L01.png", 500, channels=1), "channels-differ"),
    ],
)
def test_the_odd_first_photograph_is_blamed_and_not_the_others(tmp_path, change, kind):
    folder = make_capture(tmp_path / "c", white=False, dark=False)
    change(folder)
    for level in ("quick", "full"):
        errors = [p for p in check_capture(folder, level=level) if p.severity == "error"]
        assert [(p.kind, p.file) for p in errors] == [(kind, "frames/L01.png")]


def test_one_photograph_of_another_format_is_named(tmp_path):
    folder = make_capture(tmp_path / "c", white=False, dark=False)
    for i in range(1, 6):
        path = folder / f"frames/L{i:02d}.png"
        picture = (cv2.imread(str(path), cv2.IMREAD_UNCHANGED) >> 4).astype(np.uint8)
        path.unlink()
        name = "frames/L01.jpg" if i == 1 else f"frames/L{i:02d}.png"
        cv2.imwrite(str(folder / name), picture)
    text("frames.csv", "L01.png", "L01.jpg")(folder)
    edit_yaml(folder, camera={"channels": ["red", "green", "blue"]})
    found = [(p.severity, p.file) for p in check_capture(folder) if p.kind == "image-format"]
    assert found == [("warning", "frames/L01.jpg")]


def test_the_check_reports_everything_in_one_pass(tmp_path):
    folder = make_capture(tmp_path / "c")
    cut("frames/L02.png", 0.6)(folder)
    put("frames/L03.png", 500, rows=25)(folder)
    whole("white/L04.png", "no picture")(folder)
    put("white/L05.png", 4095)(folder)
    whole("stray.txt", "x")(folder)
    masked(frame(0)[0])(folder)
    kinds = {p.kind for p in check_capture(folder, level="full")}
    assert kinds >= {
        "image-truncated",
        "image-size",
        "image-unreadable",
        "white-saturated",
        "file-unlisted",
        "mask-empty",
    }


def test_jpeg_captures_are_warned_not_to_be_linear(tmp_path):
    folder = make_capture(tmp_path / "c", white=False, dark=False)
    for path in sorted((folder / "frames").glob("*.png")):
        codes = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) // 16
        cv2.imwrite(str(path.with_suffix(".jpg")), codes.astype(np.uint8))
        path.unlink()
    edit_text(folder / "frames.csv", ".png", ".jpg")
    edit_yaml(folder, camera={"encoding": "srgb"})
    kinds = {p.kind for p in check_capture(folder, level="full")}
    assert {"not-linear", "jpeg"} <= kinds
    edit_yaml(folder, camera={"encoding": "linear"})
    assert "jpeg-linear" in {p.kind for p in check_capture(folder, level="full")}


@pytest.mark.parametrize("name", ["frames/L02.png", "white/L03.png", "dark/dark.png", "lights.lp", "capture.yaml"])
def test_ingest_proves_every_file_of_a_sealed_capture(tmp_path, name):
    """A file that is as valid as before, but another: nothing but its digest tells."""
    folder = make_capture(tmp_path / "c")
    seal(folder)
    path = folder / "data" / name
    if path.suffix == ".png":
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED) + 1)
    else:
        path.write_text(path.read_text() + "\n")
    with pytest.raises(CaptureError) as caught:
        write_observations(load_capture(folder), tmp_path / "o", settings=IngestSettings())
    assert [p.kind for p in caught.value.problems] == ["seal-changed"]
    assert name in str(caught.value)
    assert sorted(p.file for p in check_capture(folder, level="full") if p.kind == "seal-changed") == [f"data/{name}"]
