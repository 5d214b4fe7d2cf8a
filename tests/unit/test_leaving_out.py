"""What a scene does not need is not opened: neither read, nor proven, nor copied; and what is read is the same."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from captures import RING, edit_text, make_capture, make_turntable, write_frame
from goniometer_captures import make_goniometer, make_table
from refusals import refused

from nishiki.capture.folder import load_capture
from nishiki.capture.seal import seal
from nishiki.formats.problems import CaptureError
from nishiki.observations.goniometer_store import Measurements, write_goniometer
from nishiki.observations.linearise import bands_with_object
from nishiki.observations.plane import Observations
from nishiki.observations.plane_store import write_observations
from nishiki.observations.region import chosen, usage_of
from nishiki.observations.views import Views
from nishiki.observations.views_store import write_views
from nishiki.stages.ingest import IngestSettings

WHOLE = slice(0, 24)


def plane(folder: Path, output: Path, **settings) -> Observations:
    write_observations(load_capture(folder), output, settings=IngestSettings.model_construct(**settings))
    return Observations(output)


def damage(*paths: Path) -> None:
    """Files that no reader can open."""
    for path in paths:
        path.write_bytes(b"nobody should look at this")


def test_check_lights_and_their_boards_are_not_opened(tmp_path):
    folder = make_capture(tmp_path / "c", checks=2)
    whole = plane(folder, tmp_path / "whole")
    damage(*(folder / kind / f"{name}.png" for kind in ("frames", "white") for name in ("L04", "L05")))
    with pytest.raises(CaptureError):
        plane(folder, tmp_path / "no")
    part = plane(folder, tmp_path / "part", without=("check",))
    assert part.lights == ("L01", "L02", "L03")
    for read, wanted in zip(part.read(WHOLE), whole.read(WHOLE, lights=np.arange(3)), strict=True):
        np.testing.assert_array_equal(read, wanted)


def test_a_light_held_out_can_be_left_out_by_its_name(tmp_path):
    folder = make_capture(tmp_path / "c")
    damage(folder / "frames/L02.png", folder / "white/L02.png")
    assert plane(folder, tmp_path / "o", without=("light L02",)).lights == ("L01", "L03", "L04", "L05")


def test_dark_frames_of_exposure_times_that_are_left_out_are_not_opened(tmp_path):
    folder = make_capture(tmp_path / "c", exposure_s=0.5)
    edit_text(folder / "frames.csv", "frames/L05.png,check,L05,0.5", "frames/L05.png,check,L05,2")
    edit_text(folder / "frames.csv", "white/L05.png,white,L05,0.5", "white/L05.png,white,L05,2")
    edit_text(folder / "frames.csv", "dark/dark.png,dark,,", "dark/dark.png,dark,,0.5\ndark/long.png,dark,,2")
    write_frame(folder / "dark/long.png", np.full((24, 32, 3), 200.0))
    capture = load_capture(folder)
    assert chosen(capture).files == frozenset()
    assert chosen(capture, ["check"]).skipped["dark"] == ("dark/long.png",)
    damage(folder / "dark/long.png")
    assert len(plane(folder, tmp_path / "o", without=("check",)).lights) == 4


def test_flat_frames_are_never_opened(tmp_path):
    folder = make_capture(tmp_path / "c")
    edit_text(folder / "frames.csv", "dark/dark.png,dark,,", "dark/dark.png,dark,,\nflat.png,flat,,")
    damage(folder / "flat.png")
    assert len(plane(folder, tmp_path / "o").lights) == len(RING)


def test_files_that_are_left_out_are_not_proven_against_the_seal(tmp_path):
    folder = make_capture(tmp_path / "c")
    seal(folder)
    with (folder / "data/frames/L05.png").open("ab") as file:
        file.write(b"x")
    with refused(CaptureError, kind="seal-changed"):
        plane(folder, tmp_path / "whole")
    assert len(plane(folder, tmp_path / "part", without=("check",)).lights) == 4


def test_bands_without_the_object_are_neither_kept_nor_read(tmp_path):
    mask = np.zeros((24, 32), bool)
    mask[10:14, 5:20] = True
    masked = make_capture(tmp_path / "c", mask=mask)
    found = plane(masked, tmp_path / "o", tile_mib=0)
    assert found.band_rows == 8
    assert bands_with_object(mask, 8) == (1,)
    kept = sorted(path.relative_to(found.path) for path in (found.path / "codes/c").rglob("*") if path.is_file())
    assert [path.parts[3] for path in kept] == ["1"] * len(RING)
    whole = plane(make_capture(tmp_path / "all"), tmp_path / "w", tile_mib=0)
    for rows in (WHOLE, slice(3, 21), slice(0, 9), slice(13, 24), slice(16, 24)):
        values, valid = found.read(rows)
        expected, _ = whole.read(rows)
        np.testing.assert_array_equal(valid, np.broadcast_to(mask[rows], valid.shape))
        np.testing.assert_array_equal(values[valid], expected[valid])


def turntable(folder: Path, output: Path, **settings) -> Views:
    write_views(load_capture(folder), output, settings=IngestSettings(**settings))
    return Views(output)


STATES = {"states": ("off", "on"), "boards": ("off", "on"), "dark": True, "white": True}


def test_other_polariser_states_are_not_opened(tmp_path):
    folder = make_turntable(tmp_path / "c", **STATES)
    whole = turntable(folder, tmp_path / "whole")
    damage(*folder.glob("frames/*_1.png"), *folder.glob("white/*_*.png"))
    part = turntable(folder, tmp_path / "part", without=("states", "white_states"))
    assert part.states == ("off",)
    for view in part.views:
        for read, wanted in zip(part.read(view), whole.read(view, state="off"), strict=True):
            np.testing.assert_array_equal(read, wanted)


def test_without_photographs_views_and_cameras_are_still_known(tmp_path):
    folder = make_turntable(tmp_path / "c", **STATES)
    whole = turntable(folder, tmp_path / "whole")
    # one header is read to know the size of the pictures
    damage(*(p for p in folder.glob("frames/*.png") if p.name != "0_0_0.png"), *folder.glob("white/*.png"))
    damage(folder / "dark/dark.png")
    part = turntable(folder, tmp_path / "part", without=("states", "white_states", "photographs"))
    assert (part.views, part.shape) == (whole.views, whole.shape)
    np.testing.assert_array_equal(part.matrices["v3"], whole.matrices["v3"])
    np.testing.assert_array_equal(part.silhouette("v2"), whole.silhouette("v2"))
    assert not [path for path in (part.path / "codes").rglob("*") if path.is_file() and path.name != "zarr.json"]


def test_silhouettes_boards_mesh_and_scans_are_not_opened(tmp_path):
    folder = make_turntable(tmp_path / "c", turntable={"mesh": "object.ply", "scans": ["a.ply", "b.ply"]})
    ply = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    ply += "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    for name in ("object.ply", "a.ply", "b.ply"):
        (folder / name).write_text(ply)
    capture = load_capture(folder)
    choice = chosen(capture, ["silhouettes", "mesh", "scans"])
    assert choice.skipped["mesh"] == ("object.ply",)
    assert choice.skipped["scans"] == ("a.ply", "b.ply")
    assert len(choice.skipped["silhouettes"]) == 5
    assert (choice.capture.mesh, choice.capture.scans) == (None, ())
    damage(*folder.glob("silhouettes/*.png"))
    part = turntable(folder, tmp_path / "part", without=("silhouettes", "mesh", "scans"))
    assert part.silhouette("v1") is None
    assert (part.geometry["mesh"], part.geometry["scans"]) == (None, [])


def test_oblique_photographs_and_their_boards_are_not_opened(tmp_path):
    samples = [(0.0, 0.0, float(t), 0.0) for t in range(0, 65, 5)] + [(30.0, 0.0, 10.0, 0.0), (45.0, 0.0, 20.0, 90.0)]
    folder = make_goniometer(tmp_path / "c", samples=samples, whites=[(0, 0, "", ""), (30, 0, "", ""), (45, 0, "", "")])
    settings = IngestSettings(without=("oblique",))
    write_goniometer(load_capture(folder), tmp_path / "whole", settings=IngestSettings())
    damage(folder / "frames/s13.png", folder / "frames/s14.png", folder / "white/w1.png", folder / "white/w2.png")
    write_goniometer(load_capture(folder), tmp_path / "part", settings=settings)
    whole, part = Measurements(tmp_path / "whole"), Measurements(tmp_path / "part")
    assert (len(part.samples), len(part.whites)) == (13, 1)
    for one, other in zip(part.samples, whole.samples, strict=False):
        np.testing.assert_array_equal(part.read(one).linear, whole.read(other).linear)


def test_boards_that_stand_for_others_by_the_cosine_law_are_kept(tmp_path):
    samples = [(0.0, 0.0, float(t), 0.0) for t in range(0, 65, 5)] + [(30.0, 0.0, 10.0, 0.0)]
    folder = make_goniometer(tmp_path / "c", samples=samples, whites=[(10, 0, "", ""), (20, 0, "", "")])
    choice = chosen(load_capture(folder), ["oblique"])
    assert choice.skipped == {"oblique": ("frames/s13.png",)}


def test_reading_counts_files_and_bytes(tmp_path):
    folder = make_capture(tmp_path / "c", checks=2)
    capture = load_capture(folder)
    reading = usage_of(capture, without=["check"], channels="luminance")
    found = {files["what"]: files for files in reading["files"]}
    assert [found["photographs under check lights"][name] for name in ("read", "of")] == [0, 2]
    assert [found["white boards"][name] for name in ("read", "of")] == [3, 5]
    assert found["photographs of the object"]["bytes_read"] == sum(
        (folder / f"frames/L0{i}.png").stat().st_size for i in (1, 2, 3)
    )
    assert reading["total"]["of"] == sum(1 for path in folder.rglob("*") if path.is_file())
    assert reading["total"]["bytes_of"] == sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    assert reading["channels"] == (1, 3)
    assert usage_of(capture, without=(), channels="all")["total"]["read"] == reading["total"]["of"]


def test_reading_of_a_turntable_and_of_a_table(tmp_path):
    capture = load_capture(make_turntable(tmp_path / "c", **STATES))
    reading = usage_of(capture, without=("states", "photographs", "silhouettes"), channels="all")
    found = {files["what"]: (files["read"], files["of"]) for files in reading["files"]}
    assert found["photographs of the object"] == (0, 10)
    assert found["silhouettes"] == (0, 5)
    assert (found["white boards"], found["dark frames"]) == ((2, 3), (0, 1))
    table = load_capture(make_table(tmp_path / "t"))
    assert usage_of(table, without=(), channels="all")["total"]["read"] == 2


def test_nothing_left_out_is_the_capture_itself(tmp_path):
    for number, make in enumerate((make_capture, make_turntable, make_goniometer)):
        capture = load_capture(make(tmp_path / str(number)))
        choice = chosen(capture)
        assert choice.skipped == {}
        assert choice.capture == replace(capture)


def test_a_missing_frames_table_is_told_with_a_remedy(tmp_path):
    folder = make_capture(tmp_path / "c")
    (folder / "frames.csv").unlink()
    with refused(CaptureError, "frames.csv", "/nishiki", kind="frames-missing"):
        load_capture(folder)
