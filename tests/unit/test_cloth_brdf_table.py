"""Tables of a cloth's BRDF: coordinates there and back, values at the nodes, and near them, for unlike models."""

import numpy as np
import pytest
from benchmarks.cloth_peers import Ggx, Ward

from nishiki.render.cloth import scene
from nishiki.render.cloth.scene import BrdfTable, coordinates, directions

RANDOM = np.random.default_rng(4)


def hemisphere(count, *, least=0.02):
    """Directions above the horizon, denser towards it than a cosine would have them."""
    z = RANDOM.uniform(least, 1, count)
    turn = RANDOM.uniform(0, 2 * np.pi, count)
    level = np.sqrt(1 - z * z)
    return np.stack([level * np.cos(turn), level * np.sin(turn), z], axis=1)


def test_directions_come_back():
    incident, outgoing = hemisphere(4000), hemisphere(4000)
    back = directions(*coordinates(incident, outgoing))
    np.testing.assert_allclose(back[0], incident, atol=1e-9)
    np.testing.assert_allclose(back[1], outgoing, atol=1e-9)


def test_every_node_is_above_the_horizon():
    square = scene.EDGE * np.linspace(-1, 1, 9)
    axes = np.meshgrid(square, square, [0, scene.OUTERMOST], np.arange(16) / 16, indexing="ij")
    for direction in directions(*(axis.ravel() for axis in axes)):
        assert (direction[:, 2] > 0).all()


@pytest.mark.parametrize(
    "brdf",
    [
        Ward(diffuse=np.array([0.05, 0.1, 0.2]), specular=np.full(3, 0.2), alpha_x=0.5, alpha_y=0.2),
        Ggx(diffuse=np.array([0.3, 0.1, 0.02]), specular=np.ones(3), alpha_x=0.3, alpha_y=0.3, refractive_index=1.5),
    ],
    ids=["ward", "ggx"],
)
def test_the_table_is_near_the_model(brdf):
    (table,) = BrdfTable.of(brdf)
    incident, outgoing = hemisphere(20_000, least=0.1), hemisphere(20_000, least=0.1)
    want = np.broadcast_to(brdf.evaluate(incident, outgoing), (20_000, 3)) * incident[:, 2:]
    errors = np.abs(table.evaluate(incident, outgoing) * incident[:, 2:] - want)
    assert errors.mean() < 0.02 * want.mean()
    assert np.percentile(errors / want.max(axis=0), 99) < 0.01


def test_below_the_horizon_it_is_black():
    (table,) = BrdfTable.of(Ward(diffuse=np.array([0.5]), specular=np.array([0.1]), alpha_x=0.4, alpha_y=0.4))
    up, down = np.array([[0.0, 0.6, 0.8]]), np.array([[0.0, 0.6, -0.8]])
    assert (table.evaluate(up, up) > 0).all()
    assert (table.evaluate(up, down) == 0).all()
    assert (table.evaluate(down, up) == 0).all()
