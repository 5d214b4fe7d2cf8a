"""Tables of the MERL database become captures: our own export of one, and half vectors worked out one by one."""

import math
import struct
from itertools import product

import numpy as np
import pytest
from refusals import refused

from nishiki.capture.convert import convert
from nishiki.capture.folder import load_capture
from nishiki.formats.problems import CaptureError
from nishiki.optional_formats.reflectance_tables import (
    MERL_BYTES,
    MERL_LIGHTS,
    MERL_SCALE,
    MERL_SHAPE,
    MERL_VIEWS,
    brdf_of,
    merl_bytes,
    merl_directions,
    merl_values,
    read_merl,
)

COLOUR = np.array([0.4, 0.3, 0.2])
MATERIAL = {
    "colour": COLOUR,
    "shading": np.zeros(3),
    "beta": np.array([0.5]),
    "gamma": np.array([0.3]),
    "index": 1.45,
    "transmission": 0.0,
}


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    path = tmp_path_factory.mktemp("merl") / "satin.binary"
    path.write_bytes(merl_bytes(brdf_of(*merl_directions(), **MATERIAL)))
    return path


def unit(theta, phi):
    theta, phi = math.radians(theta), math.radians(phi)
    return np.array([math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)])


def turned(vector, axis, angle):
    """Rodrigues' formula."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return vector * cosine + np.cross(axis, vector) * sine + axis * (axis @ vector) * (1 - cosine)


def cell_of(light, view):
    """Cell of the table by turning the half vector onto the normal, as Rusinkiewicz (1998) describes it."""
    half = (light + view) / np.linalg.norm(light + view)
    theta, phi = math.acos(half[2]), math.atan2(half[1], half[0])
    there = turned(turned(light, np.array([0, 0, 1.0]), -phi), np.array([0, 1.0, 0]), -theta)
    around = math.atan2(there[1], there[0]) % math.pi
    return int(90 * math.sqrt(theta / (math.pi / 2))), int(math.degrees(math.acos(there[2]))), int(math.degrees(around))


def test_every_pair_finds_its_cell():
    """A table whose values number its cells: between the middles of cells the value lies between theirs."""
    places = np.stack(np.meshgrid(*map(np.arange, MERL_SHAPE), indexing="ij"), axis=-1) + 0.5
    random = np.random.default_rng(2)
    lights, views = ([unit(*pair) for pair in random.uniform((2, 0), (80, 360), (300, 2))] for _ in range(2))
    found = merl_values(places, np.array(lights), np.array(views))
    for light, view, values in zip(lights, views, found, strict=True):
        cell = cell_of(light, view)
        assert abs(values[:2] - 0.5 - cell[:2]).max() <= 1  # 0.5 to the middle, 0.5 to the edge of the cell
        if 1 < cell[2] < 178:
            assert abs(values[2] - 0.5 - cell[2]) <= 1


def test_the_middles_of_cells_are_read_exactly_and_what_is_hidden_is_not(exported):
    stored = read_merl(exported, exported.name)
    light, view = merl_directions()
    expected = brdf_of(light, view, **MATERIAL)
    chosen = np.random.default_rng(3).integers(1, np.array(MERL_SHAPE) - 1, (2000, 3))
    rows = tuple(chosen.T)
    found = merl_values(stored, light[rows], view[rows])
    seen = found[:, 0] >= 0
    assert (expected[rows][seen] >= 0).all()
    assert seen.mean() > 0.4
    np.testing.assert_allclose(found[seen], expected[rows][seen], rtol=1e-6)
    around = tuple((chosen[:, None] + np.array(list(product((-1, 0, 1), repeat=3)))).T)
    assert seen[(expected[around][..., 0] >= 0).all(axis=0)].all()


def test_a_table_is_converted_and_says_how_it_was_read(tmp_path, exported):
    made = convert(exported, tmp_path / "c")
    assert (made.geometry, made.photographs) == ("goniometer", len(MERL_LIGHTS) * len(MERL_VIEWS))
    assert {"table-resampled"} <= {note.kind for note in made.warnings}
    capture = load_capture(tmp_path / "c").table
    light, view = (
        np.array([unit(*each) for each in angles]) for angles in (capture.incident_deg, capture.outgoing_deg)
    )
    expected = brdf_of(light, view, **MATERIAL)
    seen = capture.values[:, 0] > 0
    assert seen.mean() > 0.95
    relative = np.abs(capture.values / expected - 1)[seen]
    assert np.median(relative) < 0.003
    assert np.percentile(relative, 99) < 0.05  # near the horizon, where a degree is much


def test_other_files_are_no_such_table(tmp_path, exported):
    content = exported.read_bytes()
    assert len(content) == MERL_BYTES
    assert MERL_SCALE[0] == 1 / 1500
    for broken in (content[:-8], b"\1" + content[1:], b"", content[:7]):
        (tmp_path / "x.binary").write_bytes(broken)
        with refused(CaptureError, MERL_BYTES, len(broken), kind="table-unreadable"):
            convert(tmp_path / "x.binary", tmp_path / "c")
    assert not (tmp_path / "c").exists()
    with refused(CaptureError, kind="layout-unknown"):
        convert(tmp_path, tmp_path / "c")  # a file of another length in a folder is no table


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_values_that_are_not_finite_are_refused_not_hidden(tmp_path, exported, value):
    content = bytearray(exported.read_bytes())
    content[12 + 8 * 1000 : 12 + 8 * 1001] = struct.pack("<d", value)
    (tmp_path / "x.binary").write_bytes(content)
    with refused(CaptureError, "1", "4374000", kind="table-unreadable"):
        convert(tmp_path / "x.binary", tmp_path / "c")
