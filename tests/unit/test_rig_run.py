"""A capture run: every frame once, checked, journalled and sealed; what goes wrong is repeated or told."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from captures import CHANNELS, make_capture, write_frame
from refusals import refused
from rig_devices import Bench, write_plan

from nishiki.api import read_observations
from nishiki.capture.convert import convert
from nishiki.capture.folder import load_capture
from nishiki.capture.schema import CameraResponse
from nishiki.capture.seal import MANIFEST, read_manifest, verify_seal
from nishiki.cli import main
from nishiki.errors import UserError
from nishiki.formats.images import read_exif
from nishiki.photometric.solve import estimate_normals
from nishiki.rig.description import expect_devices, reachable_angle
from nishiki.rig.device import DeviceError, DeviceLost
from nishiki.rig.records import Journal, measure, sharpness
from nishiki.rig.run import read_frames_of, run_capture


@pytest.fixture
def hand(tmp_path):
    return make_capture(tmp_path / "hand")


def go(bench, plan, capture, pauses=None):
    pause = (lambda seconds: pauses.append(seconds)) if pauses is not None else (lambda seconds: None)
    return run_capture(Path("rig.yaml"), plan, capture, open_devices=bench.open, ask=bench.ask, pause=pause)


def events(capture, kind):
    journal = Journal(capture.with_name(f"{capture.name}.rig") / "journal.jsonl")
    return [event for event in journal.events() if event["event"] == kind]


def photographs(capture):
    digests = read_manifest(capture / MANIFEST)
    return {name: digest for name, digest in digests.items() if name.endswith(".png")}


class FailingAt:
    """Raises an error at chosen steps of a device, counted from 1."""

    def __init__(self, device, error, *steps):
        self.device, self.error, self.steps, self.count = device, error, steps, 0

    def __call__(self, device):
        if device == self.device:
            self.count += 1
            if self.count in self.steps:
                raise self.error


def test_a_run_ends_with_a_checked_and_sealed_capture(hand, tmp_path):
    bench, capture = Bench(hand), tmp_path / "capture"
    digest = go(bench, write_plan(tmp_path, hand), capture)
    made, source = load_capture(capture), load_capture(hand)
    assert made.sealed
    assert not verify_seal(capture)
    assert made.settings.camera == source.settings.camera
    np.testing.assert_array_equal(made.directions[:4], source.directions[:4])
    for frame in made.frames:
        assert (
            frame.path.read_bytes()
            == bench.photographs[frame.role if frame.role in ("white", "dark") else "object", frame.light].read_bytes()
        )
    assert [frame.role for frame in made.observed] == ["sample"] * 4 + ["check"]
    assert bench.exposures == len(made.frames) == 11
    assert [request.split(" ")[1:4] for request in bench.asked] == [
        ["the", "white", "board"],
        ["the", "lens", "cap"],
        ["the", "lens", "cap"],
    ]
    assert events(capture, "sealed")[0]["digest"] == digest
    assert go(bench, write_plan(tmp_path, hand), capture) == digest
    assert bench.exposures == 11


@pytest.mark.slow
def test_a_run_gives_the_normals_of_the_same_painting_photographed_by_hand(tmp_path):
    from nishiki.observations.check import check_capture

    hand = make_capture(tmp_path / "hand", rows=32, columns=40)
    source = tmp_path / "photographs"
    for name in ("frames", "white", "dark"):
        shutil.copytree(hand / name, tmp_path / name)
    shutil.copytree(tmp_path / "frames", source)
    shutil.copyfile(hand / "lights.lp", source / "lights.lp")
    convert(
        source,
        tmp_path / "by-hand",
        white=tmp_path / "white",
        dark=tmp_path / "dark",
        checks=("L05",),
        title="Test plane",
    )
    settings = yaml.safe_load((tmp_path / "by-hand/capture.yaml").read_text())
    settings["camera"] |= {"bits": 12, "saturation": 0.98}
    (tmp_path / "by-hand/capture.yaml").write_text(yaml.safe_dump(settings))
    go(Bench(hand), write_plan(tmp_path, hand), tmp_path / "by-rig")
    assert not [p for p in check_capture(tmp_path / "by-rig") if p.severity == "error"]
    by_hand, by_rig = load_capture(tmp_path / "by-hand"), load_capture(tmp_path / "by-rig")
    assert by_hand.settings == by_rig.settings
    np.testing.assert_array_equal(by_hand.directions, by_rig.directions)
    files = [{(f.role, f.light): f.path.read_bytes() for f in c.frames} for c in (by_hand, by_rig)]
    assert files[0] == files[1]
    fields = []
    for capture in (tmp_path / "by-hand", tmp_path / "by-rig"):
        observed = read_observations(capture)
        fit = ~observed.check
        fields.append(estimate_normals(observed.values[fit].mean(axis=3), observed.directions[fit]))
    assert fields[0].normals[..., 2].min() > 0.9
    assert fields[0].normals.tobytes() == fields[1].normals.tobytes()
    assert fields[0].albedo.tobytes() == fields[1].albedo.tobytes()


def test_a_lost_device_is_opened_again_and_the_frame_repeated(hand, tmp_path):
    bench, pauses = Bench(hand), []
    bench.disturb = FailingAt("photograph", DeviceLost("camera: unplugged"), 3, 4, 9)
    go(bench, write_plan(tmp_path, hand), tmp_path / "capture", pauses)
    assert pauses == [2, 4, 2]
    assert [event["file"] for event in events(tmp_path / "capture", "lost")] == [
        "white/L03.png",
        "white/L03.png",
        "frames/L02.png",
    ]
    assert len(events(tmp_path / "capture", "frame")) == 11


def test_a_device_that_stays_away_stops_the_run_which_goes_on_later(hand, tmp_path):
    bench = Bench(hand)
    bench.disturb = FailingAt("open", DeviceLost("lamps: no port"), *range(1, 7))
    plan, capture = write_plan(tmp_path, hand), tmp_path / "capture"
    with refused(DeviceLost, "white/L01.png"):
        go(bench, plan, capture)
    assert not capture.exists()
    go(bench, plan, capture)
    assert len(events(capture, "frame")) == 11


def test_a_refused_step_stops_at_once(hand, tmp_path):
    bench = Bench(hand)
    bench.disturb = FailingAt("configure", DeviceError("camera: no such exposure"), 1)
    with refused(DeviceError, by="set_up"):
        go(bench, write_plan(tmp_path, hand), tmp_path / "capture")
    assert events(tmp_path / "capture", "stop")[0]["message"] == "camera: no such exposure"


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda codes: codes * 0.25 + 75, "brightness is 0.25 of what its neighbours"),
        (lambda codes: np.full_like(codes, 100), "have no light: check that the lamp shines"),
        (lambda codes: np.clip(codes * 8, 0, 4095), "of the pixels are saturated"),
        (lambda codes: cv2.GaussianBlur(codes, (0, 0), 2), "of the first frame's: check that nothing moves"),
        (
            lambda codes: codes[:-2],
            "expected 24 x 32 pixels with 3 channels of uint16 as the first frame, found 22 x 32",
        ),
        (None, "the photograph cannot be read"),
    ],
    ids=["weak lamp", "no light", "saturated", "moved", "size", "damaged"],
)
def test_a_bad_photograph_is_repeated_then_the_run_stops_and_goes_on_when_mended(tmp_path, spoil, reason):
    hand = make_capture(tmp_path / "hand", yaml_extra={"camera": {"bits": 12, "black_level": 100}})
    block = {"camera": {"bits": 12, "black_level": 100}}
    plan, capture = write_plan(tmp_path, hand, white=None, dark=None, capture=block), tmp_path / "capture"
    bench = Bench(hand)
    good = bench.photographs["object", "L03"]
    bad = tmp_path / "bad.png"
    if spoil is None:
        bad.write_bytes(good.read_bytes()[:-40])
    else:
        write_frame(bad, spoil(cv2.imread(str(good), cv2.IMREAD_UNCHANGED)[:, :, ::-1].astype(np.float32)))
    bench.photographs["object", "L03"] = bad
    with refused(UserError, "frames/L03.png", "3", reason):
        go(bench, plan, capture)
    assert bench.exposures == 5
    assert (tmp_path / "capture.rig/rejected/frames_L03.png").read_bytes() == bad.read_bytes()
    bench.photographs["object", "L03"] = good
    go(bench, plan, capture)
    assert bench.exposures == 8
    assert len(events(capture, "rejected")) == 3


def test_boards_tell_lamps_of_unequal_strength_from_failed_ones(tmp_path):
    """A lamp that is three times weaker is no failure where its board is darker too."""
    hand = make_capture(tmp_path / "hand", yaml_extra={"camera": {"bits": 12, "black_level": 100}})
    for folder in ("frames", "white"):
        path = hand / folder / "L04.png"
        codes = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:, :, ::-1].astype(float)
        write_frame(path, 100 + (codes - 100) / 3)
    capture = {"camera": {"bits": 12, "black_level": 100}}
    with refused(UserError, "white/L04.png", "3"):
        go(Bench(hand), write_plan(tmp_path, hand, capture=capture), tmp_path / "a")
    checks = {"brightness": None}
    go(Bench(hand), write_plan(tmp_path, hand, capture=capture, checks=checks), tmp_path / "b")
    boards = {"when": "before"}
    plan = write_plan(tmp_path, hand, capture=capture, checks={"brightness": 2.9}, white=boards)
    shutil.rmtree(tmp_path / "a.rig")
    (hand / "white/L04.png").write_bytes((hand / "white/L03.png").read_bytes())
    with refused(UserError, "frames/L04.png", "3"):
        go(Bench(hand), plan, tmp_path / "a")


def test_a_frame_that_was_journalled_but_not_renamed_is_recognised(hand, tmp_path):
    plan, capture = write_plan(tmp_path, hand), tmp_path / "capture"
    bench = Bench(hand)
    bench.disturb = FailingAt("photograph", DeviceError("stop"), 6)
    with pytest.raises(DeviceError):
        go(bench, plan, capture)
    work = tmp_path / "capture.rig"
    shutil.move(work / "capture/white/L05.png", work / "incoming/DSC0005.PNG")
    shutil.move(work / "capture/white/L02.png", tmp_path / "gone.png")
    (work / "capture/white/L03.png").write_bytes(b"changed")
    with (work / "journal.jsonl").open("a") as journal:
        journal.write('{"event": "frame", "file": "white/L')
    bench.disturb = lambda device: None
    go(bench, plan, capture)
    assert [event["file"] for event in events(capture, "missing")] == ["white/L02.png", "white/L03.png"]
    assert bench.exposures == 6 + 2 + 6
    assert sorted(photographs(capture).values()) == sorted(photographs_of(hand).values())


def photographs_of(hand):
    from nishiki.capture.seal import payload_digests

    return {name: digest for name, digest in payload_digests(hand).items() if name.endswith(".png")}


def test_another_table_is_refused_with_the_way_on(hand, tmp_path):
    plan, capture = write_plan(tmp_path, hand), tmp_path / "capture"
    bench = Bench(hand)
    bench.disturb = FailingAt("photograph", DeviceError("stop"), 2)
    with pytest.raises(DeviceError):
        go(bench, plan, capture)
    other = write_plan(tmp_path, hand, dark=None)
    with refused(UserError, "11", by="_keep_table"):
        go(bench, other, capture)
    write_plan(tmp_path, hand)
    go(bench, tmp_path / "capture.rig/frames.tsv", capture)
    assert len(events(capture, "frame")) == 11


def test_nothing_is_overwritten_and_mistakes_are_told_before_anything_moves(hand, tmp_path):
    bench = Bench(hand)
    with refused(UserError, by="complete"):
        go(bench, write_plan(tmp_path, hand), hand)
    plan = write_plan(tmp_path, hand, capture={"camera": {"bits": 12, "gain": 2}})
    with refused(UserError, kind="unknown-key"):
        go(bench, plan, tmp_path / "capture")
    plan = write_plan(tmp_path, hand, capture={"camera": {"sensitivities": "camera.csv"}})
    with pytest.raises(UserError, match=r"camera\.csv"):
        go(bench, plan, tmp_path / "capture")
    assert bench.exposures == 0


class Shutter(Bench):
    """The photographs follow the exposure time; the lamp gives full scale in `full_s` seconds."""

    full_s = 2.0

    def see(self):
        path = self.photographs["object", self.lamps[0]].parent.parent / f"exposed{self.exposures}.png"
        light = cv2.imread(str(super().see()), cv2.IMREAD_UNCHANGED)[:, :, ::-1].astype(float) - 100
        write_frame(path, np.clip(100 + light * self.configured[-1].seconds / self.full_s, 0, 4095))
        return path


def test_automatic_exposure_uses_the_codes_without_saturation_and_is_kept(hand, tmp_path):
    camera = {"camera": {"bits": 12, "black_level": 100}}
    plan = write_plan(tmp_path, hand, exposure_s="auto", auto={"start_s": 20}, white=None, capture=camera)
    bench, capture = Shutter(hand), tmp_path / "capture"
    bench.disturb = FailingAt("photograph", DeviceError("stop"), 7)
    with pytest.raises(DeviceError):
        go(bench, plan, capture)
    bench.disturb = lambda device: None
    go(bench, plan, capture)
    (found,) = events(capture, "exposure")
    made = load_capture(capture)
    assert {frame.exposure_s for frame in made.frames} == {found["exposure_s"]}
    brightest = events(capture, "frame")[0]
    assert brightest["file"] == "frames/L01.png"
    assert 0.55 <= brightest["measures"]["peak"] <= 0.85


def test_exif_tells_the_exposure_time(tmp_path):
    from PIL import Image

    picture = Image.fromarray(np.full((16, 16, 3), 90, np.uint8))
    exif = Image.Exif()
    exif.get_ifd(34665)[33434] = 0.04
    picture.save(tmp_path / "a.jpg", exif=exif)
    assert read_exif(tmp_path / "a.jpg").exposure_s == pytest.approx(0.04)
    picture.save(tmp_path / "a.tif", tiffinfo={33434: 0.04})
    assert read_exif(tmp_path / "a.tif").exposure_s == pytest.approx(0.04)
    picture.save(tmp_path / "a.png")
    assert read_exif(tmp_path / "a.png").exposure_s is None
    (tmp_path / "a.cr3").write_bytes(b"\0\0\0\x18ftypcrx ")
    assert read_exif(tmp_path / "a.cr3").exposure_s is None


def test_sharpness_hardly_depends_on_contrast_and_falls_with_blur():
    rng = np.random.default_rng(3)
    codes = cv2.GaussianBlur(rng.random((256, 256, 3)).astype(np.float32), (0, 0), 0.7) * 2000
    assert sharpness(300 + codes * 0.3) == pytest.approx(sharpness(codes), rel=1e-3)
    assert sharpness(cv2.GaussianBlur(codes, (0, 0), 1.5)) < 0.3 * sharpness(codes)
    assert sharpness(np.full((64, 64, 3), 7.0)) is None


def test_measures_are_of_linear_light_above_the_black_level():
    codes = np.full((40, 40, 3), 128, np.uint8)
    codes[:4] = 255
    found = measure(codes, CameraResponse(channels=CHANNELS, encoding="srgb"), None)
    assert found.saturated == pytest.approx(0.1)
    assert found.level == pytest.approx(0.1 + 0.9 * 0.2159, abs=1e-3)
    linear = measure(codes.astype(np.uint16) * 16, CameraResponse(channels=CHANNELS, bits=12, black_level=2048), None)
    assert linear.dark == pytest.approx(0.9)
    assert linear.peak == pytest.approx((4080 - 2048) / 4095, abs=1e-3)


def test_angles_outside_an_axis_are_reached_the_other_way_round():
    assert reachable_angle(-15, (0, 360), "") == 345
    assert reachable_angle(270, (-180, 180), "") == -90
    with refused(UserError, "0", "90", "120"):
        reachable_angle(120, (0, 90), "table")


def test_what_the_rig_lacks_is_told(hand, tmp_path):
    _, frames = read_frames_of(write_plan(tmp_path, hand))
    bench = Bench(hand)
    rig = bench.open(Path())
    expect_devices(frames, rig)
    rig.lamps.count = 3
    with refused(UserError, "5", "3", by="expect_devices"):
        expect_devices(frames, rig)
    turned = tuple(replace(frame, lamp=None, axes=(("table", 10.0),)) for frame in frames)
    with refused(UserError, "table"):
        expect_devices(turned, rig)


def test_a_dry_run_prints_the_frames_and_moves_nothing(hand, tmp_path, capsys):
    (tmp_path / "rig.yaml").write_text(
        "camera: {kind: folder, folder: nowhere}\nlamps: {kind: dome, port: /nowhere, count: 5}\n"
    )
    plan = write_plan(tmp_path, hand)
    arguments = ["rig", "run", str(tmp_path / "rig.yaml"), str(plan), str(tmp_path / "capture")]
    with pytest.raises(SystemExit) as end:
        main([*arguments, "--dry-run"])
    assert end.value.code == 0
    printed = capsys.readouterr().out
    assert "white/L01.png\twhite\t1\tL01" in printed
    assert "11 frames: 5 white, 4 sample, 1 check, 1 dark" in printed
    assert not (tmp_path / "capture.rig").exists()
    (tmp_path / "rig.yaml").write_text(
        "camera: {kind: folder, folder: nowhere}\nlamps: {kind: dome, port: /nowhere, count: 4}\n"
    )
    with pytest.raises(SystemExit) as end:
        main([*arguments, "--dry-run"])
    assert end.value.code == 2


def test_every_line_of_the_journal_is_json_with_its_time(hand, tmp_path):
    go(Bench(hand), write_plan(tmp_path, hand), tmp_path / "capture")
    lines = (tmp_path / "capture.rig/journal.jsonl").read_text().splitlines()
    assert all({"time", "event"} <= set(json.loads(line)) for line in lines)
