"""Goniometer captures through ingest and reflectance, as a user calls them."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from captures import edit_text, write_frame
from goniometer_captures import WHITE, cloth, directions, edit_goniometer, make_goniometer, make_table, quarter_views
from refusals import refused

from nishiki.artifacts.artifact import Artifact, ArtifactWriter
from nishiki.artifacts.declaration import parse
from nishiki.artifacts.stage import Context
from nishiki.capture.convert import convert
from nishiki.capture.folder import load_capture
from nishiki.errors import UserError
from nishiki.goniometry.directions import angles
from nishiki.goniometry.readings import regions_in_view
from nishiki.goniometry.table import Reflectances
from nishiki.observations.goniometer_store import Measurements, write_goniometer
from nishiki.progress import Progress
from nishiki.stages.goniometer_samples import GoniometerSamplesSettings
from nishiki.stages.goniometer_samples.run import run
from nishiki.stages.ingest import IngestSettings

PROJECT = Path(__file__).resolve().parents[2]
NORMAL = [(0.0, 0.0, t, p) for t, p in quarter_views()]


def opened(folder, target, **values):
    """The ingested measurements of a capture, and what ingest found."""
    target.mkdir(parents=True, exist_ok=True)
    result = write_goniometer(load_capture(folder), target, settings=IngestSettings(**values))
    return Measurements(target), result


def script(name, *arguments):
    environment = {key: os.environ[key] for key in ("PATH", "NUMBA_CACHE_DIR", "HOME") if key in os.environ}
    call = [sys.executable, "scripts/stage.py", name, *map(str, arguments)]
    return subprocess.run(call, cwd=PROJECT, capture_output=True, text=True, check=False, env=environment)


def reflectances(folder, target, settings=None):
    """The reflectances of a capture, the stage's diagnostics and its folder, made in this process."""
    opened(folder, target / "ingest")
    stamp = {"scene": "test", "stage": "goniometer_samples", "key": "0" * 12, "version": "0"}
    inputs = {"ingest": Artifact(target / "ingest", {})}
    chosen = parse(GoniometerSamplesSettings, settings or {}, "settings of reflectance")
    with ArtifactWriter(target / "goniometer_samples") as output:
        told = run(Context(inputs, chosen, output, None, None, stamp, Progress("test")))
        output.finish({"diagnostics": told}, {})
    return Reflectances(target / "goniometer_samples"), told, target / "goniometer_samples"


def test_ingest_keeps_the_windows_linear(tmp_path):
    folder = make_goniometer(tmp_path / "c", exposure_s=0.5, white_exposure_s=0.25)
    measured, result = opened(folder, tmp_path / "o")
    assert (result["rows"], result["columns"], result["measurements"], result["whites"]) == (16, 16, 29, 1)
    assert measured.channels == ("red", "green", "blue")
    values = cloth(*directions(NORMAL))
    board = measured.read(measured.whites[0]).linear
    for shot, value in zip(measured.samples, values, strict=True):
        linear = measured.read(shot).linear
        assert linear.shape == (16, 16, 3)
        ratio = linear.mean(axis=(0, 1)) / board.mean(axis=(0, 1)) * WHITE / np.pi
        np.testing.assert_allclose(ratio, value, rtol=2e-3)


def test_ingest_of_chosen_channels(tmp_path):
    measured, _ = opened(make_goniometer(tmp_path / "c"), tmp_path / "o", channels="luminance")
    assert measured.channels == ("luminance",)
    np.testing.assert_allclose(measured.white_reflectance, [WHITE])
    weights = np.array([0.299, 0.587, 0.114])
    ratio = measured.read(measured.samples[3]).linear.mean() / measured.read(measured.whites[0]).linear.mean()
    assert ratio * WHITE / np.pi == pytest.approx(cloth(*directions(NORMAL[3:4]))[0] @ weights, rel=2e-3)
    edit_goniometer(tmp_path / "c", white_reflectance=[0.9, 0.8, 0.7])
    green, _ = opened(tmp_path / "c", tmp_path / "g", channels="green")
    np.testing.assert_allclose(green.white_reflectance, [0.8])


def test_hot_pixels_are_left_out_and_saturated_ones_told(tmp_path):
    folder = make_goniometer(tmp_path / "c")
    dark = np.full((20, 24, 3), 100.0)
    dark[9, 12] = 30000
    write_frame(folder / "dark/dark.png", dark)
    bright = np.full((20, 24, 3), 9000.0)
    bright[8, 10, 1] = 65535
    write_frame(folder / "frames/s3.png", bright)
    measured, result = opened(folder, tmp_path / "o", white_block=4)
    assert (result["defects"], result["saturated"]) == (1, 1)
    shot = measured.read(measured.samples[3])
    assert np.argwhere(~shot.usable).tolist() == [[7, 8]]
    assert np.argwhere(shot.saturated).tolist() == [[6, 6]]


def test_ingest_is_deterministic_and_damage_is_found(tmp_path):
    folder = make_goniometer(tmp_path / "c")
    for name in ("a", "b"):
        measured, _ = opened(folder, tmp_path / name)
    files = [p.relative_to(tmp_path / "a") for p in sorted((tmp_path / "a").rglob("*")) if p.is_file()]
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    chunk = tmp_path / "b/goniometer.zarr/codes/c/0/0/0/0"
    data = bytearray(chunk.read_bytes())
    data[len(data) // 2] ^= 4
    chunk.write_bytes(data)
    with pytest.raises(UserError, match="damaged"):
        measured.read(measured.samples[0])
    with refused(UserError, by="__init__"):
        Measurements(tmp_path)


def test_many_frames_go_over_several_chunks(tmp_path, monkeypatch):
    monkeypatch.setattr("nishiki.observations.goniometer_store.CHUNK_BYTES", 4 * 16 * 16 * 3 * 2)
    measured, _ = opened(make_goniometer(tmp_path / "c"), tmp_path / "o")
    assert len(list((tmp_path / "o/goniometer.zarr/codes/c").iterdir())) == 8
    values = cloth(*directions(NORMAL))
    levels = [measured.read(shot).linear.mean() for shot in measured.samples]
    np.testing.assert_allclose(levels / values.mean(axis=1), levels[0] / values[0].mean(), rtol=3e-3)


def test_photographs_become_reflectances(tmp_path):
    """Boards of the light's own, of another light, noise, several exposures of one direction."""
    oblique = [(40.0, 90.0, t, p) for t in (0.0, 30.0, 60.0) for p in (0.0, 90.0, 270.0)]
    folder = make_goniometer(
        tmp_path / "c",
        samples=NORMAL + oblique + NORMAL[:2],
        noise=0.05,
        exposure_s=1.0,
        goniometer={"threads_per_cm": [60, 40]},
    )
    found, told, artifact = reflectances(folder, tmp_path)
    once = [a for a in NORMAL + oblique if a[2] > 0 or a[3] == 0]  # at theta_r = 0 the azimuth tells nothing
    incident, outgoing = directions(once)
    assert len(found) == len(once)
    np.testing.assert_allclose(found.values[:, 0], cloth(incident, outgoing), rtol=0.03)
    np.testing.assert_allclose(found.incident, incident, atol=1e-12)
    np.testing.assert_allclose(found.outgoing, outgoing, atol=1e-12)
    assert found.normal_incidence.sum() == 29
    relative = found.noise[:, 0] / found.values[:, 0]
    assert np.median(relative) == pytest.approx(0.05 / 16 * 2**0.5, rel=0.4)  # of 256 pixels, cloth and board
    assert told["boards"] == {"own": 0, "incidence": 31, "cosine": 9}
    assert (told["repeated"], told["incidences"], told["weave"], told["symmetry"]) == (3, 2, "satin", "quarter")
    assert found.spacing_ratio == found.take(slice(3)).spacing_ratio == 1.5
    assert 0.2 < told["albedo_normal"][0][0] < 0.6
    assert (artifact / "coverage.svg").read_text().startswith("<svg")
    basic = found.basic
    assert basic.values.shape == (1, 31, 120, 3)
    np.testing.assert_allclose(basic.evaluate(outgoing[:29]), cloth(incident[:29], outgoing[:29]), rtol=0.06)


def test_a_longer_and_a_shorter_exposure_make_one_reading(tmp_path):
    folder = make_goniometer(tmp_path / "c", exposure_s=1.0)
    short = write_frame
    lines = (folder / "frames.csv").read_text().splitlines()
    top = (1 << 16) - 1
    value = cloth(*directions(NORMAL[:1]))[0]
    short(folder / "frames/short.png", 100 + top * value * 0.5 * np.pi * 0.25 * np.ones((20, 24, 3)))
    short(folder / "frames/s0.png", np.full((20, 24, 3), 65535.0))
    lines.append("frames/short.png,sample,0,0,0,0,0.25")
    (folder / "frames.csv").write_text("\n".join(lines) + "\n")
    found, told, _ = reflectances(folder, tmp_path)
    np.testing.assert_allclose(found.values[0, 0], value, rtol=2e-3)
    assert (told["saturated"], told["repeated"], told["unusable"]) == (1, 1, [0])


@pytest.mark.slow
def test_the_scripts_by_hand(tmp_path):
    """As a user calls them; the artifact knows where it comes from, and bad settings are told in one line."""
    folder = make_goniometer(tmp_path / "c")
    done = script("ingest", "--capture", folder, "--scene", "silk", "--output", tmp_path / "ingest")
    assert done.returncode == 0, done.stderr
    (source,) = (tmp_path / "ingest").iterdir()
    done = script(
        "goniometer_samples", "--inputs", source, "--scene", "silk", "--output", tmp_path / "goniometer_samples"
    )
    assert done.returncode == 0, done.stderr
    (artifact,) = (tmp_path / "goniometer_samples").iterdir()
    found = Reflectances(artifact)
    assert found.details["stamp"]["scene"] == "silk"
    manifest = json.loads((artifact / "artifact.json").read_text())
    assert manifest["diagnostics"]["directions"] == len(found) == 29
    assert manifest["upstream"]["ingest"]["key"] == source.name
    done = script(
        "goniometer_samples", "--inputs", source, "--settings", '{"window_px": 40}', "--output", tmp_path / "r"
    )
    assert done.returncode == 2
    assert done.stderr.startswith("nishiki goniometer_samples: window_px: 40, expected at most 16")
    assert done.stderr.count("\n") == 1


def test_a_table_gives_the_same_as_its_numbers(tmp_path):
    found, told, _ = reflectances(make_table(tmp_path / "t"), tmp_path)
    angles_deg = [(ti, 0.0, t, p) for ti in (0.0, 30.0) for t, p in quarter_views()]
    np.testing.assert_allclose(found.values[:, 0], cloth(*directions(angles_deg)), rtol=1e-12)
    assert (found.noise == 0).all()
    assert told["boards"] is None
    assert told["noise_relative"] is None


def two_cloths(labels):
    """Photographs of a cloth whose right half reflects half as much, seen by parallel projection."""

    def picture(given, values):
        theta, phi = np.radians(given[2:])
        grown = regions_in_view(labels, labels.shape, theta_r=theta, phi_r=phi, upright="arm")
        return np.where(grown[..., None] == 2, 0.5, 1.0) * values

    return picture


def test_regions_are_followed_obliquely(tmp_path):
    labels = np.ones((60, 64), np.uint16)
    labels[:, 32:] = 2
    folder = make_goniometer(
        tmp_path / "c",
        rows=60,
        columns=64,
        picture=two_cloths(labels),
        goniometer={"regions": "regions.png", "region_names": {"figure": 2}, "upright": "arm"},
    )
    write_frame(folder / "regions.png", labels[..., None], np.uint8)
    found, told, _ = reflectances(folder, tmp_path)
    assert found.regions == ("region 1", "figure")
    assert found.valid.all()
    np.testing.assert_allclose(found.values[:, 0], cloth(*directions(NORMAL)), rtol=2e-3)
    np.testing.assert_allclose(found.values[:, 1], 0.5 * cloth(*directions(NORMAL)), rtol=4e-3)
    assert found.basic.values.shape[0] == 2
    np.testing.assert_allclose(found.basic.values[1], 0.5 * found.basic.values[0], rtol=0.02)
    assert told["unusable"] == [0, 0]


def test_symmetry_can_be_chosen(tmp_path):
    whole = [(0.0, 0.0, t, p) for t in (0.0, 25.0, 50.0, 75.0) for p in np.arange(0.0, 360, 30)]
    folder = make_goniometer(tmp_path / "c", samples=whole, goniometer={"symmetry": "none"})
    found, told, _ = reflectances(folder, tmp_path)
    assert (found.symmetry, told["symmetry_images"]) == ("none", [0])
    found, told, _ = reflectances(folder, tmp_path / "q", {"symmetry": "quarter"})
    assert found.symmetry == "quarter"
    assert told["symmetry_images"] == [36]
    assert told["symmetry_departure"][0] < 5e-3


BAD = {
    "window beyond what was kept": (lambda f: None, {"window_px": 40}, "at most 16"),
    "no normal incidence": (lambda f: edit_text(f / "frames.csv", "sample,0.0,", "sample,20.0,"), {}, "normal_deg"),
    "all saturated": (
        lambda f: [write_frame(p, np.full((20, 24, 3), 65535.0)) for p in sorted((f / "frames").iterdir())],
        {},
        "exposure",
    ),
    "unknown setting": (lambda f: None, {"window": 3}, "did you mean 'window_px'"),
    "grid too fine": (lambda f: None, {"grid_deg": 0.1}, "grid_deg"),
}


@pytest.mark.parametrize("case", BAD, ids=lambda name: name)
def test_what_cannot_work_is_told_in_one_line(tmp_path, case):
    change, settings, words = BAD[case]
    folder = make_goniometer(tmp_path / "c")
    change(folder)
    with pytest.raises(UserError) as caught:
        reflectances(folder, tmp_path, settings)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.data
def test_measured_paint_goes_through_the_stage(data, tmp_path):
    """Tables of 31 bands, not lit along the normal: without the hemisphere, or from 10 degrees as if along it."""
    table = min(data.glob("*/*.brdf"))
    convert(table, tmp_path / "c")
    found, told, _ = reflectances(tmp_path / "c", tmp_path / "a", {"interpolation": "none"})
    assert found.basic is None
    assert found.values.shape[1:] == (1, 31)
    assert told["incidences"] == 8
    assert 0 < told["unusable"][0] < 100
    assert np.degrees(angles(found.incident)[0]).max() == pytest.approx(80, abs=0.1)
    with refused(UserError, "cloth"):
        reflectances(tmp_path / "c", tmp_path / "b")
    near, told, _ = reflectances(tmp_path / "c", tmp_path / "d", {"normal_deg": 11, "symmetry": "none"})
    assert near.normal_incidence.sum() > 100
    assert told["left_out_error"][0] < 0.1
    assert near.basic.values.shape == (1, 31, 120, 31)
    assert (near.basic.values > 0).all()
    assert 0 < min(told["albedo_normal"][0]) < max(told["albedo_normal"][0]) < 1
