"""Photographs of the simulator: radiometry, noise, independence of threads and bands, and of the fitted models."""

import ast
import dataclasses
from pathlib import Path

import numpy as np
import pytest

import nishiki.simulate
from nishiki import threads
from nishiki.errors import UserError
from nishiki.simulate.capture import BOARD_REFLECTANCE, FINE_NM, CameraSettings, dark_frame, expose, sensitivities
from nishiki.simulate.painting import photographs
from nishiki.simulate.painting.objects import make_object
from nishiki.simulate.painting.photographs import make_tables, photograph, white_board
from nishiki.simulate.painting.settings import (
    LampSettings,
    SimulationSettings,
    board_cosine,
    direction_error_deg,
    place_lamps,
    planck_spectrum,
)

TINY = SimulationSettings(rows=64, columns=96)
QUIET = CameraSettings(noise=False, bits=16)


@pytest.fixture(scope="module")
def tiny():
    return make_object(TINY)


def observation(codes, board, lamp, settings):
    """White-normalised observation as the capture format defines it, with the nominal direction of the lamp."""
    black = settings.camera.black_level
    return (codes.astype(float) - black) / (board.astype(float) - black) * BOARD_REFLECTANCE * lamp.direction[2]


@pytest.mark.parametrize("channels", [3, 6])
def test_flat_lambert_gives_reflectance_times_cosine(channels):
    settings = dataclasses.replace(
        TINY,
        relief="flat",
        gloss="none",
        body="lambert",
        camera=dataclasses.replace(QUIET, channels=channels, black_level=1024),
    )
    thing = make_object(settings)
    tables = make_tables(thing, settings, with_truth=False)
    expected = tables.table[thing.label].reshape(64, 2, 96, 2, channels).mean(axis=(1, 3))
    for lamp in place_lamps(settings)[:4]:
        shot = photograph(thing, lamp, settings, tables)
        found = observation(shot.codes, white_board(lamp, settings, tables), lamp, settings)
        np.testing.assert_allclose(found, expected * lamp.direction[2], atol=6e-4)
        assert (shot.lit == 100).all()


def test_board_is_white_under_every_lamp():
    settings = dataclasses.replace(TINY, camera=CameraSettings(read_noise=4.0))
    tables = make_tables(make_object(settings), settings, with_truth=False)
    for lamp in place_lamps(settings):
        code = white_board(lamp, settings, tables).astype(float) - settings.camera.black_level
        again = white_board(lamp, dataclasses.replace(settings, seed=1), tables)
        assert (again == code + settings.camera.black_level).all()
        cosine = board_cosine(lamp, settings, slice(0, 64))
        level = tables.signal * BOARD_REFLECTANCE * lamp.power * lamp.direction[2] * (4095 - 64)
        mean = (code / cosine[..., None]).mean(axis=(0, 1)) * lamp.direction[2]
        np.testing.assert_allclose(mean, level, rtol=0.06)  # beam, lens and distance take a few percent
        centre = (code / cosine[..., None])[28:36, 44:52].mean(axis=(0, 1)) * lamp.direction[2]
        np.testing.assert_allclose(centre, level, rtol=0.012)


def test_noise_has_the_stated_mean_and_variance():
    camera = CameraSettings(full_well=20000.0, read_noise=10.0, bits=16, black_level=4096)
    signal = np.broadcast_to(np.array([0.0, 0.05, 0.5], np.float32), (300, 300, 3))
    electrons = (expose(signal, camera, key=5).astype(float) - 4096) / (65535 - 4096) * 20000
    expected = np.array([0.0, 1000.0, 10000.0])
    variance = expected + 100.0
    np.testing.assert_allclose(electrons.mean(axis=(0, 1)), expected, atol=5 * np.sqrt(variance.max() / 90000))
    np.testing.assert_allclose(electrons.var(axis=(0, 1)), variance, rtol=0.03)
    flat = (electrons - expected) / np.sqrt(variance)
    assert abs(np.mean(flat[..., 2] ** 3)) < 0.05
    assert np.mean(flat[..., 2] ** 4) == pytest.approx(3.0, abs=0.1)
    for a, b in ((flat[:-1], flat[1:]), (flat[:, :-1], flat[:, 1:]), (flat[..., :1], flat[..., 1:2])):
        assert abs(np.mean(a * b)) < 0.01  # neighbours and channels are independent
    other = (expose(signal, camera, key=6).astype(float) - 4096) / (65535 - 4096) * 20000
    assert abs(np.mean(flat * (other - expected) / np.sqrt(variance))) < 0.01


def test_dark_frames_and_saturation():
    dark = dark_frame((TINY.rows, TINY.columns, 3), TINY.camera, key=1).astype(float)
    assert dark.mean() == pytest.approx(64, abs=0.2)
    assert dark.std() == pytest.approx(np.hypot(8.0 * (4095 - 64) / 30000, 12**-0.5), rel=0.1)
    codes = expose(np.full((4, 4, 3), 3.0, np.float32), CameraSettings(), key=1)
    assert (codes == 4095).all()


def test_bytes_do_not_depend_on_threads_or_bands(tiny, monkeypatch):
    lamp = place_lamps(TINY)[-1]
    tables = make_tables(tiny, TINY, with_truth=True)
    first = photograph(tiny, lamp, TINY, tables)
    monkeypatch.setattr(threads, "threads", lambda: 1)
    again = make_object(TINY)
    np.testing.assert_array_equal(again.height_mm, tiny.height_mm)
    np.testing.assert_array_equal(again.label, tiny.label)
    single = photograph(again, lamp, TINY, tables)
    monkeypatch.setattr(threads, "threads", lambda: 5)
    monkeypatch.setattr(photographs, "strips", lambda rows: (slice(k, k + 24) for k in range(0, rows, 24)))
    banded = photograph(tiny, lamp, TINY, tables)
    for name in ("codes", "lit", "xyz_lamp", "xyz_d65", "gloss", "body"):
        np.testing.assert_array_equal(getattr(single, name), getattr(first, name))
        np.testing.assert_array_equal(getattr(banded, name), getattr(first, name))


def test_another_seed_is_another_object(tiny):
    other = make_object(dataclasses.replace(TINY, seed=2))
    assert np.mean(other.label != tiny.label) > 0.1
    assert np.abs(other.height_mm - tiny.height_mm).max() > 0.01


def test_truth_is_the_photograph_without_noise():
    settings = dataclasses.replace(TINY, camera=dataclasses.replace(QUIET, white_level=0.3, black_level=1024))
    thing = make_object(settings)
    tables = make_tables(thing, settings, with_truth=True)
    lamp = place_lamps(settings)[-2]
    shot = photograph(thing, lamp, settings, tables)
    seen = observation(shot.codes, white_board(lamp, settings, tables), lamp, settings)
    # XYZ is no linear function of camera RGB, but on greys both are the same number.
    grey = np.isin(thing.label.reshape(64, 2, 96, 2), greys(thing)).all(axis=(1, 3)) & (shot.codes.max(axis=-1) < 65535)
    assert grey.sum() > 100
    np.testing.assert_allclose(seen[grey, 1], shot.xyz_lamp[grey, 1], rtol=0.02, atol=2e-3)
    np.testing.assert_allclose(shot.body + shot.gloss, shot.xyz_lamp[..., 1], atol=1e-5)
    np.testing.assert_allclose(shot.xyz_lamp[grey, 1], shot.xyz_d65[grey, 1], rtol=0.02, atol=2e-3)


def greys(thing):
    return [index for index, name in enumerate(thing.palette.names) if name.startswith("grey")]


def test_bounced_light_is_a_small_addition(tiny):
    lamp = place_lamps(TINY)[1]
    tables = make_tables(tiny, TINY, with_truth=False)
    lit = photograph(tiny, lamp, dataclasses.replace(TINY, camera=QUIET), tables).codes.astype(float)
    without = dataclasses.replace(TINY, camera=QUIET, bounce=False)
    direct = photograph(tiny, lamp, without, tables).codes.astype(float)
    assert (lit >= direct).all()
    assert 1e-4 < (lit - direct).mean() / direct.mean() < 0.05


@pytest.mark.slow
def test_relief_and_shadows_are_as_described():
    settings = SimulationSettings(rows=192, columns=256, pitch_mm=0.2)
    thing = make_object(settings)
    slopes = np.degrees(thing.steepest)
    assert 0.002 < np.mean(slopes > 40) < 0.08
    assert slopes.max() > 45
    flat = make_object(dataclasses.replace(settings, relief="flat"))
    assert (flat.normals[..., 2] == 1).all()
    thin = make_object(dataclasses.replace(settings, relief="canvas"))
    assert np.mean(thin.normals[..., 2]) > np.mean(thing.normals[..., 2])


def test_spheres_have_spherical_normals():
    settings = SimulationSettings(rows=128, columns=192, scene="spheres")
    thing = make_object(settings)
    assert np.degrees(thing.steepest).max() > 50
    # Four tiles of 32 pixels down, six across: the normal at a cap leans away from its centre, evenly.
    cap = thing.normals[32:64, 32:64]
    i, j = np.mgrid[:32, :32] - 15.5
    inside = np.hypot(i, j) < 12
    expected = np.stack([j, -i], axis=-1) * 0.2
    scale = np.sum(cap[..., :2][inside] * expected[inside]) / np.sum(expected[inside] ** 2)
    np.testing.assert_allclose(cap[..., :2][inside], scale * expected[inside], atol=0.01)
    assert len(np.unique(thing.label)) >= 20


def test_lamps_stand_where_they_should():
    settings = SimulationSettings(lights=LampSettings(rings=2, ring_lights=6, checks_deg=(20.0, 50.0)))
    lamps = place_lamps(settings)
    assert len({lamp.name for lamp in lamps}) == len(lamps) == 1 + 12 + 2
    angles = {lamp.name: np.degrees(np.arccos(lamp.direction[2])) for lamp in lamps}
    assert angles["check1-20"] == pytest.approx(20, abs=1.5)
    assert angles["ring2-3"] == pytest.approx(60, abs=1.5)
    for lamp in lamps:
        assert np.linalg.norm(lamp.position_mm) == pytest.approx(settings.distance_mm)
    mean, largest = direction_error_deg(settings)
    assert mean < largest < 0.75


def test_lamp_and_camera_curves_are_smooth_and_cover_the_grid():
    power = planck_spectrum(FINE_NM, 3200.0)
    assert np.all(np.diff(power[FINE_NM < 780]) > 0)
    # CIE standard illuminant A at 450 nm (CIE 015:2018, table 1), whose temperature is 2848 K with c2 = 1.435e7 nm K.
    assert planck_spectrum(np.array([450.0]), 2848.0 * 1.438776877 / 1.435)[0] == pytest.approx(0.330859, rel=1e-5)
    for channels in range(3, 9):
        curves = sensitivities(FINE_NM, channels)
        assert curves.shape == (channels, FINE_NM.size)
        assert curves.min() >= 0
        assert (curves.sum(axis=1) > 5).all()
        ends = (FINE_NM < 395) | (FINE_NM > 715)
        assert curves[:, ends].max() < 0.06  # nothing to speak of outside 400-700 nm


@pytest.mark.parametrize(
    "make",
    [
        lambda: SimulationSettings(rows=3),
        lambda: SimulationSettings(scene="bust"),
        lambda: SimulationSettings(gloss="wet"),
        lambda: SimulationSettings(seed=-1),
        lambda: SimulationSettings(roughness=0.001),
        lambda: CameraSettings(channels=9),
        lambda: CameraSettings(black_level=2000),
        lambda: LampSettings(rings=0),
        lambda: LampSettings(checks_deg=(20.0, 95.0)),
        lambda: SimulationSettings(lights=LampSettings(distance_mm=10.0)),
    ],
)
def test_impossible_settings_are_refused(make):
    with pytest.raises(UserError, match="simulation: "):
        make()


def test_nothing_is_imported_from_the_fitted_models():
    """The simulator must not share code with what it judges; rays, colour, folders and the seal are no models."""
    folder = Path(nishiki.simulate.__file__).parent
    common = (
        "nishiki.simulate",
        "nishiki.errors",
        "nishiki.threads",
        "nishiki.installation",
        "nishiki.colour.colour",
        "nishiki.geometry.visibility",
    )
    for file in folder.rglob("*.py"):
        files = ("nishiki.capture.seal", "nishiki.formats.files", "nishiki.installation")
        allowed = (*common, *files) if file.name == "command.py" else common
        for node in ast.walk(ast.parse(file.read_text())):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
                assert node.level == 0
            for name in names:
                assert not name.startswith("nishiki") or name.startswith(allowed), f"{file.name} imports {name}"
