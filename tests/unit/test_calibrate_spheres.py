"""Lamps from mirror spheres, against spheres traced ray by ray with lamps whose places are known."""

import json

import cv2
import numpy as np
import pytest
from mirror_rays import Scene, dome

from nishiki.calibrate.result import calibrate_spheres, put_into_capture, write_calibration
from nishiki.capture.convert import convert
from nishiki.capture.folder import load_capture
from nishiki.capture.lights import read_lights
from nishiki.capture.rti_projects import read_relight
from nishiki.capture.spheres.lamps import _centre
from nishiki.capture.spheres.optics import SphereCamera, outline_points, pixel_of_direction, reflected_rays, sphere_of
from nishiki.capture.spheres.outline import fit_outline
from nishiki.capture.spheres.search import SphereInput
from nishiki.errors import UserError


def written(folder, pictures, name="lamp"):
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for i, picture in enumerate(pictures):
        paths.append(folder / f"{name}{i + 1:02d}.png")
        cv2.imwrite(str(paths[-1]), np.round(picture * 65535).astype(np.uint16))
    return paths


def angles_deg(result, truth):
    measured = np.array([lamp["direction"] for lamp in result.numbers["lamps"]])
    truth = truth / np.linalg.norm(truth, axis=1)[:, None]
    return np.degrees(np.arccos(np.clip((measured * truth).sum(axis=1), -1, 1)))


FAR = dome(6, 1e4, (3, -2, 0))


def far_scene(radius=10.0):
    return Scene([((3, -2, radius), radius)], rows=150, columns=190, floor=0, pitch=0.25)


@pytest.fixture(scope="module")
def far_pictures():
    scene = far_scene()
    return [scene.photograph(lamp, size=250.0, seed=i) for i, lamp in enumerate(FAR)]


@pytest.fixture(scope="module")
def three_spheres(tmp_path_factory):
    """Three spheres of 48 pixels radius before a perspective camera, lamps at half a metre; their board, too."""
    floor, focal, rows, columns = -1000.0, 3200.0, 520, 760
    spheres = [((-80, -40, floor + 15), 15), ((85, -45, floor + 15), 15), ((0, 60, floor + 15), 15)]
    scene = Scene(spheres, rows=rows, columns=columns, floor=floor, focal_px=focal, samples=4)
    lamps = dome(8, 500, (0, 0, floor))
    folder = tmp_path_factory.mktemp("spheres")
    paths = written(folder / "lamps", [scene.photograph(lamp, size=12, seed=i) for i, lamp in enumerate(lamps)])
    row, column = np.mgrid[:rows, :columns]
    x, y = (column - (columns - 1) / 2) * -floor / focal, ((rows - 1) / 2 - row) * -floor / focal
    boards = []
    for i, lamp in enumerate(lamps):
        towards = lamp - np.stack([x, y, np.full_like(x, floor)], axis=-1)
        light = towards[..., 2] / np.linalg.norm(towards, axis=-1) ** 3
        shaded = 0.7 * light / light.max() * (1 - 0.15 * (x**2 + y**2) / x.max() ** 2)
        boards.append(np.clip(shaded + np.random.default_rng(i).normal(0, 0.005, x.shape), 0, 1))
    return paths, written(folder / "board", boards), lamps - [0, 0, floor], focal


@pytest.mark.parametrize(("radius", "most_deg"), [(8.0, 0.2), (16.0, 0.2)], ids=["32 px", "64 px"])
def test_one_sphere_gives_directions(tmp_path, radius, most_deg):
    scene = Scene([((3, -2, radius), radius)], rows=int(16 * radius), columns=int(18 * radius), floor=0, pitch=0.25)
    paths = written(tmp_path / "dome", [scene.photograph(lamp, size=250.0, seed=i) for i, lamp in enumerate(FAR)])
    result = calibrate_spheres(SphereInput(paths))
    angles = angles_deg(result, FAR - [3, -2, radius])
    assert angles.mean() < most_deg
    sigma = np.array([lamp["direction_sigma_deg"] for lamp in result.numbers["lamps"]])
    assert np.sqrt(((angles / sigma) ** 2).mean()) < 2
    assert not result.numbers["positions_written"]
    write_calibration(tmp_path / "out", result)
    lamps = read_lights(tmp_path / "out" / "lamps.lp")
    assert lamps.files == tuple(path.name for path in paths)
    np.testing.assert_allclose(
        read_relight(tmp_path / "out" / "lamps.dome").lights.directions, lamps.directions, atol=1e-7
    )
    content = json.loads((tmp_path / "out" / "calibration.json").read_text())
    assert len(content["inputs_sha256"]) == len(paths)
    assert "<svg" in (tmp_path / "out" / "calibration.html").read_text()
    with pytest.raises(UserError, match="exists"):
        write_calibration(tmp_path / "out", result)


@pytest.mark.slow
def test_three_spheres_give_positions_that_a_capture_uses(tmp_path, three_spheres):
    paths, _, truth, focal = three_spheres
    result = calibrate_spheres(SphereInput(paths, count=3, focal_px=focal, radius_mm=15))
    assert angles_deg(result, truth).mean() < 0.2
    assert result.numbers["positions_written"]
    positions = np.array([lamp["position_mm"] for lamp in result.numbers["lamps"]])
    error = np.linalg.norm(positions - truth, axis=1) / np.linalg.norm(truth, axis=1)
    assert error.mean() < 0.01
    write_calibration(tmp_path / "out", result)
    assert convert(paths[0].parent, tmp_path / "capture", lights_file=tmp_path / "out" / "lamps.dome").warnings
    capture = load_capture(tmp_path / "capture")
    assert capture.settings.lights.kind == "position_mm"
    assert capture.settings.pixel_pitch_mm == pytest.approx(1000 / focal, rel=2e-3)
    np.testing.assert_allclose(capture.lights.vectors, positions, rtol=1e-6, atol=1e-5)
    (tmp_path / "open").mkdir()
    (tmp_path / "open" / "capture.yaml").write_text("format: 1\nlights: {file: x.lp}\n")
    put_into_capture(tmp_path / "open", result)
    assert "lamps_mm.lp" in (tmp_path / "open" / "capture.yaml").read_text()
    assert (tmp_path / "open" / "lamps_mm.lp").is_file()


@pytest.mark.slow
def test_falloff_on_a_board_refines_positions(three_spheres):
    paths, boards, truth, focal = three_spheres
    column, row = 379.5 - 3200 * 80 / 985, 259.5 + 3200 * 40 / 985
    given = SphereInput(paths, seeds=[(row, column, 48)], focal_px=focal, radius_mm=15, board=boards)
    result = calibrate_spheres(given)  # one sphere alone gives no distance
    positions = np.array([lamp["position_mm"] for lamp in result.numbers["lamps"]])
    error = np.linalg.norm(positions - truth, axis=1) / np.linalg.norm(truth, axis=1)
    assert error.max() < 0.01


def test_lamps_without_a_usable_highlight_are_left_out_by_name(tmp_path, far_pictures):
    scene = far_scene()
    dark = scene.photograph(FAR[0], size=250.0, glare=0.0)
    result = calibrate_spheres(SphereInput(written(tmp_path / "a", [*far_pictures[:2], dark, *far_pictures[3:]])))
    assert list(result.numbers["left_out"]) == ["lamp03"]
    assert angles_deg(result, np.delete(FAR, 2, axis=0) - [3, -2, 10]).mean() < 0.3
    assert "lamps.dome" not in result.files  # its lamps have no names
    two = scene.photograph(FAR[0], size=250.0, extra=[(FAR[3], 1.0)])
    result = calibrate_spheres(SphereInput(written(tmp_path / "b", [two, *far_pictures[1:]])))
    assert list(result.numbers["left_out"]) == ["lamp01"]
    grazing = scene.photograph(np.array([3500.0, 0, -9900.0]), size=900.0)
    result = calibrate_spheres(SphereInput(written(tmp_path / "c", [grazing, *far_pictures[1:]])))
    assert list(result.numbers["left_out"]) == ["lamp01"]


def test_a_failure_leaves_the_page_with_what_was_examined(tmp_path, far_pictures):
    flat = [np.full((150, 190), 0.05 * (i + 1)) for i in range(6)]
    result = calibrate_spheres(SphereInput(written(tmp_path / "flat", flat)))
    assert result.failure
    assert not result.lines
    write_calibration(tmp_path / "out", result)
    assert (tmp_path / "out" / "calibration.html").stat().st_size > 1000
    assert calibrate_spheres(SphereInput(written(tmp_path / "one", far_pictures), count=4)).failure


def test_bad_input_is_refused(tmp_path, far_pictures):
    paths = written(tmp_path / "a", far_pictures)
    for wrong, text in (
        ({"focal_px": -1.0}, "--focal-px"),
        ({"radius_mm": 0.0}, "--radius-mm"),
        ({"board": paths[:2], "radius_mm": 1.0}, "--board"),
    ):
        with pytest.raises(UserError, match=text):
            calibrate_spheres(SphereInput(paths, **wrong))


@pytest.mark.parametrize("focal", [None, 900.0])
def test_a_pixel_shows_the_direction_that_is_seen_there(focal):
    camera = SphereCamera.of(400, 500, focal)
    parameters = np.array([260.0, 190.0, 70.0])
    if focal is not None:
        centre = np.array([12.0, -7.0, -200.0])
        parameters = centre / np.linalg.norm(centre) / np.sqrt(1 - (15 / np.linalg.norm(centre)) ** 2)
        np.testing.assert_allclose(sphere_of(parameters, camera, 15.0)[0], centre)
    column, row = outline_points(parameters, camera).mean(axis=0)
    pixels = np.array([column, row]) + np.random.default_rng(0).uniform(-25, 25, (20, 2))
    for pixel, direction in zip(pixels, reflected_rays(pixels, parameters, camera, 15.0)[1], strict=True):
        np.testing.assert_allclose(pixel_of_direction(direction, parameters, camera, 15.0), pixel, atol=1e-6)


def test_means_over_lamps_and_places_do_not_count():
    random = np.random.default_rng(2)
    both = random.normal(size=(5, 1)) + random.normal(size=(1, 7))
    assert np.abs(_centre(both)).max() < 1e-12


@pytest.mark.data
def test_measured_chrome_sphere_agrees_with_its_published_lamps(data):
    folder = data / "uw_chrome"
    paths = sorted(path for path in folder.glob("chrome.*.png") if "mask" not in path.name)
    paths.sort(key=lambda path: int(path.name.split(".")[1]))
    given = SphereInput(paths, mask=folder / "chrome.mask.png", compare=folder / "lights.lp")
    assert calibrate_spheres(given).numbers["comparison"]["mean_deg"] < 3.3  # the list itself is that uncertain


def test_the_end_of_a_reflected_shadow_is_not_the_rim():
    """On bright ground a ball shows its own shadow in a thin band at its rim, darker than both of its sides."""
    truth, fine = np.array([40.3, 38.8, 24.0]), 4
    row, column = (np.mgrid[: 80 * fine, : 80 * fine] + 0.5) / fine - 0.5
    away = np.hypot(column - truth[0], row - truth[1])
    turn = np.arctan2(row - truth[1], column - truth[0])
    pictures = []
    for k in range(12):
        shadow = np.cos(turn - k * np.pi / 6) > 0.8
        ground = np.where(shadow, 0.02, 0.4)
        seen = np.where(shadow & (away > truth[2] - 0.8), 0.02, 0.34)
        light = np.where(away < truth[2], seen, ground).reshape(80, fine, 80, fine).mean(axis=(1, 3))
        pictures.append(light + np.random.default_rng(k).normal(0, 0.003, light.shape))
    outline = fit_outline(np.float32(pictures), np.add(truth, (0.4, -0.3, -0.5)), SphereCamera.of(80, 80))
    np.testing.assert_allclose(outline.parameters, truth, atol=0.2)
