"""From a capture to observations: the radiometry of the whole chain, the store, its bands."""

import os
import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest
import zarr
from captures import RING, edit_text, edit_yaml, make_capture, write_frame
from conftest import PROJECT
from refusals import refused

from nishiki.artifacts.stage import expect_finite
from nishiki.capture.convert import convert
from nishiki.capture.folder import load_capture
from nishiki.errors import UserError
from nishiki.observations.check import check_capture
from nishiki.observations.linearise import rows_of_band
from nishiki.observations.plane import Observations
from nishiki.observations.plane_store import write_observations
from nishiki.stages.ingest import IngestSettings

ROWS, COLUMNS = 24, 32
TEXTURE = 0.5 * (0.8 + 0.2 * np.random.default_rng(1).random((ROWS, COLUMNS, 3)))


def ingest(folder, out, **settings):
    capture = load_capture(folder)
    diagnostics = write_observations(capture, out, settings=IngestSettings.model_construct(**settings))
    return Observations(out), diagnostics


def read_whole(observations):
    """Values and validity in the photographs' own coordinates; 0 and not valid outside what is kept."""
    values, valid = observations.read(slice(0, observations.shape[0]))
    row, column, rows, columns = observations.attributes["region_of_interest"]
    around = (0, 0), (row, ROWS - row - rows), (column, COLUMNS - column - columns)
    return np.pad(values, (*around, (0, 0))), np.pad(valid, around)


def truth(lights=RING):
    """What a flat Lambertian plane gives: albedo times cosine."""
    return TEXTURE[None] * np.array([z / np.linalg.norm(v) for v in lights for z in v[2:]])[:, None, None, None]


# This lamp falls off by 20 % over 32 pixels; a block of 8 sees 5 % of it, and the bilinear gain errs by its square.
@pytest.mark.parametrize(("block", "tolerance"), [(1, 1.5e-3), (4, 1.5e-3), (8, 3.5e-3)])
def test_white_board_and_dark_frames_leave_albedo_times_cosine(tmp_path, block, tolerance):
    observations, diagnostics = ingest(make_capture(tmp_path / "c"), tmp_path / "o", white_block=block)
    values, valid = observations.read(slice(0, ROWS))
    np.testing.assert_allclose(values, truth(), rtol=tolerance)
    assert valid.all()
    assert diagnostics["warnings"] == ()
    assert observations.roles == ("sample",) * 4 + ("check",)
    np.testing.assert_array_equal(observations.indices("check"), [4])


def test_exposures_are_taken_out(tmp_path):
    folder = make_capture(tmp_path / "c", exposure_s=0.5)
    frame = cv2.imread(str(folder / "frames/L02.png"), cv2.IMREAD_UNCHANGED)[:, :, ::-1]
    write_frame(folder / "frames/L02.png", 100 + (frame.astype(float) - 100) / 2)
    edit_text(folder / "frames.csv", "frames/L02.png,sample,L02,0.5", "frames/L02.png,sample,L02,0.25")
    observations, _ = ingest(folder, tmp_path / "o", white_block=4)
    values, _ = observations.read(slice(0, ROWS))
    np.testing.assert_allclose(values, truth(), rtol=4e-3)


def test_without_a_board_intensities_scale_the_lights(tmp_path):
    folder = make_capture(tmp_path / "c", white=False, yaml_extra={})
    edit_yaml(folder, lights={"file": "lights.lp", "kind": "direction", "intensities": "scale.csv"})
    rows = [f"L{i:02d},{i},{2 * i},{4 * i}" for i in range(1, 6)]
    (folder / "scale.csv").write_text("light,red,green,blue\n" + "\n".join(rows) + "\n")
    plain, _ = ingest(make_capture(tmp_path / "p", white=False), tmp_path / "po")
    scaled, _ = ingest(folder, tmp_path / "o")
    factor = np.arange(1, 6)[:, None, None, None] * np.array([1, 2, 4])
    one, other = plain.read(slice(0, ROWS))[0], scaled.read(slice(0, ROWS))[0]
    np.testing.assert_allclose(other * factor, one, rtol=1e-6)


def test_black_level_stands_in_for_dark_frames(tmp_path):
    with_frames, _ = ingest(make_capture(tmp_path / "a"), tmp_path / "ao")
    folder = make_capture(tmp_path / "b", dark=False)
    edit_yaml(folder, camera={"bits": 12, "saturation": 0.98, "black_level": 100})
    with_level, _ = ingest(folder, tmp_path / "bo")
    one, other = with_frames.read(slice(0, ROWS))[0], with_level.read(slice(0, ROWS))[0]
    np.testing.assert_allclose(other, one, rtol=1e-5)


def test_darks_are_matched_by_exposure(tmp_path):
    folder = make_capture(tmp_path / "c", exposure_s=0.5)
    write_frame(folder / "dark/long.png", np.full((ROWS, COLUMNS, 3), 900.0))
    edit_text(folder / "frames.csv", "dark/dark.png,dark,,", "dark/dark.png,dark,,0.5\ndark/long.png,dark,,4")
    observations, _ = ingest(folder, tmp_path / "o", white_block=4)
    np.testing.assert_allclose(observations.read(slice(0, ROWS))[0], truth(), rtol=2e-3)
    edit_text(folder / "frames.csv", "dark/dark.png,dark,,0.5", "dark/dark.png,dark,,0.7")
    _, diagnostics = ingest(folder, tmp_path / "o2", white_block=4)
    assert "dark" in "".join(diagnostics["warnings"])


def test_near_lamp_cosine_on_the_board_varies_over_the_picture(tmp_path):
    """A lamp 60 mm away over a board 32 mm wide: the board's own obliquity must not enter the gain."""
    lamp = np.array([20.0, -10.0, 60.0])
    folder = make_capture(tmp_path / "c", lights=[tuple(lamp), (0, 300, 500), (300, 0, 500), (0, 0, 600)], checks=0)
    edit_yaml(folder, pixel_pitch_mm=1.0, lights={"file": "lights.lp", "kind": "position_mm"})
    x = np.arange(COLUMNS) - (COLUMNS - 1) / 2
    y = -(np.arange(ROWS) - (ROWS - 1) / 2)
    way = lamp - np.stack(np.broadcast_arrays(x[None, :], y[:, None], 0.0), axis=-1)
    distance = np.linalg.norm(way, axis=-1)
    cosine = (way[..., 2] / distance)[..., None]
    irradiance = 0.7 * 3995 * (60 / distance[..., None]) ** 2
    write_frame(folder / "white/L01.png", 100 + irradiance * cosine * np.ones(3))
    write_frame(folder / "frames/L01.png", 100 + irradiance * cosine * TEXTURE)
    observations, _ = ingest(folder, tmp_path / "o", white_block=2)
    values, _ = observations.read(slice(0, ROWS))
    np.testing.assert_allclose(values[0], TEXTURE * cosine, rtol=5e-3)
    np.testing.assert_array_equal(observations.positions_mm[0], lamp)
    assert observations.image_centre == (11.5, 15.5)


def test_the_board_need_not_be_larger_than_the_object(tmp_path):
    mask = np.zeros((ROWS, COLUMNS), bool)
    mask[8:14, 9:15] = True
    folder = make_capture(tmp_path / "c", mask=mask)
    for path in (folder / "white").iterdir():
        board = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        board[:4], board[20:], board[:, :4], board[:, 20:] = 100, 100, 100, 100
        cv2.imwrite(str(path), board)
    observations, diagnostics = ingest(folder, tmp_path / "o", white_block=4)
    values, valid = read_whole(observations)
    np.testing.assert_array_equal(valid, np.broadcast_to(mask, valid.shape))
    np.testing.assert_allclose(values[:, mask], truth()[:, mask], rtol=2e-3)
    assert diagnostics["warnings"] == ()
    assert check_capture(folder, level="full") == []


@pytest.mark.parametrize("asked", [None, [1, 2, 22, 29]])
@pytest.mark.parametrize("block", [1, 2, 4])
def test_only_the_bounding_box_of_the_mask_is_kept_and_its_observations_stay_the_same(tmp_path, block, asked):
    """Boards are averaged over blocks, which stay where they are in the whole picture. An even dark level is one mean
    over what is kept, which changes the last bits."""
    mask = np.zeros((ROWS, COLUMNS), bool)
    mask[3:7, 4:6] = True
    mask[5, 7] = True
    folder = make_capture(tmp_path / "c", mask=mask)
    if asked:
        edit_yaml(folder, region_of_interest=asked)
    kept, diagnostics = ingest(folder, tmp_path / "o", white_block=block)
    edit_yaml(folder, mask=None)
    whole, _ = ingest(folder, tmp_path / "w", white_block=block)
    assert kept.shape[0] < whole.shape[0]
    assert kept.shape[1] < whole.shape[1]
    assert diagnostics["region"] == tuple(kept.attributes["region_of_interest"])
    assert diagnostics["photograph"] == (ROWS, COLUMNS)
    (values, valid), (expected, _) = read_whole(kept), read_whole(whole)
    np.testing.assert_array_equal(valid, np.broadcast_to(mask, valid.shape))
    np.testing.assert_allclose(values[:, mask], expected[:, mask], rtol=1e-6)
    row, column = kept.attributes["region_of_interest"][:2]
    assert kept.image_centre == ((ROWS - 1) / 2 - row, (COLUMNS - 1) / 2 - column)


def test_what_may_not_be_used_is_marked(tmp_path):
    mask = np.ones((ROWS, COLUMNS), bool)
    mask[:, :3] = False
    folder = make_capture(tmp_path / "c", mask=mask)
    frame = cv2.imread(str(folder / "frames/L03.png"), cv2.IMREAD_UNCHANGED)
    frame[5, 6, 0], frame[7, 8] = 4095, 0  # one channel saturated; all channels at 0
    frame[9, 10, 2] = 0  # one channel of three at 0: still an observation
    cv2.imwrite(str(folder / "frames/L03.png"), frame)
    dark = cv2.imread(str(folder / "dark/dark.png"), cv2.IMREAD_UNCHANGED)
    dark[20, 21] = 700
    cv2.imwrite(str(folder / "dark/dark.png"), dark)
    observations, diagnostics = ingest(folder, tmp_path / "o", white_block=4)
    _, valid = read_whole(observations)
    expected = np.broadcast_to(mask, valid.shape).copy()
    expected[2, 5, 6] = expected[2, 7, 8] = False
    expected[:, 20, 21] = False
    np.testing.assert_array_equal(valid, expected)
    assert diagnostics["defects"] == 1
    assert diagnostics["saturated"][2] == 1 / mask.sum()
    assert diagnostics["dark"][2] == 1 / mask.sum()
    assert diagnostics["mask_pixels"] == mask.sum()


def test_where_the_board_is_saturated_no_sample_counts_and_the_store_is_sound(tmp_path):
    folder = make_capture(tmp_path / "c")
    board = cv2.imread(str(folder / "white/L02.png"), cv2.IMREAD_UNCHANGED)
    board[:8, :8] = 4095
    cv2.imwrite(str(folder / "white/L02.png"), board)
    observations, diagnostics = ingest(folder, tmp_path / "o", white_block=4)
    values, valid = read_whole(observations)
    assert not valid[1, :8, :8].any()
    assert valid[1].mean() > 0.85
    assert valid[np.arange(len(valid)) != 1].all()
    assert np.isfinite(values[valid]).all()
    assert any("white/L02.png" in text for text in diagnostics["warnings"])
    expect_finite(tmp_path / "o", "ingest")


@pytest.mark.slow
@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_any_part_is_the_part_of_the_whole(tmp_path, compression):
    folder = make_capture(tmp_path / "c", rows=70, columns=40)
    capture = load_capture(folder)
    whole, _ = ingest(folder, tmp_path / "a", compression=compression)
    settings = IngestSettings.model_construct(tile_mib=0, compression=compression)
    write_observations(capture, tmp_path / "b", settings=settings)
    banded = Observations(tmp_path / "b")
    assert banded.band_rows == 8
    assert [b.stop for b in banded.bands()] == [8, 16, 24, 32, 40, 48, 56, 64, 70]
    values, valid = whole.read(slice(0, 70))
    read = [banded.read(b) for b in banded.bands()]
    np.testing.assert_array_equal(np.concatenate([v for v, _ in read], axis=1), values)
    np.testing.assert_array_equal(np.concatenate([v for _, v in read], axis=1), valid)
    lights = np.array([3, 0])
    part, ok = banded.read(slice(13, 51), lights=lights, columns=slice(7, 31))
    np.testing.assert_allclose(part, values[lights, 13:51, 7:31], rtol=1e-6)
    np.testing.assert_array_equal(ok, valid[lights, 13:51, 7:31])
    mean, _ = banded.read(slice(13, 51), channel="mean")
    np.testing.assert_allclose(mean, values[:, 13:51].mean(axis=-1), rtol=1e-5)
    green, _ = banded.read(slice(13, 51), channel=1)
    np.testing.assert_allclose(green, values[:, 13:51, :, 1], rtol=1e-6)


@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_the_store_is_ordinary_zarr(tmp_path, compression):
    folder = make_capture(tmp_path / "c", rows=30)
    observations, _ = ingest(folder, tmp_path / "o", compression=compression, tile_mib=0)
    codes = zarr.open_group(tmp_path / "o/frames.zarr", mode="r")["codes"][...]
    frame = cv2.imread(str(folder / "frames/L04.png"), cv2.IMREAD_UNCHANGED)[:, :, ::-1]
    np.testing.assert_array_equal(codes[3], frame)
    np.testing.assert_array_equal(observations.codes(slice(0, 30))[0], codes)


def test_the_store_is_the_same_every_time_and_is_not_overwritten(tmp_path):
    folder = make_capture(tmp_path / "c")
    for name in "ab":
        ingest(folder, tmp_path / name)
    a, b = (
        {p.relative_to(tmp_path / n): p.read_bytes() for p in (tmp_path / n).rglob("*") if p.is_file()} for n in "ab"
    )
    assert {k.as_posix()[2:]: v for k, v in a.items()} == {k.as_posix()[2:]: v for k, v in b.items()}
    with pytest.raises(FileExistsError):
        ingest(folder, tmp_path / "a")


@pytest.mark.parametrize("damage", ["flip", "cut", "remove"])
def test_damage_in_the_store_is_found(tmp_path, damage):
    ingest(make_capture(tmp_path / "c"), tmp_path / "o")
    path = tmp_path / "o/frames.zarr/codes/c/2/0/0/0"
    data = bytearray(path.read_bytes())
    if damage == "flip":
        data[len(data) // 2] ^= 1
    path.write_bytes(data[: len(data) // 2] if damage == "cut" else data)
    if damage == "remove":
        path.unlink()
    with refused(UserError, "frames.zarr"):
        Observations(tmp_path / "o").read(slice(0, 8))
    Observations(tmp_path / "o").read(slice(0, 8), lights=np.array([0, 1]))


def test_a_folder_without_a_store_is_refused(tmp_path):
    with refused(UserError, "frames.zarr"):
        Observations(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("channels", ["luminance", "green", "red", "blue"])
def test_one_channel_is_what_the_channels_give(tmp_path, channels):
    folder = make_capture(tmp_path / "c")
    every, _ = ingest(folder, tmp_path / "a", white_block=4)
    one, _ = ingest(folder, tmp_path / "o", white_block=4, channels=channels)
    assert one.channels == (channels,)
    luminance = np.array([0.299, 0.587, 0.114])
    weights = luminance if channels == "luminance" else np.eye(3)[["red", "green", "blue"].index(channels)]
    values, _ = one.read(slice(0, ROWS), channel=0)
    np.testing.assert_allclose(values, every.read(slice(0, ROWS))[0] @ weights, rtol=2e-3)


def test_a_channel_that_the_capture_does_not_have_is_reported(tmp_path):
    with refused(UserError, kind="channel-unknown"):
        ingest(make_capture(tmp_path / "c"), tmp_path / "a", channels="infrared")


def test_float_frames_with_region_and_progress(tmp_path):
    import OpenEXR

    folder = make_capture(tmp_path / "c", white=False, dark=False)
    rng = np.random.default_rng(5)
    frames = rng.random((5, ROWS, COLUMNS, 3)).astype(np.float32)
    frames[1, 4, 5, 0] = np.nan
    for i in range(5):
        channels = {n: np.ascontiguousarray(frames[i, ..., k]) for k, n in enumerate("RGB")}
        with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, channels) as file:
            file.write(str(folder / f"frames/L{i + 1:02d}.exr"))
    edit_text(folder / "frames.csv", ".png", ".exr")
    edit_yaml(folder, camera={}, region_of_interest=[3, 2, 12, 20])
    seen = []
    capture = load_capture(folder)
    write_observations(
        capture,
        tmp_path / "o",
        settings=IngestSettings(),
        progress=lambda done, of, file: seen.append((done, of, file)),
    )
    observations = Observations(tmp_path / "o")
    values, valid = observations.read(slice(0, 12))
    expected = frames[:, 3:15, 2:22]
    assert not valid[1, 1, 3]
    assert valid.sum() == valid.size - 1
    np.testing.assert_allclose(values, np.nan_to_num(expected), rtol=1e-6)
    assert seen[-1] == (5, 5, "frames/L05.exr")
    assert observations.dtype == np.float32


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_hot_pixels_of_any_bits(tmp_path, bits):
    """3 % of full scale above the dark level is hot, 1 % is not."""
    folder = make_capture(tmp_path / "c", bits=bits, **({"white": False, "yaml_extra": {}} if bits == 8 else {}))
    edit_yaml(folder, camera={"bits": bits})
    dark = cv2.imread(str(folder / "dark/dark.png"), cv2.IMREAD_UNCHANGED)
    dark[20, 21] += int(0.03 * 2**bits)
    dark[10, 11] += int(0.01 * 2**bits)
    cv2.imwrite(str(folder / "dark/dark.png"), dark)
    observations, diagnostics = ingest(folder, tmp_path / "o", white_block=8)
    assert diagnostics["defects"] == 1
    assert not observations.read(slice(0, ROWS))[1][0, 20, 21]


@pytest.mark.parametrize("white", [True, False])
@pytest.mark.parametrize("unit", [1e-4, 1.0, 65535.0])
def test_hot_pixels_of_float_files_in_any_unit(tmp_path, unit, white):
    """Float samples have no full scale: with a limit of 0.02 every pixel of a dark frame in camera codes was hot, and
    none of a frame in a large unit."""
    import OpenEXR

    folder = make_capture(tmp_path / "c", white=white, yaml_extra=None if white else {})
    rng = np.random.default_rng(2)
    for file in folder.rglob("*.png"):
        codes = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)[:, :, ::-1] / 4095
        codes += rng.normal(0, 1e-3, codes.shape)
        if file.name == "dark.png":
            codes[20, 21] += 0.05
        planes = {n: np.ascontiguousarray(unit * codes[..., k], np.float32) for k, n in enumerate("RGB")}
        with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, planes) as written:
            written.write(str(file.with_suffix(".exr")))
    edit_text(folder / "frames.csv", ".png", ".exr")
    edit_yaml(folder, camera={})
    observations, diagnostics = ingest(folder, tmp_path / "o", white_block=8)
    assert diagnostics["defects"] == 1
    assert not observations.read(slice(0, ROWS))[1][:, 20, 21].any()


def test_bands_fit_into_their_memory():
    assert rows_of_band(41, 2592, 4608, 1, 128) == 176
    assert 41 * 176 * 4608 * 4 <= 128 << 20
    assert rows_of_band(41, 2592, 4608, 3, 128) == 56
    assert rows_of_band(200, 10_000, 20_000, 8, 1) == 8
    assert rows_of_band(3, 20, 10, 1, 128) == 24


@pytest.mark.slow
def test_the_script_by_hand_keeps_all_channels(tmp_path):
    """No plan has put a choice in place of `auto`: whatever stage comes next can do its work."""
    folder = make_capture(tmp_path / "c")
    environment = os.environ | {"PYTHONPATH": str(PROJECT / "workflow" / "src")}
    command = [sys.executable, PROJECT / "scripts/stage.py", "ingest", "--capture", folder, "--output", tmp_path / "o"]
    done = subprocess.run(command, check=False, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (artifact,) = (tmp_path / "o").iterdir()
    assert Observations(artifact).channels == ("red", "green", "blue")
    done = subprocess.run(
        [*command[:3], "--output", tmp_path / "o"], check=False, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "--capture is needed" in done.stderr


MEMORY = """
import sys
from nishiki.artifacts.stage import peak_memory_kib
from nishiki.capture.folder import load_capture
from nishiki.observations.plane_store import write_observations
from nishiki.stages.ingest import IngestSettings
write_observations(load_capture(sys.argv[1]), sys.argv[2], settings=IngestSettings(channels="luminance"))
print(peak_memory_kib() / 1024)
"""


@pytest.mark.data
@pytest.mark.slow
def test_memory_of_a_full_size_capture(data, tmp_path):
    convert(data / "rti_fossil", tmp_path / "c", link=False)
    convert(data / "rti_fossil", tmp_path / "part", link=False, region=(0, 0, 64, 64))
    environment = os.environ | {"PYTHONPATH": str(PROJECT / "workflow" / "src")}
    # The first process compiles what nobody has compiled yet, which takes memory, too.
    for capture, output in (("part", "compiled"), ("c", "o")):
        command = [sys.executable, "-c", MEMORY, str(tmp_path / capture), str(tmp_path / output)]
        done = subprocess.run(command, check=True, env=environment, capture_output=True, text=True)
    assert float(done.stdout) < 400  # MiB; the photographs would take 1400
    observations = Observations(tmp_path / "o")
    assert observations.shape == (2592, 4608)
    values, valid = observations.read(slice(1200, 1208), channel=0)
    luma = cv2.imread(str(data / "rti_fossil/013_08_rti.jpg"), cv2.IMREAD_GRAYSCALE)[1200:1208] / 255
    expected = np.where(luma <= 0.04045, luma / 12.92, ((luma + 0.055) / 1.055) ** 2.4)
    place = observations.lights.index("013_08_rti")
    np.testing.assert_allclose(values[place], expected, atol=1e-5)
    assert valid.mean() > 0.9


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize("name", ["uw_cat", "diligent_ball", "psbox_cat"])
def test_measured_sets(data, tmp_path, name):
    convert(data / name, tmp_path / "c")
    observations, diagnostics = ingest(tmp_path / "c", tmp_path / "o")
    values, valid = observations.read(slice(0, observations.shape[0]), channel="mean")
    assert np.isfinite(values).all()
    assert values.min() >= 0
    inside = observations.mask
    assert not valid[:, ~inside].any()
    assert valid[:, inside].mean() > 0.5
    assert len(diagnostics["saturated"]) == len(observations.lights) == len(values)


@pytest.mark.slow
@pytest.mark.data
def test_diligent_values_are_codes_over_intensities(data, tmp_path):
    source, chosen = tmp_path / "cat", [0, 20, 40, 50, 75, 95]
    source.mkdir()
    for name in ("light_directions.txt", "light_intensities.txt"):
        rows = (data / "diligent_cat" / name).read_text().splitlines()
        (source / name).write_text("\n".join(rows[i] for i in chosen))
    for name in ("mask.png", *(f"{i + 1:03d}.png" for i in chosen)):
        shutil.copy(data / "diligent_cat" / name, source)
    convert(source, tmp_path / "c")
    observations, _ = ingest(tmp_path / "c", tmp_path / "o")
    values, _ = observations.read(slice(100, 140))
    scale = np.loadtxt(data / "diligent_cat/light_intensities.txt")
    for place, i in enumerate(chosen):
        codes = cv2.imread(str(data / f"diligent_cat/{i + 1:03d}.png"), cv2.IMREAD_UNCHANGED)[100:140, :, ::-1]
        np.testing.assert_allclose(values[place], codes / 65535 / scale[i], rtol=1e-5, atol=1e-7)


def test_regions_are_kept_numbered_from_zero_in_the_order_of_their_labels(tmp_path):
    folder = make_capture(tmp_path / "c", yaml_extra={"regions": "regions.png"})
    labels = np.where(np.arange(COLUMNS) < COLUMNS // 2, 7, 3).astype(np.uint8) * np.ones((ROWS, 1), np.uint8)
    cv2.imwrite(str(folder / "regions.png"), labels)
    observations, _ = ingest(folder, tmp_path / "o")
    assert np.array_equal(observations.regions, (labels == 7).astype(np.uint8))
