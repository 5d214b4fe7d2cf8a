"""Tables of a cloth's BRDF, peers recovered from their own values, the facet reading of a known distribution."""

import numpy as np
import pytest
from benchmarks.cloth_peers import Ggx, Ward, fit_peer, peer_of
from benchmarks.cloth_references import TILTS, TURNS, read_facets, smith_masking

from nishiki.brdf.cloth.interface import halves, hemisphere, prediction_error, reciprocity_error
from nishiki.brdf.cloth.store import goniometer_rows
from nishiki.brdf.cloth.yarn_fit import Measured
from nishiki.goniometry.interpolation import evaluate
from nishiki.optional_formats.reflectance_tables import utia_planes
from nishiki.render.cloth import scene
from nishiki.render.cloth.scene import BrdfTable, coordinates, directions

GLOSSY = Ggx(np.array([0.2]), np.array([1.0]), 0.3, 0.5, 1.5)


def direction(theta_deg, phi_deg):
    t, p = np.radians(np.broadcast_arrays(np.asarray(theta_deg, float), np.asarray(phi_deg, float)))
    return np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=-1)


def test_rows_are_those_of_a_capture():
    rows = goniometer_rows(GLOSSY, incident_deg=[(0, 0), (30, 90)], outgoing_deg=[(10, 20), (40, 50), (60, 0)])
    assert rows.shape == (6, 5)
    assert rows[4, :4].tolist() == [30, 90, 40, 50]
    assert rows[4, 4] == pytest.approx(GLOSSY.evaluate(direction(30, 90), direction(40, 50))[0])


def test_utia_planes_are_ordered_channel_light_view():
    planes = utia_planes(GLOSSY)
    assert planes.shape == (3, 6, 48, 6, 48)
    assert planes.nbytes == 288 * 288 * 3 * 8
    expected = GLOSSY.evaluate(direction(30, 15.0), direction(60, 187.5))[0]
    assert planes[1, 2, 2, 4, 25] == pytest.approx(expected)


def measurements(brdf):
    views = hemisphere(8, 16)[0]
    lights = [direction(0, 0), direction(35, 10), direction(60, 100)]
    incident = np.repeat(lights, len(views), axis=0)
    outgoing = np.tile(views, (3, 1))
    return Measured(incident, outgoing, brdf.evaluate(incident, outgoing), incident[:, 2] > 0.9999, False)


@pytest.mark.parametrize(
    ("kind", "x"), [("ward", [-1.6, -0.7]), ("ggx", [-1.5, -0.6, -0.65]), ("ashikhmin_shirley", [3.5, 1.5, -2.9])]
)
def test_peers_are_recovered_from_their_own_values(kind, x):
    truth = peer_of(kind, np.array(x), np.array([0.1, 0.4]), np.array([0.8, 0.8]))
    data = measurements(truth)
    found = fit_peer(kind, data, np.arange(len(data.values)))
    assert np.allclose(found.fit.x[:2], x[:2], atol=0.05)
    assert np.allclose(found.brdf.diffuse, truth.diffuse, rtol=0.05)
    views = hemisphere(10, 20)[0]
    light = direction(50, 60)
    error = prediction_error(views, truth.evaluate(light, views), found.brdf.evaluate(light, views))
    assert error.rms_rel < 0.02


def test_smith_masking_of_ggx_is_the_closed_form():
    alpha = 0.4
    tilt, turn = np.linspace(0, np.pi / 2, TILTS), np.arange(TURNS) * 2 * np.pi / TURNS
    grid = np.stack(np.meshgrid(tilt, turn, indexing="ij"), axis=-1)
    normals = direction(np.degrees(grid[..., 0]), np.degrees(grid[..., 1]))
    z2 = normals[..., 2] ** 2
    density = alpha**2 / (np.pi * (z2 * (alpha**2 - 1) + 1) ** 2)
    found = smith_masking(density, normals, tilt)
    tan2 = np.tan(tilt[:-4]) ** 2
    expected = 2 / (1 + np.sqrt(1 + alpha**2 * tan2))
    assert np.allclose(found[:-4], expected[:, None], rtol=0.02)


def test_facets_of_a_known_distribution_are_read():
    truth = Ggx(np.zeros(1), np.ones(1), 0.25, 0.4, 1.5)
    read = read_facets(lambda views: truth.evaluate(np.array([0, 0, 1.0]), views), index=1.5, diffuse=0.0)
    views = direction([0, 20, 40, 60, 80], 30)
    normal = np.array([0.0, 0, 1])
    assert np.allclose(read.evaluate(normal, views), truth.evaluate(normal, views), rtol=0.02)
    g = halves(normal, views)
    x, y, z = np.moveaxis(g.h, -1, 0)
    density = 1 / (np.pi * 0.1 * ((x / 0.25) ** 2 + (y / 0.4) ** 2 + z * z) ** 2)
    found = evaluate(read._splines[0], g.h)[:4, 0]
    assert np.allclose(found[:4], density[:4], rtol=0.06)
    assert reciprocity_error(read) < 1e-9
    views = hemisphere(8, 16)[0]
    for theta, most in ((15, 0.03), (45, 0.15)):
        light = direction(theta, 50)
        error = prediction_error(views, truth.evaluate(light, views), read.evaluate(light, views))
        assert error.rms_rel < most


RANDOM = np.random.default_rng(4)


def random_directions(count, *, least=0.02):
    """Directions above the horizon, denser towards it than a cosine would have them."""
    z = RANDOM.uniform(least, 1, count)
    turn = RANDOM.uniform(0, 2 * np.pi, count)
    level = np.sqrt(1 - z * z)
    return np.stack([level * np.cos(turn), level * np.sin(turn), z], axis=1)


def test_directions_come_back():
    incident, outgoing = random_directions(4000), random_directions(4000)
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
    incident, outgoing = random_directions(20_000, least=0.1), random_directions(20_000, least=0.1)
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
