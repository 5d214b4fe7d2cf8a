"""Relight's method for planes, as the benchmark of relightable images has it, against a slow writing of its rules."""

import math

import numpy as np
import pytest
import relight_planes as relight
from small_painting import dome

SHAPE = (12, 20)


def photographs(lights, gloss=0.0):
    """(pixels, lights, 3) uint8 of a wavy matte surface with some gloss."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]] / 3
    normals = np.stack([0.3 * np.sin(x), 0.3 * np.cos(y + x / 2), np.ones_like(x)], axis=-1).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colours = np.stack([0.5 + 0.3 * np.sin(x + y), 0.4 + 0.2 * np.cos(x), 0.3 + 0.2 * np.sin(y)], -1).reshape(-1, 1, 3)
    half = lights + np.array([0, 0, 1])
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    shining = gloss * np.maximum(normals @ half.T, 0)[..., None] ** 30
    linear = np.maximum(normals @ lights.T, 0)[..., None] * colours + shining
    return np.rint(255 * np.clip(linear, 0, 1) ** (1 / 2.2)).astype(np.uint8)


def slow_node(node, lights):
    """Weights of the lights at one node before the correction: Gaussians, those of little weight left out."""
    weights = [math.exp(-sum((node[k] - light[k]) ** 2 for k in range(3)) / 0.125**2) for light in lights]
    kept = [w if w / sum(weights) > 0.005 else 0.0 for w in weights]
    return [w / sum(kept) for w in kept]


def test_values_at_the_nodes_solve_the_stated_problem():
    """The made matrix minimises |A x - c|^2 + r |x - x0|^2 for every photograph c, but for weights that are cut off."""
    lights = dome(40, 2)
    made, nodes = relight.resampling(lights), relight.grid_directions(relight.SIDE)
    assert nodes[0] == pytest.approx([0, -1, 0])
    assert nodes[7] == pytest.approx([1, 0, 0])
    first = np.array([slow_node(node, lights) for node in nodes])
    between = np.stack([relight.bilinear_weights(relight.SIDE, light) for light in lights])
    rest = between.T @ (between @ made - np.eye(40)) + relight.REGULARISATION * (made - first)
    assert np.abs(rest).max() < 0.03
    assert np.abs(made[(made != 0)]).min() > 0.005


@pytest.mark.parametrize(
    ("kind", "planes", "brightness", "least"),
    [("rbf", 9, None, 27), ("bilinear", 9, None, 27), ("rbf", 9, 5, 27), ("bilinear", 18, 8, 27)],
)
def test_components_show_the_photographs_again(kind, planes, brightness, least):
    lights = dome(60, 1)
    codes = photographs(lights, gloss=0.2)
    made = relight.component_planes(kind, codes, SHAPE, lights, planes, brightness)
    again = made.decoded(made.codes())
    squares = []
    for number, light in enumerate(lights):
        offset, weights = made.transfer(light)
        squares.append(np.mean((offset + again @ weights - codes[:, number] / 255) ** 2))
    assert made.components.shape[0] == planes
    assert -10 * np.log10(np.mean(squares)) > least


def test_polynomials_are_those_of_least_squares():
    lights = dome(20, 3)
    codes = photographs(lights)
    made = relight.terms_planes("ptm", codes, SHAPE, lights)
    terms = [[1, x, y, x * x, x * y, y * y] for x, y, _ in lights]
    expected = np.linalg.lstsq(np.array(terms), codes[7] / 255, rcond=None)[0]
    np.testing.assert_allclose(made.coefficients[7].reshape(6, 3), expected, atol=1e-9)
    offset, weights = made.transfer(lights[4])
    np.testing.assert_allclose(offset + made.coefficients[7] @ weights, expected.T @ terms[4], atol=1e-9)


def test_scales_lie_between_a_plane_s_own_range_and_the_largest():
    scale, bias = relight.ranges(np.array([[0.0, -1.0], [2.0, 0.0], [1.0, -0.5]]))
    assert scale.tolist() == [2.0, 1.5]
    assert (-bias * scale).tolist() == pytest.approx([0.0, -1.0])
