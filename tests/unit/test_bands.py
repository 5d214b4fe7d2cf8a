"""A file for each band: names and folders that tell the bands, tables, boards, and normals from such captures."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from nishiki.capture.convert import convert
from nishiki.capture.folder import load_capture
from nishiki.formats.problems import CaptureError
from nishiki.observations.check import check_capture
from nishiki.observations.frames import FrameReader

BANDS, ROWS, COLUMNS = ("450nm", "530nm", "620nm"), 6, 8
AROUND = np.radians(np.arange(4) * 90)
VECTORS = np.stack([0.6 * np.cos(AROUND), 0.6 * np.sin(AROUND), np.full(4, 0.8)], 1)
LAMPS = [f"L{i + 1}" for i in range(4)]


def codes(lamp, band, gain=1000):
    """Codes that tell lamp, band and place: no two files hold the same."""
    y, x = np.mgrid[:ROWS, :COLUMNS]
    return (gain * (lamp + 1) + 100 * (band + 1) + 10 * y + x).astype(np.uint16)


def write(path, lamp, band, gain=1000):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), codes(lamp, band, gain))


def lights(folder, names=LAMPS, vectors=VECTORS):
    lines = [
        " ".join([*([name] if name else []), *(f"{v:.6f}" for v in vector)])
        for name, vector in zip(names, vectors, strict=True)
    ]
    (folder / "dome.lp").write_text(f"{len(lines)}\n" + "\n".join(lines) + "\n")


def source(folder, named="{lamp}_{band}.tif", bands=BANDS, listed=LAMPS):
    for i, lamp in enumerate([f"{300 + i}" for i in range(4)] if "x300" in listed else LAMPS):
        for k, band in enumerate(bands):
            write(folder / named.format(lamp=lamp, band=band), i, k)
    lights(folder, listed)
    return folder


def kinds(problems):
    return {problem.kind for problem in problems}


def frames_of(folder, channels="all"):
    capture = load_capture(folder)
    reader = FrameReader.of(capture, channels)
    return capture, [reader.read(frame) for frame in capture.frames]


@pytest.mark.parametrize(
    ("named", "bands", "channels", "listed"),
    {
        "wavelengths": ("{lamp}_{band}.tif", BANDS, BANDS, LAMPS),
        "lamps with suffix": ("{lamp}_{band}.tif", BANDS, BANDS, [f"{lamp}.tif" for lamp in LAMPS]),
        "lamps without names": ("{lamp}_{band}.tif", BANDS, BANDS, [None] * 4),
        "band first": ("{band}-{lamp}.png", BANDS, BANDS, LAMPS),
        "folders of bands": ("{band}/{lamp}.tif", ("450", "530", "620"), BANDS, LAMPS),
        "lamps that look like bands": (
            "{band}/x{lamp}.tif",
            ("450", "530", "620"),
            BANDS,
            [f"x{300 + i}" for i in range(4)],
        ),
        "folders of lamps": ("{lamp}/{band}.tif", BANDS, BANDS, LAMPS),
        "colours": (
            "x_{lamp}_{band}.tif",
            ("blue", "green", "amber"),
            ("blue", "green", "amber"),
            ["x_" + n for n in LAMPS],
        ),
        "LEDs": ("{lamp}_LED{band}.tif", ("450", "530", "620"), BANDS, LAMPS),
        "colours of LEDs": (
            "{lamp}_{band}.tif",
            ("Royal_Blue", "Red", "Deep_Red"),
            ("royalblue", "red", "deepred"),
            LAMPS,
        ),
        "letters": ("{lamp}_{band}.tif", ("R", "G", "B"), ("red", "green", "blue"), LAMPS),
        "filters": ("{lamp}_band{band}.tif", ("1", "2", "10"), ("band1", "band2", "band10"), LAMPS),
        "lights that name one band": ("{lamp}_{band}.tif", BANDS, BANDS, [f"{lamp}_530nm.tif" for lamp in LAMPS]),
    }.values(),
)
def test_names_and_folders_tell_the_bands(tmp_path, named, bands, channels, listed):
    made = convert(source(tmp_path / "s", named, bands, listed), tmp_path / "c", examine=check_capture)
    assert "bands-assumed" in kinds(made.warnings)
    capture, read = frames_of(tmp_path / "c")
    assert capture.settings.camera.channels == channels
    assert [len(frame.bands) for frame in capture.frames] == [3] * 4
    for i, values in enumerate(read):
        np.testing.assert_array_equal(values, np.stack([codes(i, k) for k in range(3)], axis=2))
    np.testing.assert_allclose(capture.directions, VECTORS, atol=1e-5)


def test_lights_that_list_every_file_are_one_light_a_photograph(tmp_path):
    folder = source(tmp_path / "s")
    lights(folder, [f"{lamp}_{band}.tif" for lamp in LAMPS for band in BANDS], np.repeat(VECTORS, 3, axis=0))
    assert convert(folder, tmp_path / "c").photographs == 4
    np.testing.assert_allclose(load_capture(tmp_path / "c").directions, VECTORS, atol=1e-5)


@pytest.mark.parametrize("gone", [("L2_530nm.tif",), tuple(f"L3_{b}.tif" for b in BANDS)])
def test_missing_bands_are_refused_by_lamp(tmp_path, gone):
    folder = source(tmp_path / "s")
    for name in gone:
        (folder / name).unlink()
    with pytest.raises(CaptureError) as caught:
        convert(folder, tmp_path / "c")
    assert [p.kind for p in caught.value.problems] == ["band-missing"]
    assert gone[0][:2] in caught.value.problems[0].what
    assert all(name[3:8] in caught.value.problems[0].what for name in gone)
    assert not (tmp_path / "c").exists()


def test_a_colour_file_among_grey_ones_is_named(tmp_path):
    folder = source(tmp_path / "s")
    cv2.imwrite(str(folder / "L2_530nm.tif"), np.dstack([codes(1, 1)] * 3))
    with pytest.raises(CaptureError) as caught:
        convert(folder, tmp_path / "c")
    assert [(p.kind, p.file) for p in caught.value.problems] == [("band-channels", "L2_530nm.tif")]


def test_colour_files_of_two_filters_are_six_channels(tmp_path):
    rng = np.random.default_rng(1)
    pixels = {}
    for lamp in LAMPS:
        for band in ("filter1", "filter2"):
            pixels[lamp, band] = rng.integers(500, 9000, (ROWS, COLUMNS, 3)).astype(np.uint16)
            (tmp_path / "s").mkdir(exist_ok=True)
            cv2.imwrite(str(tmp_path / f"s/{lamp}_{band}.tif"), pixels[lamp, band][..., ::-1])
    lights(tmp_path / "s")
    (tmp_path / "dark").mkdir()
    cv2.imwrite(str(tmp_path / "dark/dark.tif"), np.full((ROWS, COLUMNS, 3), (3, 2, 1), np.uint16))
    convert(tmp_path / "s", tmp_path / "c", dark=tmp_path / "dark", examine=check_capture)
    capture, read = frames_of(tmp_path / "c")
    names = [f"{colour}_{band}" for band in ("filter1", "filter2") for colour in ("red", "green", "blue")]
    assert list(capture.settings.camera.channels) == names
    for values, lamp in zip(read, LAMPS, strict=False):
        np.testing.assert_array_equal(values, np.concatenate([pixels[lamp, b] for b in ("filter1", "filter2")], axis=2))
    np.testing.assert_array_equal(read[4][0, 0], [1, 2, 3, 1, 2, 3])
    reader = FrameReader.of(capture, "green_filter2")
    np.testing.assert_array_equal(reader.read(capture.frames[1])[..., 0], pixels["L2", "filter2"][..., 1])


def test_each_channel_may_have_a_lamp_of_its_own(tmp_path):
    convert(source(tmp_path / "s"), tmp_path / "c")
    table = tmp_path / "c/lamps.csv"
    settings = tmp_path / "c/capture.yaml"
    settings.write_text(settings.read_text() + "illuminant: lamps.csv\n")
    rows = [f"{nm},{nm - 390},1,{710 - nm}" for nm in (400, 550, 700)]
    table.write_text("\n".join([f"wavelength_nm,{','.join(reversed(BANDS))}", *rows]) + "\n")
    found = load_capture(tmp_path / "c").illuminant
    assert found.names == BANDS
    assert found.values[0].tolist() == [310, 1, 10]
    table.write_text("\n".join(["wavelength_nm,tungsten,daylight,other", *rows]) + "\n")
    with pytest.raises(CaptureError) as caught:
        load_capture(tmp_path / "c")
    assert [(p.kind, p.file) for p in caught.value.problems] == [("spectra-columns", "lamps.csv")]


def test_photographs_that_are_numbered_like_wavelengths_stay_photographs(tmp_path):
    for i in range(4):
        write(tmp_path / f"s/IMG_{450 + i}.png", i, 0)
    lights(tmp_path / "s", [f"IMG_{450 + i}.png" for i in range(4)])
    made = convert(tmp_path / "s", tmp_path / "c")
    assert made.photographs == 4


def test_boards_and_dark_frames_have_bands_or_one_for_all(tmp_path):
    folder = source(tmp_path / "s")
    for i, lamp in enumerate(LAMPS):
        for k, band in enumerate(BANDS):
            write(tmp_path / f"white/board_{lamp}_{band}.tif", i, k, gain=10_000)
    write(tmp_path / "dark/dark.tif", 0, 0, gain=10)
    convert(folder, tmp_path / "c", white=tmp_path / "white", dark=tmp_path / "dark", examine=check_capture)
    capture, read = frames_of(tmp_path / "c")
    assert [frame.role for frame in capture.frames] == ["sample"] * 4 + ["white"] * 4 + ["dark"]
    np.testing.assert_array_equal(read[5], np.stack([codes(1, k, 10_000) for k in range(3)], axis=2))
    np.testing.assert_array_equal(read[8], np.stack([codes(0, 0, 10)] * 3, axis=2))
    reader = FrameReader.of(capture, "530nm")
    np.testing.assert_array_equal(reader.read(capture.frames[2])[:, :, 0], codes(2, 1))


@pytest.mark.parametrize(
    ("before", "after", "kind"),
    [
        ("frames/L2_530nm.tif,sample,L2,530nm\n", "", "band-missing"),
        ("L2,530nm", "L2,540nm", "band-unknown"),
        ("L2,530nm", "L2,", "band-empty"),
    ],
)
def test_tables_with_wrong_bands_are_refused(tmp_path, before, after, kind):
    convert(source(tmp_path / "s"), tmp_path / "c")
    table = tmp_path / "c/frames.csv"
    table.write_text(table.read_text().replace(before, after))
    assert kind in kinds(p for p in check_capture(tmp_path / "c") if p.severity == "error")


def test_exposures_that_differ_within_a_photograph_are_refused(tmp_path):
    convert(source(tmp_path / "s"), tmp_path / "c")
    table = tmp_path / "c/frames.csv"
    heading, *rows = table.read_text().splitlines()
    rows = [f"{row},{0.5 if '530nm' in row else 0.25}" for row in rows]
    table.write_text("\n".join([heading + ",exposure_s", *rows]) + "\n")
    assert "band-exposure" in kinds(check_capture(tmp_path / "c"))


def test_the_odd_band_is_named(tmp_path):
    convert(source(tmp_path / "s"), tmp_path / "c")
    cv2.imwrite(str(tmp_path / "c/frames/L1_450nm.tif"), codes(0, 0)[:4])
    for level in ("quick", "full"):
        errors = [p for p in check_capture(tmp_path / "c", level=level) if p.severity == "error"]
        assert [(p.kind, p.file) for p in errors] == [("image-size", "frames/L1_450nm.tif")]


def test_normals_of_a_capture_by_bands(data, tmp_path):
    from nishiki import estimate_normals, read_observations

    case = data / "faulty_captures/photographs/16-band-a-file"
    convert(case, tmp_path / "c", examine=check_capture)
    observed = read_observations(tmp_path / "c")
    y, x = np.mgrid[0:72, 0:96].astype(float)
    slopes = 0.5 * np.cos(2 * np.pi * x / 31) * np.cos(2 * np.pi * y / 53), 0.5 * np.sin(2 * np.pi * y / 23 + x / 40)
    truth = np.stack([-slopes[0], slopes[1], np.ones_like(x)], 2)
    truth /= np.linalg.norm(truth, axis=2, keepdims=True)
    assert observed.values.shape[3] == 6
    for grey in (observed.values.mean(axis=3), observed.values[..., 0], observed.values[..., 5]):
        normals = estimate_normals(grey, observed.directions, valid=observed.valid).normals
        off = np.degrees(np.arccos(np.clip((normals * truth).sum(axis=2), -1, 1)))
        assert np.nanmean(off) < 0.05
