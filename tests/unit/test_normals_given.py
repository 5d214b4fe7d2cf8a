"""Normals of another program: their axes, their errors, and what is refused."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from refusals import refused

from nishiki.errors import UserError
from nishiki.photometric.interreflection import FacetGrid, lambert
from nishiki.stages.normals.run import AXES, angles, find_given

ROWS, COLUMNS, CORNER = 48, 40, (6, 9)
LAMPS = np.array([(x, y, 1.0) for x in (-0.6, 0, 0.6) for y in (-0.6, 0, 0.6)])
LAMPS /= np.linalg.norm(LAMPS, axis=1, keepdims=True)


def relief(seed=0):
    """Unit normals (ROWS, COLUMNS, 3) that lean to all sides, more along x than along y."""
    rng = np.random.default_rng(seed)
    slopes = cv2.GaussianBlur(rng.standard_normal((ROWS, COLUMNS, 2)), (0, 0), 2) * (5.0, 2.5)
    vectors = np.dstack([slopes, np.ones((ROWS, COLUMNS))])
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def field(normals):
    """Observations of a region of larger photographs, and its facets, whose fit gives these normals."""
    frames = SimpleNamespace(
        shape=(ROWS, COLUMNS),
        attributes={"image_shape": [ROWS + 20, COLUMNS + 20], "region_of_interest": [*CORNER, ROWS, COLUMNS]},
    )
    seen = lambert(normals, LAMPS)
    known = np.ones((ROWS, COLUMNS), bool)
    return frames, FacetGrid(seen, seen[..., 0] > 0, LAMPS, lambda values, valid, directions: (normals, known, valid))


def write(path, vectors, *, whole=True):
    """Write vectors as 16-bit colours, alone or at the field's place in a picture as large as the photographs."""
    codes = np.rint((vectors + 1) / 2 * 65535).astype(np.uint16)
    if whole:
        picture = np.full((ROWS + 20, COLUMNS + 20, 3), 32768, np.uint16)
        picture[CORNER[0] : CORNER[0] + ROWS, CORNER[1] : CORNER[1] + COLUMNS] = codes
        codes = picture
    assert cv2.imwrite(str(path), codes[..., ::-1])
    return path


@pytest.mark.parametrize("number", range(len(AXES)))
def test_axes_are_found_whatever_they_are(tmp_path, number):
    normals = relief()
    path = write(tmp_path / "n.png", normals @ AXES[number], whole=bool(number % 2))
    given, described = find_given(*field(normals), 1, path)
    np.testing.assert_array_equal(given.axes, AXES[number])
    np.testing.assert_allclose(given.at(slice(None)), normals, atol=1e-4)
    assert described["apart_median_deg"] < 0.1
    assert described["correlation"] > 0.99 > 0.2 > described["correlation_next_axes"]


def test_vectors_of_floats_are_read_as_they_are(tmp_path):
    normals = relief()
    vectors = normals.astype(np.float32)
    vectors[20:22] = np.nan  # where there is no object
    cv2.imwrite(str(tmp_path / "n.tiff"), vectors[..., ::-1])
    given, _ = find_given(*field(normals), 1, tmp_path / "n.tiff")
    np.testing.assert_allclose(given.at(slice(3, 9)), normals[3:9], atol=1e-6)
    assert not given.at(slice(20, 22)).any()


def test_the_stated_error_is_at_least_the_angle_between_the_two(tmp_path):
    own = relief()
    other = own + 0.05 * np.random.default_rng(5).standard_normal(own.shape)
    other /= np.linalg.norm(other, axis=-1, keepdims=True)
    other[10:20] = 0
    given, _ = find_given(*field(own), 1, write(tmp_path / "n.png", other, whole=False))
    rows = slice(4, 24)
    maps = {"normals": own[rows].astype(np.float32), "sigma": np.full((20, COLUMNS), 0.01, np.float32)}
    given.into(maps, rows)
    np.testing.assert_allclose(maps["normals"][:6], other[4:10], atol=1e-4)
    np.testing.assert_array_equal(maps["normals"][6:16], own[10:20].astype(np.float32))
    np.testing.assert_array_equal(maps["sigma"][6:16], np.float32(0.01))
    apart = angles(own[rows], maps["normals"])
    assert (maps["sigma"] >= np.maximum(apart, 0.01) - 1e-3).all()


@pytest.mark.parametrize("kind", ["another object", "another size", "flat"])
def test_what_is_no_map_of_the_object_is_refused(tmp_path, kind):
    normals = relief()
    vectors = {
        "another object": relief(seed=1),
        "another size": normals[:-1],
        "flat": np.broadcast_to([0.0, 0.0, 1.0], normals.shape),
    }[kind]
    path = write(tmp_path / "n.png", vectors, whole=False)
    with refused(UserError, by="_read" if kind == "another size" else "find_given"):
        find_given(*field(normals), 1, path)
