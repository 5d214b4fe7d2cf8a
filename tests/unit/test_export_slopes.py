"""The slopes inside a texel: what they are, and the gloss that a texel shows with them beside that of its pixels."""

import json
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from small_painting import COLUMNS, ROWS, small_painting

from nishiki.brdf.slopes import isotropic_lobe, slope_covariance
from nishiki.stages.export import ExportSettings
from nishiki.stages.export.look import PaintingSurface
from nishiki.stages.export.scene import ExportedScene

UP = np.array([0.0, 0.0, 1.0])
VARNISHED = np.ones((ROWS, COLUMNS), np.uint8)
VARNISHED[:3] = 0


@pytest.fixture(scope="module")
def painting(tmp_path_factory):
    """Varnished, but for three rows; one corner is unknown."""
    return small_painting(tmp_path_factory.mktemp("slopes"), regions=VARNISHED)


def look_with(painting, step):
    """Textures whose texels have `step` pixels along a side."""
    settings = ExportSettings(gltf={"texture_px": -(-COLUMNS // step)})
    look = PaintingSurface(
        SimpleNamespace(inputs=painting.inputs, settings=settings), ExportedScene(painting.inputs)
    ).look
    assert look.step == step
    return look


@pytest.mark.parametrize("step", [2, 3, 7])
def test_the_covariance_in_a_square_is_that_of_all_slopes_in_its_pixels(painting, step):
    """Each pixel in turn, its slopes spread as its own covariance says."""
    scene = ExportedScene(painting.inputs)
    normals = scene.shading_normals(slice(0, ROWS)).astype(float)
    inside, known = slope_covariance(normals), np.abs(normals).max(axis=-1) > 0
    found = scene.block_slopes(step)
    assert found.shape == (-(-ROWS // step), -(-COLUMNS // step), 3)
    assert 0 < np.count_nonzero(~known) < known.size
    for row, column in np.ndindex(found.shape[:2]):
        square = np.s_[row * step : (row + 1) * step, column * step : (column + 1) * step]
        spread = []
        for normal, (xx, xy, yy) in zip(normals[square][known[square]], inside[square][known[square]], strict=True):
            slope = normal[:2] / normal[2]
            values, axes = np.linalg.eigh([[xx, xy], [xy, yy]])
            for value, axis in zip(values, axes.T, strict=True):
                away = np.sqrt(2 * max(value, 0)) * axis
                spread += [slope + away, slope - away]
        (xx, xy), (_, yy) = np.cov(np.transpose(spread), bias=True) if spread else np.zeros((2, 2))
        np.testing.assert_allclose(found[row, column], [xx, xy, yy], atol=2e-6)


@pytest.mark.parametrize("step", [2, 3])
def test_a_texel_shows_the_mean_gloss_of_its_pixels(painting, step):
    """Slow reference: 6 x 6 facets in each pixel between its neighbours' normals, whose gloss is averaged."""
    look, scene = look_with(painting, step), ExportedScene(painting.inputs)
    gloss = look.gloss.gltf
    alpha = gloss.materials[1].roughness ** 2
    normals = scene.shading_normals(slice(0, ROWS)).astype(float)
    slopes = normals[..., :2] / np.maximum(normals[..., 2:], 0.2)
    places = [(np.arange(6 * length) + 0.5) / 6 - 0.5 for length in (ROWS, COLUMNS)]
    for axis, place in enumerate(places):
        low = np.clip(np.floor(place).astype(int), 0, slopes.shape[axis] - 2)
        part = np.clip(place - low, 0, 1)[(slice(None), None, None) if axis == 0 else (None, slice(None), None)]
        slopes = slopes.take(low, axis) * (1 - part) + slopes.take(low + 1, axis) * part
    facets = np.dstack([slopes, np.ones(slopes.shape[:2])])
    facets /= np.linalg.norm(facets, axis=-1, keepdims=True)
    size = 6 * step
    high, wide = ROWS // step, COLUMNS // step
    texels = look.texels(slice(0, ROWS), COLUMNS).normals.reshape(ROWS, COLUMNS, 3)[::step, ::step][:high, :wide]
    widened = (gloss.roughness[:high, :wide] / 255) ** 2
    inner = np.s_[-(-4 // step) : -1, 8 // step : -1]  # off the matte rows, the unknown corner and the edges
    squares = {"narrow": 0.0, "wide": 0.0}
    for polar, turn in np.radians(list(product((10, 20, 30), (0, 90, 180, 270)))):
        light = np.array([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)])
        half = (light + UP) / np.linalg.norm(light + UP)

        def lit(normals, alpha, light=light, half=half):
            cosines = (np.maximum(normals @ each, 0) for each in (half, light, UP))
            return isotropic_lobe(*cosines, alpha) * np.maximum(normals @ light, 0)

        fine = lit(facets, alpha)[: high * size, : wide * size]
        mean = fine.reshape(high, size, wide, size).mean(axis=(1, 3))[inner]
        for name, width in (("narrow", alpha), ("wide", widened)):
            squares[name] += np.mean((lit(texels, width)[inner] - mean) ** 2) / np.mean(mean**2)
    assert squares["wide"] < 0.3 * squares["narrow"]


@pytest.mark.slow
def test_matte_surfaces_are_not_widened(tmp_path):
    painting = small_painting(tmp_path)
    file = painting.inputs["brdf"].folder / "parameters.json"
    assert isinstance(look_with(painting, 2).gloss.gltf.roughness, np.ndarray)
    parameters = json.loads(file.read_text())
    parameters["regions"][0]["beta"] = [0.0]
    file.write_text(json.dumps(parameters))
    gloss = look_with(painting, 2).gloss.gltf
    assert gloss.roughness == gloss.materials[0].roughness
