"""Relightable images of a painting, shown as their viewers show them."""

import json
import math

import numpy as np
import pytest
from PIL import Image
from relightable_images import corners
from small_painting import COLUMNS, ROWS, dome, exported_painting

from nishiki.colour.colour import srgb_encode
from nishiki.formats.banded_pictures import read_full_resolution, read_jpeg, write_deep_zoom
from nishiki.formats.relight import gaussian_weights, grid_directions
from nishiki.observations.plane import Observations
from nishiki.stages.export.light_models import (
    WIDTHS,
    GridModel,
    HarmonicModel,
    chosen_width,
    principal_components,
    ptm_weights,
    solve,
)
from nishiki.stages.export.scene import CodedPhotographs, ExportedScene, GridPictures

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The painting, the folder of its exports, and what the stage reports."""
    with exported_painting(tmp_path_factory.mktemp("painting"), ("relight",), relight={"single_file": True}) as made:
        yield made


def pixels_of(path):
    with Image.open(path) as picture:
        return np.asarray(picture)


def rbf_weights(info, lights, light):
    """Weights of the captured lights (n, 3) by sigma, as relight's viewers compute them."""
    weights = np.exp(-np.sum((lights - light) ** 2, axis=1) / info["sigma"] ** 2)
    weights[weights <= 0.001 * weights.sum()] = 0
    return weights / weights.sum()


def table_weights(info, weights):
    """(planes + 1, 3) of the table in info.json, under weights of its directions."""
    basis = np.array(info["basis"], float).reshape(info["nplanes"] + 1, len(weights), 3)
    basis[0] /= 255
    basis[1:] = (basis[1:] - 127) / np.array(info["materials"][0]["range"])[:, None, None]
    return np.einsum("l,plk->pk", weights, basis)


def viewer_weights(info, light):
    """Weights (planes + 1, 3) of the mean and the planes as OpenLIME's shader computes them from info.json."""
    x, y, z = light
    if info["type"] == "bilinear":
        side, around = info["resolution"], corners(info["resolution"], light)
        weights = np.array([around.get(node, 0.0) for node in range(side * side)])
        return table_weights(info, weights)
    if info["type"] == "rbf":
        lights = np.array(info["lights"]).reshape(-1, 3)
        return table_weights(info, rbf_weights(info, lights, light))
    if info["type"] == "ptm":
        bases = [1, x, y, x * x, x * y, y * y]
    else:
        phi, theta = np.arctan2(y, x), min(np.arccos(z), 3.1415 / 2 - 0.15)
        cosine, pi = np.cos(theta), np.pi
        root = np.sqrt(cosine - cosine**2)
        bases = [
            *(1 / np.sqrt(2 * pi), np.sqrt(6 / pi) * np.cos(phi) * root),
            *(np.sqrt(3 / (2 * pi)) * (2 * cosine - 1), np.sqrt(6 / pi) * root * np.sin(phi)),
            np.sqrt(30 / pi) * np.cos(2 * phi) * (-cosine + cosine**2),
            np.sqrt(30 / pi) * np.cos(phi) * (2 * cosine - 1) * root,
            np.sqrt(5 / (2 * pi)) * (1 - 6 * cosine + 6 * cosine**2),
            np.sqrt(30 / pi) * (2 * cosine - 1) * root * np.sin(phi),
            np.sqrt(30 / pi) * (-cosine + cosine**2) * np.sin(2 * phi),
        ]
    return np.concatenate([np.zeros((1, 3)), np.kron(np.array(bases)[:, None], np.eye(3))])


def shown_by_viewer(folder, light):
    """(rows, columns, 3): what OpenLIME computes from a relight folder for a light."""
    info = json.loads((folder / "info.json").read_text())
    count = info["nplanes"]
    planes = [pixels_of(folder / f"plane_{n}.jpg") for n in range(-(-count // 3))]
    texels = np.concatenate(planes, axis=-1)[..., :count] / 255
    material = info["materials"][0]
    coefficients = (texels - material["bias"]) * np.array(material["scale"])
    weights = viewer_weights(info, light)
    return weights[0] + coefficients @ weights[1:]


KINDS = [("ptm", 34), ("hsh", 34), ("rbf", 25), ("bilinear", 30)]


@pytest.mark.parametrize(("kind", "least"), KINDS)
def test_a_relightable_image_shows_the_photographs_in_a_viewer(exported, kind, least):
    painting, folder = exported.painting, exported.folder / f"relight_{kind}"
    figures = exported.reported["losses"]["relight"]["kinds"][kind]["psnr_db"]
    wavelengths = [45, 28, 8]
    channels = painting.reflectance()[..., wavelengths]
    squares = []
    for light in painting.lights[-3:]:
        linear = np.maximum(painting.normals @ light, 0)[..., None] * channels
        difference = np.clip(shown_by_viewer(folder, light), 0, 1) - srgb_encode(linear)
        squares.append(np.mean(difference**2))
    decibels = -10 * np.log10(np.mean(squares))
    assert decibels == pytest.approx(figures["check"]["all"], abs=0.3)
    assert decibels > least
    assert figures["fitted"]["all"] > least
    assert figures["check"]["lights"] == 3


def test_values_of_the_grid_s_nodes_are_the_model_s_put_right_by_the_photographs(exported):
    """Node by node and pixel by pixel; the correction by the stacked equations that it solves."""
    frames = Observations(exported.painting.inputs["ingest"].folder)
    lights = frames.fit_lights()
    pictures = GridPictures(frames, ExportedScene(exported.painting.inputs), lights)
    rows, values, _ = next(pictures.strips(slice(20, 22), lights))
    _, photographs, valid = next(CodedPhotographs(frames, pictures._scene).strips(slice(20, 22), lights))
    drawn = pictures.render_model(pictures.fitted_model(rows)[0], slice(None))
    captured, count = frames.directions[lights], len(lights)
    nodes = [(math.cos(turn), math.sin(turn)) for turn in (-math.pi / 2, 0, math.pi, math.pi / 2)]
    places = grid_directions(8)
    np.testing.assert_allclose(places[[0, 7, 56, 63], :2], nodes, atol=1e-12)
    around = [corners(8, light) for light in captured]
    shown = np.array([[each.get(node, 0.0) for node in range(64)] for each in around])
    for pixel in (3, 70):
        assert valid[:, pixel].all()
        first = np.zeros((64, 3))
        for node, (x, y, z) in enumerate(places):
            toward = np.array([x, y, max(z, 0.1)]) / math.sqrt(x * x + y * y + max(z, 0.1) ** 2)
            weights = np.exp(-np.sum((captured - toward) ** 2, axis=1) / 0.3**2)
            weights[weights <= 0.001 * weights.sum()] = 0
            rest = photographs[..., pixel] - drawn[:count, :, pixel]
            first[node] = drawn[count + node, :, pixel] + weights @ rest / weights.sum()
        stacked = np.concatenate([shown, math.sqrt(0.1) * np.eye(64)])
        wanted = np.concatenate([photographs[..., pixel], math.sqrt(0.1) * first])
        expected = np.linalg.lstsq(stacked, wanted, rcond=None)[0]
        np.testing.assert_allclose(values[..., pixel], np.clip(expected, -0.5, 1.5), atol=1e-5)


def test_components_at_nodes_err_least_under_the_lights():
    """Coefficients are those of the stacked least squares over lights and, with little weight, nodes."""
    random = np.random.default_rng(7)
    lights, values = dome(20, 4), np.clip(random.normal(size=(300, 64, 3)) @ np.diag([0.1, 0.2, 0.1]) + 0.5, 0, 1)
    seen = np.moveaxis(values, 0, -1).astype(np.float32)
    model = GridModel.of(lights, seen, np.ones((64, 300), bool), 9)
    shown = np.array([[corners(8, light).get(node, 0.0) for node in range(64)] for light in lights])
    stacked = np.concatenate([shown, math.sqrt(0.006) * np.eye(64)])
    design = np.einsum("rg,pgk->rkp", stacked, model.components).reshape(-1, 9)
    wanted = np.einsum("rg,gk->rk", stacked, values[5] - model.mean).ravel()
    expected = np.linalg.lstsq(design, wanted, rcond=None)[0]
    found = model.fit(seen[..., :8], np.ones((64, 8), bool))
    np.testing.assert_allclose(found[:, 5], expected, rtol=1e-3, atol=1e-4)


def test_widths_and_components_are_those_of_slow_loops():
    random = np.random.default_rng(2)
    lights, values = dome(10, 3), random.uniform(size=(40, 10, 3))
    valid = random.uniform(size=(40, 10)) > 0.2
    errors = []
    for width in WIDTHS:
        total = 0.0
        for left in range(10):
            rest = [number for number in range(10) if number != left]
            predicted = np.einsum("l,nlk->nk", gaussian_weights(lights[rest], lights[left], width), values[:, rest])
            total += ((predicted - values[:, left])[valid[:, left]] ** 2).sum()
        errors.append(total)
    assert chosen_width(lights, np.moveaxis(values, 0, -1), valid.T) == WIDTHS[int(np.argmin(errors))]
    rows = values.reshape(40, -1) - 0.5
    expected = np.linalg.svd(rows, full_matrices=False)[2][:6]
    np.testing.assert_allclose(np.abs(np.sum(principal_components(rows, 6) * expected, axis=1)), 1, atol=1e-9)


def test_a_ptm_file_shows_the_photographs(exported):
    """Decoded as the format's description says, without our reader."""
    data = (exported.folder / "relight_ptm/painting.ptm").read_bytes()
    version, layout, columns, rows, scale, bias, *_ = data.split(b"\n", 6)
    assert (version, layout, int(columns), int(rows)) == (b"PTM_1.2", b"PTM_FORMAT_RGB", COLUMNS, ROWS)
    codes = np.frombuffer(data[-ROWS * COLUMNS * 18 :], np.uint8).reshape(3, ROWS, COLUMNS, 6)[:, ::-1]
    terms = (codes - [int(each) for each in bias.split()]) * np.array([float(each) for each in scale.split()])
    squares = []
    for u, v, w in exported.painting.lights[-3:]:
        shown = (terms @ [u * u, v * v, u * v, u, v, 1]).transpose(1, 2, 0) / 255
        channels = exported.painting.reflectance()[..., [45, 28, 8]]
        linear = np.maximum(exported.painting.normals @ (u, v, w), 0)[..., None] * channels
        squares.append(np.mean((np.clip(shown, 0, 1) - srgb_encode(linear)) ** 2))
    figures = exported.reported["losses"]["relight"]["kinds"]["ptm file"]["psnr_db"]["check"]
    assert -10 * np.log10(np.mean(squares)) == pytest.approx(figures["all"], abs=0.3)
    assert figures["all"] > 34


def test_a_plane_of_light_that_falls_from_the_left_is_brighter_on_slopes_to_the_left(exported):
    left = shown_by_viewer(exported.folder / "relight_ptm", (-0.7, 0, 0.714))
    right = shown_by_viewer(exported.folder / "relight_ptm", (0.7, 0, 0.714))
    change = (left - right).mean(axis=-1).ravel()
    assert np.corrcoef(change, exported.painting.normals[..., 0].ravel())[0, 1] < -0.9
    normals = pixels_of(exported.folder / "relight_ptm/normals.jpg") / 255 * 2 - 1
    assert np.abs(normals - exported.painting.normals)[exported.painting.known].mean() < 0.02


def test_deep_zoom_tiles_hold_the_picture(tmp_path):
    rows, columns = np.mgrid[0:520, 0:300]
    picture = np.stack([rows // 4, columns // 2, (rows + columns) // 8], axis=-1).astype(np.uint8)
    write_deep_zoom(tmp_path, "plane_0", picture, tmp_path, 95)
    assert 'Width="300" Height="520"' in (tmp_path / "plane_0.dzi").read_text()
    levels = sorted(int(path.name) for path in (tmp_path / "plane_0_files").iterdir())
    assert levels == list(range(3))  # 4 tiles of 254 pixels hold 520 rows; OpenLIME asks for level 0 as a single tile
    assert read_jpeg(tmp_path / "plane_0_files/0/0_0.jpg").shape[:2] == (130, 75)
    assert read_jpeg(tmp_path / "plane_0_files/1/0_0.jpg").shape[:2] == (255, 150)
    assert read_jpeg(tmp_path / "plane_0_files/2/1_1.jpg").shape[:2] == (256, 47)
    read = np.concatenate([band for _, band in read_full_resolution(tmp_path, "plane_0", 520, 300)])
    assert np.abs(read.astype(int) - picture).mean() < 1
    assert np.abs(read.astype(int) - picture).max() < 12


def test_samples_that_are_not_valid_do_not_count():
    random = np.random.default_rng(4)
    lights = dome(14, 2)
    true = random.normal(size=(5, 6, 3)) * 0.1
    values = np.einsum("lb,nbk->nlk", ptm_weights(lights), true)
    spoilt, valid = values.copy(), np.ones((5, 14), bool)
    spoilt[2, 3], valid[2, 3] = 9, False
    fitted = solve(ptm_weights(lights), np.moveaxis(spoilt, 0, -1).astype(np.float32), valid.T, np.zeros((6, 6)))
    np.testing.assert_allclose(np.moveaxis(fitted, -1, 0), true, atol=1e-5)


def test_as_many_lights_as_terms_are_not_taken_for_a_perfect_fit():
    lights = dome(9, 1)
    values = np.random.default_rng(3).uniform(size=(9, 3, 50)).astype(np.float32)
    assert HarmonicModel.of("hsh", lights, values, np.ones((9, 50), bool)).ridge > 0
