"""The command that simulates: both folders are complete, readable, reproducible, and never overwritten."""

import csv

import numpy as np
import pytest
import yaml
import zarr

from nishiki.capture.folder import load_capture
from nishiki.formats.images import read_codes
from nishiki.simulate import command as simulate
from nishiki.simulate.painting import photographs

SMALL = ("--rows", "32", "--columns", "48", "--ring-lights", "4", "--checks", "20", "60")


def run(folder, *options):
    return simulate.main(["--output", str(folder / "capture"), "--truth", str(folder / "truth"), *SMALL, *options])


def contents(folder):
    return {str(file.relative_to(folder)): file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}


def test_both_folders_are_complete_and_reproducible(tmp_path, capsys):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        assert run(tmp_path / name) == 0
    photographs = {k: v for k, v in contents(tmp_path / "a" / "capture").items() if not k.startswith(("bag", "tagm"))}
    again = contents(tmp_path / "b" / "capture")
    assert photographs == {name: again[name] for name in photographs}
    assert contents(tmp_path / "a" / "truth") == contents(tmp_path / "b" / "truth")
    capture = load_capture(tmp_path / "a" / "capture")
    assert not capture.warnings
    assert capture.lights.names == ("top", "ring1", "ring2", "ring3", "ring4", "check1-20", "check2-60")
    assert sorted({frame.role for frame in capture.frames}) == ["check", "dark", "sample", "white"]
    codes = read_codes(capture.frames[0].path, capture.settings.camera.channels)
    assert codes.shape == (32, 48, 3)
    truth = zarr.open_group(tmp_path / "a" / "truth" / "truth.zarr", mode="r")
    assert truth.attrs["checks"] == ["check1-20", "check2-60"]
    assert truth["xyz_d65"].shape == (2, 32, 48, 3)
    assert truth["lit"].shape == (7, 32, 48)
    for name, array in truth.arrays():
        values = array[...]
        assert np.isfinite(values).all(), name
        assert values.any(), name
    assert truth["labels"][...].max() < truth["spectra"].shape[0] == truth["roughness"].shape[0]
    assert "truth.zarr" in (tmp_path / "a" / "truth" / "README.md").read_text()
    assert "written" in capsys.readouterr().err
    assert not list((tmp_path / "a").glob(".*"))


def test_existing_folders_are_left_alone(tmp_path, capsys):
    (tmp_path / "truth").mkdir()
    assert run(tmp_path) == 2
    assert str(tmp_path / "truth") in capsys.readouterr().err
    assert not (tmp_path / "capture").exists()
    assert list((tmp_path / "truth").iterdir()) == []


def test_truth_inside_the_capture_is_refused(tmp_path, capsys):
    assert simulate.main(["--output", str(tmp_path / "c"), "--truth", str(tmp_path / "c" / "t"), *SMALL]) == 2
    assert str(tmp_path / "c" / "t") in capsys.readouterr().err
    assert not (tmp_path / "c").exists()


def test_a_failure_leaves_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.setattr(photographs, "write_tables", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("channels", [4, 8])
def test_more_channels_come_as_tiff_pages(tmp_path, channels):
    assert run(tmp_path, "--channels", str(channels), "--lights-as", "position", "--scene", "spheres") == 0
    capture = load_capture(tmp_path / "capture")
    payload = capture.payload
    codes = read_codes(capture.frames[0].path, capture.settings.camera.channels)
    assert codes.shape == (32, 48, channels)
    settings = yaml.safe_load((payload / "capture.yaml").read_text())
    assert settings["lights"] == {"file": "lights.csv", "kind": "position_mm"}
    with (payload / "spectra" / "camera.csv").open() as file:
        assert next(csv.reader(file)) == ["wavelength_nm", *(f"band{i + 1}" for i in range(channels))]


def test_impossible_wishes_are_explained(tmp_path, capsys):
    assert run(tmp_path, "--channels", "5", "--format", "png") == 2
    assert "--format tiff" in capsys.readouterr().err
    assert run(tmp_path, "--white-level", "7") == 2
    assert "white_level expected" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
