"""Tables of reflection after Dupuy and Jakob against a slow reader of their files, and against the models."""

import struct

import numpy as np
import pytest
from benchmarks.cloth_peers import Ward

from nishiki.brdf.half_vector_table import HalfVectorTable, unwarp, warp
from nishiki.optional_formats.reflectance_tables import bsdf_bytes

WARD = Ward(diffuse=np.array([0.05, 0.04, 0.1]), specular=np.full(3, 0.2), alpha_x=0.5, alpha_y=0.2)
FINE = 400
"""Steps between nodes of the slow integrals."""


def read_bsdf(path):
    """The arrays of a file, heading by heading."""
    data = path.read_bytes()
    assert data[:14] == b"tensor_file\0\x01\0"
    place, arrays = 18, {}
    for _ in range(struct.unpack_from("<I", data, 14)[0]):
        (length,) = struct.unpack_from("<H", data, place)
        name = data[place + 2 : place + 2 + length].decode()
        place += 2 + length
        axes, kind, start = struct.unpack_from("<HBQ", data, place)
        shape = struct.unpack_from(f"<{axes}Q", data, place + 11)
        place += 11 + 8 * axes
        kind = {1: "u1", 10: "<f4"}[kind]
        arrays[name] = np.frombuffer(data, kind, int(np.prod(shape)), start).reshape(shape)
    return arrays


def bilinear(table, x, y):
    """A table (rows, columns) between its nodes, x and y from 0 to 1."""
    rows, columns = table.shape
    by_row = [np.interp(x * (columns - 1), np.arange(columns), line) for line in table]
    return np.interp(y * (rows - 1), np.arange(rows), by_row)


def neighbours(nodes, value):
    """Numbers and weights of the nodes around a value."""
    weights = np.interp(value, nodes, np.arange(len(nodes)))
    low = min(int(weights), len(nodes) - 2)
    return [(low, 1 - weights + low), (low + 1, weights - low)]


def look_up(arrays, light, eye):
    """f o_z (3,) of a file for two unit vectors above the horizon, by the equations of Dupuy and Jakob, the warp
    inverted by adding up its density in small steps."""
    half = (light + eye) / np.linalg.norm(light + eye)

    def place(v):
        return np.sqrt(np.arccos(min(v[2], 1)) * 2 / np.pi), (np.arctan2(v[1], v[0]) + np.pi) / (2 * np.pi)

    theta, phi = np.arccos(light[2]), np.arctan2(light[1], light[0])
    x, y = place(half)
    around = [
        (b, a, p * q) for b, p in neighbours(arrays["phi_i"], phi) for a, q in neighbours(arrays["theta_i"], theta)
    ]
    density = sum(weight * arrays["vndf"][b, a].astype(float) for b, a, weight in around)
    rows, columns = density.shape
    row = [np.interp(y * (rows - 1), np.arange(rows), column) for column in density.T]
    fine = np.linspace(0, 1, (columns - 1) * FINE + 1)
    along = np.interp(fine * (columns - 1), np.arange(columns), row)
    s = np.trapezoid(along[fine <= x], fine[fine <= x]) / np.trapezoid(along, fine)
    totals = np.trapezoid(density, dx=1 / (columns - 1), axis=1)
    fine = np.linspace(0, 1, (rows - 1) * FINE + 1)
    up = np.interp(fine * (rows - 1), np.arange(rows), totals)
    t = np.trapezoid(up[fine <= y], fine[fine <= y]) / np.trapezoid(up, fine)
    q = [sum(w * bilinear(arrays["rgb"][b, a, channel], s, t) for b, a, w in around) for channel in range(3)]
    return np.array(q) * bilinear(arrays["ndf"], x, y) / (4 * bilinear(arrays["sigma"], *place(light)))


def directions(count, lowest, seed):
    """Unit vectors (count, 3) at least `lowest` above the horizon."""
    random = np.random.default_rng(seed)
    z, phi = random.uniform(lowest, 1, count), random.uniform(-np.pi, np.pi, count)
    return np.column_stack([np.sqrt(1 - z**2) * np.cos(phi), np.sqrt(1 - z**2) * np.sin(phi), z])


@pytest.fixture(scope="module")
def table():
    return HalfVectorTable.of(WARD.evaluate)


def test_a_slow_reader_of_the_file_finds_what_the_table_says(table, tmp_path):
    path = tmp_path / "one.bsdf"
    path.write_bytes(bsdf_bytes(table.arrays("one, Nishiki")))
    arrays = read_bsdf(path)
    assert arrays["description"].tobytes() == b"one, Nishiki"
    assert arrays["jacobian"].tolist() == [1]
    light, eye = directions(25, 0.2, 1), directions(25, 0.2, 2)
    found = np.array([look_up(arrays, i, o) for i, o in zip(light, eye, strict=True)])
    expected = table.evaluate(light, eye) * eye[:, 2:]
    np.testing.assert_allclose(found, expected, rtol=5e-3, atol=1e-3 * expected.max())


def test_the_table_is_near_the_model(table):
    light, eye = directions(4000, 0.25, 3), directions(4000, 0.25, 4)
    truth = WARD.evaluate(light, eye)
    wrong = np.abs(table.evaluate(light, eye) - truth) / truth
    assert np.median(wrong) < 0.02
    assert np.percentile(wrong, 95) < 0.12
    assert not table.evaluate(light, eye * [1, 1, -1]).any(), "nothing below the horizon"
    assert not table.evaluate(light * [1, 1, -1], eye).any()


def test_a_surface_that_reflects_nothing():
    black = HalfVectorTable.of(lambda incident, outgoing: np.zeros((len(incident), 3)))
    assert all(np.isfinite(each).all() for each in black.arrays("black").values())
    assert not black.evaluate(directions(50, 0.1, 8), directions(50, 0.1, 9)).any()


def test_the_warp_and_its_inverse():
    random = np.random.default_rng(5)
    densities = random.uniform(0.1, 1, (2, 1, 9, 7))
    s, t = random.uniform(size=(2, 50))
    ones = np.ones(50)
    x, y = warp(densities[1, 0], s, t)
    again = unwarp(densities, [(ones, (ones.astype(int), 0 * ones.astype(int)))], x, y)
    np.testing.assert_allclose(again, (s, t), atol=1e-9)
    even = warp(np.ones((5, 5)), s, t)
    np.testing.assert_allclose(even, (s, t), atol=1e-12)


def test_mitsuba_reads_the_same_values(table, tmp_path):
    mitsuba = pytest.importorskip("mitsuba", reason="Mitsuba 3 is not installed (group path-tracing)")
    mitsuba.set_variant("scalar_rgb")
    path = tmp_path / "one.bsdf"
    path.write_bytes(bsdf_bytes(table.arrays("one")))
    material = mitsuba.load_dict({"type": "measured", "filename": str(path)})
    light, eye = directions(200, 0.05, 6), directions(200, 0.05, 7)
    place = mitsuba.SurfaceInteraction3f()
    found = []
    for i, o in zip(light, eye, strict=True):
        place.wi = mitsuba.Vector3f(*i)
        found.append(np.array(material.eval(mitsuba.BSDFContext(), place, mitsuba.Vector3f(*o))))
    expected = table.evaluate(light, eye) * eye[:, 2:]
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4 * expected.max())
