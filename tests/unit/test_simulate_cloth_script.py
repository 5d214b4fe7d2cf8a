"""Simulated goniometer captures: photographs that mean the right reflectances, complete, reproducible, readable."""

import csv
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from capture_facts import goniometer_facts
from refusals import refused

from nishiki.capture.folder import load_capture
from nishiki.errors import UserError
from nishiki.simulate import command as simulate
from nishiki.simulate.capture import CameraSettings
from nishiki.simulate.cloth.photographs import TINT, photographs, region_labels, white_board
from nishiki.simulate.cloth.reflectance import blocks, cell_maps, make_cloth
from nishiki.simulate.cloth.settings import make_settings, preset, quarter_views, session, unit

QUALITY = {"candidates": 6_000, "chains": 2_000}


def contents(folder):
    return {str(file.relative_to(folder)): file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}


@pytest.fixture(scope="module")
def cloth():
    return make_cloth(make_settings("satin", dye="indigo", repeats=1), **QUALITY)


def few(**changes):
    angles = np.array([[0, 0, 0, 0], [0, 0, 60, 0], [0, 0, 40, 90], [50, 45, 70, 225], [75, 90, 81, 270]], float)
    return replace(preset("satin-tiny", dye="indigo"), angles_deg=angles, **changes)


def test_sessions():
    views = quarter_views()
    assert views.shape == (540, 2)
    assert len(np.unique(views, axis=0)) == 540
    assert {0.0, 90.0} <= set(views[:, 1])
    angles = session(views, views[:7])
    assert angles.shape == (540 + 15 * 7, 4)
    assert set(angles[540:, 0]) == {15.0, 30.0, 45.0, 60.0, 75.0}


def test_periodic_pictures_differ_from_place_to_place(cloth):
    angles = few().angles_deg
    pairs = unit(angles[:, 0], angles[:, 1]), unit(angles[:, 2], angles[:, 3])
    for _, lamps, views, index in blocks(cloth, *pairs):
        maps = cell_maps(cloth, lamps, views, index)
        assert maps.shape[1:] == (10, 10, 3)
        assert maps.std(axis=(1, 2)).min() > 0.0


def test_photographs_give_back_the_reflectance(cloth):
    """Mean code over that of the board is ρ π / ρ_W, up to the part of a repeat that the window cuts off."""
    settings = few(rows=48, columns=48, camera=CameraSettings(noise=False))
    camera = settings.camera
    found = {}
    for shot in photographs((cloth,), settings):
        theta = settings.angles_deg[shot.row, 0]
        board, seconds = white_board(1, theta, settings)
        assert shot.codes.max() < 0.9 * 4095
        light = (shot.codes.mean(axis=(0, 1)) - camera.black_level) / shot.exposure_s
        white = (board.mean(axis=(0, 1)) - camera.black_level) / seconds
        ratio = light / white * settings.white_reflectance / np.pi / shot.reflectance[0]
        found[shot.row] = ratio
        assert shot.codes.std() > 3.0  # yarns are seen
    assert sorted(found) == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(np.array(list(found.values())), 1.0, atol=0.012)


def test_noise_has_the_camera_s_size(cloth):
    """Two sessions that differ in noise only: shot and read noise of the mean code."""
    clean, noisy = (
        next(photographs((cloth,), few(camera=CameraSettings(noise=noise)))).codes.astype(float)
        for noise in (False, True)
    )
    camera = CameraSettings()
    electrons = np.maximum(clean - camera.black_level, 0.0) / (4095 - camera.black_level) * camera.full_well
    expected = np.sqrt(np.mean(electrons + camera.read_noise**2)) / camera.full_well * (4095 - camera.black_level)
    assert (noisy - clean).std() == pytest.approx(expected, rel=0.08)


def test_board_is_nearly_even_and_follows_the_cosine():
    settings = few(rows=64, columns=64, camera=CameraSettings(noise=False, bits=16))
    levels = {}
    for theta in (0.0, 60.0):
        codes, seconds = white_board(1, theta, settings)
        light = (codes - 64.0) / seconds
        levels[theta] = light.mean(axis=(0, 1))
        spread = light[..., 1].std() / light[..., 1].mean()
        assert spread == pytest.approx(settings.white_texture, rel=0.1)
    np.testing.assert_allclose(levels[60.0] / levels[0.0], 0.5, rtol=1e-3)
    np.testing.assert_allclose(levels[0.0] / levels[0.0][1], TINT, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.usefixtures("_few_directions")
def test_capture_is_complete_and_reproducible(tmp_path):
    for name in ("a", "b"):
        arguments = ["--output", str(tmp_path / name / "capture"), "--truth", str(tmp_path / name / "truth")]
        assert simulate.main([*arguments, "--preset", "satin-tiny", "--dye", "crimson", "--seed", "3"]) == 0
    assert contents(tmp_path / "a" / "capture" / "data") == contents(tmp_path / "b" / "capture" / "data")
    assert contents(tmp_path / "a" / "truth") == contents(tmp_path / "b" / "truth")
    capture = load_capture(tmp_path / "a" / "capture")
    facts = goniometer_facts(capture)
    assert (facts.measurements, facts.normal, facts.incidences) == (21, 13, 2)
    assert (facts.weave, facts.symmetry, facts.regions, facts.channels) == ("satin", "quarter", False, 3)
    assert capture.warnings == ()
    truth = np.load(tmp_path / "a" / "truth" / "truth.npz")
    np.testing.assert_allclose(truth["angles_deg"], np.array(capture.angles_deg))
    assert truth["reflectance"].shape == (21, 1, 3)
    assert (truth["reflectance"][..., 0] > truth["reflectance"][..., 1]).all()  # crimson
    geometry = json.loads((tmp_path / "a" / "truth" / "geometry.json").read_text())
    assert set(geometry) == {"settings", "pattern", "yarns"}
    assert "truth.npz" in (tmp_path / "a" / "truth" / "README.md").read_text()


@pytest.fixture
def _few_directions(monkeypatch):
    """The tiny session with fewer directions."""
    from nishiki.simulate.cloth import settings

    few_angles = session(quarter_views(30.0, 22.5), quarter_views(40.0, 45.0), incidences=(40.0,), azimuths=(90.0,))
    monkeypatch.setattr(settings, "session", lambda *_, **__: few_angles)


@pytest.mark.slow
@pytest.mark.usefixtures("_few_directions")
def test_two_cloths_have_their_regions(tmp_path):
    arguments = ["--output", str(tmp_path / "capture"), "--truth", str(tmp_path / "truth"), "--preset", "satin-tiny"]
    assert simulate.main([*arguments, "--two-cloths", "--no-noise", "--no-bounce"]) == 0
    capture = load_capture(tmp_path / "capture")
    assert goniometer_facts(capture).regions
    assert capture.settings.goniometer.region_names == {"ground": 1, "figure": 2}
    labels = cv2.imread(str(tmp_path / "capture" / "data" / "regions.png"), cv2.IMREAD_UNCHANGED)
    assert set(np.unique(labels)) == {1, 2}
    truth = np.load(tmp_path / "truth" / "truth.npz")["reflectance"]
    assert truth.shape[1] == 2
    with (tmp_path / "capture" / "data" / "frames.csv").open() as file:
        first = next(csv.DictReader(file))
    picture = cv2.imread(str(tmp_path / "capture" / "data" / first["file"]), cv2.IMREAD_UNCHANGED)[..., ::-1] - 64.0
    left, right = picture[:, :12].mean(axis=(0, 1)), picture[:, 12:].mean(axis=(0, 1))
    np.testing.assert_allclose(left / right, truth[0, 0] / truth[0, 1], rtol=0.08)
    assert (tmp_path / "truth" / "geometry-2.json").is_file()


def test_regions_reach_beyond_an_oblique_photograph():
    settings = preset("satin", regions=True)
    labels, pitch = region_labels(settings)
    half = 0.5 * labels.shape[0] * pitch
    assert half > 0.5 * settings.columns * settings.pitch_mm / np.cos(np.radians(87.0))
    assert [c.face for c in settings.cloths] == ["warp", "weft"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--preset", "satin-tiny", "--relief", "flat"), "--relief"),
        (("--preset", "satin-tiny", "--harness", "6"), "harness"),
        (("--preset", "plain", "--harness", "4"), "2"),
        (("--preset", "tiny", "--dye", "indigo"), "--dye"),
        (("--preset", "satin-tiny", "--rows", "4"), "rows"),
    ],
)
def test_impossible_wishes_are_explained(tmp_path, capsys, options, message):
    arguments = ["--output", str(tmp_path / "capture"), "--truth", str(tmp_path / "truth")]
    assert simulate.main([*arguments, *options]) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_another_seed_is_another_cloth():
    one, other = make_settings("satin", seed=1), make_settings("satin", seed=2)
    assert one.warp.spacing_mm != other.warp.spacing_mm
    assert make_settings("satin", harness=8).step == 3
    with refused(UserError, "-1", by="check_ranges"):
        make_settings("satin", seed=-1)
