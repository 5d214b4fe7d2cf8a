"""The command that simulates a turntable: captures that the chain reads, complete, reproducible, in all variants."""

import numpy as np
import pytest
import zarr
from capture_facts import turntable_facts

from nishiki.capture.folder import load_capture
from nishiki.formats.images import read_codes
from nishiki.simulate import command as simulate

SMALL = ("--preset", "object-tiny", "--rows", "24", "--columns", "32", "--views", "3", "--triangles", "3600")


def run(folder, *options):
    arguments = ["--output", str(folder / "capture"), "--truth", str(folder / "truth"), *SMALL, "--supersampling", "2"]
    return simulate.main([*arguments, *options])


def contents(folder):
    return {str(file.relative_to(folder)): file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}


@pytest.mark.slow
def test_capture_is_complete_and_reproducible(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        assert run(tmp_path / name) == 0
    assert contents(tmp_path / "a" / "capture" / "data") == contents(tmp_path / "b" / "capture" / "data")
    assert contents(tmp_path / "a" / "truth") == contents(tmp_path / "b" / "truth")
    capture = load_capture(tmp_path / "a" / "capture")
    facts = turntable_facts(capture)
    assert (facts.views, facts.states, facts.lights) == (("000", "001", "002"), ("off", "on"), ("lamp",))
    assert facts.full_turn
    assert facts.cameras
    assert facts.mesh
    assert facts.silhouettes
    assert facts.white_states == ("off", "on")
    assert facts.lamp == "position_mm"
    assert facts.unit == "mm"
    codes = {
        (f.view, f.polariser): read_codes(f.path, capture.settings.camera.channels) for f in capture.frames_of("sample")
    }
    assert codes["000", "off"].shape == (24, 32, 3)
    assert codes["000", "off"].max() <= 4095
    truth = zarr.open_group(tmp_path / "a" / "truth" / "truth.zarr", mode="r")
    for name, array in truth.arrays():
        values = array[...]
        assert np.isfinite(values).all(), name
        assert values.any(), name
    scale = (4095 - 64) * truth["sensitivity"][...]
    for place, view in enumerate(("000", "001", "002")):
        found = codes[view, "off"] - 64.0
        expected = scale * truth["total"][place]
        assert np.abs(found - expected).max() < 60
        assert abs(np.mean(found - expected)) < 1.0
        crossed = scale * truth["beta"][...] * (truth["diffuse"][place] + 0.01 * truth["specular"][place])
        assert abs(np.mean(codes[view, "on"] - 64.0 - crossed)) < 1.0
    assert "truth.zarr" in (tmp_path / "a" / "truth" / "README.md").read_text()


def test_scan_is_the_object_with_noise(tmp_path):
    import trimesh

    assert run(tmp_path, "--mesh-noise-mm", "0.1") == 0
    mesh = trimesh.load(tmp_path / "capture" / "data" / "object.ply", process=False)
    truth = zarr.open_group(tmp_path / "truth" / "truth.zarr", mode="r")
    offset = mesh.vertices - truth["vertices"][...]
    np.testing.assert_array_equal(mesh.faces, truth["triangles"][...])
    assert np.sqrt(np.mean(np.sum(offset**2, axis=1))) == pytest.approx(0.1, rel=0.1)
    assert mesh.is_watertight


def test_variants(tmp_path):
    options = ("--polariser", "none", "--mesh", "none", "--silhouettes", "none", "--lights-as", "camera", "--no-bounce")
    assert run(tmp_path, *options) == 0
    facts = turntable_facts(load_capture(tmp_path / "capture"))
    assert facts.states == ("",)
    assert facts.lamp == "camera"
    assert facts.white_board
    assert not facts.mesh
    assert not facts.silhouettes
    assert facts.cameras


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--gloss", "satin"), "--gloss"),
        (("--lights-as", "direction"), "direction"),
        (("--views", "1"), "views"),
        (("--preset", "tiny", "--views", "4"), "--views"),
    ],
)
def test_impossible_wishes_are_explained(tmp_path, capsys, options, message):
    assert run(tmp_path, *options) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
